"""Adjust the p-values of all comparisons of a report together, so that no two of its sections disagree."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from gsbench.report.configurations import Configuration, Group
from gsbench.report.intervals import LEVEL, Estimate, estimate, holm

Weights = list[tuple[float, Configuration]]  # of a sum of configurations, such as one minus another
Key = tuple[tuple[str, str, float], ...]


@dataclass(frozen=True)
class Tested:
    """A difference of configurations with its interval, and its p-value corrected for all comparisons of the report."""

    difference: Estimate
    p: float  # of no difference, after Holm for the whole family; NaN where no spread is known

    @property
    def known(self) -> bool:
        """Tell whether a spread is known, so that a difference can be tested."""
        return not math.isnan(self.p)

    @property
    def told(self) -> bool:
        """Tell whether the difference is significant: the rule behind "told apart" and "ahead"."""
        return self.p < 1 - LEVEL


class Family:
    """All comparisons of one experiment that a report makes; in each quantity they are adjusted together."""

    def __init__(self, group: Group, asked: Mapping[str, Iterable[Weights]]) -> None:
        """Estimate every difference once, and adjust the p-values of each quantity together.

        Args:
            group: the records of one experiment.
            asked: the differences (weighted sums of configurations) by quantity of `configurations.QUANTITIES`. A
                difference that is asked for twice, or with the opposite sign, counts once.
        """
        self._found = {quantity: _tested(group, quantity, contrasts) for quantity, contrasts in asked.items()}

    def of(self, weights: Weights, quantity: str = "psnr") -> Tested:
        """Return one of the estimated differences, with the sign of these weights.

        Raises:
            KeyError: this difference was not asked for.
        """
        key, sign = _key(weights)
        found = self._found[quantity][key]
        return found if sign > 0 else replace(found, difference=_turned(found.difference))

    def size(self, quantity: str = "psnr") -> int:
        """Return how many comparisons are adjusted together: those of which a spread is known."""
        return sum(tested.known for tested in self._found.get(quantity, {}).values())


def _tested(group: Group, quantity: str, contrasts: Iterable[Weights]) -> dict[Key, Tested]:
    by_key: dict[Key, Weights] = {}
    for weights in contrasts:
        key, sign = _key(weights)
        by_key[key] = weights if sign > 0 else [(-weight, c) for weight, c in weights]
    found = [estimate(group.contrast(weights, quantity)) for weights in by_key.values()]
    adjusted = holm([difference.p for difference in found])
    return {key: Tested(one, p) for key, one, p in zip(by_key, found, adjusted, strict=True)}


def _key(weights: Weights) -> tuple[Key, float]:
    """Return a key that does not depend on the order and the sign of a contrast's terms, and the sign."""
    terms = sorted((c.model, c.variant, weight) for weight, c in weights)
    sign = math.copysign(1.0, terms[0][2])
    return tuple((model, variant, sign * weight) for model, variant, weight in terms), sign


def _turned(of: Estimate) -> Estimate:
    return replace(of, mean=-of.mean)
