"""Read the numbers of the published records and of trainings through the entries that gsbench has today.

This module alone knows which function of gsbench gives a golden: whoever moves a function changes a line here.
"""

import functools
import hashlib
import math
import re
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import tables as site
from tiny_run import run_here, spec_of

from gsbench.config_roles import training_hash
from gsbench.measure.record import Record
from gsbench.report import frame, paper_tables, reproduction
from gsbench.report.sections import built
from gsbench.train import checkpoint

PUBLISHED = Path(__file__).resolve().parents[2] / "results" / "published"
load = functools.cache(lambda study: frame.load(PUBLISHED / study))
Numbers = dict[str, float]  # by "table/row/column"
WORDS = {"yes": 1.0, "no": 0.0, "unknown": math.nan, "agrees": 1.0, "undecided": 0.0, "differs": -1.0}
# The columns that name a row of a table; other texts than WORDS are free.
NAMES = (
    *("table", "dataset", "row", "experiment", "scene", "model", "method", "variant", "recipe", "source"),
    *("protocol", "budget", "target", "effect", "pair", "quantity"),
)
SECTIONS = (
    *("experiment", "budgets", "frontier", "quality", "effects"),
    *("on_demand", "stages", "pairs", "curves", "lengths"),
)


def numbers(name: str, table: pd.DataFrame) -> Numbers:
    """The numbers of a table; those of rows with one name, such as the points of a curve, are added."""
    values: Numbers = {}
    for row in table.to_dict("records"):
        key = "/".join([name, *(str(row[column])[:40] for column in NAMES if column in row)])
        for column, value in row.items():
            if column not in NAMES and (isinstance(value, int | float) or value in WORDS):
                title = f"{key}/{column}"
                values[title] = values.get(title, 0.0) + float(WORDS.get(value, value))
    return values


def page(study: str) -> Numbers:
    """The tables of all sections of a report."""
    results = load(study)
    assert not results.faults
    return {
        f"{chapter.runs.dataset.iloc[0]}/{key}": value
        for chapter in results.chapters()
        for section in built(chapter)
        if section.key in SECTIONS
        for key, value in numbers(section.key, section.table).items()
    }


def paper(study: str) -> Numbers:
    """The lines of the CSV files of Table 1, Table 2 and the successors."""
    tables = paper_tables.numbers(load(study))
    return {key: value for name, table in tables.items() for key, value in numbers(name, table).items()}


def against(study: str, seeds: Sequence[int], others: Sequence[int]) -> Numbers:
    """The comparison (`--against`) of some seeds of a study with others."""
    results = load(study)
    compared = reproduction.compare(*(results.of(results.runs.seed.isin(which)) for which in (seeds, others)))
    return {"verdict": WORDS[compared.verdict]} | numbers("rows", compared.table)


def blocks() -> dict[str, list[float]]:
    """The numbers in the cells of the tables that are written into README and docs, in order of size."""
    numbers_of: dict[str, list[float]] = {}
    for name in ("README.md", "docs/results.md", "docs/tuning.md"):
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


def identity(words: Sequence[str]) -> dict[str, str]:
    """The folder of a run, which has its variant, and the hash of all that changes its training."""
    run = spec_of(words)
    return {"folder": str(run.folder), "hash": training_hash(run.plain)}


def train(words: Sequence[str]) -> tuple[Record, Path]:
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
    return {
        "parameters": packed.hexdigest(),
        "curve": hashlib.sha256(repr(curve).encode()).hexdigest(),
        "gaussians": str(record.cost.num_gaussians),
        "psnr": repr(record.metrics["psnr"]),
    }
