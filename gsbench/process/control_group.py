"""Read how much memory the control groups of this process leave to it, in both versions that Linux has.

The limit of a container or of a batch job can be set on any group between the root and that of the process.
"""

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple


class Files(NamedTuple):
    """Hold the names of the files of a control group in which a version of Linux's control groups has its memory."""

    limit: str
    used: str
    cache: str  # the line in memory.stat: cached files, which the system can drop at any time and which `used` counts


VERSIONS = {
    "cgroup2": Files("memory.max", "memory.current", "inactive_file"),
    "cgroup": Files("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}


def available(root: Path = Path("/")) -> int | None:
    """Return the bytes that the control groups of this process leave to it; None if no limit can be read.

    Args:
        root: the folder that has proc/ and the mounted control groups.
    """
    left = (_left(folder, VERSIONS[version]) for version, folder in _folders(root))
    return min((x for x in left if x is not None), default=None)


def _folders(root: Path) -> Iterator[tuple[str, Path]]:
    """Yield the version and the folder of each control group that can limit this process: its own and those above."""
    groups = {}  # the path of this process' group, by the version of control groups
    for line in _lines(root / "proc/self/cgroup"):
        number, controllers, path = (*line.split(":", 2), "", "")[:3]
        if number == "0" and not controllers:
            groups["cgroup2"] = path
        elif "memory" in controllers.split(","):
            groups["cgroup"] = path
    for line in _lines(root / "proc/self/mountinfo"):
        mount, _, filesystem = line.partition(" - ")
        kind, _, options = filesystem.partition(" ")
        fields = [re.sub(r"\\([0-7]{3})", lambda octal: chr(int(octal[1], 8)), x) for x in mount.split(" ")]
        if kind not in groups or len(fields) < 5 or (kind == "cgroup" and "memory" not in re.split("[ ,]", options)):
            continue
        top = root / fields[4].lstrip("/")
        group = PurePosixPath(groups[kind])
        inside = group.relative_to(fields[3]) if group.is_relative_to(fields[3]) else PurePosixPath()
        if ".." in inside.parts:  # the group of this process is above what this container can see
            inside = PurePosixPath()
        for folder in (inside, *inside.parents):
            yield kind, top / folder


def _left(folder: Path, files: Files) -> int | None:
    """Return the bytes that one control group leaves; None if it has no limit."""
    try:
        left = int((folder / files.limit).read_text()) - int((folder / files.used).read_text())
        cached = [int(n) for key, n in (x.split() for x in _lines(folder / "memory.stat")) if key == files.cache]
    except (OSError, ValueError):  # no such group, no limit ("max"), or something else than numbers
        return None
    return max(0, left + sum(cached))


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except (OSError, ValueError):  # ValueError: not text
        return []
