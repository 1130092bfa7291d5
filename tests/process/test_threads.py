"""Idle OpenMP threads sleep, whatever was imported first."""

import os
import subprocess
import sys

import pytest
from tiny_run import ROOT

from gsbench import kernels

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
own, all_threads = time.thread_time(), time.process_time()
alternate(50)
print((time.process_time() - all_threads) / (time.thread_time() - own))
"""


@pytest.mark.skipif(not kernels.available(), reason="the native kernels are not built here")
def test_idle_threads_sleep() -> None:
    """Catches threads that spin for milliseconds after every kernel, as libgomp's do by default: twice the CPU time."""
    plain = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    done = subprocess.run(
        [sys.executable, "-c", "import torch, gsbench" + ALTERNATE],
        capture_output=True, text=True, cwd=ROOT, env={**plain, "OMP_NUM_THREADS": "2"}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 1.3
