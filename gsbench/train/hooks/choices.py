"""Keep in the checkpoint how a training was chosen on val: among lengths (`train.lengths`) or among models."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, cast

from gsbench.config_key import joins, key
from gsbench.errors import InputError
from gsbench.train.hooks import Hook, Training, check_choice_on_val, check_excludes

if TYPE_CHECKING:
    from gsbench.config import Config
    from gsbench.measure.record import LengthChoice, ModelComparison
    from gsbench.scenes import Scene


@joins("train")
@dataclass
class LengthsKey:
    """The key of this hook."""

    lengths: int | None = key(
        None, "4: also train 1/2, 1/4, 1/8 of the iterations; keep the best on val", low=2, high=8
    )


@dataclass
class ChosenOnVal:
    """The comparisons that led to a training; gsbench.run.selection makes them."""

    length: LengthChoice | None = None  # by which `train.lengths` chose this training
    comparison: ModelComparison | None = None  # by which model=auto chose the model (`effects.compare`)

    @property
    def candidate(self) -> str | None:
        """Return the name of the chosen model or length; None if there was no choice."""
        if self.length is not None:
            return length_name(self.length.kept)
        return self.comparison.chosen if self.comparison else None


class Choices(Hook):
    """Keep the choices on val of a training."""

    name = "choices"
    measures = True

    def __init__(self, training: Training) -> None:
        super().__init__(training)
        self.chosen = ChosenOnVal()

    @classmethod
    def check(cls, config: Config) -> None:
        """Raise InputError if the iterations cannot be halved so often, or if models are compared too."""
        lengths, iterations = lengths_of(config), config.train.iterations
        if lengths is None:
            return
        least = 1 << (lengths - 1)
        if iterations < least:
            raise InputError(
                f"train.lengths={lengths}: expected at least {least} iterations to "
                f"halve {lengths - 1} times, got train.iterations={iterations}"
            )
        check_excludes("train.lengths", config, {"effects.compare": "which compares models of one length"})

    @classmethod
    def check_scene(cls, scene: Scene, config: Config) -> None:
        if lengths_of(config) is not None:
            check_choice_on_val("lengths", "length", scene, config)

    def state_dict(self) -> dict[str, Any]:
        return asdict(self.chosen)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.chosen = _parsed(state)

    def results(self) -> dict[str, Any]:
        return {"length_choice": self.chosen.length}


def choices_in(state: dict[str, Any]) -> ChosenOnVal:
    """Return the choices in a training's state, which may come from an untrusted checkpoint.

    Raises:
        InputError: the state does not hold choices as expected.
    """
    hooks = state.get("hooks")
    return _parsed(hooks.get(Choices.name) if isinstance(hooks, dict) else None)


def _parsed(state: object) -> ChosenOnVal:
    """Convert a `state_dict` of Choices, in which a choice that was not asked for is None."""
    from gsbench.measure.record import LengthChoice, ModelComparison
    from gsbench.reading import parse

    kinds = {"length": LengthChoice, "comparison": ModelComparison}
    if not isinstance(state, dict) or state.keys() != kinds.keys():
        raise InputError("checkpoint: expected the choices on val, got none: start over with resume=false")
    return ChosenOnVal(
        **{name: state[name] and parse(kind, state[name], f"checkpoint: {name}") for name, kind in kinds.items()}
    )


def length_name(iterations: int) -> str:
    """Return the name of a length among the candidates of a run."""
    return f"iterations={iterations}"


def lengths_of(config: Config) -> int | None:
    """Return `train.lengths`."""
    return cast(LengthsKey, config.train).lengths
