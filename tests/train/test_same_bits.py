"""A training has the same bits on a processor with AVX-512 and on one whose widest vectors are those of AVX2."""

import subprocess
from pathlib import Path

import pytest
from test_resume import assert_same_bits, comparable_state
from tiny_run import command, environment

from gsbench import kernels

# What each library chooses by itself on a processor without AVX-512: the kernels of gsbench, torch, its MKL, and numpy
# with its OpenBLAS.
WITHOUT_AVX512 = {
    "GSBENCH_ISA": "v3",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Zen",
}
SLOW = ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "auto", "dbs", "dgs", "freetime", "ndgs", "ubs")


@pytest.mark.parametrize("model", ["7dgs", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_a_training_has_the_same_bits_without_avx512(model: str, tmp_path: Path) -> None:
    """Catches an operation of a training, in the kernels or in a library, whose bits depend on the processor."""
    if "v4" not in kernels.native().instruction_sets() or "v3" not in kernels.native().instruction_sets():
        pytest.skip("needs a processor with AVX-512, and the kernels of v3 and v4: make test LEVELS=all")
    wanted = ["+exp=mini", "scene=suzanne", f"model={model}", "train.iterations=200"]
    plain = {name: value for name, value in environment().items() if name not in WITHOUT_AVX512}
    for folder, more in (("with", {}), ("without", WITHOUT_AVX512)):
        done = subprocess.run(command(*wanted, f"results={tmp_path / folder}"), env=plain | more,
                              capture_output=True, text=True)  # fmt: skip
        assert done.returncode == 0, done.stderr
    assert_same_bits(comparable_state(tmp_path / "with"), comparable_state(tmp_path / "without"))
