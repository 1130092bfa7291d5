"""Every .cu as the compiler of CUDA sees it: the shim's compiler is not as strict about what runs where."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

SOURCES = sorted((Path(__file__).resolve().parents[2] / "gsbench/kernels/cuda").glob("*.cu"))
# Bytes a thread keeps in local memory, at most: what is indexed by the waves of 4DGS' colours, and the derivative of 7D
# Gaussians in the paper's order of the factor, which needs more than all registers.
LOCAL_MEMORY = {"colors.cu": 152, "triangular.cu": 120}


@pytest.mark.skipif(shutil.which("nvcc") is None, reason="needs nvcc")
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.name)
def test_compiles_without_a_warning(source, tmp_path):
    """Catches host code called on the device, a missing __device__, what a shim would let pass; arrays that are indexed
    at run time and so leave the registers, and registers that run out: both slow a kernel down and change no result."""
    command = ["nvcc", "-std=c++20", "-arch=sm_90", "--ftz=true", "--cubin", "-Xptxas", "-v", "-Werror", "all-warnings"]
    command += ["-Xcompiler", "-Wno-unknown-pragmas", str(source), "-o", str(tmp_path / "out.cubin")]
    done = subprocess.run(command, capture_output=True, text=True)
    printed = done.stdout + done.stderr
    assert done.returncode == 0, printed[-4000:]
    kept = [int(number) for number in re.findall(r"(\d+) bytes (?:stack frame|spill)", printed)]
    assert kept or "__global__" not in source.read_text()
    assert max(kept, default=0) <= LOCAL_MEMORY.get(source.name, 0), printed
