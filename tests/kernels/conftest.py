"""Fixtures for tests of the compiled kernels, those of the CPU and those of CUDA."""

import fcntl
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor

from gsbench import kernels
from gsbench.kernels import cuda, library

ROOT = Path(__file__).resolve().parents[2]


INSTRUCTION_SETS = kernels.native().instruction_sets() if kernels.available() else []


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Tests of the CPU's kernels are skipped where those were not built."""
    return None if kernels.available() or "cuda" in collection_path.name else True


@pytest.fixture(params=INSTRUCTION_SETS)
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Runs the test once with each instruction set that this machine has."""
    kernels.use_instruction_set(request.param)
    yield request.param
    kernels.use_instruction_set(INSTRUCTION_SETS[-1])


@dataclass(frozen=True)
class Place:
    """Kernels to test: those of an instruction set of the CPU, or those of CUDA."""

    name: str
    device: str  # of their tensors

    def move(self, x: Tensor) -> Tensor:
        """Round a tensor to float32 on the device, as a leaf."""
        return x.detach().to(self.device, torch.float32).requires_grad_(x.requires_grad)


@pytest.fixture(params=[*INSTRUCTION_SETS, "cuda"])
def place(request: pytest.FixtureRequest) -> Iterator[Place]:
    """Runs the test with each instruction set, and with the kernels of CUDA: on a GPU, or on the CPU by the shim."""
    if request.param == "cuda":
        yield Place("cuda", request.getfixturevalue("cuda_device"))
    else:
        kernels.use_instruction_set(request.param)
        yield Place(request.param, "cpu")
        kernels.use_instruction_set(INSTRUCTION_SETS[-1])


@pytest.fixture(scope="session")
def shim() -> ModuleType:
    """The CUDA kernels built to run on the CPU (cuda_shim.h): once for all processes, and again where a source changed.
    They are kept in build/shim or the folder GSBENCH_SHIM_BUILD, and have the sanitizers GSBENCH_SANITIZE names. Skips
    without the tools to build them."""
    if not all(map(shutil.which, ("cmake", "ninja", "c++"))):
        pytest.skip("needs a GPU and the built extension, or cmake, ninja and a C++ compiler for the shim")
    folder = Path(os.environ.get("GSBENCH_SHIM_BUILD") or ROOT / "build/shim" / str(sys.implementation.cache_tag))
    options = ["-G", "Ninja", "-DCUDA=shim", "-DCMAKE_BUILD_TYPE=Release", "-DCMAKE_CXX_FLAGS_RELEASE=-O1 -DNDEBUG"]
    options += [f"-DPython_EXECUTABLE={sys.executable}", f"-DGSB_SANITIZE={os.environ.get('GSBENCH_SANITIZE', '')}"]
    plain = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}  # a sanitizer's is not cmake's
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another process of these tests waits until it is built
        for command in (
            ["cmake", "-S", str(ROOT), "-B", str(folder), *options],
            ["cmake", "--build", str(folder), "--target", "_cuda"],
        ):
            done = subprocess.run(command, capture_output=True, text=True, env=plain)
            assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    spec = importlib.util.spec_from_file_location("_cuda", next(folder.glob("_cuda.*.so")))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def cuda_device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where the CUDA kernels run: `cuda`, or `cpu`, whose kernels are those of the shim meanwhile, built or not."""
    if cuda.available():
        return "cuda"
    shim = request.getfixturevalue("shim")
    monkeypatch.setattr(kernels, "_native", shim)
    monkeypatch.setitem(library._LIBRARIES, "cpu", library.CudaLibrary(shim))
    return "cpu"
