"""Every .cu as the compiler of CUDA sees it: the shim's compiler is not as strict about what runs where."""

import shutil
import subprocess
from pathlib import Path

import pytest

SOURCES = sorted((Path(__file__).resolve().parents[2] / "gsbench/kernels/cuda").glob("*.cu"))


@pytest.mark.skipif(shutil.which("nvcc") is None, reason="needs nvcc")
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_compiles_without_a_warning(source: Path, tmp_path: Path) -> None:
    """Catches host code called on the device, a missing __device__, and what a shim would let pass."""
    command = ["nvcc", "-std=c++20", "-arch=sm_90", "--ptx", "-Werror", "all-warnings", "-Xcompiler",
               "-Wno-unknown-pragmas", str(source), "-o", str(tmp_path / "out.ptx")]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
