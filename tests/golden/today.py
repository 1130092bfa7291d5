"""Read the numbers of the published records and of trainings through the entries that gsbench has today.

The goldens beside this file name numbers by scene, model and metric, in units. This module alone knows which function
of gsbench gives them: whoever moves a function changes a line here, and no golden.
"""

import hashlib
import math
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import hydra
import tables as site
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from tiny_run import run_here

from gsbench.config import CONF, register_schema
from gsbench.config_roles import training_hash
from gsbench.measure.record import Record
from gsbench.report import frame, frontier, paper_tables, reproduction
from gsbench.report.comparisons import comparisons
from gsbench.report.configurations import groups
from gsbench.report.numbers import numbers
from gsbench.report.page import build
from gsbench.report.page.content import Canvas, DataTable, Runs
from gsbench.report.page.palette import styles
from gsbench.report.tables import build as build_tables
from gsbench.report.tables import load
from gsbench.run.identity import identify
from gsbench.train import checkpoint

PUBLISHED = Path(__file__).resolve().parents[2] / "results" / "published"
Numbers = dict[str, float]  # by "what/scene/model/metric"
UNITS = {"psnr": "psnr_db", "seconds": "train_s", "ms": "frame_ms", "mb": "model_mb"}
VERDICTS = {"agrees": 1.0, "undecided": 0.0, "differs": -1.0}
WORDS = {"yes": 1.0, "no": 0.0, "not known": math.nan}
# Files behind the page: the columns that name a row, and the name of every number in it.
PAGE: dict[str, tuple[list[str], dict[str, str]]] = {
    "frontier.csv": (["scene", "model", "variant"], {
        "seeds": "seeds", "PSNR dB": "psnr_db", "95 % low": "psnr_db low", "95 % high": "psnr_db high",
        "PSNR val dB": "psnr_val_db", "training s": "train_s", "ms a frame": "frame_ms", "MB": "model_mb",
        "slower and worse than another": "dominated"}),
    "time_to_quality.csv": (["scene", "target"], {}),
    "effects.csv": (["effect"], {
        name if not more else f"{name}: {more}": f"{unit} {word}".strip()
        for name, unit in (("dB", "psnr_db"), ("training s", "train_s"), ("ms a frame", "frame_ms"), ("MB", "model_mb"))
        for more, word in (("", ""), ("95 % low", "low"), ("high", "high"), ("significant", "significant"))
    } | {"dB: half width over scenes like these": "psnr_db ± over scenes", "scenes that gain": "scenes gaining",
         "scenes that lose": "scenes losing"}),
    "effects_on_demand.csv": (["scene", "model", "variant"], {
        "seeds": "seeds", "largest p": "largest p", "seeds gated": "seeds gated",
        "Gaussians before": "gaussians before",
        "refined by AGR": "refined", "conditioned": "conditioned", "time frozen": "time frozen",
        "direction frozen": "direction frozen", "static": "static", "removed": "removed", "degree 0": "degree 0",
        "degree 1": "degree 1", "degree 2": "degree 2", "degree 3": "degree 3",
        "% of AGR left out of a frame": "agr left out %", "predicted dB": "predicted_db", "PSNR dB": "psnr_db",
        "95 % low": "psnr_db low", "95 % high": "psnr_db high", "ms a frame before": "frame_ms before",
        "change in ms": "frame_ms change", "low": "frame_ms low", "high": "frame_ms high",
        "MB before": "model_mb before", "MB": "model_mb"}),
    "stages.csv": (["model"], {}),
    "pairs.csv": (["pair"], {
        "dB": "psnr_db", "95 % low": "psnr_db low", "95 % high": "psnr_db high", "better on % of views": "better %",
        "significant": "significant"}),
}  # fmt: skip


@cache
def records(study: str) -> list[Record]:
    """The published runs of a study."""
    read, faults = load(PUBLISHED / study)
    assert not faults
    return read


def table(study: str) -> Numbers:
    """What `--json` has of the result table: means, intervals over seeds and ranks; the paper's rows as shown."""
    runs = records(study)
    built = numbers(runs, build_tables(runs), [])["tables"]
    values: Numbers = {}
    for group, of in zip(groups(runs), built, strict=True):
        for section in of["sections"]:
            scene = "average" if section["title"].startswith("average") else section["title"]
            label = ""
            for row in section["rows"]:
                label = label if row["of_the_paper"] else row["label"]
                key = f"{group.dataset}/{scene}/{label}"
                for name, number in row["numbers"].items():
                    for part in ("mean", "high", "rank"):
                        values[f"{key}/{name} {part}"] = number[part]
                if row["of_the_paper"]:
                    for name, text in row["shown"].items():
                        values[f"{key}/{name} paper"] = first_number(text)
    return values


def paper(study: str) -> Numbers:
    """The lines of the CSV files of Table 1, Table 2 and the successors."""
    values: Numbers = {}
    for name, (_, lines) in paper_tables.build(records(study)).items():
        for line in lines:
            words = ("table", "dataset", "row", "experiment", "scene", "model", "method", "source", "recipe")
            key = "/".join(str(line[word]) for word in words if line.get(word))
            for column, value in line.items():
                if isinstance(value, float | int) and f"{name}/{key}/{column}" not in values:  # the first of equals
                    values[f"{name}/{key}/{column.replace(' (leaks)', '')}"] = float(value)
    return values


def against(study: str, seeds: Sequence[int], others: Sequence[int]) -> Numbers:
    """The comparison (`--against`) of some seeds of a study with others."""
    results = frame.load(PUBLISHED / study)
    sides = [results.of(results.runs.seed.isin(which)) for which in (seeds, others)]
    compared = reproduction.compare(sides[0], sides[1], ("ours", "theirs"))
    values = {"verdict": VERDICTS[compared.verdict]}
    for row in compared.table.to_dict("records"):
        model = f"{row['model']} {row['variant']}".rstrip()
        key = f"{row['dataset']}/{row['scene']}/{model}/{row['quantity']}"
        values[f"{key} verdict"] = VERDICTS[row["verdict"]]
        values |= {f"{key} {part}": row[part] for part in ("difference", "high", "p_holm")}
    return values


def page(study: str) -> Numbers:
    """The CSV files behind the figures of report.html, and the model that it names for each budget."""
    values: Numbers = {}
    runs = records(study)
    for i, group in enumerate(groups(runs)):
        canvas = Canvas(f"g{i}", Runs(), styles(group.series), 0)
        family = comparisons(group)
        for section in build._sections(group, family, PUBLISHED / study, canvas):
            if section.table is not None:
                values |= {f"{group.dataset}/{key}": value for key, value in _of_file(section.table)}
        points = frontier.points(group, group.basis)
        for cost, budget in frontier.BUDGETS:
            if choice := frontier.choose(points, cost, budget, family):
                chosen = choice.point.configuration
                key = f"{group.dataset}/budgets/{UNITS[cost]} {budget:g}/{chosen.model} {chosen.variant}"
                values[f"{key}/psnr_db"] = choice.point.psnr.mean
    return values


def _of_file(of: DataTable) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a file behind the page; curves as the sums of their points."""
    titles = [column.title for column in of.columns]
    rows: list[dict[str, Any]] = [dict(zip(titles, row, strict=True)) for row in of.rows]
    what = of.name.removesuffix(".csv")
    if what == "anytime":
        sums: Numbers = {}
        for row in rows:
            for column, name in (("PSNR val dB", "psnr_val_db"), ("seconds", "train_s")):
                key = f"anytime/{row['scene']}/{row['model']}/{name} sum"
                sums[key] = sums.get(key, 0.0) + row[column]
        yield from sums.items()
    elif of.name in PAGE:
        named, columns = PAGE[of.name]
        for row in rows:
            key = "/".join([what, *(str(row[column]) for column in named)])
            for column in columns or [title for title in titles if title.endswith(" s")]:
                value = row[column]
                number = WORDS[value] if isinstance(value, str) else math.nan if value is None else float(value)
                yield f"{key}/{columns.get(column, column)}", number


def blocks() -> dict[str, list[float]]:
    """The numbers in the cells of the tables that are written into README and docs, in order of size."""
    numbers_of: dict[str, list[float]] = {}
    for name in ("README.md", "docs/results.md"):
        text = site.filled(name)
        for block, body in re.findall(r"<!-- written by \S+ (\w+) -->(.*?)<!-- end -->", text, re.DOTALL):
            lines = [line for line in body.splitlines() if line.startswith("|")]
            under = [line for before, line in zip(["", *lines], lines, strict=False) if before.startswith("|")]
            cells = [cell for line in under for cell in line.strip("|").split("|")[1:]]
            numbers_of[f"{name}/{block}"] = sorted(number for cell in cells for number in all_numbers(cell))
    return numbers_of


def all_numbers(text: str) -> list[float]:
    """The numbers in a text; digits in a name such as 7dgs are none."""
    plain = text.replace("−", "-").replace(",", "").replace("*", "")
    return [float(number) for number in re.findall(r"(?<![\w.=-])[-+]?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w=])", plain)]


def first_number(text: str) -> float:
    """The first number in a cell; NaN if it has none."""
    return next(iter(all_numbers(text)), math.nan)


def identity(words: Sequence[str]) -> dict[str, str]:
    """The folder of a run, which has its variant, and the hash of all that changes its training."""
    register_schema()
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        composed = hydra.compose("config", [*words], return_hydra_config=True)
        choices = OmegaConf.to_container(composed.hydra.runtime.choices)
        OmegaConf.set_struct(composed, False)
        del composed.hydra
        run = identify(composed, choices, words)
    return {"folder": str(run.folder), "hash": training_hash(run.plain)}


def train(words: Sequence[str]) -> tuple[Record, Path]:
    """Train and measure a run in this process."""
    return run_here(*words)


def bits(record: Record, folder: Path) -> dict[str, str]:
    """SHA-256 of the trained parameters and of the curve of PSNR on val; the number of Gaussians and PSNR on test."""
    assert record.status == "ok", record.reason
    state = checkpoint.read(folder / checkpoint.FILE_NAME).state["model"]
    packed = hashlib.sha256()
    for name in sorted(state):
        packed.update(f"{name} {[*state[name].shape]}".encode())
        packed.update(state[name].detach().numpy().tobytes())
    curve = [(point.iteration, point.psnr_val) for point in record.curve]
    assert record.cost is not None
    assert record.metrics is not None
    return {
        "parameters": packed.hexdigest(),
        "curve": hashlib.sha256(repr(curve).encode()).hexdigest(),
        "gaussians": str(record.cost.num_gaussians),
        "psnr": repr(record.metrics["psnr"]),
    }
