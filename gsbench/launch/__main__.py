"""Show the state of an experiment's runs and the time that they still need, or launch again what did not finish.

python -m gsbench.launch status results/EXP [--watch] [--json]
python -m gsbench.launch retry results/EXP [launch.memory=16G ...]
"""

import argparse
import os
import shlex
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from gsbench.errors import InputError, printable
from gsbench.launch import plan
from gsbench.launch.plan import identity
from gsbench.launch.status import BROKEN, DAMAGED, GOING, STATES, Experiment, RunStatus, read, status
from gsbench.process.ending import end_with
from gsbench.reading import as_json
from gsbench.run import stop

WATCH_SECONDS = 10.0
MOST_COMMANDS = 20  # commands that are printed for runs outside a sweep


def main(arguments: list[str] | None = None) -> int:
    """Do what the command line says, and return the exit status.

    Returns:
        0 if all runs are done or going on, 1 if a run was stopped, has not started, failed or is lost, 2 if the folder
        or an argument is wrong, and 128 and its number after a signal (Ctrl-C: 130).
    """
    parser = argparse.ArgumentParser(prog="python -m gsbench.launch", description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    texts = {
        "status": "show the state of each run: done, running, stopped, failed, ...",
        "retry": "launch again the runs that were stopped, failed, are lost or not started",
        "job": "do one run of a plan; a job of Slurm calls it",
    }
    parsers = {name: commands.add_parser(name, help=text) for name, text in texts.items()}
    for name, command in parsers.items():
        command.add_argument("folder", type=Path, metavar="FOLDER" if name == "job" else "results/EXP")
    parsers["status"].add_argument("--watch", action="store_true", help="repeat until no run is running or waiting")
    parsers["status"].add_argument("--json", action="store_true", help="print all runs as JSON, also done ones")
    parsers["retry"].add_argument("launch", nargs="*", metavar="launch.KEY=VALUE", help="launch settings to change")
    parsers["job"].add_argument("number", type=int, help="the run's place in the plan")
    options = parser.parse_args(arguments)
    try:
        if not options.folder.is_dir():
            raise InputError(
                f"{options.folder}: expected the folder of an experiment, such as results/mini",
                docs="runs.md#the-folder-of-a-run",
            )
        if options.command == "job":
            return _job(options.folder, options.number)
        if options.command == "retry":
            return _retry(options.folder, options.launch)
        while options.watch:
            if sys.stdout.isatty():
                print("\033[H\033[2J", end="")
            runs = _show(options.folder, options.json)
            if not any(run.state in GOING for run in runs):
                return _verdict(runs)
            time.sleep(WATCH_SECONDS)
        return _verdict(_show(options.folder, options.json))
    except InputError as error:
        print(f"gsbench.launch: {printable(error)}", file=sys.stderr)
        return 2
    except stop.Stopped as stopped:
        print(f"gsbench.launch: {stopped}", file=sys.stderr)
        return stopped.code
    except KeyboardInterrupt:
        return 130


def lines(experiment: Experiment, runs: Sequence[RunStatus]) -> list[str]:
    """Return lines of text that show the states of the runs of an experiment."""
    counts = Counter(run.state for run in runs)
    summary = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    folder = experiment.folder
    text = [f"{folder}: {len(runs)} runs: {summary}" if runs else f"{folder}: no run was asked for"]
    text += [f"a plan is left out: {reason}" for reason in experiment.damaged]
    if silent := experiment.queue.silent:
        text.append(f"Slurm did not answer ({silent}): a run that reported in the last 10 minutes counts as running")
    if time_left := _time_left(runs):
        text.append(time_left)
    common = set.intersection(*(set(run.overrides) for run in runs)) if len(runs) > 1 else set()
    named = [(run, " ".join(word for word in run.overrides if word not in common)) for run in runs]
    name_width = max((len(name) for run, name in named if run.state != "done"), default=0)
    width = max([8, *(len(run.state) for run in runs)])
    for state in STATES[1:]:  # not of runs that are done
        text += [f"  {state:{width}} {name:{name_width}}  {_details(run)}" for run, name in named if run.state == state]
    return list(map(printable, text))


def _time_left(runs: Sequence[RunStatus]) -> str:
    """Return how long the runs that are not done will train, if the mean of those that are is known; else ""."""
    trained = [run.train_s for run in runs if run.train_s is not None]
    left = [run for run in runs if run.state != "done"]
    if not trained or not left:
        return ""
    seconds = sum(fmean(trained) if run.seconds_left is None else run.seconds_left for run in left)
    return f"  about {plan.duration(seconds)} of training left, one run after the other, each as long as those done"


def _details(run: RunStatus) -> str:
    """Return what a line says of a run behind its name: step, PSNR, time left and job, or why it does not run."""
    phrases = []
    if run.state in ("running", "queued"):
        if run.step is not None:
            phrases.append(f"step {run.step}/{run.steps}" if run.steps else "loads")
        if run.psnr is not None:
            phrases.append(f"val {run.psnr:.2f} dB")
        if run.seconds_left is not None:
            phrases.append(f"{plan.duration(run.seconds_left)} left")
        if run.job is not None:
            phrases.append(f"job {run.job}")
    if run.reason:
        phrases.append(run.reason)
    return ", ".join(phrases)


def _show(folder: Path, in_json: bool) -> list[RunStatus]:
    experiment = read(folder)
    runs = status(experiment)
    print(as_json(runs) if in_json else "\n".join(lines(experiment, runs)), flush=True)
    return runs


def _verdict(runs: list[RunStatus]) -> int:
    return 1 if any(run.state in BROKEN for run in runs) else 0


def _retry(folder: Path, launch: list[str]) -> int:
    """Launch the broken runs of sweeps again, and print the commands of other broken runs; return the exit status."""
    from gsbench.launch.sweep import retry  # imports Hydra, which a status does not need
    from gsbench.run.grammar import quoted_value

    stop.listen()
    folder = folder.resolve()  # runs are launched from the folder that the first command was typed in
    experiment = read(folder)
    broken = [
        run for run in status(experiment) if run.state in BROKEN and identity(run.overrides) not in experiment.planned
    ]
    count = retry(experiment, launch)
    single = [run for run in broken if not " ".join(run.overrides).startswith(DAMAGED)]  # their lines say what to do
    for run in single[:MOST_COMMANDS]:
        words = " ".join(map(shlex.quote, (*run.overrides, f"results={quoted_value(str(folder.parent))}")))
        print(
            f"gsbench.launch: not of a sweep, so only its own command starts it again: python -m gsbench "
            f"{printable(words)}",
            file=sys.stderr,
        )
    if len(single) > MOST_COMMANDS:
        print(f"gsbench.launch: and {len(single) - MOST_COMMANDS} more runs of no sweep", file=sys.stderr)
    if not count and not broken:
        print(f"{folder}: no run was stopped, failed, is lost or not started", file=sys.stderr)
    return _verdict(_show(folder, False))


def _job(folder: Path, run_number: int) -> int:
    """Do run `run_number` of the plan in `folder`, in a job of Slurm."""
    from gsbench.launch.command import compose_run, hydra_with
    from gsbench.launch.processes import do_planned

    stop.listen()
    sys.path.append(os.getcwd())  # `python -P` leaves it out, but a model of the user's may be there
    planned = plan.read(folder / plan.FILE_NAME)
    if not 0 <= run_number < len(planned.runs):
        raise InputError(
            f"job: expected the number of a run in {folder}, 0 to {len(planned.runs) - 1}, got {run_number}"
        )
    with hydra_with(Path(planned.config_dir) if planned.config_dir else None):
        config = compose_run(planned.runs[run_number])
        return 0 if do_planned(config, folder, run_number, at_once=0).reason is None else 1


if __name__ == "__main__":
    end_with("gsbench.launch", main)
