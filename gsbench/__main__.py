"""Run `python -m gsbench`: compose the configs of the command line and run them one after the other.

torch is imported only when the first run starts, so that wrong options are reported quickly.
"""

import os
import shlex
import sys
import warnings
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gsbench import usage
from gsbench.config import CONF, HERE, register_schema
from gsbench.errors import InputError, one_line, printable
from gsbench.process.ending import end_with
from gsbench.run.stop import Stopped, listen
from gsbench.sweep.axes import check_complete, check_words, expand
from gsbench.sweep.callbacks import started
from gsbench.sweep.explain import explain, raised_by_library
from gsbench.sweep.finish import see_through
from gsbench.sweep.parallel import do_or_start
from gsbench.sweep.task import Problem
from gsbench.version import __version__

BAD_INPUT, FAILED = 2, 1  # exit statuses: the command line or the data is wrong; a run failed
_problems: list[Problem] = []  # problems of the runs that failed; the sweep continues after a failure


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def entry(composed: DictConfig) -> Problem | None:
    """Do one run of a sweep. If the run fails, the error is stored and returned, and the sweep continues."""
    try:
        check_complete(composed)
    except InputError as error:
        print(f"gsbench: error: {printable(error)}", file=sys.stderr)
        _problems.append(Problem(str(error), True))
        return _problems[-1]
    problem = do_or_start(composed)
    if problem is not None:
        _problems.append(problem)
    return problem


def main() -> NoReturn:
    """Run the commands `python -m gsbench` and `gsbench`, and end the process."""
    end_with("gsbench", run_command)


def run_command() -> None:
    """Run what the command line says; print an error as one line instead of a stack trace.

    Raises:
        SystemExit: with the exit status, if it is not 0.
    """
    register_schema()
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # makes Hydra raise its errors; they are printed in one line below
    for stream in filter(None, (sys.stdout, sys.stderr)):  # None: it was closed before the process began
        stream.reconfigure(errors="replace")  # a terminal in ASCII shows ? for other letters
    listen()
    warnings.formatwarning = _in_one_line
    if "--version" in sys.argv[1:]:  # Hydra would print its own
        print(f"gsbench {__version__}")
        return
    if sys.argv[1:2] == ["doctor"]:
        from gsbench.doctor import main as doctor

        sys.exit(doctor(sys.argv[2:]))
    try:
        if {"-h", "--help"} & set(sys.argv[1:]):  # Hydra would compose a config first
            print(usage.text(sys.argv[1:]), end="")
            return
        sys.argv[1:] = expand(sys.argv[1:])
        check_words(sys.argv[1:])
        broken, is_refused = see_through(entry, started)
    except Stopped as stopped:
        print(f"gsbench: {stopped}", file=sys.stderr)
        sys.exit(stopped.code)
    except Exception as error:
        told = _told(error)
        if told is None:
            raise
        print(f"gsbench: error: {printable(told)}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    if broken:
        print(f"gsbench: {len(broken)} runs did not end well: python -m gsbench.sweep status "
              f"{shlex.quote(str(started[0].parents[1]))}", file=sys.stderr)  # fmt: skip
    if is_refused or (_problems and all(problem.is_refused for problem in _problems) and not broken):
        sys.exit(BAD_INPUT)
    sys.exit(FAILED if _problems or broken else 0)


def _told(error: Exception) -> str | None:
    """Return one line that explains an error in the command line; None if the error has another cause."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, HydraException | OmegaConfBaseException):
        return explain(error)
    if isinstance(error, OSError):  # an error of Hydra's files; errors of a run are stored in its record.json
        return one_line(error)
    return explain(error) if raised_by_library(error) else None


_in_two_lines = warnings.formatwarning


def _in_one_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Format a Python warning of gsbench in one line, without the line of code that Python adds."""
    if not Path(filename).is_relative_to(HERE):
        return _in_two_lines(message, category, filename, lineno, line)
    return f"gsbench: warning: {message}\n"


if __name__ == "__main__":
    main()
