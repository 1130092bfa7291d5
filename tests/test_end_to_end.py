"""From config to table on the embedded scenes: that models of more dimensions earn them, measured, in a short run."""

from pathlib import Path

import pytest
from tiny_run import gsbench

from gsbench.measure import record
from gsbench.report import output
from gsbench.report.frame import load
from gsbench.report.render.text import terminal

SHORT = (
    *("train.iterations=250", "train.densify.every=25", "train.curve_points=1", "data.initial_points=500"),
    *("protocol.renders=30", "protocol.pictures=0"),
)


def metrics_of(run: record.Record) -> dict[str, float]:
    """The metrics that a run has."""
    assert run.metrics is not None, run.reason
    return {name: value for name, value in run.metrics.items() if value is not None}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    done = gsbench("-m", "+exp=mini", "scene=moving-matte,suzanne", "model=3dgs,7dgs", f"results={folder}", *SHORT)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_model_learns_and_time_is_worth_something(results):
    """Catches a model that does not learn, or a time dimension that does nothing where things move."""
    runs = {(run.scene, run.model): metrics_of(run) for run in map(record.read, record.find(results))}
    assert len(runs) == 4
    for metrics in runs.values():
        assert metrics["psnr"] > metrics["psnr_background_only"] + 3  # dB of an empty picture
        assert "psnr_train" in metrics
    for scene in ("moving-matte", "suzanne"):
        assert runs[scene, "7dgs"]["psnr"] > runs[scene, "3dgs"]["psnr"] + 1


def test_the_table_has_every_run_and_the_papers_row(results):
    """Catches a table that drops runs, the average, or the paper's row beside the stand-in scene."""
    folder = results / "mini"
    runs = load(folder)
    assert not runs.faults
    shown = output.shown_sections(runs)
    output.write(runs, folder, shown)
    text = terminal(shown)
    for word in ("moving-matte", "suzanne", "3dgs", "7dgs", "28.26"):
        assert word in text
        assert word in (folder / "table.md").read_text()
    assert max(map(len, text.splitlines())) <= 120
    assert len((folder / "table.csv").read_text().splitlines()) == 1 + 4
