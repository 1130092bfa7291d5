"""Freed memory: what one step frees the next one gets, on every thread."""

import os
import subprocess
import sys

import pytest
from tiny_run import ROOT

from gsbench.process.start import OPTIONS

pytestmark = pytest.mark.skipif("CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="another malloc than glibc's")

# Blocks of 80 MB: arenas of threads hold 64 MB at most. The heap grows for some rounds until its holes fit.
ROUNDS = """
import sys
import resource
from concurrent.futures import ThreadPoolExecutor
torch.set_num_threads(1)
pool = ThreadPoolExecutor(2)
def faults(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        list(pool.map(lambda _: torch.zeros(20_000_000).sum(), range(2)))
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults(int(sys.argv[1]))
print(faults(int(sys.argv[2])))
"""
ALL_ANEW = 2 * 80_000_000 / 4096  # page faults of a round in which every block is mapped


def page_faults(imports: str, before: int, rounds: int, **variables: str) -> float:
    """Page faults of a round, after some rounds that do not count."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | variables
    code = f"import {imports}\n{ROUNDS}"
    command = [sys.executable, "-c", code, str(before), str(rounds)]
    done = subprocess.run(command, stdout=subprocess.PIPE, cwd=ROOT, env=environment, check=True)
    return int(done.stdout) / rounds


def test_workers_get_the_memory_they_freed() -> None:
    """Catches gradients that are mapped anew in every step: a third of a training at 517,000 Gaussians."""
    assert page_faults("torch, gsbench", 20, 5) < 0.01 * ALL_ANEW  # gsbench second, which is harder


def test_the_environment_has_the_last_word() -> None:
    """Catches settings of malloc that a user has chosen and that an import overrules."""
    assert page_faults("gsbench, torch", 1, 2, **dict.fromkeys(OPTIONS, "4")) > 0.9 * ALL_ANEW
