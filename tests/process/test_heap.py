"""Freed memory: what one step frees the next one gets, on every thread."""

import os
import subprocess
import sys

import pytest
from tiny_run import ROOT

from gsbench.process.heap import OPTIONS

pytestmark = pytest.mark.skipif("CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="another malloc than glibc's")

# Blocks of 80 MB: arenas of threads hold 64 MB at most. The heap grows for some rounds until its holes fit.
ROUNDS = """
import resource
from concurrent.futures import ThreadPoolExecutor
torch.set_num_threads(1)
pool = ThreadPoolExecutor(2)
def faults(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        list(pool.map(lambda _: torch.zeros(20_000_000).sum(), range(2)))
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults(20)
print(faults(10))
"""
ALL_ANEW = 10 * 2 * 80_000_000 / 4096  # page faults where every block is mapped in every round


def page_faults(imports: str, **variables: str) -> int:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | variables
    code = f"import {imports}\n{ROUNDS}"
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=ROOT, env=environment, check=True)
    return int(done.stdout)


@pytest.mark.parametrize("imports", ["gsbench, torch", "torch, gsbench"])
def test_workers_get_the_memory_they_freed(imports: str) -> None:
    """Catches gradients that are mapped anew in every step: a third of a training at 517,000 Gaussians."""
    assert page_faults(imports) < 0.01 * ALL_ANEW


def test_the_environment_has_the_last_word() -> None:
    """Catches settings of malloc that a user has chosen and that an import overrules."""
    assert page_faults("gsbench, torch", **dict.fromkeys(OPTIONS, "4")) > 0.9 * ALL_ANEW
