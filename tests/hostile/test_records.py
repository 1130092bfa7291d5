"""Hostile records: one that can be written again and reported, or an InputError of one line beside a good record."""

import contextlib
import dataclasses
import io
import json
from pathlib import Path

from make_golden import make
from mutations import damage_bytes, damage_json, double_a_key, replace_file
from workers import Case, Pool, generator, sample

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.report.__main__ import main


def draw(seed: int, folder: Path) -> Case:
    """Draw a record, damaged in its values, its bytes or as a file, and a good one of another experiment beside it."""
    r = generator("records", seed)
    content = json.loads(json.dumps(dataclasses.asdict(make())))
    damage = r.choice(("values", "values", "values", "bytes", "file", "twice"))
    done = [damage_json(r, content) for _ in range(r.choice((0, 1, 1, 2)))] if damage == "values" else []
    data = json.dumps(content).encode()
    if damage in ("bytes", "twice"):
        data, what = (damage_bytes if damage == "bytes" else double_a_key)(r, data)
        done.append(what)
    path = folder / "a" / files.FILE_NAME
    path.parent.mkdir()
    path.write_bytes(data)
    if damage == "file":
        done.append(replace_file(r, path))
    files.write(make(experiment="other"), folder / "b" / files.FILE_NAME)
    return Case("; ".join(done), lambda: check_record(path, folder))


def check_record(path: Path, folder: Path) -> None:
    """Read a record, write it again, and report the folder it is in; a damaged one is named beside the good ones."""
    report, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(report), contextlib.redirect_stderr(errors):
        status = main([str(folder)])
    assert "experiment other, data mini" in report.getvalue()
    assert all(line.isprintable() and len(line) <= 120 for line in report.getvalue().splitlines()[:-1])
    try:
        record = files.read(path)
    except InputError:
        there = path.exists() or path.is_symlink()  # a link to nothing is a damaged record, nothing at all is none
        assert status == (1 if there else 0)
        assert (str(path) in errors.getvalue()) == there
        assert len(errors.getvalue().splitlines()) == there
        raise
    assert status == 0
    assert not errors.getvalue()
    files.write(record, folder / "again.json")
    assert files.read(folder / "again.json") == record


@sample(30, 300)
def test_any_record_is_read_or_an_input_error(count: int, pool: Pool) -> None:
    """Catches a stack trace, a record that is read and cannot be reported, and one damaged record that hides others."""
    pool.check(__name__, count)
