"""Describe the provenance of a run: its commit, versions, machine, config and time."""

import hashlib
import json
import platform
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from gsbench.measure.machine import hardware
from gsbench.measure.record import Provenance
from gsbench.version import __version__

PACKAGES = ("torch", "numpy", "scikit-image", "lpips", "opencv-contrib-python-headless")


def provenance(
    *,
    config: dict[str, Any],
    data_hash: str,
    threads: int,
    device: str | None = None,
    instruction_set: str | None = None,
) -> Provenance:
    """Describe the provenance of a run that ends now; the packages whose versions it records are not imported.

    Args:
        config: the whole resolved config, plain JSON.
        data_hash: the fingerprint of the scene.
        threads: the number of threads of torch, which is also that of the kernels.
        device: the name of the GPU; None stands for the processor, which is then named.
        instruction_set: the instruction set that the CPU's kernels run with; None if they are not built.
    """
    here = hardware(instruction_set)
    return Provenance(
        git_commit=git_commit(),
        versions=versions(),
        device=device or here.processor,
        threads=threads,
        config=config,
        config_hash=config_hash(config),
        data_hash=data_hash,
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        hardware=here,
    )


def config_hash(config: dict[str, Any]) -> str:
    """Compute the SHA-256 of a resolved config in plain JSON; the order of its keys does not matter."""
    canonical = json.dumps(config, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of python, of gsbench and of the installed packages that the numbers depend on."""
    found = {"python": platform.python_version(), "gsbench": __version__}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


NO_CODE = ("results", "docs", "*.md")


def git_commit() -> str | None:
    """Return the commit of the checkout that this file belongs to, with "-dirty" if tracked code differs from it.

    Changed results and texts do not count, as they change no number. The commit is None if git does not track this
    file, as in a wheel that is installed inside another repository.
    """
    here = Path(__file__)
    if _git(here.parent, "ls-files", "--error-unmatch", here.name) is None:
        return None
    head = _git(here.parent, "rev-parse", "HEAD")
    changed = _git(here.parent, "diff", "--name-only", "HEAD", "--", ":/", *(f":(top,exclude){x}" for x in NO_CODE))
    return f"{head}-dirty" if head is not None and changed else head


def _git(folder: Path, *arguments: str) -> str | None:
    """Run git and return its output; None if git is not installed, fails, hangs or lacks memory."""
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError, MemoryError):
        return None
    return done.stdout.strip()
