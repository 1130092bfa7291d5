"""Show how far the runs of an experiment are, or put back those that did not end.

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
from gsbench.sweep.status import BROKEN, GOING, Run, read, status

WATCH_SECONDS = 10.0


def main(arguments: list[str] | None = None) -> int:
    """Return 0 if no run failed or is lost, else 1; 2 if there is nothing to look at."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.sweep", description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    shown = commands.add_parser("status", help="what is done, running, queued, planned, failed, lost")
    shown.add_argument("experiment", type=Path, metavar="results/EXP")
    shown.add_argument("--watch", action="store_true", help="again and again until nothing is running or waits")
    shown.add_argument("--json", action="store_true", help="every run, the ones that are done too, as JSON")
    again = commands.add_parser("retry", help="put back what failed, was lost or never started")
    again.add_argument("experiment", type=Path, metavar="results/EXP")
    again.add_argument("launch", nargs="*", metavar="launch.KEY=VALUE", help="other settings than it had")
    asked = parser.parse_args(arguments)
    try:
        if not asked.experiment.is_dir():
            raise InputError(f"{asked.experiment}: expected the folder of an experiment, such as results/mini")
        if asked.command == "retry":
            return _retry(asked.experiment, asked.launch)
        return _watch(asked.experiment, asked.json) if asked.watch else _verdict(_show(asked.experiment, asked.json))
    except InputError as error:
        print(f"gsbench.sweep: {printable(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # who read it has seen enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _show(folder: Path, as_json: bool) -> list[Run]:
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


def _verdict(runs: list[Run]) -> int:
    return 1 if any(run.state in BROKEN for run in runs) else 0


def _retry(folder: Path, launch: list[str]) -> int:
    from gsbench.sweep.retry import retry  # imports Hydra, which a status does not need
    from gsbench.sweep.task import do

    folder = folder.resolve()  # runs are launched from the folder that the first command was given in
    count = retry(read(folder), launch, do)
    if not count:
        print(f"{folder}: nothing failed, is lost or was never started", file=sys.stderr)
    return _verdict(_show(folder, False))


if __name__ == "__main__":
    sys.exit(main())
