"""Run `python -m MODULE` in forks of one process that has imported everything: a command costs no imports.

A fork is a process of its own: its threads, signals, environment and exit status are those of a new one. What imports
themselves do, such as their order, is tested in processes that are started anew.
"""

import gc
import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# One thread: tests share the machine, and the sums of a run are those of its thread count.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "COLUMNS": "100"}
IMPORTED = (
    "torch._dynamo",  # torch's optimizers import it, and the time screen has one
    "cv2",
    "gsbench.measure.perceptual",
    "gsbench.models.registry",
    "gsbench.run.execution",
    "gsbench.launch.sweep",
)
_servers: list[subprocess.Popen[str]] = []  # one, from the first command on; its input ends with this process


def ended(*command: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command of any kind, at its end, with what it wrote; options are those of subprocess.run."""
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """This Python, started anew, at its end."""
    return ended(sys.executable, *arguments, **options)


def python_m(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module as a command to its end, in the root of the project and in this process's environment."""
    with tempfile.TemporaryDirectory() as folder:
        process = Forked(Path(folder), module, *arguments)
        return subprocess.CompletedProcess([module, *arguments], process.wait(), process.out, process.err)


class Forked:
    """A module that runs as a command, in the root of the project and in this process's environment."""

    def __init__(self, folder: Path, module: str, *arguments: str) -> None:
        self.files = folder / "out", folder / "err"
        self.returncode: int | None = None
        environment, files = os.environ | ENVIRONMENT, [*map(str, self.files)]
        self.pid = _ask({"argv": [module, *arguments], "environment": environment, "files": files})
        assert self.pid is not None

    @property
    def out(self) -> str:
        return self.files[0].read_text()

    @property
    def err(self) -> str:
        """What it has written so far to its standard error."""
        return self.files[1].read_text()

    def poll(self) -> int | None:
        """Return the exit status, or None while it runs."""
        if self.returncode is None:
            self.returncode = _ask({"pid": self.pid, "options": os.WNOHANG})
        return self.returncode

    def wait(self) -> int:
        if self.returncode is None:
            self.returncode = _ask({"pid": self.pid, "options": 0})
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal to it, unless it is known to have ended."""
        if self.returncode is None:
            os.kill(self.pid, number)


def _ask(asked: dict[str, Any]) -> int | None:
    """Ask the process that forks, which is started first if there is none."""
    if not _servers:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        environment = os.environ | ENVIRONMENT
        _servers.append(subprocess.Popen([sys.executable, __file__], cwd=ROOT, env=environment, **pipes))
    (server,) = _servers
    assert server.stdin is not None
    assert server.stdout is not None
    try:
        print(json.dumps(asked), file=server.stdin, flush=True)
        answer = server.stdout.readline()
    except BaseException:  # a test's time is over: the answer to come is not the next command's
        server.kill()
        _servers.clear()
        raise
    assert answer, "the process that forks has ended"
    number: int | None = json.loads(answer)
    return number


def serve() -> None:
    """Answer each line of the input: with the number of a new fork, or with the exit status of one, None if it runs. A
    fork returns, as a new process would begin."""
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        asked = json.loads(line)
        answer: int | None
        if "pid" in asked:
            pid, status = os.waitpid(asked["pid"], asked["options"])
            answer = os.waitstatus_to_exitcode(status) if pid else None
        else:
            for path in asked["files"]:
                Path(path).touch()
            answer = os.fork()
            if not answer:
                answers.close()
                become(asked)
                return
        print(json.dumps(answer), file=answers, flush=True)
    os._exit(0)


def become(asked: dict[str, Any]) -> None:
    """Take on the input, the output, the environment and the arguments of a command."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, path in enumerate(asked["files"], 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(asked["environment"])
    sys.argv = asked["argv"]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and those under nohup


if __name__ == "__main__":
    sys.path[0] = str(ROOT)
    for name in IMPORTED:
        importlib.import_module(name)
    gc.freeze()  # a collection would write to, and so copy, every page of what was imported
    serve()
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
