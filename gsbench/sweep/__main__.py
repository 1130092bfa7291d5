"""Show the state of an experiment's runs, estimate the time they need, or launch again those that did not finish.

python -m gsbench.sweep status results/EXP [--watch] [--json]
python -m gsbench.sweep estimate results/EXP [--at-once 2] [--json]
python -m gsbench.sweep retry results/EXP [launch.memory=16G ...]
"""

import argparse
import os
import shlex
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from gsbench.as_json import as_json
from gsbench.errors import InputError, printable
from gsbench.process.ending import end_with
from gsbench.run import stop
from gsbench.sweep import estimate
from gsbench.sweep.plan import identity
from gsbench.sweep.status import BROKEN, GOING, STATES, RunStatus, read, status

WATCH_SECONDS = 10.0
MOST_COMMANDS = 20  # commands that are printed for runs outside a sweep


def main(arguments: list[str] | None = None) -> int:
    """Show the state of an experiment or launch runs again, as the command line says, and return the exit code.

    Returns:
        0 if all runs are done or going on, 1 if a run was stopped, has not started, failed or is lost, 2 if the folder
        or an argument is wrong, and 128 and its number after a signal (Ctrl-C: 130).
    """
    parser = argparse.ArgumentParser(prog="python -m gsbench.sweep", description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    shown = commands.add_parser("status", help="show the state of each run: done, running, stopped, failed, ...")
    shown.add_argument("experiment", type=Path, metavar="results/EXP")
    shown.add_argument("--watch", action="store_true", help="repeat until no run is running or waiting")
    shown.add_argument("--json", action="store_true", help="print all runs as JSON, also those that are done")
    timed = commands.add_parser("estimate", help="estimate how long the runs that are not done will train")
    timed.add_argument("experiment", type=Path, metavar="results/EXP")
    timed.add_argument("--at-once", type=int, default=1, metavar="N", help="runs at a time (1)")
    timed.add_argument("--json", action="store_true", help="print the estimate of each run as JSON")
    again = commands.add_parser(
        "retry", help="launch again the runs that were stopped, failed, are lost or not started"
    )
    again.add_argument("experiment", type=Path, metavar="results/EXP")
    again.add_argument("launch", nargs="*", metavar="launch.KEY=VALUE", help="launch settings to change")
    options = parser.parse_args(arguments)
    try:
        if not options.experiment.is_dir():
            raise InputError(
                f"{options.experiment}: expected the folder of an experiment, such as results/mini",
                docs="runs.md#the-folder-of-a-run",
            )
        if options.command == "retry":
            return _retry(options.experiment, options.launch)
        if options.command == "estimate":
            return _estimate(options.experiment, options.at_once, options.json)
        if options.watch:
            return _watch(options.experiment, options.json)
        return _verdict(_show(options.experiment, options.json))
    except InputError as error:
        print(f"gsbench.sweep: {printable(error)}", file=sys.stderr)
        return 2
    except stop.Stopped as stopped:
        print(f"gsbench.sweep: {stopped}", file=sys.stderr)
        return stopped.code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the program that reads the output has ended, such as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _show(folder: Path, in_json: bool) -> list[RunStatus]:
    experiment = read(folder)
    runs = status(experiment)
    if in_json:
        print(as_json(runs))
    else:
        print("\n".join(lines(folder, runs, experiment.queue.silent)), flush=True)
    return runs


def _estimate(folder: Path, at_once: int, in_json: bool) -> int:
    if at_once < 1:
        raise InputError(f"--at-once: expected at least 1, got {at_once}")
    found = estimate.estimate(status(read(folder)))
    print(as_json(found) if in_json else "\n".join(estimate.lines(found, at_once)))
    return 0


def lines(experiment: Path, runs: Sequence[RunStatus], silent: str | None = None) -> list[str]:
    """Return lines of text that show the states of the runs of an experiment.

    Args:
        experiment: the folder of the experiment.
        runs: its runs with their states.
        silent: the reason why Slurm did not answer; None if it did or was not asked.
    """
    counts = Counter(run.state for run in runs)
    summary = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    shown = [f"{experiment}: {len(runs)} runs: {summary}" if runs else f"{experiment}: no run was asked for"]
    if silent:
        shown.append(f"Slurm did not answer ({silent}): a run that reported in the last 10 minutes counts as running")
    common = set.intersection(*(set(run.overrides) for run in runs)) if len(runs) > 1 else set()
    named = [(run, " ".join(one for one in run.overrides if one not in common)) for run in runs]
    width = max((len(name) for run, name in named if run.state != "done"), default=0)
    wide = max(8, *(len(run.state) for run in runs))
    for state in STATES[1:]:
        shown += [f"  {state:{wide}} {name:{width}}  {_details(run)}" for run, name in named if run.state == state]
    return list(map(printable, shown))


def _details(run: RunStatus) -> str:
    parts = []
    if run.state in ("running", "queued"):
        if run.step is not None:
            parts.append(f"step {run.step}/{run.steps}" if run.steps else "loads")
        if run.psnr is not None:
            parts.append(f"val {run.psnr:.2f} dB")
        if run.seconds_left is not None:
            parts.append(f"{_duration(run.seconds_left)} left")
        if run.job is not None:
            parts.append(f"job {run.job}")
    if run.reason:
        parts.append(run.reason)
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    minutes = seconds / 60
    return f"{seconds:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def _watch(folder: Path, in_json: bool) -> int:
    while True:
        if sys.stdout.isatty():
            print("\033[H\033[2J", end="")
        runs = _show(folder, in_json)
        if not any(run.state in GOING for run in runs):
            return _verdict(runs)
        time.sleep(WATCH_SECONDS)


def _verdict(runs: list[RunStatus]) -> int:
    return 1 if any(run.state in BROKEN for run in runs) else 0


def _retry(folder: Path, launch: list[str]) -> int:
    from gsbench.run.grammar import quoted_value  # imports Hydra, which a status does not need
    from gsbench.sweep.parallel import do_or_start
    from gsbench.sweep.retry import retry

    stop.listen()
    folder = folder.resolve()  # runs are launched from the folder that the first command was given in
    experiment = read(folder)
    single = [run for run in status(experiment)
              if run.state in BROKEN and identity(run.overrides) not in experiment.requested]  # fmt: skip
    count = retry(experiment, launch, do_or_start)
    for run in single[:MOST_COMMANDS]:
        words = " ".join(map(shlex.quote, (*run.overrides, f"results={quoted_value(str(folder.parent))}")))
        print(f"gsbench.sweep: not of a sweep, so only its own command starts it again: python -m gsbench "
              f"{printable(words)}", file=sys.stderr)  # fmt: skip
    if len(single) > MOST_COMMANDS:
        print(f"gsbench.sweep: and {len(single) - MOST_COMMANDS} more runs of no sweep", file=sys.stderr)
    if not count and not single:
        print(f"{folder}: no run was stopped, failed, is lost or not started", file=sys.stderr)
    return _verdict(_show(folder, False))


if __name__ == "__main__":
    end_with("gsbench.sweep", main)
