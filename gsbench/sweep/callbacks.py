"""Write the plan of a sweep when Hydra starts it, and the outcome of each run when the run ends.

Hydra calls `WritePlan`, which conf/config.yaml lists under hydra.callbacks. With Slurm, the `WritePlan` object is
pickled into every job.
"""

import copy
import os
import shlex
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.conf import HydraConf
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from gsbench.errors import InputError, one_line
from gsbench.measure.record import FILE_NAME
from gsbench.run.progress import born
from gsbench.sweep import container, plan
from gsbench.sweep.plan import Ended, Plan
from gsbench.sweep.task import Problem

started: list[Path] = []  # the folders of the plans that this process wrote


class WritePlan(Callback):
    """A Hydra callback that writes plan.json when a sweep starts, and `ended/<number>.json` when a run ends."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the plan of the sweep, and print the command that shows the status of its runs."""
        planned = plan_of(expand(config), config)
        folder = Path(config.hydra.sweep.dir)
        plan.write(planned, folder)
        started.append(folder)
        container.use(config, planned.runs)
        experiment = folder.parents[1]
        print(f"{len(planned.runs)} runs; their status: python -m gsbench.sweep status {shlex.quote(str(experiment))}",
              file=sys.stderr)  # fmt: skip

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note when the run starts, and prepare the process of a job that runs in a container image."""
        self._began = time.time()
        if config.launch.container is not None:
            container.enter()

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write the outcome of the run, which contains the path of its record, and print the time left of the sweep.

        The path is stored because two commands may request the same run with different overrides.
        """
        is_started = is_parallel(config.hydra) and job_return.status == JobStatus.COMPLETED  # its process writes it
        if config.hydra.mode == RunMode.MULTIRUN and not is_started:
            # `return_value` would print an error, and raise it
            composed = copy.deepcopy(config)
            with read_write(composed), open_dict(composed):
                del composed["hydra"]
            write_outcome(config.hydra, composed, job_return._return_value, self._began)


def is_parallel(hydra: HydraConf) -> bool:
    """Return whether each run has a process of its own on this machine (`+launch=parallel`)."""
    return bool(hydra.runtime.choices.get("launch") == "parallel")


def write_outcome(hydra: HydraConf, composed: DictConfig, problem: object, began: float, at_once: int = 1) -> None:
    """Write the outcome of a run of a sweep that ended in this process, and print the time left of the sweep.

    Args:
        hydra: Hydra's own config of the run.
        composed: the config of the run, without Hydra's.
        problem: why the run did not end well; None if it did.
        began: the time at which the run started, Unix seconds.
        at_once: the number of runs at a time.
    """
    folder = Path(str(hydra.sweep.dir))
    outcome = ended(composed, hydra.runtime.choices, problem, folder.parents[2], began)
    plan.write_ended(folder, hydra.job.num, outcome)
    if "submitit" not in hydra.launcher._target_:  # Slurm starts its jobs when it can
        line = time_left(folder, at_once)
        print(line, end="\n" if line else "", file=sys.stderr)


def expand(config: DictConfig) -> list[list[str]]:
    """Return the Hydra overrides of each run of a sweep, expanded in the same way as by Hydra's own sweeper."""
    params = [f"{key}={value}" for key, value in (config.hydra.sweeper.params or {}).items()]
    overrides = OverridesParser.create().parse_overrides([*params, *config.hydra.overrides.task])
    (runs,) = BasicSweeper.split_arguments(overrides, None)
    return runs


def plan_of(runs: Sequence[Sequence[str]], config: DictConfig) -> Plan:
    """Return the plan of a sweep: the runs that this process launches, and how it launches them."""
    return Plan(
        launcher=config.hydra.runtime.choices["hydra/launcher"],
        runs=[list(run) for run in runs],
        hydra=list(config.hydra.overrides.hydra),
        cwd=os.getcwd(),
        host=socket.gethostname(),
        pid=os.getpid(),
        born=born(os.getpid()),
        started=time.time(),
    )


def time_left(folder: Path, at_once: int) -> str:
    """Return a line with the number of ended runs of a sweep, and about how long its other runs will take.

    The other runs are expected to take as long as the mean of those that this sweep has trained. The line is empty
    before the first of these, and after the last run.

    Args:
        folder: the folder of the sweep's plan.
        at_once: the number of runs at a time.
    """
    total, outcomes = len(plan.read(folder / plan.FILE_NAME).runs), plan.read_ended(folder)
    took = [outcome.seconds for outcome in outcomes.values() if outcome.seconds is not None]
    left = total - len(outcomes)
    if not took or left <= 0:
        return ""
    seconds = fmean(took) * left / max(1, min(at_once, left))
    about = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
    return f"{len(outcomes)} of {total} runs have ended; about {about} left"


def ended(composed: DictConfig, choices: Mapping[str, str], problem: object, results: Path, began: float) -> Ended:
    """Return the outcome of a run that ended in this process: the path of its record, or why there is none.

    `began` is the time (Unix seconds) at which the run started; a record that is older was kept.
    """
    if isinstance(problem, Problem) and problem.is_refused:
        return Ended(None, problem.reason, is_refused=True)
    if isinstance(problem, InputError):
        return Ended(None, str(problem), is_refused=True)
    from gsbench.run.identity import identify  # imports torch, which the run has loaded already

    try:
        path = identify(composed, choices).folder / FILE_NAME
    except (InputError, OmegaConfBaseException) as error:  # the latter: a key of the run has no value
        return Ended(None, one_line(error))
    if not path.exists():
        return Ended(None, "it ended without a record")
    seconds = time.time() - began if path.stat().st_mtime >= began else None
    return Ended(os.path.relpath(path, results), None, seconds=seconds)
