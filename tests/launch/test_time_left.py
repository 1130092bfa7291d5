"""The time left of a sweep, which each run prints when it ends."""

import re
from pathlib import Path

import pytest
from tiny_run import gsbench, overrides, write_moving_square

from gsbench.launch import plan
from gsbench.launch.plan import Ended, Plan, time_left


def test_the_time_left_is_that_of_the_runs_that_have_not_ended(tmp_path: Path) -> None:
    """Catches runs that were kept and count as trained in no time, runs that failed and are waited for, runs at once
    that are added up, and a line that divides by nothing."""
    plan.write(Plan("local", [[f"seed={i}"] for i in range(10)]), tmp_path)
    assert time_left(tmp_path, 2) == ""
    plan.write_ended(tmp_path, 0, Ended("record.json", None))  # kept
    assert time_left(tmp_path, 2) == ""
    plan.write_ended(tmp_path, 1, Ended("record.json", None, seconds=30.0))
    plan.write_ended(tmp_path, 2, Ended("record.json", None, seconds=50.0))
    assert time_left(tmp_path, 2) == "3 of 10 runs have ended; about 2 min left"
    assert time_left(tmp_path, 1) == "3 of 10 runs have ended; about 5 min left"
    for number in range(3, 9):
        plan.write_ended(tmp_path, number, Ended(None, "it ended without a record"))
    assert time_left(tmp_path, 4) == "9 of 10 runs have ended; about 40 s left"
    plan.write_ended(tmp_path, 9, Ended("record.json", None, seconds=1.0))
    assert time_left(tmp_path, 2) == ""


@pytest.mark.parametrize("launch", [[], ["+launch=parallel", "launch.at_once=1"]])
def test_a_sweep_prints_the_time_left(launch: list[str], tmp_path: Path) -> None:
    """Catches a sweep that says nothing until its end, one that is repeated and expects its kept runs to train, and an
    outcome that a run of a process of its own writes without its record.

    In a process of its own: `+launch=parallel` forks, and a fork of a process with threads can wait for them forever.
    """
    words = overrides(write_moving_square(tmp_path / "data"), tmp_path / "results", "model=3dgs", "train.iterations=2")
    first = gsbench("-m", *words, "seed=0,1", *launch)
    assert first.returncode == 0, first.stderr
    assert len(re.findall(r"1 of 2 runs have ended; about \d+ s left\n", first.stderr)) == 1
    (folder,) = (tmp_path / "results").glob("*/.sweep/*")
    assert [outcome.reason for outcome in plan.read_ended(folder).values()] == [None, None]
    again = gsbench("-m", *words, "seed=0,1", *launch)
    assert again.returncode == 0, again.stderr
    assert "have ended" not in again.stderr
