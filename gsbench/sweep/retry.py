"""Relaunch those runs of an experiment that failed, were lost or never started, with their original launcher."""

import os
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF, register_schema
from gsbench.config_roles import launches
from gsbench.errors import InputError, printable
from gsbench.run.grammar import quoted_value
from gsbench.sweep import container, plan
from gsbench.sweep.axes import SCENES_DEPEND_ON, scenes_of
from gsbench.sweep.callbacks import plan_of
from gsbench.sweep.explain import explain
from gsbench.sweep.finish import see_through
from gsbench.sweep.plan import identity
from gsbench.sweep.status import BROKEN, Experiment, RequestedRun, status

CONFIG_NAME = "config"


def broken(experiment: Experiment) -> list[RequestedRun]:
    """List the requested runs that failed, were lost or never started."""
    states = {identity(run.overrides): run.state for run in status(experiment)}
    return [run for one, run in experiment.requested.items() if states[one] in BROKEN]


def retry(experiment: Experiment, more: Sequence[str], task: Callable[[DictConfig], Any]) -> int:
    """Relaunch the runs that failed, were lost or never started; wait for them, and return their number.

    Args:
        experiment: the state of the experiment, read just before.
        more: overrides of the launch settings, such as more memory.
        task: the function that executes a run from its composed config.

    The runs are launched in groups with the same launch settings. If a group cannot be launched, this is printed on
    stderr, and the other groups are still launched. For example, the folder in which its command was given may be gone,
    or an override may no longer be known.

    Raises:
        InputError: `more` has an override that is not known or does not belong to the launch settings.
    """
    for one in more:
        if not launches(one):
            raise InputError(f"retry: expected overrides of launch, such as launch.memory=16G, got '{one}'")
    register_schema()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            compose(CONFIG_NAME, list(more))
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(f"retry: {explain(error)}") from None
    groups: dict[tuple[str, ...], list[RequestedRun]] = defaultdict(list)
    for requested in broken(experiment):
        groups[(requested.plan.cwd, *_launch(requested), *requested.plan.hydra)].append(requested)
    for group in groups.values():
        try:
            _relaunch(experiment, group, more, task)
        except (HydraException, OmegaConfBaseException, OSError, ValueError) as error:  # ValueError: of the launcher
            why = explain(error) if isinstance(error, HydraException | OmegaConfBaseException) else str(error)
            print(f"gsbench.sweep: {len(group)} runs of {group[0].folder / plan.FILE_NAME} cannot be launched again: "
                  f"{printable(why)}", file=sys.stderr)  # fmt: skip
    return sum(map(len, groups.values()))


def _launch(requested: RequestedRun) -> list[str]:
    """Return those overrides of a run that say how it is launched."""
    return [one for one in requested.overrides if launches(one)]


def _relaunch(
    experiment: Experiment, group: list[RequestedRun], more: Sequence[str], task: Callable[[DictConfig], Any]
) -> None:
    """Launch runs of one earlier command again, through Hydra's launcher but without its sweeper.

    The runs do not form a complete grid, so a sweeper could not expand them.
    """
    first = group[0]
    results = str(experiment.folder.parent.resolve())
    try:
        os.chdir(first.plan.cwd)
    except (OSError, ValueError) as error:
        raise InputError(f"{first.plan.cwd!r:.200}, the folder where its command was given and its paths start: "
                         f"{getattr(error, 'strerror', error)}") from None  # fmt: skip
    # Scenes that have no file in conf/ become choices of the group `scene`, as when the command was given.
    scenes_of([one for one in first.overrides if one.partition("=")[0].lstrip("+") in SCENES_DEPEND_ON])
    runs = [[*(one for one in requested.overrides if not one.startswith("results=")),
             f"results={quoted_value(results)}", *more] for requested in group]  # fmt: skip
    with initialize_config_dir(str(CONF), job_name="gsbench", version_base="1.3"):
        config = compose(CONFIG_NAME, [*first.plan.hydra, *_common(runs)], return_hydra_config=True)
        with open_dict(config):
            config.hydra.mode = RunMode.MULTIRUN
            config.hydra.runtime.output_dir = config.hydra.sweep.dir
        folder = Path(config.hydra.sweep.dir)
        plan.write(plan_of(runs, config), folder)
        container.use(config, runs)
        print(f"{len(runs)} runs again, launch={config.hydra.runtime.choices.get('launch', 'local')}", file=sys.stderr)
        context = HydraContext(config_loader=GlobalHydra.instance().config_loader(), callbacks=Callbacks(config))
        launcher = Plugins.instance().instantiate_launcher(hydra_context=context, task_function=task, config=config)
        see_through(lambda: _raise_first([job._return_value for job in launcher.launch(runs, 0)]), [folder])


def _raise_first(returned: Sequence[object]) -> None:
    """Raise the first error among what the runs returned: one that refused a run. Hydra's sweeper does the same."""
    for value in returned:
        if isinstance(value, Exception):
            raise value


def _common(runs: list[list[str]]) -> list[str]:
    """Return the overrides that all runs share, in their order; the config of the launch is composed from them."""
    return [one for one in runs[0] if all(one in run for run in runs)]
