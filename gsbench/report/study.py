"""Write the records of a study as three tables, and read them: runs.csv, views.csv.gz and curves.csv.gz.

A cell of runs.csv is JSON; texts stand without quotes where that is clear. An empty cell is a part that the record of
this run does not have. The columns of `gsbench.report.columns` come first, and what they do not cover follows under its
place in record.json. Numbers keep all their bits, and equal records give equal bytes.
"""

import csv
import gzip
import io
import json
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsbench.errors import InputError, did_you_mean, printable
from gsbench.measure import record as files
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.reading import parse_json, read_file
from gsbench.report.columns import CURVES, PARTS, RUNS, VIEWS

RUNS_FILE, VIEWS_FILE, CURVES_FILE = "runs.csv", "views.csv.gz", "curves.csv.gz"
MAX_TABLE = 1 << 26  # bytes of a table, unpacked; the largest known has less than four million
FORMULA = ("=", "+", "-", "@")  # a spreadsheet computes a text that begins with one of these
_JSON = tuple('"[{-0123456789tfnNI')  # JSON begins with one of these
_BY_PLACE = {column.place: column for column in RUNS if column.place and column.kind != "dict"}
_BY_NAME = {column.name: column for column in _BY_PLACE.values()}

Row = dict[str, str]  # the cells of a row by column


def write(records: Iterable[Record], folder: Path) -> None:
    """Write the tables of some records to a folder.

    Raises:
        InputError: a record would not be read back as it is, for instance because a key has a dot.
    """
    runs: list[Row] = []
    views: list[Row] = []
    curves: list[Row] = []
    records = list(records)
    for i, record in enumerate(records):
        plain = asdict(record)
        scores, points = plain.pop("per_view"), plain.pop("curve")
        key = {"run": str(i)}
        runs.append(key | {name: cell(value) for name, value in _flat(plain)})
        for view in scores:
            numbers = {name: _number(view[field]) for name, field in VIEWS.items()}
            views.append(key | {"view": cell(view["name"])} | numbers)
        curves += [key | dict(zip(CURVES, map(_number, point), strict=True)) for point in points]  # named tuples
    for old, new in zip(records, _records(runs, views, curves, str(folder / RUNS_FILE)), strict=True):
        if new != old:
            raise InputError(f"{folder}: {old.path}: expected a record that tables can hold, got {new}"[:500])
    first = ["run", *_BY_NAME]
    rest = sorted({name for run in runs for name in run} - set(first))
    tables = {RUNS_FILE: _csv(runs, first + rest)}
    for name, rows, columns in ((VIEWS_FILE, views, ["view", *VIEWS]), (CURVES_FILE, curves, list(CURVES))):
        tables[name] = gzip.compress(_csv(rows, ["run", *columns]), mtime=0)
    files_beside = {folder / f"{name}.new": table for name, table in tables.items()}
    try:  # all before the first is replaced: an earlier study stays whole if the disk is full
        for path, table in files_beside.items():
            write_atomically(path, table)
    except BaseException:
        for path in files_beside:
            path.unlink(missing_ok=True)
        raise
    for path in files_beside:
        path.replace(path.with_suffix(""))


def find(root: Path) -> list[Path]:
    """Return the sorted folders of all studies under `root`, without subfolders called "published"."""
    return [path.parent for path in files.find(root, RUNS_FILE)]


def read(folder: Path) -> tuple[list[Record], list[str]]:
    """Read the records of a study, and why damaged ones were left out.

    Raises:
        InputError: a file is missing or damaged, or the files are not of one study.
    """
    runs = _rows(read_file(folder / RUNS_FILE, str(folder / RUNS_FILE), MAX_TABLE), folder / RUNS_FILE)
    views = _rows(_unpacked(folder / VIEWS_FILE), folder / VIEWS_FILE, ("view", *VIEWS))
    curves = _rows(_unpacked(folder / CURVES_FILE), folder / CURVES_FILE, CURVES)
    records, faults = [], []
    for result in _records(runs, views, curves, str(folder / RUNS_FILE)):
        if isinstance(result, Record):
            records.append(result)
        else:
            faults.append(printable(result))
    return records, faults


def _records(runs: list[Row], views: list[Row], curves: list[Row], where: str) -> Iterator[Record | InputError]:
    """Yield the record of each run, or what is wrong with it."""
    by_run: dict[str, tuple[list[Any], list[Any]]] = {run.get("run", ""): ([], []) for run in runs}  # views, curve
    if len(by_run) < len(runs):
        raise InputError(f"{where}: run: expected another number in each row")
    for row in (*views, *curves):
        if row.get("run") not in by_run:
            raise InputError(f"{where}: expected the run {row.get('run')!r:.80}, which the other tables name")
    for row in views:
        scores = {field: _value(row.get(name, "")) for name, field in VIEWS.items()}
        by_run[row["run"]][0].append({"name": _value(row.get("view", ""))} | scores)
    for row in curves:
        by_run[row["run"]][1].append([_value(row.get(name, "")) for name in CURVES])
    for run in runs:
        place = f"{where}: run {run['run']}"
        try:
            plain = _nested({name: text for name, text in run.items() if text and name != "run"}, place)
            plain["per_view"], plain["curve"] = by_run[run["run"]]
            yield files.parsed(plain, place)
        except InputError as error:
            yield error


def _flat(plain: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of a record with the name of its column; an empty object and a list are values."""
    for key, value in plain.items():
        place = f"{prefix}{key}"
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{place}.")
        elif column := _BY_PLACE.get(place):
            yield column.name, value if column.unit == 1 or value is None else value / column.unit
        else:
            yield _swapped(place, PARTS), value


def _nested(cells: Row, where: str) -> dict[str, Any]:
    """Return the record of a row of runs.csv as plain JSON."""
    plain: dict[str, Any] = {}
    for name, text in cells.items():
        value = _value(text)
        column = _BY_NAME.get(name)
        if column and column.unit != 1 and isinstance(value, int | float):
            value = round(value * column.unit)
        place = column.place if column else _swapped(name, ((new, old) for old, new in PARTS))
        *parents, key = place.split(".")
        at = plain
        for parent in parents:
            at = at.setdefault(parent, {})
            if not isinstance(at, dict):
                raise InputError(f"{where}: {name}: expected no value of {parent} itself beside it")
        if key in at:
            raise InputError(f"{where}: {name}: expected one column for {place}")
        at[key] = value
    return plain


def _swapped(name: str, prefixes: Iterable[tuple[str, str]]) -> str:
    """Return a name whose first part is replaced, such as "protocol.resize" as "protocol_resize" by PARTS."""
    return next((f"{new}{name.removeprefix(old)}" for old, new in prefixes if name.startswith(old)), name)


def cell(value: Any) -> str:
    """Return a value as a cell of a CSV file: a clear text as it is, everything else as JSON.

    A text that a spreadsheet would compute, or a terminal obey, is in quotes, with its control characters escaped.
    """
    is_clear = isinstance(value, str) and value.isprintable() and not value.startswith(FORMULA)
    is_clear = is_clear and _value(value) == value  # it is read as the same text
    return value if is_clear else json.dumps(value, allow_nan=False)


def _value(text: str) -> Any:
    """Return the value of a cell; None if it is empty."""
    if text[:1] in _JSON:
        with suppress(InputError):
            return parse_json(text.encode(), "")
    return text or None


def _number(value: float | None) -> str:
    return "" if value is None else repr(value)


def _csv(rows: list[Row], columns: list[str]) -> bytes:
    file = io.StringIO()
    table = csv.DictWriter(file, columns, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return file.getvalue().encode()


def _rows(data: bytes, path: Path, known: Iterable[str] = ()) -> list[Row]:
    """Return the rows of a CSV file, in which every row has all cells; `known`: all columns that it may have."""
    try:
        lines = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        columns, *rows = list(lines) or [[]]
        if len(set(columns)) < len(columns):
            raise ValueError("two columns have one name")
        if "run" not in columns:
            raise ValueError("no column is named run: are cells separated by commas?")
        if known and (others := set(columns) - {"run", *known}):
            raise ValueError(f"column {min(others)[:80]!a} is not known. {did_you_mean(min(others), known)}")
        if short := [n for n, row in enumerate(rows, 2) if len(row) != len(columns)]:
            raise ValueError(f"row {short[0]} has not the {len(columns)} cells of the first")
        return [dict(zip(columns, row, strict=True)) for row in rows]
    except (ValueError, csv.Error) as error:  # also bad UTF-8, and a row with another number of cells
        raise InputError(f"{path}: expected a CSV table: {error}") from None


def _unpacked(path: Path) -> bytes:
    """Return the content of a gzip file of at most MAX_TABLE bytes."""
    packed = zlib.decompressobj(wbits=31)
    try:
        data = packed.decompress(read_file(path, str(path), MAX_TABLE), MAX_TABLE)
    except zlib.error as error:
        raise InputError(f"{path}: expected a gzip file: {error}") from None
    if not packed.eof or packed.unused_data:
        raise InputError(f"{path}: expected one whole gzip file of at most {MAX_TABLE:,} bytes, unpacked")
    return data
