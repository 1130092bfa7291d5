"""Say how to install the packages of an extra, without the name `gsbench`: in PyPI that is another project's.

This module does not import torch.
"""

from importlib import metadata

COMMAND = "gsbench.__main__:main"  # that of this project in the metadata of its distribution


def how_to_install(
    extra: str,  # such as view
) -> str:
    """Return the command that installs an extra, from a checkout or from a wheel."""
    return f"pip install '.[{extra}]' in a checkout of gsbench, or 'WHEEL.whl[{extra}]'"


def requirements() -> list[str]:
    """Return what the installed distribution of gsbench requires, whatever its name is; [] if it is not installed."""
    for command in metadata.entry_points(group="console_scripts", name="gsbench"):
        if command.value == COMMAND and command.dist is not None:
            return command.dist.requires or []
    return []
