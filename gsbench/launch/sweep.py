"""Launch the runs of a sweep here, in parallel processes or on Slurm; launch again those that did not end well."""

import os
import shlex
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from gsbench.config_roles import launches
from gsbench.errors import InputError, printable
from gsbench.launch import plan, slurm
from gsbench.launch.command import RunConfig, compose_run, hydra_with
from gsbench.launch.plan import Plan, identity
from gsbench.launch.processes import do_planned, launch_parallel
from gsbench.launch.status import BROKEN, Experiment, PlannedRun, RunStatus, read, status
from gsbench.run.grammar import quoted_value


@dataclass(frozen=True)
class Outcome:
    """How a sweep ended."""

    broken: list[RunStatus]  # the runs that did not end well
    is_refused: bool  # whether not one run began; then its plan is deleted
    experiment: Path  # the folder of its results


def launch(configs: Sequence[RunConfig], config_dir: Path | None) -> Outcome:
    """Launch runs, all by the launcher of the first, and wait until the last of them has ended.

    Raises:
        InputError: the launcher refuses the runs.
        Stopped: a signal asked this process, or that of a run, to end.
    """
    first: DictConfig = configs[0].config
    folder = plan.folder_of(first.results, first.experiment)
    experiment = folder.parents[1]
    runs = [config.overrides for config in configs]
    planned = Plan(first.launch.by, runs, str(config_dir.absolute()) if config_dir else None)
    try:
        plan.write(planned, folder)
    except OSError as error:
        raise InputError(
            f"results: expected a folder that can be written, got '{first.results}': {error.strerror}"
        ) from None
    short = experiment.relative_to(Path.cwd()) if experiment.is_relative_to(Path.cwd()) else experiment
    print(f"{len(runs)} runs; their status: python -m gsbench.launch status {shlex.quote(str(short))}", file=sys.stderr)
    try:
        if planned.launcher == "slurm":
            slurm.launch(configs, planned, folder)
        elif planned.launcher == "parallel":
            launch_parallel(configs, folder)
        else:
            for run_number, config in enumerate(configs):
                do_planned(config, folder, run_number)
    except InputError:
        plan.forget(folder)
        raise
    ended = plan.read_ended(folder)
    if len(ended) == len(runs) and all(outcome.is_refused for outcome in ended.values()):
        plan.forget(folder)
        return Outcome([], True, experiment)
    wanted = set(map(identity, runs))
    states = [run for run in status(read(experiment)) if identity(run.overrides) in wanted]
    return Outcome([run for run in states if run.state in (*BROKEN, "planned")], False, experiment)


def retry(experiment: Experiment, more: Sequence[str]) -> int:
    """Launch those runs of sweeps again that were stopped, failed, are lost or not started; return their number.

    Runs that were launched alike are launched together, with the launch settings `more`. If they cannot be launched,
    for example because the folder in which their command was typed is gone, the reason is printed on stderr, and the
    others are still launched.

    Raises:
        InputError: `more` has an override that is not known or does not belong to the launch settings.
    """
    for override in more:
        if not launches(override):
            raise InputError(f"retry: expected overrides of launch, such as launch.memory=16G, got '{override}'")
    with hydra_with(None):
        compose_run(["+exp=mini", "scene=suzanne", *more])  # any run, to check `more`
    states = {identity(run.overrides): run.state for run in status(experiment)}
    groups: dict[tuple[str | None, ...], list[PlannedRun]] = defaultdict(list)
    for key, run in experiment.planned.items():
        if states[key] in BROKEN:
            groups[(run.plan.cwd, run.plan.config_dir, *filter(launches, run.overrides))].append(run)
    for group in groups.values():
        try:
            _launch_again(experiment, group, more)
        except InputError as error:
            print(
                f"gsbench.launch: {len(group)} runs of {group[0].folder / plan.FILE_NAME} cannot be launched again: "
                f"{printable(error)}",
                file=sys.stderr,
            )
    return sum(map(len, groups.values()))


def _launch_again(experiment: Experiment, group: Sequence[PlannedRun], more: Sequence[str]) -> None:
    """Launch runs of one plan again, with the launch settings `more`.

    They start in the folder where their command was typed, because their paths are relative to it.
    """
    results = f"results={quoted_value(str(experiment.folder.parent.resolve()))}"
    planned = group[0].plan
    try:
        os.chdir(planned.cwd)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{planned.cwd!r:.200}, the folder where its command was typed and its paths start: "
            f"{getattr(error, 'strerror', error)}"
        ) from None
    config_dir = Path(planned.config_dir) if planned.config_dir else None
    with hydra_with(config_dir):
        configs = [
            compose_run([*(word for word in run.overrides if not word.startswith("results=")), results, *more])
            for run in group
        ]
        print(f"{len(group)} runs again, launch={configs[0].config.launch.by}", file=sys.stderr)
        launch(configs, config_dir)
