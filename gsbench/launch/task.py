"""Do one run in this process, and write its outcome beside the plan of its sweep."""

import os
import sys
import time
import traceback
from pathlib import Path

from omegaconf.errors import OmegaConfBaseException

from gsbench.errors import InputError, one_line, printable
from gsbench.launch import plan
from gsbench.launch.command import RunConfig, explain
from gsbench.launch.plan import Ended
from gsbench.measure.record import FILE_NAME
from gsbench.process.memory import is_out_of_memory, too_little_address_space


def do_planned(config: RunConfig, folder: Path, number: int, at_once: int = 1) -> Ended:
    """Do run `number` of the sweep whose plan is in `folder`; write its outcome, and print the time left.

    Args:
        config: the run.
        folder: the folder of the plan.
        number: the run's place in the plan.
        at_once: the number of runs at a time; 0 if nobody knows, as on Slurm.
    """
    ended = do(config)
    plan.write_ended(folder, number, ended)
    if at_once and (line := plan.time_left(folder, at_once)):
        print(line, file=sys.stderr)
    return ended


def do(config: RunConfig) -> Ended:
    """Do a run, and return its outcome; a reason why it did not end well is printed too."""
    began, results = time.time(), Path(config.config.results).absolute()
    try:
        ended = _done(config, began, results)
    except OmegaConfBaseException as error:  # a reference in the config that leads nowhere
        ended = Ended(reason=explain(error), is_refused=True)
    except InputError as error:
        ended = Ended(reason=str(error), is_refused=True)
    except Exception as error:
        if not is_out_of_memory(error):
            traceback.print_exc()
        kind = "out of memory" if is_out_of_memory(error) else type(error).__name__
        ended = Ended(reason=f"{kind}: {one_line(error)}")
    if ended.reason is not None:
        print(f"gsbench: error: {printable(f'{config.config.scene.name}: {ended.reason}')}", file=sys.stderr)
    return ended


def _done(config: RunConfig, began: float, results: Path) -> Ended:
    if (limit := too_little_address_space()) is not None:
        raise MemoryError(limit)
    from gsbench.run.identity import identify  # imports torch
    from gsbench.run.run import UnrecordedError, run

    path = identify(config.config, config.choices).folder.absolute() / FILE_NAME
    try:
        record = run(config.config, config.choices, config.overrides)
    except UnrecordedError as error:
        return Ended(reason=str(error))
    problem = None if record is None or record.status == "ok" else f"{record.status}: {record.reason}"
    if not path.exists():  # another process does the run
        return Ended(reason=problem or "it ended without a record" if record else None)
    seconds = time.time() - began if path.stat().st_mtime >= began else None  # an older record was kept
    return Ended(os.path.relpath(path, results), problem, seconds=seconds)
