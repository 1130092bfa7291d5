"""Make the random generators of a training from the seed of its run, and draw the order of the views."""

import functools

import torch


def batch(step: int, views: int, batch_size: int, seed: int) -> list[int]:
    """Return the indices of the training views of a step.

    Each epoch is a random permutation of all views. The result depends only on the arguments, so a resumed run uses the
    same views as an uninterrupted one.

    Args:
        step: the number of the step, counted from 0.
        views: the number of training views.
        batch_size: the number of views in a step.
        seed: the seed of the run.
    """
    chosen = []
    for position in range(step * batch_size, (step + 1) * batch_size):
        epoch, place = divmod(position, views)
        chosen.append(_order(views, seed, epoch)[place])
    return chosen


@functools.lru_cache(maxsize=2)  # a batch may end one epoch and begin the next
def _order(views: int, seed: int, epoch: int) -> list[int]:
    """Return the order of the training views in an epoch."""
    return torch.randperm(views, generator=generator(seed, epoch)).tolist()


def generator(seed: int, *purpose: int) -> torch.Generator:
    """Return a random generator whose seed is a hash of the run's seed and more numbers, such as the step."""
    mixed = 0
    for number in (seed, *purpose):
        mixed = (mixed * 6364136223846793005 + number + 1442695040888963407) % (1 << 63)
    return torch.Generator().manual_seed(mixed)
