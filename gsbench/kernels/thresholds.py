"""The numbers of math/thresholds.h, read from it: one source for the kernels and for the same mathematics in torch."""

import re
from importlib import resources

_LINE = re.compile(r"^constexpr float (\w+) = ([\d.]+)f;", re.MULTILINE)
_VALUES = dict(_LINE.findall(resources.files("gsbench.kernels").joinpath("math/thresholds.h").read_text()))

LOG_SIZE_MAX = float(_VALUES["LOG_SIZE_MAX"])
EXPONENT_MAX = float(_VALUES["EXPONENT_MAX"])
TIME_GATE_MIN = float(_VALUES["TIME_GATE_MIN"])
