"""What an import of gsbench settles for a process: freed memory is reused, idle threads sleep, vectors give equal bits.

Each program runs in a process of its own, and prints a number or what torch and MKL report.
"""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from forked import python
from tiny_run import ROOT

from gsbench import kernels
from gsbench.process import start

SETTLED = ("MALLOC_", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", start.TORCH, start.MKL)  # by a caller, unless a test says so
# Two blocks of 80 MB at a time: arenas of threads hold 64 MB. The heap grows for some rounds until its holes fit.
FAULTS = """
import resource
import threading
from concurrent.futures import ThreadPoolExecutor
torch.set_num_threads(1)
pool, both = ThreadPoolExecutor(2), threading.Barrier(2)
def fill(_):
    block = torch.zeros(20_000_000)
    both.wait()
def faults(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        list(pool.map(fill, range(2)))
    return (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / rounds
faults({before})
print(faults({rounds}))
"""
HUGE_PAGES = """
import re
areas = re.findall(r"^Size: +(\\d+) kB$.*?^VmFlags:(.*?)$", open("/proc/self/smaps").read(), re.M | re.S)
print(sum(int(kilobytes) for kilobytes, flags in areas if " hg" in flags))
"""
ALL_ANEW = 2 * 80_000_000 / 4096  # page faults of a round in which every block is mapped
# A kernel of two threads, then work of Python's thread alone; prints the CPU time of all threads, in that of this one.
ALTERNATE = """
import time
from gsbench.kernels.loss import l1_ssim
torch.set_num_threads(2)
image = torch.rand(40, 40, 3)

def alternate(rounds):
    for _ in range(rounds):
        l1_ssim(image, image, 0.2)
        end = time.thread_time() + 0.004
        while time.thread_time() < end:
            pass

alternate(5)
of_thread, of_all = time.thread_time(), time.process_time()
alternate(50)
print((time.process_time() - of_all) / (time.thread_time() - of_thread))
"""
VECTORS = "print(torch.backends.cpu.get_cpu_capability()); torch.ones(64, 64) @ torch.ones(64, 64)"
HAS_MKL = "mkl" in torch.__config__.show().lower()
GLIBC = pytest.mark.skipif("CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="another malloc than glibc's")


def printed(imports: str, program: str, **variables: str) -> str:
    """What a program prints that first imports some modules, with these variables of the environment."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith(SETTLED)}
    done = python("-c", f"import {imports}\n{program}", cwd=ROOT, env=plain | variables)
    assert done.returncode == 0, done.stderr
    return done.stdout


@GLIBC
def test_workers_get_the_memory_they_freed():
    """Catches gradients that are mapped anew in every step: a third of a training at 517,000 Gaussians."""
    faults = float(printed("torch, gsbench", FAULTS.format(before=20, rounds=5)))  # gsbench second, which is harder
    assert faults < 0.01 * ALL_ANEW


@GLIBC
@pytest.mark.skipif(not Path("/sys/kernel/mm/transparent_hugepage").is_dir(), reason="a system without huge pages")
def test_the_heap_asks_for_huge_pages():
    """Catches a heap that asks for none: a step takes 4 to 13 % longer."""
    assert float(printed("gsbench, torch", HUGE_PAGES)) * 1024 >= start.HUGE - start.HUGE_PAGE


@GLIBC
def test_the_environment_has_the_last_word():
    """Catches settings of malloc that a user has chosen and that an import overrules."""
    faults = printed("gsbench, torch", FAULTS.format(before=1, rounds=2), **dict.fromkeys(start.OPTIONS, "4"))
    assert float(faults) > 0.9 * ALL_ANEW


def test_malloc_is_asked_for_what_the_user_has_not_set(monkeypatch):
    """Catches an option under another number or variable, and one set over the user's."""
    asked = []
    for variable in start.OPTIONS:
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(start.ctypes, "CDLL", lambda _: SimpleNamespace(mallopt=lambda *option: asked.append(option)))
    monkeypatch.setattr(start, "_allow_huge_pages", lambda _: None)
    start.keep_freed_memory()
    monkeypatch.setenv("MALLOC_MMAP_THRESHOLD_", "4")
    start.keep_freed_memory()
    assert asked == [(-1, 1 << 30), (-3, 1 << 30), (-8, 1), (-1, 1 << 30), (-8, 1)]


def test_an_openmp_that_is_not_loaded_reads_the_variable(monkeypatch):
    """Catches a variable of another name or value, one set over the user's, and libgomp where it is not needed."""

    def load(name, mode):
        assert (name, mode) == ("libgomp.so.1", os.RTLD_NOLOAD)
        raise OSError

    for variable in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.setenv(variable, "of before")  # so that the end of the test undoes what it sets
        monkeypatch.delenv(variable)
    monkeypatch.setattr(start.ctypes, "CDLL", load)
    start.sleep_when_idle()
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    start.sleep_when_idle()
    assert os.environ["OMP_WAIT_POLICY"] == "active"
    monkeypatch.delenv("OMP_WAIT_POLICY")
    monkeypatch.setenv("GOMP_SPINCOUNT", "1")
    start.sleep_when_idle()
    assert "OMP_WAIT_POLICY" not in os.environ


@pytest.mark.skipif(not kernels.available(), reason="the native kernels are not built here")
def test_idle_threads_sleep():
    """Catches threads that spin for milliseconds after every kernel, as libgomp's do by default: twice the CPU time."""
    assert float(printed("torch, gsbench", ALTERNATE, OMP_NUM_THREADS="2")) < 1.3


@pytest.mark.skipif(not start._has_avx512() and not HAS_MKL, reason="needs a processor with AVX-512, or MKL")
@pytest.mark.parametrize(
    ("imports", "capability", "code", "variables"),
    [
        ("torch", "AVX512", "CNR:OFF", {}),
        ("torch, gsbench", "AVX2", "CNR:COMPATIBLE", {}),
        ("gsbench, torch", "AVX512", "CNR:COMPATIBLE", {"ATEN_CPU_CAPABILITY": "avx512"}),
    ],
)
def test_vectors_are_chosen_as_gsbench_is_imported(imports, capability, code, variables):
    """Catches a setting after torch or MKL has read it, a variable that they do not know, and one over the user's."""
    text = printed(imports, VECTORS, MKL_VERBOSE="1", **variables)
    assert not start._has_avx512() or capability in text.splitlines()
    assert not HAS_MKL or code in text


@pytest.mark.parametrize(
    ("flags", "wanted"), [("fpu avx2 avx512f avx512bw", "avx2"), ("fpu avx2 fma", None), ("", None)]
)
def test_nothing_is_set_without_avx512(flags, wanted, monkeypatch, tmp_path):
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
