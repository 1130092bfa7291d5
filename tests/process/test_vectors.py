"""torch and MKL compute the same bits on every processor, unless the environment says otherwise."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_run import ROOT

from gsbench.process import vectors

ASK = "import torch; print(torch.backends.cpu.get_cpu_capability())"
PRODUCT = "import torch; torch.ones(64, 64) @ torch.ones(64, 64)"


def said(code: str, **variables: str) -> str:
    """What a new process prints, whose environment chooses no arithmetic but by `variables`."""
    plain = {name: value for name, value in os.environ.items() if name not in (vectors.TORCH, vectors.MKL)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=plain | variables, check=True)
    return done.stdout


def capability(imports: str, **variables: str) -> str:
    """The vectors that torch uses in a new process."""
    return said(f"{imports}; {ASK}", **variables).strip()


@pytest.mark.skipif(not vectors._has_avx512(), reason="needs a processor with AVX-512")
@pytest.mark.parametrize("imports", ["import gsbench", "import torch; import gsbench"])
def test_torch_uses_avx2_where_there_is_avx512(imports: str) -> None:
    """Catches a setting that comes after torch has read it."""
    assert capability("import torch") == "AVX512"
    assert capability(imports) == "AVX2"
    assert capability(imports, ATEN_CPU_CAPABILITY="avx512") == "AVX512"


@pytest.mark.skipif("mkl" not in torch.__config__.show().lower(), reason="needs a torch with MKL")
@pytest.mark.parametrize("imports", ["import gsbench", "import torch; import gsbench"])
def test_mkl_uses_its_compatible_code(imports: str) -> None:
    """Catches a variable that MKL does not know, or one that is set too late."""
    for wanted, first in (("CNR:OFF", "import torch"), ("CNR:COMPATIBLE", imports)):
        assert wanted in said(f"{first}; {PRODUCT}", MKL_VERBOSE="1")


@pytest.mark.parametrize(
    ("flags", "wanted"),
    [("fpu avx2 avx512f avx512bw", "avx2"), ("fpu avx2 fma", None), ("", None)],
)
def test_nothing_is_set_without_avx512(
    flags: str, wanted: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches AVX2 asked of a processor that may not have it, where torch would end by a signal."""
    info = tmp_path / "cpuinfo"
    if flags:
        info.write_text(f"processor\t: 0\nflags\t\t: {flags}\n")
    monkeypatch.setattr(vectors, "CPUINFO", info)
    for variable in (vectors.TORCH, vectors.MKL):
        monkeypatch.setenv(variable, "of before")  # so that the end of the test undoes what it sets
        monkeypatch.delenv(variable)
    vectors.compute_the_same_bits()
    assert os.environ.get(vectors.TORCH) == wanted
    assert os.environ[vectors.MKL] == "COMPATIBLE"
