"""Do one run (stub)."""

import sys
from omegaconf import DictConfig

def do(composed: DictConfig) -> None:
    """Do it."""
    from gsbench.errors import InputError
    from gsbench.run.run import run

    try:
        run(composed)
    except InputError as error:
        print(f"gsbench: error: {composed.scene.name}: {error}", file=sys.stderr)
