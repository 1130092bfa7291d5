"""Say at which steps of a run its schedule changed something, from the config in its record.

The rule is that of gsbench.train.schedule, which needs torch; a test holds the two together.
"""

from typing import Any

from gsbench.measure.record import Record

MEANING = {
    "A": "AGR starts",
    "R": "opacities are reset",
    "D": "densification ends",
    "L": "λ starts to be learned",
}
STEPS_BETWEEN_RESETS = 300  # as in gsbench.train.schedule
MOST_RESETS = 4  # that are marked


def of(record: Record) -> list[tuple[int, str]]:
    """Return steps and the letters of what happens there, by rising step; nothing where the config does not tell."""
    config = record.provenance.config.get("train")
    try:
        steps = _steps(record, config) if isinstance(config, dict) else []
    except (KeyError, TypeError, ZeroDivisionError, OverflowError):
        return []  # a record of another gsbench, whose config has other keys
    letters: dict[int, str] = {}
    for step, letter in sorted(steps):
        letters[step] = letters.get(step, "") + letter
    return sorted(letters.items())


def _steps(record: Record, config: dict[str, Any]) -> list[tuple[int, str]]:
    total, densify = config["iterations"], config["densify"]
    scaled = lambda step: max(1, round(step * total / config["recipe_iterations"]))  # noqa: E731
    stop = scaled(densify["stop"])
    every = max(scaled(densify["reset_every"]), STEPS_BETWEEN_RESETS)
    resets = [done for done in range(every, stop + 1, every) if done + every // 2 <= stop]
    found = [(step, "R") for step in resets[:MOST_RESETS]] + [(stop, "D")]
    if record.effects.refinement:
        found.append((scaled(config["refine_from"]), "A"))
    if "modulation" in record.provenance.config["model"]["lr"]:
        found.append((scaled(config["modulation_from"]), "L"))
    return [(step, letter) for step, letter in found if step <= total]
