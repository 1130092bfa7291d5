"""The order of views, and the streams of random numbers."""

from gsbench.train.batches import batch, generator


def test_every_view_is_seen_once_an_epoch() -> None:
    """Catches sampling with replacement, and batches that lose views where an epoch ends within them."""
    order = [view for step in range(35) for view in batch(step, 7, 3, seed=1)]
    for epoch in range(15):
        assert sorted(order[7 * epoch : 7 * epoch + 7]) == list(range(7))
    assert order[:7] != order[7:14]


def test_batches_depend_on_seed_and_step_alone() -> None:
    """Catches hidden state in the order of views, which a resumed run would not have."""
    assert batch(12, 60, 4, seed=3) == batch(12, 60, 4, seed=3)
    assert any(batch(k, 60, 4, seed=3) != batch(k, 60, 4, seed=4) for k in range(3))


def test_streams_of_different_purposes_differ() -> None:
    """Catches seeds that collide: (0, 1) and (1, 0), or a stream reused for another purpose."""
    first = {generator(*key).initial_seed() for key in [(0,), (1,), (0, 0), (0, 1), (1, 0), (0, 1, 0)]}
    assert len(first) == 6
