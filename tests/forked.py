"""Run `python -m MODULE` in forks of one process that has imported everything: a command costs no imports.

A fork is a process of its own: its threads, signals, environment and exit status are those of a new one. What imports
themselves do, such as their order, is tested in processes that are started anew.
"""

import gc
import importlib
import json
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import composed

ROOT = Path(__file__).resolve().parents[1]
# One thread: tests share the machine, and the sums of a run are those of its thread count.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "COLUMNS": "100"}
IMPORTED = (
    "torch._dynamo",  # torch's optimizers import it, and the time screen has one
    "cv2",
    "gsbench.measure.perceptual",
    "gsbench.models.registry",
    "gsbench.run.run",
    "gsbench.sweep.callbacks",
    "gsbench.sweep.retry",
    "gsbench.sweep.task",
)
_servers: list[subprocess.Popen[str]] = []  # one, from the first command on; its input ends with this process


def python_m(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module as a command to its end, in the root of the project and in this process's environment."""
    if not _servers:
        _servers.append(
            subprocess.Popen([sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                             cwd=ROOT, env=os.environ | ENVIRONMENT)
        )  # fmt: skip
    (server,) = _servers
    assert server.stdin is not None
    assert server.stdout is not None
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder, "out"), Path(folder, "err")
        asked = {"argv": [module, *arguments], "environment": os.environ | ENVIRONMENT, "files": [str(out), str(err)]}
        try:
            print(json.dumps(asked), file=server.stdin, flush=True)
            answer = server.stdout.readline()
        except BaseException:  # a test's time is over: the answer to come is not the next command's
            server.kill()
            _servers.clear()
            raise
        assert answer, "the process that forks has ended"
        return subprocess.CompletedProcess([module, *arguments], int(answer), out.read_text(), err.read_text())


def serve() -> None:
    """Fork for each line of the input and answer with the exit status; a fork returns, as a new process would begin."""
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        child = os.fork()
        if not child:
            answers.close()
            become(json.loads(line))
            return
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=answers, flush=True)
    os._exit(0)


def become(asked: dict[str, Any]) -> None:
    """Take on the input, the output, the environment and the arguments of a command."""
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, path in enumerate(asked["files"], 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(asked["environment"])
    sys.argv = asked["argv"]


if __name__ == "__main__":
    sys.path[0] = str(ROOT)
    for name in IMPORTED:
        importlib.import_module(name)
    composed.keep()
    gc.freeze()  # a collection would write to, and so copy, every page of what was imported
    serve()
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
