"""Show the state of an experiment's runs, or launch again the runs that did not finish.

python -m gsbench.sweep status results/EXP [--watch] [--json]
python -m gsbench.sweep retry results/EXP [launch.memory=16G ...]
"""

import argparse
import json
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path

from gsbench.errors import InputError, printable
from gsbench.sweep.show import lines
from gsbench.sweep.status import BROKEN, GOING, RunStatus, read, status

WATCH_SECONDS = 10.0


def main(arguments: list[str] | None = None) -> int:
    """Return 0 if no run failed or is lost, 1 if a run failed or is lost, and 2 if the folder is no experiment."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.sweep", description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    shown = commands.add_parser("status", help="show which runs are done, running, queued, planned, failed or lost")
    shown.add_argument("experiment", type=Path, metavar="results/EXP")
    shown.add_argument("--watch", action="store_true", help="repeat until no run is running or waiting")
    shown.add_argument("--json", action="store_true", help="print all runs as JSON, also those that are done")
    again = commands.add_parser("retry", help="launch again the runs that failed, are lost or never started")
    again.add_argument("experiment", type=Path, metavar="results/EXP")
    again.add_argument("launch", nargs="*", metavar="launch.KEY=VALUE", help="launch settings to change")
    options = parser.parse_args(arguments)
    try:
        if not options.experiment.is_dir():
            raise InputError(f"{options.experiment}: expected the folder of an experiment, such as results/mini")
        if options.command == "retry":
            return _retry(options.experiment, options.launch)
        if options.watch:
            return _watch(options.experiment, options.json)
        return _verdict(_show(options.experiment, options.json))
    except InputError as error:
        print(f"gsbench.sweep: {printable(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader has closed the pipe, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _show(folder: Path, as_json: bool) -> list[RunStatus]:
    experiment = read(folder)
    runs = status(experiment)
    if as_json:
        print(json.dumps([asdict(run) for run in runs], indent=1))
    else:
        print("\n".join(lines(folder, runs, experiment.queue.silent)), flush=True)
    return runs


def _watch(folder: Path, as_json: bool) -> int:
    while True:
        if sys.stdout.isatty():
            print("\033[H\033[2J", end="")
        runs = _show(folder, as_json)
        if not any(run.state in GOING for run in runs):
            return _verdict(runs)
        time.sleep(WATCH_SECONDS)


def _verdict(runs: list[RunStatus]) -> int:
    return 1 if any(run.state in BROKEN for run in runs) else 0


def _retry(folder: Path, launch: list[str]) -> int:
    from gsbench.sweep.retry import retry  # imports Hydra, which a status does not need
    from gsbench.sweep.task import do

    folder = folder.resolve()  # runs are launched from the folder that the first command was given in
    count = retry(read(folder), launch, do)
    if not count:
        print(f"{folder}: no run failed, is lost or never started", file=sys.stderr)
    return _verdict(_show(folder, False))


if __name__ == "__main__":
    sys.exit(main())
