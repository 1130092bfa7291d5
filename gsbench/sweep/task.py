"""Execute one run of a sweep from its composed config, in the process or job that the launcher chose."""

import sys
from dataclasses import dataclass

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from gsbench.errors import InputError, one_line, printable
from gsbench.process.memory import is_out_of_memory, too_little_address_space


@dataclass(frozen=True)
class Problem:
    """The reason why a run did not end well, and whether the run was refused before it started."""

    reason: str
    is_refused: bool  # whether the settings are invalid, so that nothing was run or recorded


def do(composed: DictConfig) -> Problem | None:
    """Execute a run; return None if it ended well, otherwise the reason, which is also printed on stderr."""
    chosen = HydraConfig.get()
    if (too_little := too_little_address_space()) is not None:
        return _told(composed, Problem(f"out of memory: {too_little}", False))
    try:
        from gsbench.run.run import UnrecordedError, run  # imports torch
    except (ImportError, OSError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        return _told(composed, Problem(f"out of memory while torch is loaded: {one_line(error)}", False))
    try:
        record = run(composed, chosen.runtime.choices, chosen.overrides.task)
        if record is None or record.status == "ok":
            return None
        problem = Problem(f"{record.status}: {record.reason}", False)
    except InputError as error:
        problem = Problem(str(error), not isinstance(error, UnrecordedError))
    except MemoryError as error:  # there was not enough memory to write a record
        problem = Problem(f"out of memory: {one_line(error)}", False)
    return _told(composed, problem)


def _told(composed: DictConfig, problem: Problem) -> Problem:
    print(f"gsbench: error: {printable(f'{composed.scene.name}: {problem.reason}')}", file=sys.stderr)
    return problem
