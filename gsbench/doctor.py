"""Check an installation: what is there, what is missing, and what to do about it (`python -m gsbench doctor`).

torch is imported only by the checks that need it, so that an installation without torch is told what it lacks.
"""

import argparse
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from gsbench.errors import how_to_install, one_line, printable
from gsbench.measure.machine import hardware
from gsbench.measure.provenance import git_commit
from gsbench.process.ending import end_with
from gsbench.reading import as_json
from gsbench.version import __version__

OK, ABSENT, BROKEN = "ok", "absent", "broken"  # absent: an optional part that is not there
LEAST_DISK = 1 << 30  # bytes; a run of D-NeRF writes less than a tenth of this
LEAST_MEMORY = 1 << 30
TIMEOUT = 10  # seconds for the compiler to say its version
COMMAND = "gsbench.__main__:main"  # that of this project in the metadata of its distribution
COMPILERS = ("c++", "g++", "clang++")
INSTALL = "pip install -c constraints.txt . (docs/install.md)"
LARGEST_ERROR = 1e-4  # between the images of two backends


@dataclass(frozen=True)
class Check:
    """The result of one check: what was found, and what to do if it is not ok."""

    name: str
    state: str  # OK, ABSENT or BROKEN
    detail: str
    todo: str = ""

    @property
    def line(self) -> str:
        """Return the check as one line of text."""
        return printable(f"{self.state:7} {self.name:11} {self.detail}" + (f" -> {self.todo}" if self.todo else ""))


def _judged(name: str, is_ok: bool, detail: str, todo: str, otherwise: str = BROKEN) -> Check:
    """Return the result of a check that is ok, or else `otherwise` with what to do."""
    return Check(name, OK, detail) if is_ok else Check(name, otherwise, detail, todo)


def main(arguments: list[str] | None = None) -> int:
    """Print the checks of this installation; return 1 if a part is broken, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m gsbench doctor", description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print the checks as JSON")
    options = parser.parse_args(arguments)
    checks = [check for look in CHECKS for check in _looked(look)]
    print(as_json({"checks": checks}) if options.json else "\n".join(check.line for check in checks))
    return 1 if any(check.state == BROKEN for check in checks) else 0


def _looked(look: Callable[[], Iterator[Check]]) -> list[Check]:
    """Return the results of a check; an error that the check did not expect is a result too."""
    try:
        return list(look())
    except Exception as error:
        return [Check(look.__name__.strip("_"), BROKEN, f"{type(error).__name__}: {one_line(error)}", INSTALL)]


def _gsbench() -> Iterator[Check]:
    commit = git_commit()
    whence = f"commit {commit[:12]}{commit[40:]}" if commit else "from a wheel"  # 40 digits, perhaps with "-dirty"
    yield Check("gsbench", OK, f"{__version__}, {whence}, in {Path(__file__).parent}")
    yield Check("python", OK, f"{platform.python_version()}, {sys.prefix}")


def _packages() -> Iterator[Check]:
    """Name the versions of the core packages, and which extras are complete."""
    core, extras = _requirements()
    missing = [name for name in core if _version(name) is None]
    versions = ", ".join(f"{name} {_version(name)}" for name in ("torch", "numpy", "hydra-core"))
    detail = f"missing: {', '.join(missing)}" if missing else f"{versions} and {len(core) - 3} more"
    yield _judged("packages", not missing, detail, INSTALL)
    there = [extra for extra, names in extras.items() if all(map(_version, names))]
    lacking = [extra for extra in extras if extra not in there]
    yield Check(
        "extras",
        OK if there else ABSENT,
        ", ".join(there) or "none",
        f"{how_to_install('NAME')}, NAME of {', '.join(lacking)}" if lacking else "",
    )


def _requirements() -> tuple[list[str], dict[str, list[str]]]:
    """Return the names of the required packages, and those of each extra for users."""
    core: list[str] = []
    extras: dict[str, list[str]] = {}
    for line in requirements():
        name = re.match(r"[\w.-]+", line)[0]  # type: ignore[index]
        extra = re.search(r"extra == ['\"](\w+)['\"]", line)
        if extra is None:
            core.append(name)
        elif extra[1] not in ("dev", "docs"):
            extras.setdefault(extra[1], []).append(name)
    return core, extras


def requirements() -> list[str]:
    """Return what the installed distribution of gsbench requires, whatever its name is; [] if it is not installed."""
    for command in metadata.entry_points(group="console_scripts"):
        if command.value == COMMAND and command.dist is not None:
            return command.dist.requires or []
    return []


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _machine() -> Iterator[Check]:
    """Name the processor, and check the number of threads and the free memory."""
    import torch

    from gsbench.process.memory import available

    here, free = hardware(), available()
    usable = len(os.sched_getaffinity(0))
    yield Check("processor", OK, f"{here.processor}, {here.cores} cores, {usable} for this process")
    threads = torch.get_num_threads()
    todo = f"set OMP_NUM_THREADS={usable}: more threads than cores are slow"
    yield _judged("threads", threads <= usable, f"{threads} of torch and the kernels", todo)
    if free is not None:
        detail = f"{free / 2**30:.1f} of {here.memory_gib} GiB free"
        yield _judged("memory", free >= LEAST_MEMORY, detail, "end other programs")


def _disk() -> Iterator[Check]:
    """Check the free space where results are written by default."""
    free = shutil.disk_usage(Path.cwd()).free
    todo = "free a GiB, or set results=FOLDER on another disk"
    yield _judged("disk", free >= LEAST_DISK, f"{free / 2**30:.1f} GiB free in {Path.cwd()}", todo)


def _compiler() -> Iterator[Check]:
    """Name the C++ compiler with which a build would start: that of CXX, or the first of COMPILERS."""
    chosen = os.environ.get("CXX", "").split()  # perhaps with arguments, as in "ccache g++"
    commands = [chosen] if chosen else [[name] for name in COMPILERS]
    command = next((command for command in commands if shutil.which(command[0])), None)
    if command is None:
        name = f"none: CXX={' '.join(chosen)} is not there" if chosen else "none"
        yield Check("compiler", ABSENT, name, "to build from source: apt-get install g++ python3-dev")
        return
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=TIMEOUT, check=False)
    yield Check("compiler", OK, f"{(done.stdout.splitlines() or command)[0]}")


def _kernels() -> Iterator[Check]:
    """Check that the CPU kernels are built and draw the image of the reference."""
    from gsbench import kernels

    if not kernels.available():
        todo = "install a C++20 compiler, then reinstall (docs/install.md)"
        yield Check("kernels", BROKEN, "not built: the CPU renders by the slow reference", todo)
        return
    error = _difference()
    used = f"{kernels.instruction_set()} (here: {', '.join(kernels.native().instruction_sets())})"
    detail = f"for the CPU, instruction set {used}; an image differs by {error:.0e} from the reference"
    yield _judged("kernels", error <= LARGEST_ERROR, detail, "build again: make clean && make setup")


def _difference() -> float:
    """Return the largest difference between images of a few Gaussians by the CPU kernels and by the reference."""
    import torch

    from gsbench.raster import rasterize

    random = torch.Generator().manual_seed(0)
    means = torch.randn(50, 3, generator=random) * 0.5 + torch.tensor([0.0, 0.0, 4.0])
    factors = torch.eye(3).expand(50, 3, 3) * 0.1
    intrinsics = torch.tensor([[[50.0, 0.0, 32.0], [0.0, 50.0, 32.0], [0.0, 0.0, 1.0]]])
    inputs = (means, factors, torch.full((50,), 0.7), torch.rand(50, 3, generator=random), torch.eye(4)[None])
    images = [rasterize(*inputs, intrinsics, 64, 64, backend=name).image for name in ("cpu", "reference")]
    return float((images[0] - images[1]).abs().max())


def _gpu() -> Iterator[Check]:
    """Check that torch sees the GPU of an installed driver, and that its kernels are built."""
    import torch

    from gsbench.kernels import cuda

    if not torch.cuda.is_available():
        if shutil.which("nvidia-smi") is None:
            yield Check("gpu", ABSENT, "none; the CPU trains")
        else:
            why = "a driver is there, but this torch sees no device"
            yield Check("gpu", BROKEN, why, "install torch with CUDA for this driver (docs/gpu.md)")
        return
    device = torch.cuda.get_device_properties(0)
    name = f"{device.name}, {device.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"
    state = "built" if cuda.built() else "not built: the GPU renders by the slow reference"
    yield _judged("gpu", cuda.built(), f"{name}, kernels {state}", "install nvcc, then reinstall (docs/gpu.md)")


def _weights() -> Iterator[Check]:
    """Say for each network of LPIPS whether its weights are here."""
    from gsbench.measure.perceptual import BACKBONES, is_here

    for backbone, chosen in BACKBONES.items():
        there = is_here(backbone)
        detail = f"{chosen.file}{'' if there else ' is not here'}"
        yield _judged(f"lpips {backbone}", there, detail, f"python -m gsbench.fetch lpips-{backbone}", ABSENT)


def _data() -> Iterator[Check]:
    """Name the data sets that are in `data`, and how to get the others."""
    from gsbench.fetch.sources import sources

    archives = [source for source in sources(Path("data")).values() if source.is_archive]
    there = [str(source.target) for source in archives if source.target.exists()]
    absent = [source.name for source in archives if not source.target.exists()]
    embedded = importlib.util.find_spec("gsbench.scenes.sample") is not None
    yield Check(
        "data",
        OK if embedded else BROKEN,
        ", ".join(["the embedded scenes" if embedded else "none", *there]),
        f"for more: python -m gsbench.fetch {' '.join(absent)}" if absent else "",
    )


CHECKS = (_gsbench, _packages, _machine, _disk, _compiler, _kernels, _gpu, _weights, _data)

if __name__ == "__main__":  # as `python -m gsbench.doctor` too, like the other commands
    end_with("gsbench.doctor", main)
