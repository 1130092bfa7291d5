"""Say at which steps of a run its schedule changed something, from the config in its record."""

from dataclasses import fields
from typing import Any

from gsbench.config import DensifyConfig, TrainConfig
from gsbench.measure.record import Record
from gsbench.schedule import Schedule

MEANING = {
    "A": "AGR starts",
    "R": "opacities are reset",
    "D": "densification ends",
    "L": "λ starts to be learned",
}
MOST_RESETS = 4  # that are marked


def of(record: Record) -> list[tuple[int, str]]:
    """Return steps and the letters of what happens there, by rising step; nothing where the config does not tell."""
    config = record.provenance.config.get("train")
    try:
        steps = _steps(record, config) if isinstance(config, dict) else []
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return []  # a record of another gsbench, whose config has other keys
    letters: dict[int, str] = {}
    for step, letter in sorted(steps):
        letters[step] = letters.get(step, "") + letter
    return sorted(letters.items())


def _steps(record: Record, config: dict[str, Any]) -> list[tuple[int, str]]:
    densify = DensifyConfig(**_known(DensifyConfig, config["densify"]))
    train = TrainConfig(**_known(TrainConfig, config) | {"densify": densify})
    schedule = Schedule(train, sh_degree=0, agr=record.effects.refinement)
    found = [(step, "R") for step in schedule.resets_after[:MOST_RESETS]] + [(schedule.densify_stop, "D")]
    if record.effects.refinement:
        found.append((schedule.scaled(train.refine_from), "A"))
    if "modulation" in record.provenance.config["model"]["lr"]:
        found.append((schedule.scaled(train.modulation_from), "L"))
    return [(step, letter) for step, letter in found if step <= train.iterations]


def _known(kind: type[TrainConfig | DensifyConfig], config: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a recorded config that this version of gsbench has; those that it lacks have their default."""
    names = {one.name for one in fields(kind)}
    return {key: value for key, value in config.items() if key in names}
