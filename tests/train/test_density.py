"""Density control: who is cloned, split or pruned, and when; the limit; what is thinned; and blend weights."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_optim import descend, fitted
from tiny_training import moving_square, train, trainer

from gsbench.config import DensifyConfig
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import rasterize_slice
from gsbench.train.batches import generator
from gsbench.train.density.blend_weights import blend_weights
from gsbench.train.density.control import gaussian_limit
from gsbench.train.density.gradient import GradientDensification
from gsbench.train.optim import Optimizer
from gsbench.train.rows import Rows


def control_of(count: int, threshold: float = 1.0) -> tuple[GaussianModel, Optimizer, GradientDensification]:
    """3DGS after one step with Gaussian i at (i, i, i), all small and half opaque, and a density control of 3 views."""
    model, optimizer = fitted(count)
    descend(model, optimizer, 0)
    with torch.no_grad():
        model.splats["scales"].fill_(math.log(0.001))  # below 0.01 x extent 2
        model.splats["opacities"].fill_(0.0)
        model.splats["means"].copy_(torch.arange(float(count))[:, None].expand(count, 3))
    config = DensifyConfig(grad_threshold=threshold)
    return model, optimizer, GradientDensification(Rows(model, optimizer), config, 0.01, views=3)


def look(control: GradientDensification, gradients: torch.Tensor, drawn: list[int] | None = None) -> None:
    """Let a view of 100 x 50 pixels have gradients of 2D means, [N, 2], and see the Gaussians `drawn`, or all."""
    is_drawn = torch.ones(1, len(gradients)) if drawn is None else torch.tensor([drawn])
    control.accumulate(is_drawn.bool(), gradients[None], width=100, height=50, views=1, skip=torch.zeros(()))


def densified(control: GradientDensification, most: int = 100, has_reset: bool = False) -> tuple[list[float], int]:
    """The places of all Gaussians after a round, and how many were refused."""
    refused = control.densify(generator(1), has_reset, most)
    return control.model.splats["means"].detach()[:, 0].tolist(), refused


def test_density_control_clones_small_splits_large_prunes_faint():
    """Catches a wrong criterion or count of any of the three, and a gradient in pixels instead of half pictures. Also a
    clone or a child that goes on with its parent's momentum."""
    model, optimizer, control = control_of(6)
    with torch.no_grad():
        model.splats["scales"][3:5] = math.log(0.1)  # large
        model.splats["opacities"][5] = -6.0  # sigmoid is 0.0025
    gradients = torch.zeros(6, 2)
    gradients[[0, 3]] = torch.tensor([0.03, 0.0])  # x 100 / 2 pixels x 1 view = 1.5 > 1
    gradients[1] = torch.tensor([0.0, 0.03])  # x 50 / 2 = 0.75 < 1
    look(control, gradients)
    places, _ = densified(control)
    assert len(places) == 7  # 1, 2, 4 kept; 0 cloned to two; 3 split in two; 5 pruned
    assert places[:5] == [0, 1, 2, 4, 0]
    assert (model.splats["scales"][5:] < math.log(0.1) - math.log(1.59)).all()
    for parameter in model.splats.values():
        for moment in ("exp_avg", "exp_avg_sq"):
            has_moved = optimizer.moments[parameter][moment].reshape(7, -1).any(1)
            assert has_moved.tolist() == [True] * 4 + [False] * 3
    assert control.gradient.shape == (7,)
    assert not control.gradient.any()
    descend(model, optimizer, 1)


def test_no_more_gaussians_than_the_cap_and_the_largest_gradients_first():
    """Catches a threshold of 0 that makes 3.3 million Gaussians in 21 steps, and a cap that depends on the rows' order
    in a sort that is not stable, or takes the first rows whatever their gradients."""
    _, _, control = control_of(6, threshold=0.0)
    look(control, torch.tensor([0.0, 0.2, 0.1, 0.3, 0.2, 0.2])[:, None] * torch.tensor([1.0, 0.0]))
    assert densified(control, most=9) == ([0, 1, 2, 3, 4, 5, 1, 3, 4], 2)
    for most in (9, 5):  # a file to start from may have more Gaussians than allowed
        look(control, torch.ones(9, 2))
        assert densified(control, most)[1] == len(control.model) == 9


def test_what_no_view_of_an_epoch_drew_is_pruned():
    """Catches dead weight that stays, Gaussians dropped too early, and counts or gradients that do not move along."""
    _, _, control = control_of(4)
    for drawn, times, left in (
        ([1, 0, 0, 1], 4, [0, 1, 2, 3]),  # four views in a row may miss one of three
        ([1, 0, 1, 1], 1, [0, 2, 3]),  # the fifth
        ([1, 0, 1], 4, [0, 2, 3]),
        ([1, 0, 1], 1, [0, 3]),
    ):
        for _ in range(times):
            look(control, torch.zeros(len(drawn), 2), drawn)
        assert densified(control)[0] == left
    _, _, control = control_of(4)
    for drawn in ([1, 0, 0, 0], [1, 1, 0, 1], [1, 0, 0, 1]):
        look(control, torch.ones(4, 2), drawn)
    assert control.unseen.tolist() == [0, 1, 3, 0]
    control.rows.select(torch.tensor([3, 2, 1]))  # as a gate does
    assert control.unseen.tolist() == [0, 3, 1]
    assert control.gradient.tolist() == control.times_visible.tolist() == [0, 0, 0]


def test_large_gaussians_are_pruned_only_when_asked():
    """Catches pruning by size before the first opacity reset."""
    model, _, control = control_of(4)
    with torch.no_grad():
        model.splats["scales"].fill_(math.log(0.1))
        model.splats["scales"][0] = math.log(0.3)  # above 0.1 x extent 2
    assert densified(control)[0] == [0, 1, 2, 3]
    assert densified(control, has_reset=True)[0] == [1, 2, 3]


def test_the_rule_is_called_as_the_schedule_says():
    """Catches a last densification that does not know the views before it, counting for none (2 % of a step), children
    that are scattered alike in every round or not by the seed, and pruning by size before opacities were reset."""
    fitted = trainer("3dgs", "train.batch_size=1")
    rule, schedule, stop = fitted.density.rule, fitted.schedule, fitted.schedule.densify_stop
    counted, draws, resets = list[int](), list[float](), list[bool]()

    def densify(random: torch.Generator, has_reset: bool, _: int) -> int:
        draws.append(torch.rand(1, generator=random).item())
        resets.append(has_reset)
        return 0

    rule.accumulate, rule.densify = lambda *_: counted.append(fitted.step), densify
    for fitted.step in (stop - 2, stop - 1, stop, stop + 1):
        fitted.train_step()
    assert (counted, len(draws)) == ([stop - 2, stop - 1], 1)
    schedule.densifies, schedule.resets = lambda _: True, lambda _: False
    draws.clear()
    for fitted.config.seed, fitted.step in ((0, 3), (0, 4), (1, 3), (0, 3)):
        fitted.train_step()
    assert len(set(draws)) == 3
    assert draws[0] == draws[3]
    resets.clear()
    for fitted.step in (0, schedule.reset_every - 1, schedule.reset_every):
        fitted.train_step()
    assert resets == [False, False, True]


def test_what_is_long_in_time_is_split_along_its_path_near_the_clip():
    """Catches 7DGS never splitting in time, where a small Gaussian that asks for density and moves gets two times, and
    a split that draws from all of a Gaussian that lasts for ever: AGR read times of -240."""
    fitted = trainer("7dgs")
    model, rule, sizes = fitted.model, fitted.density.rule, fitted.model.splats["log_diagonal"].data
    sizes[:, 4:], sizes[:, 3] = math.log(1e-3), math.log(1e4)  # small, in space they would be cloned; long
    model.splats["motion"].data[0, 3] = 100.0
    model.splats["opacities"].data.fill_(2.0)
    rule.gradient[:2], rule.times_visible[:2] = 1.0, 1.0
    times, N = model.splats["times"].detach()[:2].clone(), len(model)
    rule.densify(generator(0), has_reset=False, most=100)
    assert len(model) == N + 2
    clone, *children = model.splats["times"].detach()[-3:]
    assert clone == times[1]
    assert all(0.01 < abs(child - times[0]) < 6 for child in children)


@pytest.mark.parametrize(
    ("number", "side", "initial", "most"),
    [
        (120, 80, 1_000, 12_000),
        (120, 80, 10_000, 40_000),
        (100, 800, 100_000, 1_000_000),
        (800, 2_000, 400_000, 2_000_000),
    ],
)
def test_the_limit_follows_from_the_training_pixels(number, side, initial, most):
    """Catches a limit of the views' number or of one view, one that many initial points exceed, and one without end."""
    views: list[Any] = [SimpleNamespace(camera=SimpleNamespace(width=side, height=side))] * number
    assert gaussian_limit(None, views, initial) == most
    assert gaussian_limit(500, views, initial) == 500


def test_a_training_keeps_to_it_and_says_so_once(capsys):
    """Catches a limit that no round of densification gets, and a training that is silent about what it left out."""
    square = moving_square()
    points = replace(square.points, means=square.points.means[:20], colors=square.points.colors[:20])
    words = ("train.densify.grad_threshold=0", "train.densify.every=5", "effects.gate=off")
    fitted = trainer("3dgs", *words, scene=replace(square, points=points))
    pixels = sum(view.camera.width * view.camera.height for view in square.train)
    assert fitted.density.limit == max(pixels // 64, 80)
    train(fitted)
    assert len(fitted.model) <= fitted.density.limit
    printed = capsys.readouterr().err
    assert printed.count(f"{fitted.density.limit} Gaussians are the most (default of train.densify.max_gaussians)") == 1


def test_the_lightest_gaussians_go_and_moments_follow():
    """Catches the heaviest that go, a weight of the wrong rows, and moments or counts of other Gaussians."""
    fitted = trainer("3dgs", "train.densify.thin_to=0.5")
    fitted.train_step()
    model, optimizer = fitted.model, fitted.optimizer
    weights = blend_weights(model, fitted.scene.train, fitted.renderer.antialias)
    kept = weights.argsort(descending=True, stable=True)[: round(len(model) / 2)].sort().values
    means, moments = model.splats["means"].detach()[kept], optimizer.moments[model.splats["means"]]["exp_avg"][kept]
    fitted.density.thin()
    assert torch.equal(model.splats["means"], means)
    assert torch.equal(optimizer.moments[model.splats["means"]]["exp_avg"], moments)
    assert len(fitted.density.rule.unseen) == len(kept)


def test_blend_weights_add_up_to_alpha():
    """Catches weights of another channel count or view: the weights of a pixel add up to its alpha."""
    fitted = trainer("3dgs")
    view = fitted.scene.train[0]
    gaussians = fitted.model.slice(CameraTime.of(view.camera, view.time))
    alpha = rasterize_slice(gaussians, view.camera, torch.zeros(3), fitted.model.backend).alpha
    weights = blend_weights(fitted.model, [view], antialias=False)
    torch.testing.assert_close(weights.sum(), alpha.detach().sum(), rtol=1e-4, atol=0)
