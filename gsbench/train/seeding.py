"""Derive every random draw of a training from the seed of its run: the order of views, and the generators."""

import torch


def batch(step: int, views: int, batch_size: int, seed: int) -> list[int]:
    """List the views of a step: every view appears once an epoch, in an order drawn from (seed, epoch).

    The result depends only on the arguments, so a resumed run sees the same views as an uninterrupted one.

    Args:
        step: number of the step, counted from 0.
        views: the number of training views.
        batch_size: number of views in a step.
        seed: seed of the run.
    """
    chosen = []
    for position in range(step * batch_size, (step + 1) * batch_size):
        epoch, place = divmod(position, views)
        chosen.append(int(torch.randperm(views, generator=generator(seed, epoch))[place]))
    return chosen


def generator(seed: int, *purpose: int) -> torch.Generator:
    """Make a random generator for a seed and a purpose, such as the number of a step."""
    mixed = 0
    for number in (seed, *purpose):
        mixed = (mixed * 6364136223846793005 + number + 1442695040888963407) % (1 << 63)
    return torch.Generator().manual_seed(mixed)
