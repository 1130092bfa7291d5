"""A step: which views it sees, the gradients as a mean over them for any number of threads."""

from dataclasses import fields, replace

import pytest
import torch
from tiny_training import SIZE, moving_square, trainer

from gsbench.kernels.backends import AUTO, REFERENCE
from gsbench.scenes.scene import View
from gsbench.train.batches import batch, generator
from gsbench.train.hooks.penalties import PENALTIES, PenaltiesConfig
from gsbench.train.step import PartResult, Sums, add_up, deal


def gradient_of_a_step(batch: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Of the means, and of the 2D means as density control collected it; and the loss. All views are one view."""
    square = moving_square()
    fitted = trainer("3dgs", f"train.batch_size={batch}", scene=replace(square, train=square.train[:1] * 4))
    means = fitted.model.splats["means"]
    fitted.optimizer.update = fitted.optimizer.end = lambda *_: None
    fitted.train_step()
    return (
        means.grad.clone(),
        fitted.density.rule.gradient / fitted.density.rule.times_visible.clamp(min=1),
        fitted.finite_check.loss,
    )


def test_a_batch_is_a_mean():
    """Catches a loss summed over the batch, and a density gradient that is not scaled back to one view."""
    single, four = gradient_of_a_step(1), gradient_of_a_step(4)
    torch.testing.assert_close(four[0], single[0], rtol=1e-4, atol=1e-8)
    torch.testing.assert_close(four[1], single[1], rtol=1e-4, atol=1e-8)
    assert single[1].max() > 0
    assert four[2] == pytest.approx(single[2], rel=1e-5)


@pytest.mark.parametrize("backend", [AUTO, REFERENCE], ids=lambda backend: backend.name)
def test_bytes_train_as_floats_do(backend, monkeypatch):
    """Catches a step that makes floats of an image in 8 bits for the kernel, and other gradients by its bytes."""
    square = moving_square()
    in_bytes = [replace(view, pixels=(255 * view.image).round().to(torch.uint8)) for view in square.train]
    gradients = []
    for views in (in_bytes, [replace(view, pixels=view.image) for view in in_bytes]):
        fitted = trainer("3dgs", scene=replace(square, train=views))
        fitted.model.backend = backend
        with monkeypatch.context() as patch:
            patch.setattr(View, "image", property(lambda _: pytest.fail("a float copy")))
            fitted.gradients(views[:2])
        gradients.append([p.grad for p in fitted.model.splats.values()])
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


@pytest.mark.parametrize("views", range(1, 10))
def test_any_number_of_workers_gives_the_same_bits(views):
    """Catches views of one worker that are added to each other before those in front of them."""
    each = torch.randn(views, 1000, generator=torch.Generator().manual_seed(views))  # some sums round with the order
    totals = []
    for workers in range(1, views + 1):
        sums: list[Sums] = deal(views, [views * worker // workers for worker in range(workers + 1)])
        for added, value in zip(sums, each, strict=True):
            added[0] = added[0] + value if 0 in added else value.clone()
        totals.append(add_up(sums)[0])
    assert all(torch.equal(total, totals[0]) for total in totals)


def test_two_workers_hold_two_sums_and_one_view_has_one():
    """Catches a gradient of the whole model for each view, which takes memory and time to zero, and an empty half."""
    sums = deal(8, [0, 4, 8])
    assert len({id(added) for added in sums}) == 2
    assert sums[3] is sums[0]
    assert sums[7] is sums[4]
    only = deal(1, [0, 1])
    only[0][5] = torch.ones(2)
    assert add_up(only)[5] is only[0][5]


def test_what_any_view_of_the_batch_saw_is_moved():
    """Catches sparse_adam that moves what the last view saw alone, or the first."""
    fitted = trainer("3dgs", "train.batch_size=3", "optim=sparse_adam")
    N = len(fitted.model)
    drawn = torch.zeros(3, 1, N, dtype=torch.bool)
    for view in range(3):
        drawn[view, 0, view] = True  # each view sees the Gaussian of its number
    results = [PartResult([i], torch.ones(1), drawn[i], torch.zeros(1, N, 2), {}) for i in range(3)]
    fitted.gradients = lambda *_: results
    moved = []
    fitted.optimizer.update = moved.append
    for step in (0, 1):
        fitted.step = step
        fitted.train_step()
    assert all(drawn.tolist() == [True] * 3 + [False] * (N - 3) for drawn in moved)
    assert len(moved) == 2


def test_early_steps_see_small_images():
    """Catches a resolution that is not the schedule's, a camera that does not shrink with its image, or its centre."""
    fitted, looked = trainer("3dgs", "train.coarse=[[2,15000]]", "train.batch_size=1"), list[View]()
    real, half = fitted.gradients, fitted.schedule.scaled(15_000)
    fitted.gradients = lambda views, *more: looked.extend(views) or real(views, *more)
    for fitted.step in (0, half - 1, half):
        fitted.train_step()
    assert [view.camera.width for view in looked] == [SIZE // 2, SIZE // 2, SIZE]
    small, full = looked[0], next(view for view in fitted.scene.train if view.name == looked[0].name)
    assert list(small.image.shape[:2]) == [small.camera.height, small.camera.width]
    torch.testing.assert_close(small.camera.K[:2], full.camera.K[:2] / 2)
    torch.testing.assert_close(small.image[3, 5], full.image[6:8, 10:12].mean((0, 1)))
    assert not fitted.batches._reduced, "small images that no later step needs"


def test_every_penalty_has_its_settings():
    """Catches a penalty without a weight in the config, and a weight that nothing reads."""
    assert {field.name for field in fields(PenaltiesConfig)} == set(PENALTIES)


def test_every_view_is_seen_once_an_epoch():
    """Catches sampling with replacement, and batches that lose views where an epoch ends within them."""
    order = [view for step in range(35) for view in batch(step, 7, 3, seed=1)]
    for epoch in range(15):
        assert sorted(order[7 * epoch : 7 * epoch + 7]) == list(range(7))
    assert order[:7] != order[7:14]


def test_batches_depend_on_seed_and_step_alone():
    """Catches hidden state in the order of views, which a resumed run would not have, and seeds that collide: (0, 1)
    and (1, 0), or a stream that is used again for another purpose."""
    assert batch(12, 60, 4, seed=3) == batch(12, 60, 4, seed=3)
    assert any(batch(k, 60, 4, seed=3) != batch(k, 60, 4, seed=4) for k in range(3))
    assert len({generator(*key).initial_seed() for key in [(0,), (1,), (0, 0), (0, 1), (1, 0), (0, 1, 0)]}) == 6
