"""Separate command-line overrides that change results from those that set folders or how a run is launched."""

import re
from collections.abc import Sequence

from gsbench.measure.renamed import present_override

UNNAMED = ("results", "resume", "log", "launch")  # groups and keys that change no number of a run
_UNNAMED = re.compile(rf"[+~]*({'|'.join(UNNAMED)})\b")
_LAUNCH = re.compile(r"[+~]*launch\b")


def deciding(overrides: Sequence[str]) -> list[str]:
    """Return the sorted overrides that change results; equal runs have equal lists."""
    return sorted(present_override(one) for one in overrides if not _UNNAMED.match(one))


def launches(override: str) -> bool:
    """Return whether an override only sets how a run is launched, for instance on Slurm."""
    return _LAUNCH.match(override) is not None
