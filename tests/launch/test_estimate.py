"""How long the rest of a sweep trains: by runs that differ in seed or scene, or not at all."""

import json
from pathlib import Path
from typing import Any

import crowd
import pytest

from gsbench.launch import estimate
from gsbench.launch.__main__ import main
from gsbench.launch.estimate import lines, span
from gsbench.launch.status import RunStatus


def run(folder: Path, model: str, scene: str, seed: int, state: str = "planned", **of: Any) -> RunStatus:
    """A run of a sweep; a finished one has a record which says that it trained for `seconds` on a `machine`."""
    path = folder / f"{model}-{scene}-{seed}" / "record.json"
    if state == "done":
        record = crowd.record(model, scene, seed)
        record["cost"]["train_s"], record["provenance"]["device"] = of.pop("seconds"), of.pop("machine", "EPYC")
        path.parent.mkdir()
        path.write_text(json.dumps(record, default=str))
        of["record"] = str(path)
    return RunStatus(sorted(crowd.overrides(model, scene, seed)), state, **of)


@pytest.fixture
def runs(tmp_path: Path) -> list[RunStatus]:
    """Two seeds and a third on another machine are done; another seed, a scene, a model and a lost run are not."""
    return [
        run(tmp_path, "7dgs", "lego", 0, "done", seconds=3600.0),
        run(tmp_path, "7dgs", "lego", 1, "done", seconds=7200.0),
        run(tmp_path, "7dgs", "lego", 2, "done", seconds=1.0, machine="another"),
        run(tmp_path, "7dgs", "lego", 3),
        run(tmp_path, "7dgs", "trex", 0, "failed"),
        run(tmp_path, "4dgs", "lego", 0),
        run(tmp_path, "3dgs", "lego", 0, "running", step=10, steps=20, seconds_left=1800.0),
        run(tmp_path, "7dgs", "lego", 4, "lost", step=75, steps=100),
    ]


def test_a_run_takes_what_its_like_took(runs: list[RunStatus]) -> None:
    """Catches another model, machine or scene that counts where a seed does, and a resumed run that counts in full."""
    estimated = estimate.estimate(runs)
    assert [(each.seconds, each.least, each.most, each.compared, each.differ) for each in estimated.runs] == [
        (5400.0, 3600.0, 7200.0, 2, "seed"),
        (5400.0, 3600.0, 7200.0, 2, "seed and scene"),
        (None, None, None, 0, None),
        (1800.0, 1800.0, 1800.0, 0, None),
        (1350.0, 900.0, 1800.0, 2, "seed"),
    ]
    assert estimated.done == 3
    assert estimated.machine is not None
    assert estimated.machine.startswith("EPYC")
    assert estimated.hours() == (5400 + 5400 + 1800 + 1350) / 3600
    assert estimated.hours(2) == pytest.approx(1.5 + 0.5)


def test_the_lines_say_by_what_and_what_is_not_known(runs: list[RunStatus]) -> None:
    """Catches hours that leave out runs without a word, or that look exact."""
    text = lines(estimate.estimate(runs), 2)
    assert text[0] == "5 of 8 runs are not done"
    assert "2 by runs that differ in seed, 1 by runs that differ in seed and scene, 1 by their own rate" in text[1]
    assert text[2].startswith("2 hours of training, 2 at a time (1.5 to 2.5 if each takes as long as the fastest or")
    assert "1 (+exp=crowd model=4dgs scene=lego seed=0)" in text[3]
    nothing = lines(estimate.estimate(runs[5:6]), 1)
    assert len(nothing) == 2
    assert "hours" not in nothing[1]


def test_the_longest_begin_first() -> None:
    """Catches a sum over the number of runs at once, which no schedule reaches."""
    assert span([3.0, 1.0, 1.0, 1.0], 2) == 3.0
    assert span([], 4) == 0.0


def test_the_command_reads_a_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches an estimate that no folder of results gives, and a number at once that divides by zero."""
    experiment = crowd.write(51, tmp_path)
    assert main(["estimate", str(experiment), "--json"]) == 0
    estimated = json.loads(capsys.readouterr().out)
    assert estimated["done"] == 49
    assert {each["differ"] for each in estimated["runs"]} == {"seed"}
    assert main(["estimate", str(experiment)]) == 0
    assert "2 of 51 runs are not done" in capsys.readouterr().out
    assert main(["estimate", str(experiment), "--at-once", "0"]) == 2
    assert main(["estimate", str(tmp_path / "none")]) == 2
