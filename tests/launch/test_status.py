"""What became of each run of a sweep: by its plan, the record or progress it left, its process, and Slurm's queue."""

import json
import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import crowd
import pytest
from tiny_run import ROOT

from gsbench.launch import plan, status
from gsbench.launch.__main__ import lines, main
from gsbench.launch.plan import Ended, Plan
from gsbench.launch.slurm import Queue, ask
from gsbench.launch.status import RunStatus
from gsbench.run import progress
from gsbench.run.progress import Progress, born
from gsbench.run.stop import Stopped

RUN = ("7dgs", "lego", 0)
WORDS = crowd.overrides(*RUN)
HERE = {"host": socket.gethostname(), "pid": os.getpid(), "born": born(os.getpid())}
GONE = {**HERE, "born": 1}  # a later process that was given the number of one that is gone
OTHER = {"host": "elsewhere"}
JOB, IN_JOB = {"job": "7"}, {"job": "7_0", **GONE}
DIVERGED = {"status": "diverged", "reason": "step 7: loss is nan", "metrics": None, "cost": None}
DENIED = "/opt/python: Permission denied"
SILENT = Queue({}, "squeue is not on this machine")


def planned(experiment: Path, name: str = "2026-11-22_00-00-00.000000", **of: Any) -> Path:
    """Write the plan of one run, launched by this process unless told otherwise, and return its folder."""
    folder = experiment / plan.FOLDER / name
    plan.write(replace(Plan("local", [[*WORDS, "results=somewhere"]]), **of), folder)
    return folder


def traced(
    experiment: Path,
    plan_of: dict[str, Any] | None = None,
    progress_of: dict[str, Any] | None = None,
    record_of: dict[str, Any] | str | None = None,
    ended: Ended | None = None,
    log: str = "",
    stops: bool = False,
) -> Path:
    """Write what a run leaves, and return its folder: its plan, progress, record, the note of its end, and its log."""
    folder = experiment / "lego" / "7dgs" / "seed0"
    folder.mkdir(parents=True, exist_ok=True)
    if plan_of is not None:
        at_plan = planned(experiment, **plan_of)
        (at_plan / "0.log").write_text(log)
        if ended:
            plan.write_ended(at_plan, 0, ended)
    if progress_of is not None:
        at = Progress(WORDS, **HERE, job=None, step=100, steps=400, seconds=50.0, psnr_val=21.5)
        at = replace(at, **progress_of)
        progress.write(folder, at)
        if stops:
            progress.release_claim(folder, at, is_stopped=True)
    if record_of is not None:
        record = json.dumps(crowd.record(*RUN) | record_of, default=str) if isinstance(record_of, dict) else record_of
        (folder / "record.json").write_text(record)
        newer = time.time() + 1  # than a progress that was left over
        os.utime(folder / "record.json", (newer, newer))
    return folder


def only(experiment: Path, queue: Queue | None = None) -> RunStatus:
    """The status of the only run there is, with Slurm's queue as given."""
    read = status.read(experiment)
    if queue:
        read.queue = queue
    (run,) = status.status(read)
    return run


@pytest.mark.parametrize(
    ("queue", "traces", "state", "reason"),
    [
        # no trace but the plan
        (None, {"plan_of": {}}, "planned", None),
        (None, {"plan_of": GONE}, "not started", None),
        (None, {"plan_of": OTHER}, "planned", None),
        (None, {"plan_of": OTHER | {"started": time.time() - 660}}, "not started", None),
        (Queue({"7_0": "PENDING Priority"}), {"plan_of": JOB}, "queued", "Priority"),
        (Queue({}), {"plan_of": JOB}, "lost", "never started"),
        (SILENT, {"plan_of": JOB}, "planned", None),
        # a progress
        (None, {"progress_of": HERE}, "running", None),
        (None, {"progress_of": GONE}, "lost", "step 100 of 400"),
        (None, {"progress_of": GONE | {"updated": time.time() + 1e6}}, "lost", "last seen 0 s ago"),
        (None, {"progress_of": OTHER}, "running", None),
        (None, {"progress_of": OTHER | {"updated": time.time() - 660}}, "lost", "step 100 of 400"),
        (Queue({"7_0": "PENDING Resources"}), {"plan_of": JOB, "progress_of": IN_JOB}, "queued", "Resources"),
        (Queue({"7_0": "RUNNING"}), {"plan_of": JOB, "progress_of": IN_JOB}, "running", None),
        (Queue({"7_1": "RUNNING"}), {"plan_of": JOB, "progress_of": IN_JOB}, "lost", "at step 100 of 400"),
        (SILENT, {"plan_of": JOB, "progress_of": {"job": "7_0"}}, "running", None),
        # .. that a signal has stopped
        (None, {"progress_of": {}, "stops": True}, "stopped", "stopped at step 100 of 400: the same command continues"),
        # a record
        (None, {"plan_of": {}, "progress_of": {}, "record_of": {}}, "done", None),
        (None, {"plan_of": {"started": time.time() - 100}, "record_of": DIVERGED}, "failed", "diverged: step 7: loss"),
        # .. of the command that made it, which did not name the seed
        (
            None,
            {
                "plan_of": GONE,
                "record_of": {"overrides": ["+exp=crowd", "model=7dgs", "scene=lego"]},
                "ended": Ended("crowd/lego/7dgs/seed0/record.json", None),
            },
            "done",
            None,
        ),
        (None, {"record_of": {"metrics": {"psnr": 60.0}}}, "failed", "record.json: metrics.psnr: expected 28"),
        (None, {"record_of": {"seed": "0"}}, "failed", "record.json: seed: expected int, got str"),
        *((None, {"record_of": text}, "failed", "seed0/record.json") for text in ("{", '{"status": "ok"}')),
        # the note of its end alone
        (None, {"plan_of": {}, "ended": Ended(None, "seed: expected >= 0, got -1")}, "failed", "seed: expected >= 0"),
        (
            Queue({}),
            {
                "plan_of": JOB,
                "ended": Ended(None, "it ended without a record"),
                "log": "step 5\ngsbench: error: its record cannot be written: No space left on device\n",
            },
            "failed",
            "it ended without a record; its log ends: gsbench: error: its record cannot be written: No space",
        ),
    ],
)
def test_the_state_of_a_run_follows_from_its_traces(queue, traces, state, reason, tmp_path):
    """Catches a trace that is not matched to its run, a hard death that is taken for running for ever, a living,
    requeued or refused run that is taken for lost, a damaged record that stops the status of all others, and a reason
    that is named nowhere."""
    traced(tmp_path / "crowd", **traces)
    run = only(tmp_path / "crowd", queue)
    assert run.state == state
    assert (reason or "") in (run.reason or "")
    assert (run.reason is None) == (reason is None)
    if state == "running":
        assert (run.step, run.steps, run.psnr, run.seconds_left) == (100, 400, 21.5, 150.0)
        shown = lines(status.Experiment(tmp_path / "crowd"), [replace(run, seconds_left=7560.0)])[1]
        assert "step 100/400, val 21.50 dB, 2.1 h left" in shown
    if state == "done":
        assert run.psnr == crowd.record(*RUN)["metrics"]["psnr"]
    if traces.get("progress_of") == IN_JOB:
        assert run.job == "7_0"
    if queue is SILENT:
        text = "\n".join(lines(status.Experiment(tmp_path / "crowd", queue=queue), [run]))
        assert "squeue is not on this machine" in text


def test_a_process_that_was_killed_is_gone(tmp_path):
    """Catches a check that asks only whether the process number is in use, zombies included."""
    sleeper = subprocess.Popen(["sleep", "60"])
    folder = traced(tmp_path, progress_of={"pid": sleeper.pid, "born": born(sleeper.pid)})
    assert only(tmp_path).state == "running"
    sleeper.kill()
    time.sleep(0.2)
    run = only(tmp_path)
    sleeper.wait()
    assert run.state == "lost"
    assert f"process {sleeper.pid}" in str(run.reason)
    assert "continues" not in str(run.reason)
    (folder / "checkpoint.pt").touch()
    assert str(only(tmp_path).reason).endswith(
        "at step 100 of 400: the same command continues from its last checkpoint"
    )


@pytest.mark.parametrize(
    ("job", "step", "log", "reason"),
    [
        (
            "FAILED|9:0",
            "OUT_OF_MEMORY|0:125",
            "step 5\nslurmstepd: error: Detected 1 oom_kill event\nsrun: error: n1: task 0: Killed",
            "job 7_0 ended: OUT_OF_MEMORY; its log ends: slurmstepd: error: Detected 1 oom_kill event",
        ),
        (
            "FAILED|1:0",
            "COMPLETED|0:0",
            "bar 50 %| gsbench: error: no such file\nbye",
            "job 7_0 ended: FAILED, exit 1:0; its log ends: gsbench: error: no such file",
        ),
        ("TIMEOUT|0:0", "CANCELLED|0:15", "step 5\nstep 6", "job 7_0 ended: TIMEOUT; its log ends: step 6"),
    ],
    ids=["memory", "error", "time"],
)
def test_a_lost_job_says_how_it_ended(job, step, log, reason, tmp_path, monkeypatch):
    """Catches memory that ran out told as a kill, as only the step of a job knows of it, and a log's last line."""
    sacct = tmp_path / "sacct"
    sacct.write_text(f"#!/bin/sh\nprintf '7_0|{job}\\n7_0.batch|{step}\\n7_1|COMPLETED|0:0\\n'\n")
    sacct.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    traced(tmp_path / "crowd", plan_of=JOB, log=log)
    run = only(tmp_path / "crowd", Queue({}))
    assert run.state == "lost"
    assert reason in str(run.reason)


@pytest.mark.parametrize(
    ("log", "cause"),
    [
        (f"{DENIED}\nsrun: error: n1: task 0: Exited with exit code 13\n", DENIED),
        ("srun: error: n1: task 0: Exited with exit code 13\n", "srun: error: n1: task 0: Exited with exit code 13"),
        ("srun: error: n1: task 0: Exited with exit code 13\n" + DENIED, DENIED),
        ("loading\nRuntimeError: this\nsrun: error: n1: task 0: Exited with exit code 1\n", "RuntimeError: this"),
        ("step 5\nslurmd: error: Detected 1 oom_kill event\nstep 6", "slurmd: error: Detected 1 oom_kill event"),
        ("", "(empty)"),
    ],
)
def test_a_log_is_quoted_where_it_names_the_cause(log, cause, tmp_path):
    """Catches `exit code 13` alone for a job whose log says in its first line that Python may not be run."""
    path = tmp_path / "7_0_log.err"
    path.write_text(log)
    assert status.cause_in(path) == cause
    path.unlink()
    os.mkfifo(path)
    assert status.cause_in(path) == "(no log)"


def test_a_failure_is_planned_once_it_is_tried_again(tmp_path):
    """Catches a retried run that still looks failed."""
    folder = traced(tmp_path, plan_of={"started": time.time() - 100}, record_of=DIVERGED)
    os.utime(folder / "record.json", (time.time() - 1, time.time() - 1))
    assert only(tmp_path).state == "failed"
    planned(tmp_path, "2026-11-22_00-00-01.000000")
    assert only(tmp_path).state == "planned"


@pytest.mark.parametrize("newer", ["a", "b"])
def test_of_two_traces_of_a_run_the_newer_counts(tmp_path, newer):
    """Catches the first one found, or the older one: folders of a run done again under another name remain."""
    now = time.time()
    for name in ("a", "b"):
        path = tmp_path / name / "record.json"
        path.parent.mkdir()
        psnr = 20.0 + (name == newer)
        of = {"metrics": {"psnr": psnr}, "per_view": [{"name": "r_0", "psnr": psnr}]}
        path.write_text(json.dumps(crowd.record(*RUN) | of, default=str))
        os.utime(path, (now, now - 60 * (name != newer)))
    assert only(tmp_path).psnr == 21.0
    for name in ("a", "b"):
        (tmp_path / name / "record.json").unlink()
        age = 0 if name == newer else 60
        progress.write(tmp_path / name, Progress(WORDS, step=100 - age, steps=400, seconds=5.0, updated=now - age))
    assert only(tmp_path).step == 100


@pytest.mark.parametrize(("of", "state"), [(HERE, "running"), (GONE, "lost")])
def test_runs_outside_the_plan_are_shown_beside_one_without_a_record(tmp_path, of, state):
    """Catches a live or a killed training that was taken for the planned one, which has no record either."""
    planned(tmp_path)
    other = tmp_path / "lego" / "7dgs" / "seed1"
    other.mkdir(parents=True)
    progress.write(other, Progress(crowd.overrides("7dgs", "lego", 1), **of, steps=400))
    states = {run.overrides[-1]: run.state for run in status.status(status.read(tmp_path))}
    assert states == {"seed=0": "planned", "seed=1": state}


def test_no_file_moves_the_terminal(tmp_path, capsys):
    """Catches escapes of a progress.json or a record that clear the screen, or write a line that gsbench did not."""
    escape = "\x1b[2J\x07\x9b\r\nall is well"
    traced(
        tmp_path,
        progress_of={"overrides": [*WORDS, f"x={escape}"], "host": f"a{escape}", "updated": 0.0},
        record_of=DIVERGED | {"overrides": [f"y={escape}"], "reason": escape},
    )
    assert main(["status", str(tmp_path)]) == 1
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) == 3
    assert all(line.isprintable() for line in shown.splitlines())
    assert r"x=\x1b[2J" in shown


def test_damaged_files_hide_no_run(tmp_path):
    """Catches a plan of another version, or a progress file read first, that stops the status of all runs, and a plan
    that is left out in silence."""
    folder = traced(tmp_path, plan_of={}, record_of={})
    (path,) = tmp_path.rglob(plan.FILE_NAME)
    path.write_text('{"launcher": "basic"}')
    damaged = folder.parent / "another"
    damaged.mkdir()
    (damaged / progress.FILE_NAME).write_text("{")
    assert damaged.name < folder.name
    experiment = status.read(tmp_path)
    (run,) = status.status(experiment)
    assert run.state == "done"
    assert f"a plan is left out: {tmp_path}" in lines(experiment, [run])[1]


def test_only_what_differs_names_a_run():
    """Catches a status that repeats what all runs have in common, or hides which run failed."""
    runs = [
        RunStatus(crowd.overrides("7dgs", "lego", seed), state, "why" if state == "failed" else None)
        for seed, state in enumerate(["done", "failed", "done"])
    ]
    assert lines(status.Experiment(Path("results/crowd")), runs) == [
        "results/crowd: 3 runs: 2 done, 1 failed",
        "  failed   seed=1  why",
    ]


def test_the_time_left_is_that_of_the_runs_that_are_done(tmp_path):
    """Catches a sweep of days that says nothing of them, and seconds of a record that are not read."""
    traced(tmp_path / "crowd", record_of={})
    (done,) = status.status(status.read(tmp_path / "crowd"))
    assert done.train_s == crowd.record(*RUN)["cost"]["train_s"]
    runs = [replace(done, train_s=train_s) for train_s in (3600.0, 7200.0)]
    runs += [RunStatus(WORDS, "planned"), RunStatus(WORDS, "running", seconds_left=3600.0)]
    assert "about 2.5 h of training left" in lines(status.Experiment(tmp_path), runs)[1]
    for nothing_known in (runs[:2], runs[2:]):
        assert not any("of training left" in line for line in lines(status.Experiment(tmp_path), nothing_known))


def test_a_folder_without_runs_is_told(tmp_path, capsys):
    """Catches a stack trace for the folder of an experiment that has no run yet."""
    main(["status", str(tmp_path)])
    assert capsys.readouterr().out == f"{tmp_path}: no run was asked for\n"
    assert main(["status", str(tmp_path / "nothing")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert f"{tmp_path}/nothing: expected the folder of an experiment" in err


def test_the_parts_of_an_experiment_are_in_order(tmp_path):
    """Catches runs in the order in which a file system lists their folders, and another experiment's."""
    for seed in (3, 1, 4, 0, 5, 2):
        folder = tmp_path / f"crowd.{seed}" / "run"
        folder.mkdir(parents=True)
        progress.write(folder, Progress(crowd.overrides("7dgs", "lego", seed), steps=400))
    (tmp_path / "crowds").mkdir()
    progress.write(tmp_path / "crowds", Progress(crowd.overrides("7dgs", "lego", 6), steps=400))
    seeds = [run.overrides[-1] for run in status.status(status.read(tmp_path / "crowd"))]
    assert seeds == [f"seed={seed}" for seed in range(6)]


@pytest.mark.parametrize(("end", "code"), [(KeyboardInterrupt(), 130), (Stopped(15), 143)])
def test_a_watch_that_is_interrupted_has_the_status_of_the_signal(end, code, tmp_path, monkeypatch):
    """Catches a stack trace, or a success, for Ctrl-C."""
    traced(tmp_path, progress_of={})
    monkeypatch.setattr(time, "sleep", lambda _: (_ for _ in ()).throw(end))
    assert main(["status", str(tmp_path), "--watch"]) == code


def test_slurm_that_does_not_answer_is_a_reason():
    """Catches a status that waits for ever, or ends in a stack trace."""
    assert "timed out" in str(ask("sleep", "5", seconds=0.05))


def test_status_is_repeated_until_nothing_goes_on(tmp_path, capsys, monkeypatch):
    """Catches a watch that ends at once or never, the status of a failed run, and a log cleared like a terminal."""
    folder = traced(tmp_path / "crowd", progress_of={})
    ends = iter([{}, DIVERGED])
    for expected, words, cleared in ((0, "1 done", 0), (1, "1 failed", 2)):
        monkeypatch.setattr(sys.stdout, "isatty", lambda clears=cleared > 0: clears)
        monkeypatch.setattr(time, "sleep", lambda _: traced(tmp_path / "crowd", record_of=next(ends)))
        assert main(["status", str(tmp_path / "crowd"), "--watch"]) == expected
        out = capsys.readouterr().out
        assert out.count("\033[H\033[2J") == cleared
        first, *_, last = [line for line in out.splitlines() if ": 1 runs: " in line]
        assert first.endswith("1 running")
        assert last.endswith(words)
        (folder / "record.json").unlink()


@pytest.mark.parametrize("number", ["1", "-1"])
def test_a_job_of_no_run_is_refused(number, tmp_path, capsys):
    """Catches a stack trace, and the last run in place of none."""
    plan.write(Plan("slurm", [["+exp=mini", "scene=dust"]], None), tmp_path)
    assert main(["job", str(tmp_path), number]) == 2
    assert f"{tmp_path}, 0 to 0, got {number}" in capsys.readouterr().err


def test_a_large_sweep_is_read_in_no_time_without_torch_or_hydra(tmp_path):
    """Catches a status that composes configs, or imports what it does not need."""
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
