"""Where the CUDA kernels run: on a GPU where there is one, else on the CPU by the shim, built once a session."""

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import gsbench.kernels.cuda as kernels

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def cuda_device(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """`cuda`, or `cpu` with the kernels replaced by those of the shim. Skips without the tools to build that."""
    if kernels.available():
        yield "cuda"
        return
    if not all(map(shutil.which, ("cmake", "ninja", "c++"))):
        pytest.skip("needs a GPU and the built extension, or cmake, ninja and a C++ compiler for the shim")
    folder = Path(os.environ.get("GSBENCH_SHIM_BUILD", tmp_path_factory.mktemp("cuda_shim")))
    options = ["-G", "Ninja", "-DCUDA=shim", "-DCMAKE_BUILD_TYPE=Release", f"-DPython_EXECUTABLE={sys.executable}"]
    for command in (["cmake", "-S", str(ROOT), "-B", str(folder), *options],
                    ["cmake", "--build", str(folder), "--target", "_cuda"]):  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    spec = importlib.util.spec_from_file_location("_cuda", next(folder.glob("_cuda.*.so")))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    built, kernels._cuda = kernels._cuda, module
    torch.set_num_threads(1)
    yield "cpu"
    kernels._cuda = built
