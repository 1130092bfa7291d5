"""Separate the overrides that decide a run's results from those that only set its folder or how it is launched."""

import re
from collections.abc import Sequence

from gsbench.measure.renamed import present_override

UNNAMED = ("results", "resume", "launch")  # groups and keys that change no number of a run
_UNNAMED = re.compile(rf"[+~]*({'|'.join(UNNAMED)})\b")
_LAUNCH = re.compile(r"[+~]*launch\b")


def deciding(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that decide a run's results, sorted; two commands of the same run have the same ones."""
    return sorted(present_override(one) for one in overrides if not _UNNAMED.match(one))


def launches(override: str) -> bool:
    """Tell whether an override says how a run is launched."""
    return _LAUNCH.match(override) is not None
