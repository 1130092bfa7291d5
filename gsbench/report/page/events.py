"""Find the steps at which the schedule changed a run's training, from the config in its record."""

from dataclasses import replace
from typing import Any

from gsbench.config import TrainConfig
from gsbench.errors import InputError
from gsbench.measure.record import Record
from gsbench.measure.schema import parse
from gsbench.report.configurations import iterations
from gsbench.schedule import Schedule

MEANING = {
    "A": "AGR starts",
    "R": "opacities are reset",
    "D": "densification ends",
    "L": "λ starts to be learned",
}
MOST_RESETS = 4  # opacity resets that are marked


def of(record: Record) -> list[tuple[int, str]]:
    """Return the steps of training events, such as an opacity reset, with a letter for each event.

    The list is empty if the config in the run's record cannot be read.
    """
    try:
        steps = _steps(record)
    except (InputError, KeyError, TypeError, AttributeError, ArithmeticError):
        return []  # a record of another version of gsbench, with other config keys
    letters: dict[int, str] = {}
    for step, letter in sorted(steps):
        letters[step] = letters.get(step, "") + letter
    return sorted(letters.items())


def _steps(record: Record) -> list[tuple[int, str]]:
    config = record.provenance.config
    train = parse(TrainConfig, config["train"], "config")
    train = replace(train, iterations=iterations(record) or train.iterations)
    schedule = Schedule(train, sh_degree=0, agr=record.effects.refinement)
    found = [(step, "R") for step in schedule.resets_after[:MOST_RESETS]] + [(schedule.densify_stop, "D")]
    if record.effects.refinement:
        found.append((schedule.scaled(train.refine_from), "A"))
    if _rates(record).get("lambda", {}).get("start", 0) > 0:
        found.append((schedule.scaled(train.lambda_from), "L"))
    return [(step, letter) for step, letter in found if step <= train.iterations]


def _rates(record: Record) -> dict[str, Any]:
    """Return the learning rates of a run's model from the config in its record.

    If the run chose its model automatically (model=auto), these are the rates of the model that was chosen.
    """
    model = record.provenance.config["model"]
    if model.get("candidates"):
        found = record.on_demand.comparison if record.on_demand else None
        choices = {
            one.get("name"): one for group in ("compared", "candidates") for one in model.get(group, {}).values()
        }
        by_screen = model["candidates"]["moving" if record.effects.time else "static"]
        model = choices.get(found.chosen, by_screen) if found else by_screen
    rates: dict[str, Any] = model["lr"]
    return rates
