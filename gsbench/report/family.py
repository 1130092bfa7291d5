"""Adjust the p-values of all comparisons in a report together, so that its sections reach the same conclusions."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from gsbench.report.configurations import Configuration, Group
from gsbench.report.intervals import LEVEL, Estimate, estimate, holm

Weights = list[tuple[float, Configuration]]  # a weighted sum of configurations, such as one minus another
Key = tuple[tuple[str, str, float], ...]


@dataclass(frozen=True)
class Tested:
    """An estimated difference between models, and its p-value after adjustment for all comparisons of the report."""

    difference: Estimate
    p: float  # adjusted with Holm's method for all comparisons; NaN if the spread is not known

    @property
    def known(self) -> bool:
        """Tell whether the spread over seeds is known, so that the difference can be tested."""
        return not math.isnan(self.p)

    @property
    def told(self) -> bool:
        """Tell whether the difference is significant; the report then calls two models "told apart" or one "ahead"."""
        return self.p < 1 - LEVEL


class Family:
    """All comparisons that a report makes in one experiment; the p-values of each quantity are adjusted together."""

    def __init__(self, group: Group, asked: Mapping[str, Iterable[Weights]]) -> None:
        """Estimate every difference once, and adjust the p-values of each quantity (such as PSNR) together.

        Args:
            group: the run records of one experiment.
            asked: for each quantity, the differences to test. A difference is a weighted sum of models' results, such
                as the result of one model minus that of another. If a difference is given twice, or with the opposite
                sign, it counts once.
        """
        self._found = {quantity: _tested(group, quantity, contrasts) for quantity, contrasts in asked.items()}

    def of(self, weights: Weights, quantity: str = "psnr") -> Tested:
        """Return one of the estimated differences, with the sign that the given weights have.

        Raises:
            KeyError: the difference was not among those given to the constructor.
        """
        key, sign = _key(weights)
        found = self._found[quantity][key]
        return found if sign > 0 else replace(found, difference=_turned(found.difference))

    def size(self, quantity: str = "psnr") -> int:
        """Return the number of comparisons whose p-values are adjusted together.

        A comparison whose spread is not known has no p-value and does not count.
        """
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
    """Return a key for a weighted sum of models' results, and the sign of the sum.

    The key does not depend on the order of the terms, and it is the same if all terms change their sign.
    """
    terms = sorted((c.model, c.variant, weight) for weight, c in weights)
    sign = math.copysign(1.0, terms[0][2])
    return tuple((model, variant, sign * weight) for model, variant, weight in terms), sign


def _turned(of: Estimate) -> Estimate:
    return replace(of, mean=-of.mean, each=tuple(-mean for mean in of.each))
