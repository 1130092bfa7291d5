"""Published studies: three tables that give back every record as it was, and refuse what no study has written."""

import errno
import gzip
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from records import HOSTILE, but, elsewhere, frontier, gates, lost, make

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.curve import Point
from gsbench.measure.record import LengthChoice, OnDemand, Record, Region, Stop, ViewScore
from gsbench.report import frame, study
from gsbench.report.output import publish

TEXTS = (
    *("", "1", "1e5", "1.0 ", "true", "null", "NaN", "[1", '"'),
    *("=1+1", "-2", "+3", "@x", " a,b\n\t", "ü\u202e", HOSTILE),
)


def hard() -> list[Record]:
    """Records whose every kind of value could be read back as another one."""
    config = {"texts": list(TEXTS), "empty": {}, "none": None, "zero": 0, "zeros": 0.0, "yes": True, "tiny": 5e-324}
    config |= {str(i): text for i, text in enumerate(TEXTS)}
    odd = but(
        make("4dgs", seed=2, missing={"psnr_train": "=cmd", "lpips_vgg": ""}),
        per_view=[ViewScore(text, 0.1 + 0.2, lpips_alex=None) for text in TEXTS],
        curve=[Point(1, 0.1, None), Point(2, 1 / 3, 20.0)],
        stop=Stop(2, 1),
        on_demand=OnDemand(gates=gates()),
        length_choice=LengthChoice(10, []),
        regions={"moving": Region("masks", 1, 0.1, "d")},
        exact=["a"],
        dataset=HOSTILE,
        overrides=list(TEXTS),
        metrics={"psnr_train": None, "lpips_vgg": None},
        provenance={"config": config, "data_notes": ["\x1b[31m"], "git_commit": "12e4567"},
    )
    rendered = but(elsewhere(make(), "other", bytes=12_345_678), parts={"score": {"dssim1": 1 / 3}})
    return [make(), rendered, odd, lost(make(seed=1), "=out"), *frontier(("3dgs",), ("suzanne",), 2, views=3)]


def test_a_study_gives_back_its_records(tmp_path):
    """Catches a number that loses bits, a text that becomes a number, a null, and bytes that differ from day to day."""
    records = hard()
    study.write(records, tmp_path / "a")
    back, faults = study.read(tmp_path / "a")
    assert (back, faults) == (records, [])
    assert msgspec.json.encode(back, order="sorted") == msgspec.json.encode(records, order="sorted")  # 1 is not 1.0
    study.write(back, tmp_path / "b")
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    assert not [line for line in (tmp_path / "a/runs.csv").read_text().splitlines() if "\x1b" in line or ",=" in line]


def test_a_record_that_no_table_can_hold_is_refused(tmp_path):
    """Catches a key with a dot, which comes back as two keys, in a study that is already published."""
    with pytest.raises(InputError, match="expected a record that tables can hold"):
        study.write([but(make(), provenance={"config": {"a.b": 1, "a": {"c": 2}}})], tmp_path)
    assert not list(tmp_path.iterdir())


def edited(before: str, after: str) -> Callable[[Path], object]:
    def edit(folder: Path) -> None:
        path = folder / study.RUNS_FILE
        assert before in path.read_text()
        path.write_text(path.read_text().replace(before, after, 1))

    return edit


def packed(name: str, text: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(gzip.compress(text))


@pytest.mark.parametrize(
    ("harm", "fault"),
    [
        (lambda folder: (folder / study.VIEWS_FILE).unlink(), "views.csv.gz: expected a file"),
        (lambda folder: (folder / study.VIEWS_FILE).write_bytes(b"no"), "views.csv.gz: expected a gzip file"),
        (packed(study.CURVES_FILE, b"run\n99\n"), "expected the run '99'"),
        (packed(study.CURVES_FILE, b"run,psnr\n"), "column 'psnr' is not known. Did you mean 'psnr_val_db'?"),
        (packed(study.VIEWS_FILE, b"run,view\n0\n"), "views.csv.gz: expected a CSV table: row 2 has not the 2 cells"),
        (lambda folder: (folder / study.RUNS_FILE).write_bytes(b""), "no column is named run"),
        (packed(study.CURVES_FILE, b"\xff"), "curves.csv.gz: expected a CSV table"),
        (packed(study.CURVES_FILE, b"0" * (study.MAX_TABLE + 1)), "expected one whole gzip file of at most"),
        (edited("\n1,", "\n0,"), "run: expected another number in each row"),
        (edited("run,", "seed,"), "two columns have one name"),
        (edited(",", ";"), "no column is named run: are cells separated by commas?"),
        (edited("\n0,", "\n0,1,"), "expected a CSV table"),
        (edited(",ok,", ",fine,"), "run 0: status"),
        (edited("psnr_db", "psnr_dB"), "run 0: the file: unknown key 'psnr_dB'"),
        (edited("protocol_background", "protocol"), "run 0"),
    ],
)
def test_damaged_tables_are_left_out(harm, fault, tmp_path):
    """Catches a study that was edited by hand, cut off or blown up, and whose numbers are counted or end in a trace."""
    study.write(hard(), tmp_path)
    harm(tmp_path)
    (first, *_) = frame.load(tmp_path).faults
    assert fault in first
    assert "\n" not in first


def test_a_run_is_published_once_and_only_if_it_finished_on_a_clean_commit(tmp_path):
    """Catches a failed or dirty run among published ones, one that is there twice, and one that is lost."""
    to, folder = tmp_path / "published/mini", tmp_path / "mini"

    def published(*records: Record) -> str:
        for record in records:
            files.write(record, folder / str(record.seed) / files.FILE_NAME)
        return publish(folder, to)

    assert "2 runs in" in published(make(seed=0), make(seed=1))
    assert "3 runs in" in published(make(seed=1, psnr=30.0), make(seed=2))
    assert frame.load(to).runs[["seed", "psnr_db"]].to_numpy().tolist() == [[0, 25.0], [1, 30.0], [2, 25.0]]
    before = {path: path.read_bytes() for path in to.iterdir()}
    dirty = [but(make(seed=3), provenance={"git_commit": commit}) for commit in ("0123-dirty", None)]
    for bad in (*dirty, lost(make(seed=3))):
        with pytest.raises(InputError, match="expected finished runs of clean commits"):
            published(bad)
    assert {path: path.read_bytes() for path in to.iterdir()} == before
    for inside in (folder, folder / "x"):
        with pytest.raises(InputError, match="expected a folder outside of"):
            publish(folder, inside)
    files.write(make(), folder / "3" / files.FILE_NAME)
    (folder / "0" / files.FILE_NAME).unlink()
    assert "3 runs in" in publish(folder, folder / files.PUBLISHED / "x")


def test_a_full_disk_leaves_the_earlier_study_whole(tmp_path, monkeypatch):
    """Catches new runs beside the views of before, which are in no table any more."""

    def full(path: Path, data: bytes) -> None:
        if path.name.startswith(study.CURVES_FILE):
            raise OSError(errno.ENOSPC, "No space left on device")
        path.write_bytes(data)

    study.write([make()], tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(study, "write_atomically", full)
    with pytest.raises(OSError, match="No space"):
        study.write(hard(), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_study_that_a_spreadsheet_saved_is_read(tmp_path):
    """Catches a byte order mark in front of the first column's name, and other ends of lines."""
    study.write(hard(), tmp_path)
    runs = tmp_path / study.RUNS_FILE
    before = study.read(tmp_path)
    runs.write_bytes(b"\xef\xbb\xbf" + runs.read_bytes().replace(b"\n", b"\r\n"))
    assert study.read(tmp_path) == before
