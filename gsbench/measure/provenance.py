"""Collect the provenance of a run: its commit, package versions, machine, settings and time."""

import functools
import platform
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench import kernels
from gsbench.config_roles import config_hash
from gsbench.measure.machine import hardware
from gsbench.measure.record import Provenance
from gsbench.version import __version__

if TYPE_CHECKING:
    from gsbench.scenes import Scene

PACKAGES = ("torch", "numpy", "scikit-image", "lpips", "opencv-contrib-python-headless")


def provenance(config: dict[str, Any], scene: "Scene | None", device: str) -> Provenance:
    """Return the provenance of a run that ends now.

    Args:
        config: all settings of the run with references resolved, as plain JSON.
        scene: the scene; None if it could not be loaded.
        device: "cpu" or a GPU of this machine, such as "cuda".
    """
    import torch

    here = hardware(kernels.instruction_set())
    return Provenance(
        git_commit=running_commit(),
        versions=versions(),
        device=torch.cuda.get_device_name(device) if device.startswith("cuda") else here.processor,
        threads=torch.get_num_threads(),
        config=config,
        config_hash=config_hash(config),
        data_hash=scene.fingerprint if scene else "not loaded",
        data_notes=[*scene.notes] if scene else [],
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        hardware=here,
    )


def versions() -> dict[str, str]:
    """Return the versions of Python, gsbench and the installed packages that results depend on."""
    installed = {"python": platform.python_version(), "gsbench": __version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            installed[package] = metadata.version(package)
    return installed


NO_CODE = ("results", "docs", "*.md")


def git_commit() -> str | None:
    """Return the git commit of gsbench's checkout, with the suffix "-dirty" if code was changed or added.

    If git cannot say whether code was changed, the suffix is there too. Changed results and documents do not count,
    because they change no measurement. Of new files, those in gsbench and conf count unless git ignores them: a run may
    read them. Return None if git does not track this file, for instance if gsbench was installed from a wheel.
    """
    here = Path(__file__)
    if _git(here.parent, "ls-files", "--error-unmatch", here.name) is None:
        return None
    head = _git(here.parent, "rev-parse", "HEAD")
    changed = _git(here.parent, "diff", "--name-only", "HEAD", "--", ":/", *(f":(top,exclude){x}" for x in NO_CODE))
    added = _git(here.parent, "ls-files", "--others", "--exclude-standard", "--", ":/gsbench", ":/conf")
    is_clean = (changed, added) == ("", "")  # None: git failed
    return head if head is None or is_clean else f"{head}-dirty"


running_commit = functools.cache(git_commit)  # the code that runs stays when the checkout changes later


def _git(folder: Path, *arguments: str) -> str | None:
    """Run git and return its output, or None if git is not installed, fails, hangs or lacks memory."""
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError, MemoryError):
        return None
    return done.stdout.strip()
