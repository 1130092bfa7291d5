"""From config to table on the embedded scenes: that models of more dimensions earn them, measured, in a short run."""

from pathlib import Path

import pytest
from tiny_run import gsbench

from gsbench.measure import record
from gsbench.report import output
from gsbench.report.frame import load
from gsbench.report.render.text import terminal

SHORT = ("train.iterations=250", "train.densify.every=25", "train.curve_points=1", "data.initial_points=500",
         "protocol.renders=30", "protocol.pictures=0")  # fmt: skip


def scores(results: Path) -> dict[tuple[str, str], float]:
    by_run = {}
    for path in record.find(results):
        run = record.read(path)
        assert run.status == "ok", run.reason
        assert run.metrics is not None
        psnr = run.metrics["psnr"]
        assert psnr is not None
        background = run.metrics["psnr_background_only"]
        assert run.metrics["psnr_train"] is not None
        assert background is not None
        assert psnr > background + 3, f"{run.scene} {run.model}: {psnr:.2f} dB, an empty picture has {background:.2f}"
        by_run[run.scene, run.model] = psnr
    return by_run


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    done = gsbench("-m", "+exp=mini", "scene=moving-matte,suzanne", "model=3dgs,7dgs", f"results={folder}", *SHORT)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_model_learns_and_time_is_worth_something(results: Path) -> None:
    """Catches a model that does not learn, or a time dimension that does nothing where things move."""
    psnr = scores(results)
    assert len(psnr) == 4
    assert psnr["moving-matte", "7dgs"] > psnr["moving-matte", "3dgs"] + 1
    assert psnr["suzanne", "7dgs"] > psnr["suzanne", "3dgs"] + 1


def test_the_table_has_every_run_and_the_papers_row(results: Path) -> None:
    """Catches a table that drops runs, the average, or the paper's row beside the stand-in scene."""
    folder = results / "mini"
    runs = load(folder)
    assert not runs.faults
    shown = output.tables(runs)
    output.write(runs, folder, shown)
    text = terminal(shown)
    for word in ("moving-matte", "suzanne", "3dgs", "7dgs", "28.26"):
        assert word in text
        assert word in (folder / "table.md").read_text()
    assert max(map(len, text.splitlines())) <= 120
    assert len((folder / "table.csv").read_text().splitlines()) == 1 + 4
