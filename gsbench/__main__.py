"""Run `python -m gsbench`: expand the command line to runs, and do them here or by a launcher.

torch is imported only when the first run starts, so that wrong options are reported quickly.
"""

import os
import shlex
import sys
import warnings
from pathlib import Path
from typing import NoReturn

import hydra
from omegaconf import DictConfig

from gsbench import usage
from gsbench.config import CONF, HERE, register_schema
from gsbench.config_roles import in_order
from gsbench.errors import InputError, one_line
from gsbench.launch import command, processes, sweep
from gsbench.process.ending import end_with
from gsbench.run.stop import Stopped, listen
from gsbench.version import __version__

BAD_INPUT, FAILED = 2, 1  # exit statuses: the command line or the data is wrong; a run failed


def main() -> NoReturn:
    """Run the commands `python -m gsbench` and `gsbench`, and end the process."""
    end_with("gsbench", lambda: run_command(sys.argv[1:]))


def run_command(words: list[str]) -> int:
    """Run what the command line says, and return the exit status; an error is printed as one line."""
    for stream in filter(None, (sys.stdout, sys.stderr)):  # None: it was closed before the process began
        stream.reconfigure(errors="replace")  # a terminal in ASCII shows ? for other letters
    listen()
    warnings.formatwarning = _in_one_line
    if words[:1] == ["doctor"]:
        from gsbench.doctor import main as doctor

        return doctor(words[1:])
    if "--version" in words:  # Hydra would print its own
        print(f"gsbench {__version__}")
        return 0
    try:
        if {"-h", "--help"} & set(words):  # Hydra would compose a config first
            print(usage.text(words), end="")
            return 0
        return _run(command.parse(words))
    except Stopped as stopped:
        print(f"gsbench: {stopped}", file=sys.stderr)
        return stopped.code
    except (InputError, OSError) as error:
        print(f"gsbench: error: {one_line(error)}", file=sys.stderr)
        return BAD_INPUT


def _run(parsed: command.Command) -> int:
    """Do the runs of a command line, or let Hydra answer its question about the config; return the exit status."""
    if parsed.asks:
        register_schema()
        sys.argv[1:] = in_order(sys.argv[1:])
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # makes Hydra raise its errors
        try:
            answer()
        except Exception as error:  # Hydra raises errors of many types for a wrong word
            raise InputError(command.explain(error)) from None
        return 0
    with command.hydra_with(parsed.config_dir):
        runs, is_sweep = command.runs_of(parsed)
        configs = [command.compose_run(overrides) for overrides in runs]
        command.check_runs(configs)
        if not is_sweep:
            ended = processes.do(configs[0])
            return 0 if ended.reason is None else BAD_INPUT if ended.is_refused else FAILED
        outcome = sweep.launch(configs, parsed.config_dir)
    if outcome.broken:
        print(
            f"gsbench: {len(outcome.broken)} runs did not end well: python -m gsbench.launch status "
            f"{shlex.quote(str(outcome.experiment))}",
            file=sys.stderr,
        )
    return BAD_INPUT if outcome.is_refused else FAILED if outcome.broken else 0


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def answer(_: DictConfig) -> None:
    """Let Hydra answer a question about the config, such as --cfg job; it answers before it would call this."""


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
