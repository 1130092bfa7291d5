"""Write blocks of README and docs/: models and config keys from the code, results from the reference records.

`make docs` runs it; a test fails where a block is not what this writes.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import config_tables
import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from gsbench.config import CONF, register_schema
from gsbench.models import find
from gsbench.models.base import GaussianModel
from gsbench.report import blocks
from gsbench.run.setup import build
from gsbench.scenes.scene import Points
from gsbench.usage import first_sentence

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = ROOT / "results" / "published"
MARKS = "<!-- written by docs/site/tables.py: {} -->", "<!-- end -->"


def models() -> str:
    """Return a row for each choice of model=, as it is composed for the embedded scenes."""
    register_schema()
    rows = [
        "| `model=` | what it does | observes | numbers a Gaussian |",
        "| --- | --- | --- | ---: |",
    ]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        rows += [row_of(path) for path in sorted((CONF / "model").glob("*.yaml"))]
    return "\n".join(rows)


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


TABLES: dict[str, dict[str, Callable[[Path], str]]] = {
    "README.md": blocks.README,
    "docs/models.md": {"models": lambda _: models()},
    "docs/config.md": {"config": lambda _: config_tables.tables()},
    "docs/results.md": blocks.RESULTS,
}


def filled(page: str, published: Path = PUBLISHED) -> str:
    """Return a page with its blocks as they should be.

    Args:
        page: its path in the project.
        published: the folder of reference records.
    """
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
