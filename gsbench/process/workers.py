"""Run independent tasks in parallel, each on a Python thread with its share of the kernels' threads."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Sequence[Item], workers: int) -> Iterator[Result]:
    """Yield the result of `work` for each item, in the order of the items, with `workers` items in parallel.

    Kernels give the same bits for any number of threads, so the results do not depend on `workers`.

    Args:
        work: must not write to data that another item reads. Gradients are enabled as for the caller.
        items: each starts as soon as a worker is free, however slowly the results are taken.
        workers: see `gsbench.kernels.backends.Backend.workers`.
    """
    workers = min(workers, len(items))
    if workers <= 1:
        return map(work, items)
    gradients = torch.is_grad_enabled()

    def run(item: Item) -> Result:
        with torch.set_grad_enabled(gradients):
            return work(item)

    return _pool(workers, max(1, torch.get_num_threads() // workers)).map(run, items)


@functools.cache
def _pool(workers: int, threads: int) -> ThreadPoolExecutor:
    """Start workers whose kernels and torch operations run on `threads` threads each."""
    before = torch.get_num_threads()

    def settle() -> None:
        torch.get_num_threads()  # in a thread that has not asked yet, asking puts the process's number in place
        torch.set_num_threads(threads)

    pool = ThreadPoolExecutor(workers, "gsbench-worker", settle)
    # A worker is started by each call that finds none idle, and setting its own number sets that of threads to come.
    list(pool.map(lambda _: time.sleep(0.01), range(workers)))
    torch.set_num_threads(before)
    return pool
