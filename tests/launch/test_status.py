"""What became of each run of a sweep: by its plan, the record or progress it left, its process, and Slurm's queue."""

import dataclasses
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import crowd
import pytest
from tiny_run import ROOT

from gsbench.launch import plan, status
from gsbench.launch.__main__ import lines, main
from gsbench.launch.plan import Ended, Plan
from gsbench.launch.slurm import Queue
from gsbench.launch.status import RunStatus
from gsbench.run import progress
from gsbench.run.progress import Progress, born

RUN = ("7dgs", "lego", 0)
WORDS = crowd.overrides(*RUN)
HERE = {"host": socket.gethostname(), "pid": os.getpid(), "born": born(os.getpid())}
GONE = {**HERE, "born": 1}  # a later process that was given the number of one that is gone
FIRST, SECOND = "2026-11-22_00-00-00.000000", "2026-11-22_00-00-01.000000"


def planned(experiment: Path, name: str = FIRST, **of: object) -> Path:
    """Write the plan of one run, launched by this process unless told otherwise, and return its folder."""
    one_run = Plan("local", [[*WORDS, "results=somewhere"]])
    folder = experiment / plan.FOLDER / name
    plan.write(dataclasses.replace(one_run, **of), folder)  # type: ignore[arg-type]
    return folder


def run_folder(experiment: Path) -> Path:
    folder = experiment / "lego" / "7dgs" / "seed0"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def recorded(experiment: Path, **changed: object) -> Path:
    path = run_folder(experiment) / "record.json"
    path.write_text(json.dumps(crowd.record(*RUN) | changed, default=str))
    return path


def trains(experiment: Path, **of: object) -> None:
    at = Progress(WORDS, **HERE, job=None, step=100, steps=400, seconds=50.0, psnr_val=21.5)  # type: ignore[arg-type]
    progress.write(run_folder(experiment), dataclasses.replace(at, **of))  # type: ignore[arg-type]


def only(experiment: Path, queue: Queue | None = None) -> RunStatus:
    """The status of the only run there is, with Slurm's queue as given."""
    read = status.read(experiment)
    if queue:
        read.queue = queue
    (run,) = status.status(read)
    return run


def test_a_run_is_planned_then_running_then_done(tmp_path: Path) -> None:
    """Catches a plan, a progress or a record that is not matched to its run, and an ETA of nonsense."""
    planned(tmp_path)
    assert only(tmp_path).state == "planned"
    trains(tmp_path)
    run = only(tmp_path)
    assert (run.state, run.step, run.steps, run.psnr, run.seconds_left) == ("running", 100, 400, 21.5, 150.0)
    recorded(tmp_path)
    os.utime(run_folder(tmp_path) / "record.json", (time.time() + 1, time.time() + 1))  # a left-over progress is older
    run = only(tmp_path)
    assert (run.state, run.psnr) == ("done", crowd.record(*RUN)["metrics"]["psnr"])


@pytest.mark.parametrize(
    ("of", "state"),
    [
        (HERE, "running"),
        (GONE, "lost"),
        ({"host": "elsewhere"}, "running"),
        ({"host": "elsewhere", "updated": time.time() - 660}, "lost"),
    ],
)
def test_a_run_is_lost_when_its_process_is_gone(tmp_path: Path, of: dict[str, object], state: str) -> None:
    """Catches a hard death that is taken for running for ever, and a living run that is taken for lost."""
    trains(tmp_path, **of)
    assert only(tmp_path).state == state


def test_a_process_that_was_killed_is_gone(tmp_path: Path) -> None:
    """Catches a check that asks only whether the process number is in use, zombies included."""
    sleeper = subprocess.Popen(["sleep", "60"])
    trains(tmp_path, pid=sleeper.pid, born=born(sleeper.pid))
    assert only(tmp_path).state == "running"
    sleeper.kill()
    time.sleep(0.2)
    run = only(tmp_path)
    sleeper.wait()
    assert run.state == "lost"
    assert f"process {sleeper.pid}" in str(run.reason)
    assert "step 100 of 400" in str(run.reason)


@pytest.mark.parametrize(
    ("states", "state", "reason"),
    [
        ({"7_0": "PENDING Resources"}, "queued", "Resources"),
        ({"7_0": "RUNNING"}, "running", None),
        ({"7_1": "RUNNING"}, "lost", "at step 100 of 400"),
    ],
)
def test_slurm_decides_about_its_jobs(tmp_path: Path, states: dict[str, str], state: str, reason: str | None) -> None:
    """Catches a requeued job that is taken for running, and a job that Slurm forgot for anything but lost."""
    planned(tmp_path, job="7")
    trains(tmp_path, job="7_0", **GONE)
    run = only(tmp_path, Queue(states))
    assert run.state == state
    assert run.job == "7_0"
    assert reason is None or reason in str(run.reason)


def test_a_job_without_a_trace_is_queued_or_lost(tmp_path: Path) -> None:
    """Catches a submitted run that is planned for ever after its job was cancelled."""
    planned(tmp_path, job="7")
    assert only(tmp_path, Queue({"7_0": "PENDING Priority"})).state == "queued"
    run = only(tmp_path, Queue({}))
    assert (run.state, run.job) == ("lost", "7_0")
    assert "never started" in str(run.reason)


def test_a_slurm_that_is_silent_is_said(tmp_path: Path) -> None:
    """Catches runs that are lost because squeue did not answer."""
    planned(tmp_path, job="7")
    down = Queue({}, "squeue is not on this machine")
    assert only(tmp_path, down).state == "planned"
    trains(tmp_path, job="7_0")
    run = only(tmp_path, down)
    assert run.state == "running"
    assert "squeue is not on this machine" in "\n".join(lines(status.Experiment(tmp_path, queue=down), [run]))


def test_a_job_that_ended_without_a_record_quotes_its_log(tmp_path: Path) -> None:
    """Catches a full disk that is named nowhere: the note of the run's end still fitted, its record did not."""
    folder = planned(tmp_path, job="7")
    plan.log_of(folder, 0).write_text("step 5\ngsbench: error: its record cannot be written: No space left on device\n")
    plan.write_ended(folder, 0, Ended(None, "it ended without a record"))
    run = only(tmp_path, Queue({}))
    assert run.state == "failed"
    assert "it ended without a record; its log ends: gsbench: error: its record" in str(run.reason)
    assert "No space left on device" in str(run.reason)


@pytest.mark.parametrize(
    ("job", "step", "log", "reason"),
    [
        (
            "FAILED|9:0", "OUT_OF_MEMORY|0:125",
            ["step 5", "slurmstepd: error: Detected 1 oom_kill event", "srun: error: n1: task 0: Killed"],
            "job 7_0 ended: OUT_OF_MEMORY; its log ends: slurmstepd: error: Detected 1 oom_kill event",
        ),
        ("FAILED|1:0", "COMPLETED|0:0", ["bar 50 %| gsbench: error: no such file", "bye"],
         "job 7_0 ended: FAILED, exit 1:0; its log ends: gsbench: error: no such file"),
        ("TIMEOUT|0:0", "CANCELLED|0:15", ["step 5", "step 6"], "job 7_0 ended: TIMEOUT; its log ends: step 6"),
    ],
    ids=["memory", "error", "time"],
)  # fmt: skip
def test_a_lost_job_says_how_it_ended(
    job: str, step: str, log: list[str], reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches memory that ran out told as a kill, as only the step of a job knows of it, and a log's last line."""
    bin_of_slurm = tmp_path / "bin"
    bin_of_slurm.mkdir()
    sacct = bin_of_slurm / "sacct"
    sacct.write_text(f"#!/bin/sh\nprintf '7_0|{job}\\n7_0.batch|{step}\\n7_1|COMPLETED|0:0\\n'\n")
    sacct.chmod(0o755)
    monkeypatch.setenv("PATH", f"{bin_of_slurm}:{os.environ['PATH']}")
    plan.log_of(planned(tmp_path / "crowd", job="7"), 0).write_text("\n".join(log))
    run = only(tmp_path / "crowd", Queue({}))
    assert run.state == "lost"
    assert reason in str(run.reason)


def test_a_run_that_never_started_is_lost_with_its_sweep(tmp_path: Path) -> None:
    """Catches runs of a killed sweep that are planned for ever."""
    planned(tmp_path, **GONE)
    assert (only(tmp_path).state, only(tmp_path).reason) == ("not started", None)


def test_failures_keep_their_reason_until_they_are_tried_again(tmp_path: Path) -> None:
    """Catches a reason that is not shown, and a retried run that still looks failed."""
    planned(tmp_path, started=time.time() - 100)
    recorded(tmp_path, status="diverged", reason="step 7: loss is nan", metrics=None, cost=None)
    run = only(tmp_path)
    assert (run.state, run.reason) == ("failed", "diverged: step 7: loss is nan")
    time.sleep(0.05)
    planned(tmp_path, SECOND)
    assert only(tmp_path).state == "planned"


def test_one_run_in_other_words_is_one_run(tmp_path: Path) -> None:
    """Catches a kept run that looks lost because the record names the overrides of the command that made it."""
    recorded(tmp_path, overrides=["+exp=crowd", "model=7dgs", "scene=lego"])  # seed 0 is the default
    folder = planned(tmp_path, **GONE)
    plan.write_ended(folder, 0, Ended(f"{tmp_path.name}/lego/7dgs/seed0/record.json", None))
    assert only(tmp_path).state == "done"


@pytest.mark.parametrize("newer", ["a", "b"])
def test_of_two_traces_of_a_run_the_newer_counts(tmp_path: Path, newer: str) -> None:
    """Catches the first one found, or the older one: folders of a run done again under another name remain."""
    now = time.time()
    for folder in ("a", "b"):
        path = tmp_path / folder / "record.json"
        path.parent.mkdir()
        path.write_text(json.dumps(crowd.record(*RUN) | {"metrics": {"psnr": 20.0 + (folder == newer)}}, default=str))
        os.utime(path, (now, now - 60 * (folder != newer)))
    assert only(tmp_path).psnr == 21.0
    for folder in ("a", "b"):
        (tmp_path / folder / "record.json").unlink()
        age = 0 if folder == newer else 60
        at = Progress(WORDS, **HERE, job=None, step=100 - age, steps=400, seconds=5.0, updated=now - age)  # type: ignore[arg-type]
        progress.write(tmp_path / folder, at)
    assert only(tmp_path).step == 100


@pytest.mark.parametrize(("of", "state"), [(HERE, "running"), (GONE, "lost")])
def test_runs_outside_the_plan_are_shown_beside_one_without_a_record(
    tmp_path: Path, of: dict[str, object], state: str
) -> None:
    """Catches a live training that no status shows, and a killed one that is not lost: they were taken for the planned
    one, which has no record either."""
    planned(tmp_path)
    other = tmp_path / "lego" / "7dgs" / "seed1"
    other.mkdir(parents=True)
    progress.write(other, Progress(crowd.overrides("7dgs", "lego", 1), **of, steps=400))  # type: ignore[arg-type]
    states = {run.overrides[-1]: run.state for run in status.status(status.read(tmp_path))}
    assert states == {"seed=0": "planned", "seed=1": state}


def test_no_file_moves_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches escapes of a progress.json or a record that clear the screen, or write a line that gsbench did not."""
    escape = "\x1b[2J\x07\x9b\r\nall is well"
    trains(tmp_path, overrides=[*WORDS, f"x={escape}"], host=f"a{escape}", updated=0.0)
    recorded(tmp_path, overrides=[f"y={escape}"], status="failed", reason=escape, metrics=None, cost=None)
    assert main(["status", str(tmp_path)]) == 1
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) == 3
    assert all(line.isprintable() for line in shown.splitlines())
    assert r"x=\x1b[2J" in shown


@pytest.mark.parametrize(
    ("log", "cause"),
    [
        ("/opt/python: Permission denied\nsrun: error: n1: task 0: Exited with exit code 13\n",
         "/opt/python: Permission denied"),
        ("srun: error: n1: task 0: Exited with exit code 13\n", "srun: error: n1: task 0: Exited with exit code 13"),
        ("loading\nRuntimeError: this\nsrun: error: n1: task 0: Exited with exit code 1\n", "RuntimeError: this"),
        ("step 5\nslurmd: error: Detected 1 oom_kill event\nstep 6", "slurmd: error: Detected 1 oom_kill event"),
        ("", "(empty)"),
    ],
)  # fmt: skip
def test_a_log_is_quoted_where_it_names_the_cause(log: str, cause: str, tmp_path: Path) -> None:
    """Catches `exit code 13` alone for a job whose log says in its first line that Python may not be run."""
    path = tmp_path / "7_0_log.err"
    path.write_text(log)
    assert status.cause_in(path) == cause
    path.unlink()
    os.mkfifo(path)
    assert status.cause_in(path) == "(no log)"


def test_a_run_that_ended_without_a_record_is_failed(tmp_path: Path) -> None:
    """Catches a refused run that is lost: nothing broke down, it was refused."""
    plan.write_ended(planned(tmp_path), 0, Ended(None, "seed: expected >= 0, got -1"))
    run = only(tmp_path)
    assert (run.state, run.reason) == ("failed", "seed: expected >= 0, got -1")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"status": "ok"}', '{"status": 1, "reason": 2, "metrics": 3}', "\0"])
def test_a_damaged_record_is_named(tmp_path: Path, text: str) -> None:
    """Catches a record that stops the status of all others."""
    path = recorded(tmp_path)
    path.write_text(text)
    run = only(tmp_path)
    assert run.state == "failed"
    assert str(path) in str(run.reason)


def test_a_damaged_plan_is_named(tmp_path: Path) -> None:
    """Catches a plan of another version that stops the status of all runs, or that is left out in silence."""
    (planned(tmp_path) / plan.FILE_NAME).write_text('{"launcher": "basic"}')
    recorded(tmp_path)
    experiment = status.read(tmp_path)
    (run,) = status.status(experiment)
    assert run.state == "done"
    assert f"a plan is left out: {tmp_path}" in lines(experiment, [run])[1]


def test_only_what_differs_names_a_run() -> None:
    """Catches a status that repeats what all runs have in common, or hides which run failed."""
    runs = [RunStatus(crowd.overrides("7dgs", "lego", seed), state, "why" if state == "failed" else None)
            for seed, state in enumerate(["done", "failed", "done"])]  # fmt: skip
    assert lines(status.Experiment(Path("results/crowd")), runs) == [
        "results/crowd: 3 runs: 2 done, 1 failed", "  failed   seed=1  why",
    ]  # fmt: skip


def test_a_large_sweep_is_read_in_no_time_without_torch_or_hydra(tmp_path: Path) -> None:
    """Catches a status that composes configs, validates records, or imports what it does not need."""
    experiment = crowd.write(500, tmp_path)
    code = (
        "import sys, time\n"
        "from gsbench.launch.__main__ import main\n"
        "code = main(sys.argv[1:])\n"
        "assert time.process_time() < 3, time.process_time()\n"
        "assert not {'torch', 'hydra', 'pandas'} & sys.modules.keys()\n"
        "sys.exit(code)"
    )
    command = [sys.executable, "-c", code, "status", str(experiment)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert "500 runs: 490 done, 10 running" in done.stdout
