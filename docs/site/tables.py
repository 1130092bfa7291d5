"""Write blocks of README and docs/: models and config keys from the code, results from the reference records.

`make docs` runs it; a test fails where a block is not what this writes.
"""

import inspect
import sys
from collections.abc import Callable
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from gsbench.config import CONF, Config, register_schema
from gsbench.config_key import Key, declared, described
from gsbench.models import find
from gsbench.models.base import GaussianModel
from gsbench.report import blocks
from gsbench.run.setup import build
from gsbench.scenes.scene import Points
from gsbench.usage import first_sentence

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = ROOT / "results" / "published"
MODELS_HEAD = "| `model=` | what it does | observes | numbers a Gaussian |\n| --- | --- | --- | ---: |"
CONFIG_HEAD = "key=default | meaning\n---|---"
MARKS = "<!-- written by docs/site/tables.py: {} -->", "<!-- end -->"


def models() -> str:
    """Return a row for each choice of model=, as it is composed for the embedded scenes."""
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return "\n".join([MODELS_HEAD, *map(row_of, sorted((CONF / "model").glob("*.yaml")))])


def row_of(path: Path) -> str:
    """Return the row of one file of conf/model/: what `--help` says of it, and facts of the model."""
    composed = hydra.compose("config", ["+exp=mini", "scene=suzanne", f"model={path.stem}"])
    name = f"[`{path.stem}`](../conf/model/{path.name})"
    about = first_sentence(path)
    if composed.model.candidates:
        chosen = " or ".join(f"`{candidate.name}`" for candidate in composed.model.candidates.values())
        return f"| {name} | {about} | what the chosen one does: {chosen} | |"
    model = find(composed.model.name)
    observes = " and ".join(model.observes) or "neither"
    return f"| {name} | {about} | {observes} | {numbers(composed)} |"


def numbers(composed: DictConfig) -> int:
    """Count the raw parameters of one Gaussian, without AGR's network, which all share."""
    model: GaussianModel = build(OmegaConf.to_object(composed))  # type: ignore[arg-type]  # a Config, by its schema
    points = torch.eye(4, 3)
    model.initialise(Points(points, points), 1.0, torch.Generator())
    return sum(parameter[0].numel() for parameter in model.splats.values())


def config() -> str:
    """Return a heading, the purpose and a table of keys for each group of the config."""
    groups: dict[str, dict[str, tuple[str, str]]] = {}
    for name, facts in declared(Config).items():
        group = name.partition(".")[0] if "." in name else ""
        rows = groups.setdefault(group, {})
        cells = cells_of(facts)
        alike = next((key for key in rows if rows[key] == cells and is_alike(key, name)), name)  # they share a row
        rows[merged(alike, name)] = rows.pop(alike, cells)
    return "\n\n".join(
        "\n".join([*heading(group), CONFIG_HEAD, *(f"`{name}{cells[0]}` | {cells[1]}" for name, cells in rows.items())])
        for group, rows in groups.items()
    )


def heading(group: str) -> list[str]:
    """Return the title of a group and what it is for."""
    about = inspect.getdoc(described(Config, group).kind if group else Config) or ""
    return [f"## {group or 'The run'}", "", about, ""]


def cells_of(facts: Key) -> tuple[str, str]:
    """Return the default of a key, as `=default`, and its meaning with its range."""
    allowed = facts.range.replace("at least ", "≥").replace(" to ", "–")
    unit = facts.unit and f" {facts.unit}"
    meaning = f"{facts.help} ({allowed}{unit})" if allowed else facts.help
    return (f"={facts.shown}", meaning) if facts.shown else ("", f"{meaning}; required")


def is_alike(first: str, second: str) -> bool:
    """Return whether two keys with equal facts are of groups beside each other, such as two penalties."""
    before, after = first.split("."), second.split(".")
    return len(before) == len(after) > 2 and (before[:-2], before[-1]) == (after[:-2], after[-1])


def merged(first: str, second: str) -> str:
    """Return one name for alike keys: `train.penalties.opacity|size.weight`."""
    if first == second:
        return first
    *group, names, last = first.split(".")
    return ".".join([*group, f"{names},{second.split('.')[-2]}", last])


TABLES: dict[str, dict[str, Callable[[Path], str]]] = {
    "README.md": blocks.README,
    "docs/models.md": {"models": lambda _: models()},
    "docs/config.md": {"config": lambda _: config()},
    "docs/results.md": blocks.RESULTS,
    "docs/tuning.md": {"trials": blocks.trials},
}


def filled(page: str, published: Path = PUBLISHED) -> str:
    """Return a page, named by its path in the project, with its blocks as the records in a folder make them."""
    text = (ROOT / page).read_text()
    for name, write in TABLES[page].items():
        first, last = MARKS[0].format(name), MARKS[1]
        before, mark, rest = text.partition(first)
        assert mark, f"{page}: expected the line {first}"
        text = f"{before}{first}\n\n{write(published)}\n\n{last}{rest.partition(last)[2]}"
    return text


def main() -> int:
    """Write the pages."""
    for page in TABLES:
        (ROOT / page).write_text(filled(page))
    return 0


if __name__ == "__main__":
    sys.exit(main())
