"""Run hostile cases in worker processes, so that a crash, a hang or a flood of memory is one named failure.

A module of cases has a function `draw(seed, folder)` that returns a `Case`: what it is, in a line, and the call. The
call must end well or raise an InputError of one line; whatever else happens is a failure that names seed and input.
"""

import importlib
import json
import os
import random
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from gsbench.errors import InputError

LIMIT_S = 30  # of a case; the first gradient of a process takes 8, while torch imports what it needs for it
START_S = 120  # of the imports of a worker
MEMORY = 8 << 30  # bytes of address space beyond those that torch takes: a flood ends here and not in the machine


@dataclass(frozen=True)
class Case:
    """One hostile input."""

    what: str  # the input, in a line
    call: Callable[[], object]  # raises AssertionError where a result is wrong


def sample(few: int, all_of_them: int) -> pytest.MarkDecorator:
    """Parametrise a test by the number of its cases: a few always, all of them where slow tests run."""
    return pytest.mark.parametrize("count", [few, pytest.param(all_of_them, marks=pytest.mark.slow)])


def generator(kind: str, seed: int) -> random.Random:
    """Return the random numbers of one case, which differ between kinds of cases of one seed."""
    return random.Random(f"{kind} {seed}")


class Pool:
    """Runs the cases of all modules in one worker, and in a new one where it died or hangs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.worker: _Worker | None = None

    def check(self, module: str, count: int) -> None:
        """Run `count` cases of a module; fail with every seed that failed.

        A twentieth of them at least must be accepted, and as many refused: otherwise the cases do not test much.
        """
        counts = {"accepted": 0, "refused": 0}
        failures = []
        for seed in range(count):
            self.worker = self.worker or _Worker(self.folder)
            outcome, report = self.worker.run(module, seed)
            if outcome in ("died", "hung"):
                self.stop()
            if outcome in counts:
                counts[outcome] += 1
            else:
                failures.append(f"{module}.draw({seed}): {report}")
        assert not failures, f"{len(failures)} of {count} cases failed:\n\n" + "\n\n".join(failures)
        assert min(counts.values()) >= count / 20, f"expected both outcomes, got {counts}"

    def stop(self) -> None:
        """End the worker."""
        if self.worker is not None:
            self.worker.stop()
            self.worker = None


class _Worker:
    """One process that runs cases, one after the other."""

    def __init__(self, folder: Path) -> None:
        self.errors = (folder / "stderr").open("wb+")
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "workers", str(folder)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, env=environment
        )
        self.unread = b""
        ready = self._line(START_S)
        assert ready == "ready", f"the worker did not start: {ready} {self._stderr()}"

    def run(self, module: str, seed: int) -> tuple[str, str]:
        """Run one case; return its outcome and what there is to tell."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{module} {seed}\n".encode())
        self.process.stdin.flush()
        what = self._line(LIMIT_S)  # before the call, so that the input is known whatever comes
        answer = self._line(LIMIT_S)
        if answer == "hung":
            return "hung", f"{what}: no answer within {LIMIT_S} s"
        if answer == "died":
            return "died", f"{what}: the process died, exit status {self.process.wait()}: {self._stderr()}"
        outcome, report = json.loads(answer)
        return outcome, f"{what}: {report}"

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()
        self.errors.close()

    def _line(self, limit_s: float) -> str:
        """The next line of the worker; `died` or `hung` where there is none."""
        assert self.process.stdout is not None
        end = time.monotonic() + limit_s
        while b"\n" not in self.unread:
            there, _, _ = select.select([self.process.stdout], [], [], max(0, end - time.monotonic()))
            if not there:
                return "hung"
            data = os.read(self.process.stdout.fileno(), 1 << 16)
            if not data:
                return "died"
            self.unread += data
        line, self.unread = self.unread.split(b"\n", 1)
        return line.decode()

    def _stderr(self) -> str:
        self.errors.seek(0)
        return self.errors.read()[-2000:].decode(errors="replace")


def _serve(folder: Path) -> None:
    """Answer each module and seed that come by two lines: what the case is, then its outcome."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a library prints is no answer
    importlib.import_module("torch")
    _limit_memory()
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        module, seed = line.split()
        with tempfile.TemporaryDirectory(dir=folder) as case_folder:
            case: Case = importlib.import_module(module).draw(int(seed), Path(case_folder))
            print(json.dumps(case.what)[:600], file=answers, flush=True)
            print(json.dumps(_judge(case)), file=answers, flush=True)


def _limit_memory() -> None:
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, resource.RLIM_INFINITY))


def _judge(case: Case) -> tuple[str, str]:
    """Run a case; return its outcome and what there is to tell."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a warning from the depths is no clear message either
            case.call()
    except InputError as error:
        message = str(error)
        clear = message and len(message) < 1000 and message.isprintable()
        return ("refused", message) if clear else ("unclear", repr(message)[:2000])
    except BaseException:
        return "raised", traceback.format_exc()[-3000:]
    return "accepted", ""


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
