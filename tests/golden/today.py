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

import tables as site
from tiny_run import run_here, spec_of

from gsbench.config_roles import training_hash
from gsbench.measure.record import Record
from gsbench.report import frame, paper_tables, reproduction
from gsbench.report.frame import Results
from gsbench.report.section import Section
from gsbench.report.sections import built, experiment
from gsbench.report.sections.budgets import BUDGETS
from gsbench.train import checkpoint

PUBLISHED = Path(__file__).resolve().parents[2] / "results" / "published"
Numbers = dict[str, float]  # by "what/scene/model/metric"
UNITS = {"psnr": "psnr_db", "seconds": "train_s", "ms": "frame_ms", "mb": "model_mb"}
VERDICTS = {"agrees": 1.0, "undecided": 0.0, "differs": -1.0}
WORDS = {"yes": 1.0, "no": 0.0, "unknown": math.nan}
OLD_NAMES = {"gaussians": "num_gaussians", "psnr_db": "psnr", "psnr_moving_db": "psnr_moving",
             "psnr_object_db": "psnr_object", "psnr_best_on_test_db": "psnr_best_on_test"}  # fmt: skip
COSTS = {"dB": "psnr_db", "training s": "train_s", "ms a frame": "frame_ms", "MB": "model_mb"}
SAME = ("refined", "conditioned", "static", "removed", "degree 0", "degree 1", "degree 2", "degree 3", "seeds")
# By section: the name of its numbers, the columns that name a row, and the name of every other column.
PAGE: dict[str, tuple[str, list[str], dict[str, str]]] = {
    "budgets": ("budgets", [], {}),
    "frontier": ("frontier", ["scene", "model", "variant"], {
        name: name for name in ("seeds", "psnr_db", "psnr_val_db", "train_s", "frame_ms", "model_mb", "dominated")}),
    "quality": ("time_to_quality", ["scene", "target"], {}),
    "effects": ("effects", ["effect"], COSTS | {f"{unit}: significant": f"{name} significant" for unit, name in
        COSTS.items()} | {"± over scenes": "psnr_db ± over scenes", "scenes that gain": "scenes gaining",
        "scenes that lose": "scenes losing"}),
    "on_demand": ("effects_on_demand", ["scene", "model", "variant"], {name: name for name in SAME} | {
        "p": "largest p", "gated": "seeds gated", "before": "gaussians before", "time": "time frozen",
        "direction": "direction frozen", "asleep": "agr left out %", "predicted": "predicted_db", "dB": "psnr_db",
        "ms_before": "frame_ms before", "ms": "frame_ms change", "mb_before": "model_mb before", "mb": "model_mb"}),
    "stages": ("stages", ["model"], {}),
    "pairs": ("pairs", ["pair"], {"dB": "psnr_db", "low": "psnr_db low", "high": "psnr_db high", "ahead": "better %",
                                  "significant": "significant"}),
    "curves": ("anytime", [], {}),
}  # fmt: skip


@cache
def chapters(study: str) -> list[Results]:
    """The experiments of a study."""
    results = frame.load(PUBLISHED / study)
    assert not results.faults
    return list(results.chapters())


def table(study: str) -> Numbers:
    """The result table: means, intervals over seeds and ranks; the paper's rows as shown."""
    values: Numbers = {}
    for chapter in chapters(study):
        section = experiment.table(chapter, [])
        names = [name for name in section.shown_columns if name not in ("scene", "model", "seeds")]
        shown = section.shown().to_dict("records")
        dataset, label = chapter.runs.dataset.iloc[0], ""
        for row, texts in zip(section.table.to_dict("records"), shown, strict=True):
            is_paper = row["model"].startswith("paper")
            label = label if is_paper else row["model"]
            scene = "average" if row["scene"].startswith("average") else row["scene"]
            for name in names:
                key = f"{dataset}/{scene}/{label}/{OLD_NAMES.get(name, name)}"
                if is_paper:
                    values[f"{key} paper"] = first_number(texts[section.column(name).title])
                else:
                    values[f"{key} mean"], values[f"{key} high"] = row[name], row[name] + row[f"{name} ±"]
                    values[f"{key} rank"] = row.get(f"{name} rank", 0)
    return values


PAPER = {"psnr_db": "psnr", "psnr_best_on_test_db": "psnr_best_on_test", "gaussians": "num_gaussians"}


def paper(study: str) -> Numbers:
    """The lines of the CSV files of Table 1, Table 2 and the successors."""
    values: Numbers = {}
    for name, table in paper_tables.numbers(frame.load(PUBLISHED / study)).items():
        for line in table.to_dict("records"):
            words = ("table", "dataset", "row", "experiment", "scene", "model", "method", "source", "recipe")
            key = "/".join(str(line[word]) for word in words if line.get(word) and line[word] == line[word])
            is_measured = line.get("row") != "published" and not str(line.get("source")).startswith("paper")
            for column, value in line.items():
                quantity, _, end = column.partition(" ")
                known = isinstance(value, float | int) and column not in words and column != "protocol"
                known &= is_measured or not (end or column == "seeds" or (column == "scenes" and value != value))
                title = f"{PAPER.get(quantity, quantity)} {end}".strip()
                if known and (f"{name}/{key}/{title}" not in values or title == "psnr_best_on_test"):  # first of equals
                    values[f"{name}/{key}/{title}"] = float(value)
    return values


def against(study: str, seeds: Sequence[int], others: Sequence[int]) -> Numbers:
    """The comparison (`--against`) of some seeds of a study with others."""
    results = frame.load(PUBLISHED / study)
    sides = [results.of(results.runs.seed.isin(which)) for which in (seeds, others)]
    compared = reproduction.compare(*sides)
    values = {"verdict": VERDICTS[compared.verdict]}
    for row in compared.table.to_dict("records"):
        model = f"{row['model']} {row['variant']}".rstrip()
        key = f"{row['dataset']}/{row['scene']}/{model}/{row['quantity']}"
        values[f"{key} verdict"] = VERDICTS[row["verdict"]]
        values |= {f"{key} {part}": row[part] for part in ("difference", "high", "p_holm")}
    return values


def page(study: str) -> Numbers:
    """The tables behind the figures of report.html, and the model that it names for each budget."""
    values: Numbers = {}
    for chapter in chapters(study):
        dataset = chapter.runs.dataset.iloc[0]
        for section in built(chapter):
            if section.key in PAGE:
                values |= {f"{dataset}/{key}": value for key, value in _of_section(section)}
    return values


def _of_section(section: Section) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a table behind the page; curves as the sums of their points."""
    what, named, columns = PAGE[section.key]
    if section.key == "curves":
        sums = section.table.groupby(["scene", "model"])[["psnr_val_db", "train_s"]].sum()
        for (scene, model), row in sums.iterrows():
            yield from ((f"anytime/{scene}/{model}/{name} sum", row[name]) for name in row.index)
        return
    for row in section.table.to_dict("records"):
        if section.key == "budgets":
            if isinstance(row["model"], str):
                cost, budget = BUDGETS[row["budget"]]
                yield f"budgets/{cost} {budget:g}/{row['model']} {row['variant']}/psnr_db", row["psnr_db"]
            continue
        key = "/".join([what, *(str(row[name] or "none") for name in named)])
        for name in columns or [name for name in section.shown_columns if name not in named]:
            value = row[name]
            number = WORDS[value] if isinstance(value, str) else float(value)
            title = {"quality": f"{name.removesuffix(', s')} s", "stages": f"{name} s"}.get(
                section.key, columns.get(name, name)
            )
            yield f"{key}/{title}", number
            if f"{name} ±" in row:
                for end, sign in (("low", -1), ("high", 1)):
                    yield f"{key}/{title.removesuffix(' change')} {end}", number + sign * row[f"{name} ±"]


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
    run = spec_of(words)
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
