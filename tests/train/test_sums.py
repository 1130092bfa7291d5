"""Which sum each view of a batch adds to, and the order in which the sums are added."""

import itertools

import pytest
import torch

from gsbench.train.step import Sums, add_up, deal


def gradient(views: int, workers: int) -> torch.Tensor:
    """The gradient of a batch of views; many numbers, since each order of sums rounds some of them its own way."""
    bounds = [views * worker // workers for worker in range(workers + 1)]
    each = torch.randn(views, 1000, generator=torch.Generator().manual_seed(views))
    sums: list[Sums] = deal(views, bounds)
    for own, value in zip(sums, each, strict=True):
        own[0] = own[0] + value if 0 in own else value.clone()
    return add_up(sums)[0]


@pytest.mark.parametrize("views", range(1, 10))
def test_any_number_of_workers_gives_the_same_bits(views: int) -> None:
    """Catches views of one worker that are added to each other before those in front of them."""
    found = [gradient(views, workers) for workers in range(1, views + 1)]
    assert all(torch.equal(a, b) for a, b in itertools.pairwise(found))


def test_two_workers_hold_two_sums() -> None:
    """Catches a gradient of the whole model for each view, which takes memory and time to zero."""
    sums = deal(8, [0, 4, 8])
    assert len({id(own) for own in sums}) == 2
    assert sums[3] is sums[0]
    assert sums[7] is sums[4]


def test_one_view_has_one_sum() -> None:
    """Catches a second half that is empty."""
    only = deal(1, [0, 1])
    only[0][5] = torch.ones(2)
    assert add_up(only)[5] is only[0][5]
