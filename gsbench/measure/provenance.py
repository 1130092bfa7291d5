"""Where a run's numbers come from: the commit, the versions, the machine, the config, the time."""

import hashlib
import json
import platform
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from gsbench.measure.record import Provenance

PACKAGES = ("gsbench", "torch", "numpy", "scikit-image", "lpips", "opencv-contrib-python-headless")


def provenance(*, config: dict[str, Any], data_hash: str, threads: int, device: str | None = None) -> Provenance:
    """The provenance of a run that is finishing now.

    `config` is the whole resolved config as plain JSON, `data_hash` the scene's fingerprint, `device` the GPU's name;
    None stands for the processor, by its name. Imports none of the packages whose versions it notes.
    """
    return Provenance(
        git_commit=git_commit(),
        versions=versions(),
        device=device or processor_name(),
        threads=threads,
        config=config,
        config_hash=config_hash(config),
        data_hash=data_hash,
        time=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def config_hash(config: dict[str, Any]) -> str:
    """sha256 of a resolved config as plain JSON, whatever the order of its keys."""
    canonical = json.dumps(config, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def versions() -> dict[str, str]:
    """The versions of python and of the installed packages that the numbers depend on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def git_commit() -> str | None:
    """The commit of the checkout this file belongs to, "-dirty" added where tracked files differ from it.

    None where git does not track this file: a wheel installed inside somebody's repository is not of their commit.
    """
    here = Path(__file__)
    if _git(here.parent, "ls-files", "--error-unmatch", here.name) is None:
        return None
    return _git(here.parent, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    """What git says, or None where it is not installed, fails or hangs."""
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def processor_name() -> str:
    """The processor as its maker calls it, e.g. "AMD EPYC 9B14"."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
