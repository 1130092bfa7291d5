"""Densification by scores of several views: the scores themselves, who is cloned or pruned by them, and resuming."""

import math
from dataclasses import replace

import pytest
import torch
from interrupted import assert_same_bits
from models.small import Moments, started
from test_mcmc import OPTIONS
from tiny_training import moving_square, train, trainer

from gsbench.config import DensifyConfig
from gsbench.kernels.backends import REFERENCE
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.render import rasterize_slice, render
from gsbench.scenes.scene import Points, View
from gsbench.train.batches import generator
from gsbench.train.density.multiview import LEAST_IMPORTANCE, VIEWS, ErrorScore, MultiviewDensification, drawn_once
from gsbench.train.density.rule import Scores
from gsbench.train.hooks.minimum_sizes import MinimumScale
from gsbench.train.losses import photometric
from gsbench.train.renderer import Renderer
from gsbench.train.rows import Rows

GREY = torch.tensor([0.2, 0.3, 0.4])
NAMES = ("3dgs", "4dgs", "6dgs", "7dgs", "dgs", "freetime")
ROUNDS = (
    *("train.densify.kind=multiview", "train.densify.grad_threshold=1e-6"),
    *("train.densify.start=0", "train.densify.stop=50", "train.densify.every=10"),
    *("train.iterations=60", "train.recipe_iterations=60", "train.refine_from=0"),
)


def four_gaussians() -> GaussianModel:
    """3DGS with two pairs of Gaussians, of which one hides the other in part, that all views see."""
    model = build("3dgs")
    means = torch.tensor([[-0.5, 0.0, 0.0], [-0.4, 0.1, 0.3], [0.5, 0.2, 0.0], [0.4, -0.2, -0.3]])
    model.initialise(Points(means, torch.rand(4, 3, generator=generator(3))), 4.4, generator(0))
    model.splats["scales"].data.fill_(math.log(0.15))
    model.splats["opacities"].data.copy_(torch.tensor([2.0, 1.0, 0.5, -1.0]))
    return model


def scores_of(model: GaussianModel, views: list[View]) -> ErrorScore:
    return ErrorScore(model, views, Renderer(GREY, antialias=False), ssim_weight=0.2)


def weights_of_pixels(model: GaussianModel, view: View) -> torch.Tensor:
    """The blend weight of each Gaussian in each pixel, [H, W, N]: an image whose channels are the Gaussians."""
    gaussians = model.slice(CameraTime.of(view.camera, view.time))
    channels = gaussians._replace(colors=torch.eye(len(model)))
    return rasterize_slice(channels, view.camera, torch.zeros(len(model)), REFERENCE).image[0].detach()


def wrong_on_the_left(model: GaussianModel, view: View, by: float) -> View:
    """The view with the model's own image, to which noise is added, and more in its left third."""
    image = render(model, view.camera, view.time, GREY).detach()
    image += 0.05 * by * torch.randn(image.shape, generator=generator(7))
    image[:, :6] += by * torch.randn(16, 6, 3, generator=generator(8))
    return replace(view, pixels=image)


def test_scores_are_the_sums_by_hand():
    """Catches pixels that are not flagged, errors of another range, losses of other views, and a mean that is a sum."""
    model = four_gaussians()
    views = [wrong_on_the_left(model, *pair) for pair in zip(moving_square().train[:3], (0.2, 0.5, 1.0), strict=True)]
    importance, badness = scores_of(model, views)(generator(5))
    counts, weighed = torch.zeros(4), torch.zeros(4)
    for view in views:
        image = render(model, view.camera, view.time, GREY).detach()
        differences = (image - view.image).reshape(-1, 3).tolist()
        errors = [(abs(r) + abs(g) + abs(b)) / 3 for r, g, b in differences]
        least, most = min(errors), max(errors)
        weights = weights_of_pixels(model, view).reshape(-1, 4)
        c = sum(w for w, error in zip(weights, errors, strict=True) if (error - least) / (most - least) > 0.1)
        assert 0.1 * weights.sum() < c.sum() < 0.9 * weights.sum()
        counts += c / 3
        weighed += photometric(image, view.image, 0.2) * c
    torch.testing.assert_close(importance, counts, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(badness, (weighed - weighed.min()) / (weighed.max() - weighed.min()), rtol=0, atol=1e-4)
    assert 0.05 < badness.sort().values[-2] < 0.95


def test_perfect_images_and_models_without_gaussians_are_scored():
    """Catches a division by a range of equal errors, and the least of no numbers: all Gaussians may be pruned."""
    model = four_gaussians()
    exact = [
        replace(view, pixels=render(model, view.camera, view.time, GREY).detach()) for view in moving_square().train[:2]
    ]
    importance, badness = scores_of(model, exact)(generator(0))
    assert not importance.any()
    assert not badness.any()
    Rows(model, Moments()).select(torch.arange(0))
    score = scores_of(model, moving_square().train)
    density = MultiviewDensification(Rows(model, Moments()), DensifyConfig(), 0.005, 10, score)
    assert density.densify(generator(0), has_reset=True, most=100) == 0
    assert len(model) == 0


def test_ten_different_views_are_drawn_anew():
    """Catches a view that is drawn twice, more views than ten, and the same ones in every round."""
    score = scores_of(four_gaussians(), moving_square().train)
    real, looked_at = score._of_view, list[str]()
    score._of_view = lambda view: looked_at.append(view.name) or real(view)
    for seed in (0, 1, 0):
        score(generator(seed))
    rounds = [looked_at[:VIEWS], looked_at[VIEWS : 2 * VIEWS], looked_at[2 * VIEWS :]]
    assert [len(set(names)) for names in rounds] == [10, 10, 10]
    assert rounds[0] == rounds[2] != rounds[1]


def of_eight(name: str, opacities: list[float], badness: list[float]) -> tuple[MultiviewDensification, torch.Tensor]:
    """The rule with scores that are given for eight Gaussians, of which 2 to 5 are important; and their means."""
    model = started(build(name, **OPTIONS[name]), 8)
    model.splats["opacities"].data.copy_(torch.tensor(opacities))
    importance = torch.full((8,), LEAST_IMPORTANCE)
    importance[2:6] = 10.0
    scores, config = Scores(importance, torch.tensor(badness)), DensifyConfig(grad_threshold=1.0)
    rule = MultiviewDensification(Rows(model, Moments()), config, 0.005, 10, lambda _: scores)
    return rule, model.splats["means"].detach().clone()


def copies(model: GaussianModel, means: torch.Tensor) -> list[int]:
    """How many Gaussians of the model have each of the means."""
    counts: list[int] = (model.splats["means"].detach()[:, None] == means).all(-1).sum(0).tolist()
    return counts


@pytest.mark.parametrize("name", NAMES)
def test_only_important_gaussians_of_large_gradient_are_cloned(name):
    """Catches a rule that asks for one of the two, a threshold that is not above, and opacities left above 0.8."""
    density, means = of_eight(name, [3.0, 1.0, 3.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0] * 8)
    density.gradient[:4], density.times_visible[:] = 5.0, 1.0
    assert density.densify(generator(1), has_reset=False, most=100) == 0
    assert len(density.model) == len(density.unseen) == 10
    counts = copies(density.model, means)
    assert [counts[i] for i in (0, 1, 4, 5, 6, 7)] == [1] * 6
    assert set(counts[2:4]) <= {0, 2}  # split or cloned
    opacities = density.model.splats["opacities"].detach()
    assert opacities[:2].tolist() == pytest.approx([math.log(4), 1.0])
    assert opacities.max().item() == pytest.approx(math.log(4))


@pytest.mark.parametrize(("has_reset", "left"), [(False, [0, 1, 1, 1, 1, 1, 1, 0]), (True, [0, 1, 1, 1, 1, 0, 1, 0])])
def test_half_as_many_as_candidates_are_drawn_from_all(has_reset, left):
    """Catches candidates that all go, Gaussians that go without being one, draws of the good ones, large Gaussians that
    are never candidates, and unseen ones that have to be drawn."""
    density, means = of_eight("3dgs", [-8.0] * 4 + [0.0] * 4, [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    with torch.no_grad():
        density.model.splats["scales"].fill_(math.log(0.1))
        density.model.splats["scales"][5] = math.log(0.3)  # above 0.1 x extent 2: a candidate after a reset
    density.unseen[7] = density.patience
    density.densify(generator(1), has_reset, most=100)  # two are drawn: 0 and 5
    assert copies(density.model, means) == left


def test_children_are_drawn_as_their_parent():
    """Catches scores of the rows before the split that are given to other rows after it."""
    density, means = of_eight("3dgs", [0.0, 0.0, -8.0, 0.0, 0.0, 0.0, 0.0, -8.0], [0.0, 0.0, 1.0] + [0.0] * 5)
    with torch.no_grad():
        density.model.splats["scales"].fill_(math.log(0.1))  # large: split
    density.gradient[2], density.times_visible[:] = 5.0, 1.0
    density.densify(generator(1), has_reset=False, most=100)  # three are faint, so one is drawn: a child
    assert copies(density.model, means) == [1, 1, 0, 1, 1, 1, 1, 1]
    assert len(density.model) == 8


def test_rows_are_drawn_once_in_proportion():
    """Catches a row that is drawn twice, and weights that are not proportions."""
    assert sorted(drawn_once(torch.tensor([1.0, 1e6, 1e-6]), 3, generator(0)).tolist()) == [0, 1, 2]
    firsts = [int(drawn_once(torch.tensor([1.0, 3.0]), 1, generator(seed))) for seed in range(1000)]
    assert 0.71 < sum(firsts) / 1000 < 0.79


@pytest.mark.usefixtures("threads")
def test_scores_have_the_same_bits_for_any_number_of_threads():
    """Catches views whose weights are added in the order that threads come by."""
    model = started(build("7dgs", **OPTIONS["7dgs"]), 300)
    score, scores = scores_of(model, moving_square().train), []
    for count in (1, 2, 3, 8):
        torch.set_num_threads(count)
        scores.append(list(score(generator(0))))
    assert scores[0][0].any()
    for other in scores[1:]:
        assert_same_bits(scores[0], other)


@pytest.mark.parametrize("name", NAMES)
def test_every_model_trains_by_it(name):
    """Catches a model whose slices give no blend weights, and state of the training that does not follow the rows."""
    fitted = trainer(name, *ROUNDS)
    before = len(fitted.model)
    model = train(fitted, until=21).model
    assert len(model) > before
    assert len(model) == len(fitted.hook(MinimumScale).least) == len(fitted.density.rule.unseen)
    assert all(parameter.isfinite().all() for parameter in model.parameters())
