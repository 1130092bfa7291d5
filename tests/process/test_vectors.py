"""torch and MKL compute the same bits on every processor, unless the environment says otherwise."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_run import ROOT

from gsbench.process import start

ASK = "import torch; print(torch.backends.cpu.get_cpu_capability()); torch.ones(64, 64) @ torch.ones(64, 64)"
HAS_MKL = "mkl" in torch.__config__.show().lower()


def printed(imports: str, **variables: str) -> str:
    """What torch and MKL print of their vectors in a new process, whose environment chooses none but by `variables`."""
    plain = {name: value for name, value in os.environ.items() if name not in (start.TORCH, start.MKL)}
    command = [sys.executable, "-c", f"{imports}; {ASK}"]
    environment = plain | {"MKL_VERBOSE": "1"} | variables
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=True).stdout


@pytest.mark.skipif(not start._has_avx512() and not HAS_MKL, reason="needs a processor with AVX-512, or MKL")
def test_vectors_are_chosen_as_gsbench_is_imported() -> None:
    """Catches a setting that comes after torch or MKL has read it, a variable that they do not know, and one that is
    set over the user's."""
    for imports, capability, code, variables in (
        ("import torch", "AVX512", "CNR:OFF", {}),
        ("import torch; import gsbench", "AVX2", "CNR:COMPATIBLE", {}),
        ("import gsbench", "AVX512", "CNR:COMPATIBLE", {"ATEN_CPU_CAPABILITY": "avx512"}),
    ):
        text = printed(imports, **variables)
        assert not start._has_avx512() or capability in text.splitlines()
        assert not HAS_MKL or code in text


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
    monkeypatch.setattr(start, "CPUINFO", info)
    for variable in (start.TORCH, start.MKL):
        monkeypatch.setenv(variable, "of before")  # so that the end of the test undoes what it sets
        monkeypatch.delenv(variable)
    start.compute_the_same_bits()
    assert os.environ.get(start.TORCH) == wanted
    assert os.environ[start.MKL] == "COMPATIBLE"
