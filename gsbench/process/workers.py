"""Run independent tasks in parallel Python threads that share the processors."""

import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Sequence[Item], workers: int) -> Iterator[Result]:
    """Yield `work(item)` for each item in order, computed by `workers` parallel threads.

    Results do not depend on `workers`, because gsbench's kernels give the same bits for any number of threads.

    Args:
        work: must not write to data that another call reads. Gradients are enabled if they are enabled for the caller.
        items: an item is started as soon as a worker is free, even if the caller has not taken earlier results.
        workers: the number of threads; see `gsbench.kernels.backends.Backend.workers`.
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
    """Return a pool of worker threads; in each worker, kernels and torch use `threads` threads."""
    before = torch.get_num_threads()

    def settle() -> None:
        torch.get_num_threads()  # the first call in a thread sets its number to that of the process, so call it first
        torch.set_num_threads(threads)

    pool = ThreadPoolExecutor(workers, "gsbench-worker", settle)
    # All workers start now: the pool starts one only when a call finds none idle, and none is idle until all wait.
    # Setting its own number of threads, a worker also sets that of threads to come, so the number is restored.
    started = threading.Barrier(workers)
    list(pool.map(lambda _: started.wait(), range(workers)))
    torch.set_num_threads(before)
    return pool
