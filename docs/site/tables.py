"""Write tables of docs/: models and config keys from the code, results from the published records.

`make docs` runs it; a test fails where a table is not what this writes.
"""

import dataclasses
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import hydra
import torch
from omegaconf import MISSING, DictConfig

from gsbench.config import CONF, Config, register_schema
from gsbench.measure.record import FILE_NAME, Record, read
from gsbench.models import find
from gsbench.models.base import GaussianModel
from gsbench.run.setup import build
from gsbench.scenes.scene import Points

DOCS = Path(__file__).resolve().parents[1]
PUBLISHED = DOCS.parent / "results" / "published"
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
    """Return the row of one file of conf/model/."""
    composed = hydra.compose("config", ["+exp=mini", "scene=suzanne", f"model={path.stem}"])
    name = f"[`{path.stem}`](../conf/model/{path.name})"
    about = " ".join(re.findall("^# (.*)", path.read_text(), re.MULTILINE))
    if composed.model.candidates:
        chosen = " or ".join(f"`{one.name}`" for one in composed.model.candidates.values())
        return f"| {name} | {about} | what the chosen one does: {chosen} | |"
    model = find(composed.model.name)
    if path.stem == composed.model.name:
        about = (inspect.getdoc(inspect.getmodule(model)) or "").partition("\n")[0]
    observes = " and ".join(model.observes) or "neither"
    return f"| {name} | {about} | {observes} | {numbers(composed)} |"


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
    rows, below = ["| key | default | |", "| --- | --- | --- |"], []
    for field in dataclasses.fields(kind):
        key = f"{prefix}{field.name}"
        if dataclasses.is_dataclass(field.type):
            below.append((field.type, key))
        else:
            rows.append(f"| `{key}` | {default_of(field)} | {comments.get(field.name, '')} |")
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
    """Show the default of a key as YAML has it, or its type where the default does not tell it."""
    factory = field.default_factory
    value = field.default if factory is dataclasses.MISSING else factory()
    if value == MISSING:
        return type_of(field)
    if value is None:
        return f"`null`, {type_of(field).removesuffix(' or None')}"
    words = {True: "true", False: "false", "": "''"}
    return f"`{words[value] if isinstance(value, bool | str) and value in words else value}`"


def table1() -> str:
    """Return a row for each model of `make table1`, means over the two embedded scenes and three seeds."""
    rows = [
        "| model | PSNR | SSIM | LPIPS-Alex | training, s | FPS | Gaussians |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for model in ("3dgs", "6dgs", "4dgs", "7dgs_noagr", "7dgs", "auto"):
        runs = published("mini", model)
        psnr, similarity, distance = (mean(runs, lambda run, key=key: run.metrics[key]) for key in METRICS)
        seconds, fps, count = (mean(runs, lambda run, key=key: getattr(run.cost, key)) for key in COSTS)
        rows.append(
            f"| {model} | {psnr:.2f} | {similarity:.3f} | {distance:.3f} | {seconds:.1f} | {fps:,.0f} | {count:,.0f} |"
        )
    return "\n".join(rows)


def frontier() -> str:
    """Return PSNR and seconds of each model at each length and capacity, means over two scenes and three seeds."""
    models = ("3dgs", "6dgs", "4dgs", "7dgs_noagr", "7dgs_nodir", "7dgs", "auto")
    rows = [f"| iterations | {' | '.join(models)} |", f"| ---: |{' ---: |' * len(models)}"]
    for title, variant in CASES.items():
        runs = [published("frontier", f"{model}{variant}") for model in models]
        psnr = [mean(one, lambda run: run.metrics["psnr"]) for one in runs]
        shown = [f"**{x:.2f}**" if x == max(psnr) else f"{x:.2f}" for x in psnr]
        seconds = [f"{mean(one, lambda run: run.cost.train_s):.1f}" for one in runs]
        cells = [f"{x}, {s}" for x, s in zip(shown, seconds, strict=True)]
        rows.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(rows)


def published(experiment: str, folder: str) -> list[Record]:
    """Read the published records of an experiment in model folders of that name, of all scenes and seeds."""
    found = [read(path) for path in sorted((PUBLISHED / experiment).glob(f"*/{folder}/seed*/{FILE_NAME}"))]
    assert len(found) == len({(run.scene, run.seed) for run in found}) == RUNS, (
        f"{experiment}/{folder}: {len(found)} runs"
    )
    return found


def mean(runs: list[Record], value: Callable[[Any], float]) -> float:
    """Average a value over runs: the scenes have the same seeds, so this is the mean over scenes too."""
    return fmean(value(run) for run in runs)


METRICS = ("psnr", "ssim", "lpips_alex")
COSTS = ("train_s", "fps", "num_gaussians")
RUNS = 6  # two scenes, three seeds
CASES = {
    "250": ",iterations=250",
    "500": ",iterations=500",
    "1,000": "",
    "1,000, threshold 4e-4": ",densify.grad_threshold=0.0004",
    "1,000, threshold 1e-4": ",densify.grad_threshold=0.0001",
    "2,000": ",iterations=2000",
    "4,000": ",iterations=4000",
}
TABLES = {"models": models, "config": config, "table1": table1, "frontier": frontier}
PAGES = {"models": ("models",), "config": ("config",), "results": ("table1", "frontier")}


def filled(page: str) -> str:
    """Return a page with its tables as they should be."""
    text = (DOCS / f"{page}.md").read_text()
    for name in PAGES[page]:
        first, last = MARKS[0].format(name), MARKS[1]
        before, _, rest = text.partition(first)
        text = f"{before}{first}\n\n{TABLES[name]()}\n\n{last}{rest.partition(last)[2]}"
    return text


def main() -> int:
    """Write the pages."""
    for page in PAGES:
        (DOCS / f"{page}.md").write_text(filled(page))
    return 0


if __name__ == "__main__":
    sys.exit(main())
