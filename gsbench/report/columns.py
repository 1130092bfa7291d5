"""The columns of the tables of runs, views and curves; columns.csv says where their numbers are and what they mean.

`gsbench.report.frame` reads records into these tables, and `gsbench.report.study` writes them to files.
"""

import csv
from dataclasses import dataclass, fields
from importlib import resources
from typing import Literal

import msgspec

from gsbench.measure.record import ViewScore


@dataclass(frozen=True)
class RunColumn:
    """A column of `runs`: its name with its unit, and the cells of its row in columns.csv; empty ones are left out."""

    name: str
    kind: Literal["str", "object", "float", "int", "bool", "dict"]
    meaning: str
    place: str = ""  # in record.json; "" if the column is computed from others
    unit: float = 1.0  # the number in a record is divided by it
    title: str = ""  # in tables that are shown; "" for the name
    digits: int | None = 2  # decimals in such tables; None (null): two below ten, else one
    better: Literal["higher", "lower", ""] = ""  # "" if models are not ranked by it


_LINES = (resources.files(__package__) / "columns.csv").read_text().splitlines()
_ROWS = [{key: cell for key, cell in row.items() if cell} for row in csv.DictReader(_LINES)]
RUNS = msgspec.convert(_ROWS, tuple[RunColumn, ...], strict=False)  # cells are texts
PARTS = (  # of a record that differ between runs have a column for each key, such as protocol_eval_split
    ("protocol.", "protocol_"),  # how the run was evaluated
    ("cost.stage_s.", "stage_"),  # the seconds of train_s by stage: stage_raster ..
    ("provenance.config.", "config."),  # all settings; only in runs.csv
)
_NAMES = {column.place: column.name for column in RUNS}
# By column, the score in record.json.
VIEWS = {_NAMES[f"metrics.{score.name}"]: score.name for score in fields(ViewScore) if score.name != "name"}
CURVES = {"iteration": "iteration", "train_s": "seconds", "psnr_val_db": "psnr_val"}
