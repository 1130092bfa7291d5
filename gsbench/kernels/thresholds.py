"""The numbers of math/thresholds.h, read from it: one source for the kernels and for the same mathematics in torch."""

import re
from importlib import resources

_LINE = re.compile(r"^constexpr float (\w+) = ([\d.e-]+)f(?: / ([\d.]+)f)?;", re.MULTILINE)
_TEXT = resources.files("gsbench.kernels").joinpath("math/thresholds.h").read_text()
_VALUES = {name: float(value) / float(divisor or 1) for name, value, divisor in _LINE.findall(_TEXT)}

LOG_SIZE_MAX = _VALUES["LOG_SIZE_MAX"]
EXPONENT_MAX = _VALUES["EXPONENT_MAX"]
TIME_GATE_MIN = _VALUES["TIME_GATE_MIN"]
ALPHA_MIN = _VALUES["ALPHA_MIN"]
ALPHA_MAX = _VALUES["ALPHA_MAX"]
TRANSMITTANCE_MIN = _VALUES["TRANSMITTANCE_MIN"]
