"""Read constants and arguments from the C++ headers of the kernels, so that C++ and Python use the same."""

import re
from importlib import resources

_ARGUMENTS = ("arguments.h", "cpu/kernels.h", "cuda/kernels.h")
_LINE = re.compile(r"^constexpr (int|float|double) (\w+) = ([\d.e-]+)f?(?: / ([\d.]+)f)?;", re.MULTILINE)


def _constants(header: str, *kinds: str) -> dict[str, float]:
    """Return the constants of these types in a C++ header of this package, by name."""
    text = resources.files("gsbench.kernels").joinpath(header).read_text()
    return {
        name: float(value) / float(divisor or 1)
        for type_, name, value, divisor in _LINE.findall(text)
        if type_ in kinds
    }


def argument_structures() -> set[tuple[str, str]]:
    """Return the role and the field names, such as ("OUTPUTS", "means, factors"), of each structure of arguments."""
    folder = resources.files("gsbench.kernels")
    text = "".join(folder.joinpath(header).read_text() for header in _ARGUMENTS)
    declared = re.findall(r"^GSB_(?:FIELDS\(\w+|ARRAYS\(\w+, \w+), (\w+), ([^)]*)\)", text, re.MULTILINE)
    return {(role, ", ".join(re.findall(r"\w+", names))) for role, names in declared}


_thresholds = _constants("math/thresholds.h", "float", "double")
LOG_SIZE_MAX = _thresholds["LOG_SIZE_MAX"]
EXPONENT_MAX = _thresholds["EXPONENT_MAX"]
TIME_OPACITY_FACTOR_MIN = _thresholds["TIME_OPACITY_FACTOR_MIN"]
ALPHA_MIN = _thresholds["ALPHA_MIN"]
ALPHA_MAX = _thresholds["ALPHA_MAX"]
TRANSMITTANCE_MIN = _thresholds["TRANSMITTANCE_MIN"]
RIM_MIN = _thresholds["RIM_MIN"]
DIRECT_FADING = _thresholds["DIRECT_FADING"]
BETA_LOG_MIN = _thresholds["BETA_LOG_MIN"]

_sizes = _constants("math/sizes.h", "int")
TILE = int(_sizes["TILE"])
MAX_WAVES = int(_sizes["MAX_WAVES"])
HIDDEN = int(_sizes["HIDDEN"])
MAX_NETWORKS = int(_sizes["MAX_NETWORKS"])
MAX_VALUES = int(_sizes["MAX_VALUES"])
MAX_ADAM = int(_sizes["MAX_ADAM"])
