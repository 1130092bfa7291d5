"""Do the run of a config that a sweep composed, in whatever process or job the sweep put it."""

import sys

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from gsbench.errors import InputError


def do(composed: DictConfig) -> str | None:
    """Do a run; return why it did not end well, which is on stderr too, or None."""
    from gsbench.run.run import run  # imports torch

    chosen = HydraConfig.get()
    try:
        record = run(composed, chosen.runtime.choices, chosen.overrides.task)
        problem = None if record is None or record.status == "ok" else f"{record.status}: {record.reason}"
    except InputError as error:
        problem = str(error)
    if problem:
        print(f"gsbench: error: {composed.scene.name}: {problem}", file=sys.stderr)
    return problem
