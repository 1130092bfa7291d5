"""Break a sweep on a real Slurm in every way we know, and check that nothing is lost, forgotten or different.

    make slurm-check

A sweep of 2 scenes x 2 models x 2 seeds is done on this machine without Slurm; that is what every number is compared
with. Then it is done on the Slurm of cluster.py while jobs, nodes and memory fail under it. What fails is named
by `python -m gsbench.launch status` with its reason, `... retry` completes it, and every record that comes out
equals the one of this machine: metrics, the curve's PSNR, and the bits of the checkpoint.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from cluster import Cluster, missing, send, wait_until
from interrupted import assert_same_bits, bits

from gsbench.errors import InputError
from gsbench.run.progress import FILE_NAME as PROGRESS
from gsbench.run.progress import Progress, is_alive
from gsbench.run.progress import read as read_progress

ROOT = Path(__file__).resolve().parents[2]
SCENES, MODELS, SEEDS = ("moving-matte", "suzanne"), ("3dgs", "7dgs"), ("0", "1")
# Runs of some ten seconds; a job that is killed loses at most one or two of them.
TINY = ("+exp=mini", "scene.downscale=4", "data.initial_points=1000", "train.curve_points=5")
TINY += ("train.checkpoint_minutes=0.02",)
STEPS = 1500
SHORT = (*TINY, f"train.iterations={STEPS}")
ALL = (*SHORT, f"scene={','.join(SCENES)}", f"model={','.join(MODELS)}", f"seed={','.join(SEEDS)}")
ONE = (*SHORT, "scene=suzanne", "model=3dgs", "seed=0")  # one of the eight, where a fault needs no more
LONG_SECONDS = 90  # of training, for a run that is longer than the time limit of its job
SLURM = ("+launch=slurm", "launch.cpus=1", "launch.memory=2G")


class Sweep:
    """A sweep in a results folder of its own, submitted to Slurm; `wait` ends when its command does."""

    def __init__(self, cluster: Cluster, results: Path, *overrides: str) -> None:
        self.cluster = cluster
        self.results = results
        self.log = cluster.folder / f"{results.name}.log"
        self._start("gsbench", "-m", *SLURM, f"results={results}", *overrides)

    def retry(self, *launch: str) -> None:
        self._start("gsbench.launch", "retry", str(self.results / "mini"), *launch)
        self.wait()

    def wait(self, seconds: float = 300) -> None:
        """Wait until the command has ended, whatever became of its runs."""
        wait_until(f"{self.log}: the end of the command", lambda: self.command.poll() is not None, seconds)

    def status(self) -> list[dict[str, Any]]:
        """What `python -m gsbench.launch status` says of each run."""
        command = [sys.executable, "-m", "gsbench.launch", "status", str(self.results / "mini"), "--json"]
        done = subprocess.run(
            command, env=self.cluster.environment, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
        )
        return json.loads(done.stdout) if done.stdout else []

    def states(self) -> list[str]:
        return sorted(run["state"] for run in self.status())

    def training(self) -> list[Progress]:
        """The runs that train at this moment and have a checkpoint, the newest last."""
        training = []
        for path in self.results.rglob(PROGRESS):
            with contextlib.suppress(InputError):  # it ended just now
                if path.with_name("checkpoint.pt").exists() and is_alive(progress := read_progress(path)):
                    training.append(progress)
        return sorted(training, key=lambda progress: progress.started)

    def one_training(self, node: str = "n1,n2") -> Progress:
        """Wait until a run trains on a node and has a checkpoint; return the newest."""
        on_node: list[Progress] = []

        def trains() -> bool:
            jobs = self.cluster.run("squeue", "-h", "--array", "--states=RUNNING", "-w", node, "-o", "%F_%K").split()
            on_node[:] = [run for run in self.training() if run.job in jobs or f"{run.job}_N/A" in jobs]
            return bool(on_node)

        wait_until(f"a run with a checkpoint on {node}", trains, 240, self._over)
        return on_node[-1]

    def broken(self) -> list[str]:
        """The reasons of the runs that failed or are lost."""
        return [f"{run['state']}: {run['reason']}" for run in self.status() if run["state"] in ("failed", "lost")]

    def _over(self) -> str | None:
        return f"the command has ended, see {self.log}" if self.command.poll() is not None else None

    def _start(self, *module: str) -> None:
        with self.log.open("ab") as log:
            self.command = subprocess.Popen(
                [sys.executable, "-m", *module], env=self.cluster.environment, cwd=ROOT, stdout=log, stderr=log
            )


class Check:
    """The injections, each with a line of what came of it; `reference` holds the results of this machine."""

    def __init__(self, folder: Path, cluster: Cluster) -> None:
        self.folder = folder
        self.cluster = cluster
        self.reference = folder / "reference"
        self.faults: list[str] = []
        self.since = time.monotonic()  # the last line

    def sweep(self, name: str, *overrides: str) -> Sweep:
        """Submit a sweep into the results folder `name`."""
        return Sweep(self.cluster, self.folder / name, *overrides)

    def say(self, name: str, wanted: str, holds: bool, got: object) -> None:
        """Print a line of an injection with its seconds, and remember it if what is wanted does not hold."""
        shown, since, self.since = str(got).replace(f"{self.folder}/", ""), self.since, time.monotonic()
        line = f"{name}: {wanted}: {'yes' if holds else 'NO'} ({shown}; {self.since - since:.0f} s)"
        print(("ok    " if holds else "FAULT ") + line, flush=True)
        if not holds:
            self.faults.append(line)

    def completed(self, name: str, sweep: Sweep, runs: int) -> None:
        """Say whether every run of a sweep is done and equals that of this machine."""
        states = sweep.states()
        differing = differences(self.reference, sweep.results)
        self.say(
            name,
            f"{runs} of {runs} done, equal to this machine's",
            states == ["done"] * runs and not differing,
            differing or f"{states.count('done')} done",
        )


def killed_jobs_and_nodes(check: Check) -> None:
    """SIGKILL of a job's process, requeue of a job, loss of a node, in one sweep of eight runs."""
    sweep = check.sweep("killed", *ALL)

    killed = sweep.one_training()
    send(killed.pid, signal.SIGKILL)
    wait_until("the killed run is lost", lambda: sweep.broken() != [], 60)
    reasons = sweep.broken()
    check.say(
        "SIGKILL of a job's process",
        "named with its job and its end",
        len(reasons) == 1 and f"job {killed.job} ended: FAILED" in reasons[0],
        reasons[0],
    )

    job = str(sweep.one_training().job)
    check.cluster.run("scontrol", "requeue", job)
    in_queue = ("squeue", "-h", "--array", "-o", "%T", "-j", job)
    wait_until("the requeued run waits", lambda: "PENDING" in check.cluster.run(*in_queue), 60)
    requeued = [run for run in sweep.status() if run["job"] == job]
    check.say(
        "requeue of a running job",
        "queued, not lost",
        [run["state"] for run in requeued] == ["queued"],
        f"{requeued[0]['state']} at step {requeued[0]['step']}: {requeued[0]['reason']}",
    )

    sweep.one_training("n2")
    check.cluster.kill_node("n2")
    wait_until("n2 is down", lambda: check.cluster.states()["n2"].startswith("down"), 120)
    check.cluster.start_node("n2")
    check.say(
        "SIGKILL of a slurmd and its jobs",
        "only the first injection is lost",
        len(sweep.broken()) == 1,
        ", ".join(sweep.states()),
    )

    sweep.wait(400)
    check.say("the other seven", "done", sweep.states() == ["done"] * 7 + ["lost"], ", ".join(sweep.states()))

    sweep.retry()
    check.completed("retry after the kills", sweep, 8)


def time_limit(check: Check) -> None:
    """A time limit that comes before the run's end: at 2 minutes less 60 s, Slurm's signal comes after 30 to 60 s."""
    # Without growth all steps take equally long, so that a short run just before says how many fill the time.
    fixed = (*TINY, "scene=suzanne", "model=7dgs", "seed=0", "train.densify.max_gaussians=1000")
    do_here(check.folder / "rate", (*fixed, f"train.iterations={STEPS}"))
    (quick,) = (check.folder / "rate").rglob("record.json")
    seconds = json.loads(quick.read_text())["cost"]["train_s"]
    long = (*fixed, f"train.iterations={round(STEPS * LONG_SECONDS / seconds)}")
    sweep = check.sweep("time_limit", *long, "launch.minutes=2", "launch.signal_seconds=60")
    do_here(check.reference, long)  # beside the job, which can only become longer by it
    sweep.wait(600)
    log = "".join(path.read_text() for path in sweep.results.rglob("*.log"))
    check.say(
        "time limit",
        "saved and requeued at Slurm's signal",
        "continues from step" in log,
        f"{log.count('continues from step')} times",
    )
    check.completed("time limit", sweep, 1)


def out_of_memory(check: Check) -> None:
    """A job that takes more memory than it asked for is killed by Slurm."""
    sweep = check.sweep("memory", *ONE, "launch.memory=100M")
    sweep.wait()
    reasons = sweep.broken()
    check.say("out of memory", "named", "memory limit" in reasons[0], reasons[0])
    sweep.retry("launch.memory=2G")
    check.completed("retry with more memory", sweep, 1)


INJECTIONS = (killed_jobs_and_nodes, time_limit, out_of_memory)  # what no fake of Slurm does


def differences(reference: Path, results: Path) -> list[str]:
    """How the finished runs of a folder differ from the same runs of the reference: status, metrics, curve, or bits."""
    differing = []
    for run in (path.parent.relative_to(results) for path in sorted(results.rglob("record.json"))):
        records = [json.loads((root / run / "record.json").read_text()) for root in (reference, results)]
        here, there = (
            [record["status"], record["metrics"], [point[::2] for point in record["curve"] or []]] for record in records
        )
        try:
            assert_same_bits(here, there, "record")
            assert_same_bits(bits(reference / run), bits(results / run))
        except (AssertionError, InputError) as error:
            differing.append(f"{run}: {error}")
    return differing


def do_here(folder: Path, overrides: tuple[str, ...]) -> None:
    """Do runs on this machine, without Slurm, two at a time."""
    command = [sys.executable, "-m", "gsbench", "-m", "+launch=parallel", "launch.at_once=2", *overrides]
    command.append(f"results={folder}")
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def main(chosen: list[str]) -> int:
    """Return 0 if every injection ended as it should, 1 if one did not, 77 where no Slurm can be brought up."""
    reason = missing()
    if reason:
        print(f"slurm-check: skipped: {reason}")
        return 77
    begin = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="slurm-check-", dir="/tmp"))  # short: sockets have paths of 107 characters
    do_here(folder / "reference", ALL)
    print(f"the sweep on this machine: {time.monotonic() - begin:.0f} s", flush=True)
    start = time.monotonic()
    with Cluster(folder / "slurm") as cluster:
        print(f"Slurm is up: {cluster.run('sinfo', '-V')}, 2 nodes, {time.monotonic() - start:.0f} s", flush=True)
        check = Check(folder, cluster)
        for injection in INJECTIONS:
            if chosen and injection.__name__ not in chosen:
                continue
            try:
                injection(check)
            except Exception as error:  # the others are still worth a look
                traceback.print_exc()
                check.faults.append(f"{injection.__name__}: {error}")
                print(f"FAULT {check.faults[-1]}", flush=True)
    minutes = (time.monotonic() - begin) / 60
    print(f"{len(check.faults)} faults in {minutes:.1f} minutes" + (f"; logs: {folder}" if check.faults else ""))
    if not check.faults:
        shutil.rmtree(folder)
    return 1 if check.faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
