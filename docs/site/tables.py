"""Write the tables of docs/models.md and docs/config.md from the registry of models, conf/ and the config's schema.

`make docs` runs it; a test fails where a table is not what this writes.
"""

import dataclasses
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import MISSING, DictConfig

from gsbench.config import CONF, Config, register_schema
from gsbench.models import find
from gsbench.models.base import GaussianModel
from gsbench.run.setup import build
from gsbench.scenes.scene import Points

DOCS = Path(__file__).resolve().parents[1]
MARKS = "<!-- written by docs/site/tables.py: {} -->", "<!-- end -->"


def models() -> str:
    """Return a row for each choice of model=, as it is composed for the embedded scenes."""
    register_schema()
    rows = [
        "| `model=` | what it does | observes | AGR | raw geometry | numbers a Gaussian |",
        "| --- | --- | --- | --- | --- | ---: |",
    ]
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        rows += [row_of(path) for path in sorted((CONF / "model").glob("*.yaml"))]
    return "\n".join(rows)


def row_of(path: Path) -> str:
    """Return the row of one file of conf/model/."""
    composed = hydra.compose("config", ["+exp=mini", "scene=suzanne", f"model={path.stem}"])
    name = f"[`{path.stem}`](../conf/model/{path.name})"
    about = " ".join(re.findall("^# (.*)", path.read_text(), re.MULTILINE))
    if composed.model.candidates:
        chosen = " or ".join(f"`{one.name}`" for one in composed.model.candidates.values())
        return f"| {name} | {about} | what the chosen one does: {chosen} | | | |"
    model = find(composed.model.name)
    if path.stem == composed.model.name:
        about = (inspect.getdoc(inspect.getmodule(model)) or "").partition("\n")[0]
    observes = " and ".join(model.observes) or "neither"
    raw = ", ".join(f"`{one}`" for one in dict.fromkeys([*model.centers, *model.geometry]))
    return f"| {name} | {about} | {observes} | {'yes' if composed.agr else 'no'} | {raw} | {numbers(composed)} |"


def numbers(composed: DictConfig) -> int:
    """Count the raw parameters of one Gaussian, without AGR's network, which all share."""
    model: GaussianModel = build(composed)  # type: ignore[arg-type]  # composed by the schema of Config
    points = torch.eye(4, 3)
    model.initialise(Points(points, points), 1.0, torch.Generator())
    return sum(parameter[0].numel() for parameter in model.splats.values())


def config() -> str:
    """Return a table of keys for each part of the config."""
    return "\n\n".join(part(Config, "", "The run"))


def part(kind: Any, prefix: str, title: str) -> Iterator[str]:
    """Yield the heading, the words and the table of a part of the config, then those of the parts below it."""
    comments = dict(re.findall(r"^    (\w+): .*  # (?!type:)(.*)$", inspect.getsource(kind), re.MULTILINE))
    rows, below = ["| key | type | default | |", "| --- | --- | --- | --- |"], []
    for field in dataclasses.fields(kind):
        key = f"{prefix}{field.name}"
        if dataclasses.is_dataclass(field.type):
            below.append((field.type, key))
        else:
            rows.append(f"| `{key}` | {type_of(field)} | {default_of(field)} | {comments.get(field.name, '')} |")
    yield f"## {title}"
    yield inspect.getdoc(kind) or ""
    yield "\n".join(rows)
    for inner, key in below:
        yield from part(inner, f"{key}.", key)


def type_of(field: "dataclasses.Field[Any]") -> str:
    """Name the type of a key."""
    text = field.type.__name__ if isinstance(field.type, type) and not hasattr(field.type, "__args__") else field.type
    return str(text).replace("gsbench.config.", "").replace("typing.", "").replace(" | ", " or ")


def default_of(field: "dataclasses.Field[Any]") -> str:
    """Show the default of a key as YAML has it; nothing where a choice or an experiment gives it."""
    factory = field.default_factory
    value = field.default if factory is dataclasses.MISSING else factory()
    if value == MISSING:
        return ""
    words = {None: "null", True: "true", False: "false", "": "''"}
    return f"`{words[value] if isinstance(value, bool | str | None) and value in words else value}`"


TABLES = {"models": models, "config": config}


def filled(name: str) -> str:
    """Return the page of a table as it should be."""
    first, last = MARKS[0].format(name), MARKS[1]
    before, _, rest = (DOCS / f"{name}.md").read_text().partition(first)
    return f"{before}{first}\n\n{TABLES[name]()}\n\n{last}{rest.partition(last)[2]}"


def main() -> int:
    """Write both pages."""
    for name in TABLES:
        (DOCS / f"{name}.md").write_text(filled(name))
    return 0


if __name__ == "__main__":
    sys.exit(main())
