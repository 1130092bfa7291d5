"""The trainer's wiring: which gradient, which views, which rows and which rate go where, asked of a real trainer."""

import copy
import math
import re
import time
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from tiny_training import compose, moving_square

from gsbench.errors import InputError
from gsbench.kernels.adam import adam_all
from gsbench.kernels.backends import AUTO, REFERENCE, Backend
from gsbench.measure.curve import Point
from gsbench.measure.speed import StageClock
from gsbench.models import CameraTime
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.render import rasterize_slice
from gsbench.run.checks import check_values
from gsbench.run.setup import build
from gsbench.scenes.scene import Scene, View
from gsbench.train.batches import generator
from gsbench.train.density.blend_weights import blend_weights
from gsbench.train.hooks.average import Average
from gsbench.train.hooks.best import Best
from gsbench.train.hooks.minimum_sizes import MinimumScale
from gsbench.train.hooks.penalties import Penalties, PenaltiesConfig
from gsbench.train.loop import Trainer
from gsbench.train.optim import rate_at
from gsbench.train.regularisers import PENALTIES
from gsbench.train.step import ViewResult


def trainer(model: str = "7dgs", *overrides: str, scene: Scene | None = None) -> Trainer:
    """A trainer at its step 0, of a scene with three views of val and two of test."""
    config = compose(model, 100, *overrides)
    made = build(config)
    if scene is None:
        square = moving_square()
        scene = replace(square, val=square.train[:3], test=square.train[3:5])
    assert scene.points is not None
    made.initialise(scene.points, scene.extent, generator(config.seed))
    return Trainer(made, scene, scene.test, config)


def gradient_of_a_step(batch: int) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Of the means, and of the 2D means as density control collected it; and the loss. All views are one view."""
    square = moving_square()
    fitted = trainer("3dgs", f"train.batch_size={batch}", scene=replace(square, train=square.train[:1] * 4))
    means = fitted.model.splats["means"]
    seen = []
    fitted.optimizer.step = lambda *_: seen.append(means.grad)  # type: ignore[method-assign]
    fitted.train_step()
    assert means.grad is not None
    return (
        means.grad.clone(),
        fitted.density.rule.gradient / fitted.density.rule.times_visible.clamp(min=1),
        fitted.finite_check.loss,
    )


def test_a_batch_is_a_mean() -> None:
    """Catches a loss summed over the batch, and a density gradient that is not scaled back to one view."""
    one, four = gradient_of_a_step(1), gradient_of_a_step(4)
    torch.testing.assert_close(four[0], one[0], rtol=1e-4, atol=1e-8)
    torch.testing.assert_close(four[1], one[1], rtol=1e-4, atol=1e-8)
    assert one[1].max() > 0
    assert four[2] == pytest.approx(one[2], rel=1e-5)


@pytest.mark.parametrize("backend", [AUTO, REFERENCE], ids=lambda backend: backend.name)
def test_bytes_train_as_floats_do(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_density_gradients_are_of_one_view_in_half_images() -> None:
    """Catches a gradient that is not rescaled by the batch, or that is left in pixels."""
    density = trainer("3dgs").density.rule
    N = len(density.model)
    gradient = torch.tensor([3e-3, 4e-3]).expand(1, N, 2).clone()
    density.accumulate(torch.ones(1, N, dtype=torch.bool), gradient, width=20, height=20, views=4)
    torch.testing.assert_close(density.gradient, torch.full((N,), 5e-3 * 4 * 10))


def test_the_curve_is_of_val_and_the_best_of_the_evaluated_split() -> None:
    """Catches a curve measured on test, and a best on val that stores val's own score."""
    fitted = trainer()
    scores = {id(fitted.scene.val): [20.0, 21.0, 20.5], id(fitted.views): [15.0, 14.0, 16.0]}
    fitted.psnr = lambda views: scores[id(views)].pop(0)  # type: ignore[method-assign]
    for step in (0, 1, 2):
        fitted.step = step
        fitted._measure()
    assert [point.psnr_val for point in fitted.curve.points] == [20.0, 21.0, 20.5]
    assert isinstance(fitted.curve.last, Point)
    assert (fitted.hook(Best).scores.val, fitted.hook(Best).scores.eval_at_best_val, fitted.hook(Best).scores.eval) == (
        21.0,
        14.0,
        None,
    )


def test_opacities_are_reset_when_the_schedule_says() -> None:
    """Catches a reset that is never called, is called every step, or leaves any of Adam's two moments."""
    fitted = trainer()
    fitted.schedule.resets = lambda step: step == 1  # type: ignore[method-assign]
    opacities = fitted.model.splats["opacities"]
    with torch.no_grad():
        opacities.fill_(2.0)
    ceiling = 2 * fitted.config.model.min_opacity
    for step in (0, 1):
        fitted.run(lambda _: None, "a step", goes_on=lambda: False)
        assert (torch.sigmoid(opacities).max().item() <= ceiling * 1.001) == (step == 1)
    state = fitted.optimizer.moments[opacities]
    assert not state["exp_avg"].any()
    assert not state["exp_avg_sq"].any()


def test_a_point_of_the_curve_is_measured_before_a_reset() -> None:
    """Catches a curve, and a best on val, of models whose opacities were lowered a moment ago."""
    fitted = trainer()
    fitted.schedule.resets = fitted.schedule.measures = lambda _: True  # type: ignore[method-assign]
    opacities = fitted.model.splats["opacities"]
    with torch.no_grad():
        opacities.fill_(2.0)
    fitted.psnr = lambda _: opacities.max().sigmoid().item()  # type: ignore[method-assign]
    fitted.run(lambda _: None, "a step", goes_on=lambda: False)
    assert fitted.curve.last.psnr_val > 0.5  # type: ignore[union-attr, operator]
    assert opacities.max().sigmoid() <= 2.001 * fitted.config.model.min_opacity


def test_what_any_view_of_the_batch_saw_is_moved() -> None:
    """Catches sparse_adam that moves what the last view saw alone, or the first."""
    fitted = trainer("3dgs", "train.batch_size=3", "optim=sparse_adam")
    N = len(fitted.model)
    drawn = torch.zeros(3, 1, N, dtype=torch.bool)
    for view in range(3):
        drawn[view, 0, view] = True  # each view sees the Gaussian of its number
    seen = [ViewResult(torch.ones(()), one, torch.zeros(1, N, 2), {}) for one in drawn]
    fitted.gradients = lambda *_: seen  # type: ignore[assignment]
    moved = []
    fitted.optimizer.step = lambda _, drawn, __: moved.append(drawn)  # type: ignore[method-assign]
    for step in (0, 1):
        fitted.step = step
        fitted.train_step()
    assert all(drawn.tolist() == [True] * 3 + [False] * (N - 3) for drawn in moved)
    assert len(moved) == 2


def test_counts_are_kept_while_gaussians_are_densified() -> None:
    """Catches a last densification that does not know the views before it, and counting for none (2 % of a step)."""
    fitted = trainer("3dgs", "train.batch_size=1")
    stop, counted = fitted.schedule.densify_stop, []
    fitted.density.rule.accumulate = lambda *_: counted.append(fitted.step)  # type: ignore[method-assign]
    for fitted.step in (stop - 2, stop - 1, stop, stop + 1):
        fitted.train_step()
    assert counted == [stop - 2, stop - 1]
    assert fitted.schedule.densifies(stop - 1)


def test_large_gaussians_go_once_opacities_were_reset() -> None:
    """Catches pruning by size that is never asked for, or asked for from the start."""
    fitted = trainer()
    asked = []
    fitted.density.rule.densify = lambda _, has_reset, __: asked.append(has_reset)  # type: ignore[method-assign]
    fitted.schedule.densifies = lambda _: True  # type: ignore[method-assign]
    fitted.schedule.resets = lambda _: False  # type: ignore[method-assign]
    for step in (0, fitted.schedule.reset_every - 1, fitted.schedule.reset_every):
        fitted.step = step
        fitted.train_step()
    assert asked == [False, False, True]


def test_children_of_every_densification_are_drawn_anew() -> None:
    """Catches children that are scattered alike in every densification, and draws that are not those of the seed."""
    fitted = trainer("3dgs")
    drawn: list[float] = []
    fitted.density.rule.densify = lambda random, *_: drawn.append(torch.rand(1, generator=random).item())  # type: ignore[method-assign]
    fitted.schedule.densifies = lambda _: True  # type: ignore[method-assign]
    for fitted.config.seed, fitted.step in ((0, 3), (0, 4), (1, 3), (0, 3)):
        fitted.train_step()
    assert len(set(drawn)) == 3
    assert drawn[0] == drawn[3]


def test_rates_fall_in_the_optimizer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches rates that are set once, or given to another parameter: those of a step reach Adam."""
    fitted, given = trainer("7dgs"), {}

    def note(parameters: list[torch.Tensor], *arguments: Any) -> None:
        given.update({p.data_ptr(): rate for p, rate in zip(parameters, arguments[4], strict=True)})
        adam_all(parameters, *arguments)

    monkeypatch.setattr("gsbench.train.optim.adam_all", note)
    for step in (0, 50, 99):
        fitted.step = step
        fitted.train_step()
        for name, parameters in fitted.model.groups().items():
            rate = rate_at(fitted.config.model.lr[name], step, fitted.config.train, fitted.scene.extent)
            assert all(given[p.data_ptr()] == rate for p in parameters if p.data_ptr() in given), name
        assert len(given) >= 10


def test_what_is_long_in_time_is_split_along_its_path() -> None:
    """Catches 7DGS never splitting in time: a small Gaussian that asks for density and moves gets two times."""
    fitted = trainer("7dgs")
    model, density = fitted.model, fitted.density.rule
    with torch.no_grad():
        model.splats["log_diagonal"][:, 4:] = math.log(1e-3)  # small: in space it would be cloned
        model.splats["motion"][0, 3] = 10.0
        model.splats["opacities"].fill_(2.0)
    density.gradient[:2], density.times_visible[:2] = 1.0, 1.0
    times = model.splats["times"].detach()[:2].clone()
    N = len(model)
    density.densify(generator(0), has_reset=False, most=100)
    assert len(model) == N + 2
    children, clone = model.splats["times"].detach()[-2:], model.splats["times"].detach()[-3]
    assert (children != times[0]).all()
    assert clone == times[1]


def test_children_in_time_stay_near_the_clip() -> None:
    """Catches a split in time that draws from all of a Gaussian that lasts for ever: AGR read times of -240."""
    model = trainer("7dgs").model
    with torch.no_grad():
        model.splats["log_diagonal"][:, 3] = math.log(1e4)
        model.splats["motion"][:, 3] = 100.0
    before = model.splats["times"].detach().clone()
    assert model.long_in_time().all()
    model.split_rows(torch.arange(len(model)), generator(0))
    moved = (model.splats["times"].detach() - before).abs()
    assert 0.5 < moved.max() < 6


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("name", ["3dgs", "4dgs", "6dgs", "7dgs"])
def test_a_model_shows_the_same_by_kernels_and_in_torch(name: str, degree: int, half: bool) -> None:
    """Catches a kernel's path that ignores directional_half, the harmonics' schedule, or AGR."""
    option = [f"model.options.directional_half={half}"] if name in ("6dgs", "7dgs") else []
    fitted = trainer(name, "agr=true", *option)
    model = fitted.model
    random = generator(1)
    with torch.no_grad():
        for splat in model.splats.values():
            splat.add_(0.3 * torch.randn(splat.shape, generator=random))
        assert model.refinement is not None
        model.refinement.weight_out.normal_(0, 0.02, generator=random)
    model.set_active(replace(model.active, sh_degree=degree, refine=True))
    shown = []
    for backend in (AUTO, REFERENCE):
        model.backend = backend
        shown.append(model.slice(CameraTime.at(fitted.scene.train[2].camera.center, 0.4)))
    drawn = shown[1].opacities > 1 / 200  # colours of what is not drawn are not computed
    assert drawn.sum() > 10
    for a, b in zip(*map(tensors_of, shown), strict=True):
        torch.testing.assert_close(a[drawn], b[drawn], rtol=1e-3, atol=1e-4)


def test_agr_starts_as_linear_layers_do() -> None:
    """Catches another initialisation than torch.nn.Linear's: uniform within 1 / sqrt(width), output layers zero."""
    refinement = trainer("7dgs").model.refinement
    assert refinement is not None
    bound = 1 / math.sqrt(7 + 2 * refinement.octaves)
    for values in (refinement.weight_in, refinement.bias_in):
        assert 0.9 * bound < values.abs().max() <= bound
        assert values.mean().abs() < 0.1 * bound
    assert refinement.weight_in.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
    assert not refinement.weight_out.any()
    assert not refinement.bias_out.any()


def test_the_size_of_4dgs_is_its_largest_in_space() -> None:
    """Catches the smallest scale, and a duration that counts as a size."""
    model = trainer("4dgs").model
    with torch.no_grad():
        model.splats["scales"].copy_(torch.tensor([0.0, 1.0, -1.0, 5.0]).expand(len(model), 4))
    torch.testing.assert_close(model.scales(), torch.full((len(model),), math.e))


def test_the_floor_is_held_in_training_and_follows_the_rows() -> None:
    """Catches a minimum scale that is never held, or that is of other Gaussians once rows were moved."""
    fitted = trainer("7dgs", "train.densify.every=1")
    sizes = fitted.model.splats["log_diagonal"]
    for step in (0, 60):
        with torch.no_grad():
            sizes[:, 4:] = -20.0
        fitted.step = step
        fitted.train_step()
        held = fitted.model.splats["log_diagonal"].detach()[:, 4:].amin(1)
        assert len(held) == len(fitted.hook(MinimumScale).least)
        if step == 0:
            torch.testing.assert_close(held, fitted.hook(MinimumScale).least.log(), rtol=1e-2, atol=0)


def test_the_bar_tells_seconds_and_val_without_reading_the_clock(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a bar that says neither, and one that waits for a GPU at every step to say it."""
    fitted = trainer("3dgs", "train.curve_points=4")
    reads = []
    seconds = StageClock.seconds.fget
    assert seconds is not None
    monkeypatch.setattr(StageClock, "seconds", property(lambda clock: reads.append(1) or seconds(clock)))
    fitted.run(lambda _: None, "square")
    assert len(reads) == 4 + 1  # the points of the curve, and the checkpoint at the end
    last = capsys.readouterr().err.split("\r")[-1]
    assert fitted.curve.progress in last
    assert re.search(r"\d+ s of training, val \d+\.\d\d dB \([+-]\d", last)


def with_fake_clock(fitted: Trainer, now: list[float], patch: pytest.MonkeyPatch) -> Trainer:
    """A trainer whose steps take 2 s in a stage and 1 s around it, and whose measuring takes 100 s."""

    def work(seconds: float) -> None:
        now[0] += seconds

    def step() -> None:
        work(0.75)
        with fitted.stages("loss"):
            work(2.0)
        work(0.25)

    def measure(_: object) -> float:
        work(100.0)
        return 20.0

    patch.setattr(time, "perf_counter", lambda: now[0])
    patch.setattr(fitted, "train_step", step)
    patch.setattr(fitted, "psnr", measure)
    return fitted


def test_the_seconds_of_a_training_are_the_wall_clock_of_its_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches Python between stages that no second holds, val, checkpoints and reports that are held to be training,
    a curve of another clock, and a stopped run that loses seconds or counts them twice."""
    now = [0.0]
    saved: list[dict[str, Any]] = []

    def save(state: dict[str, Any]) -> None:
        now[0] += 1000.0
        saved.append(state)

    def goes_on() -> bool:
        now[0] += 10_000.0
        return fitted.step != 3

    settings = ("3dgs", "train.iterations=10", "train.curve_points=5", "train.densify.stop=0")
    for _ in range(2):  # the second training continues the first, which ends after three steps
        fitted = with_fake_clock(trainer(*settings), now, monkeypatch)
        if saved:
            fitted.load_state_dict(saved[-1])
        fitted.run(save, "square", goes_on)
    assert fitted.step == 10
    assert fitted.stages.seconds == pytest.approx({"loss": 20.0, "other": 10.0})
    assert [(p.iteration, p.seconds) for p in fitted.curve.points] == [(n, 3.0 * n) for n in (2, 4, 6, 8, 10)]


def test_early_steps_see_small_images() -> None:
    """Catches a resolution that is not the schedule's, a camera that does not shrink with its image, or its centre."""
    fitted = trainer("3dgs", "train.coarse=[[2,15000]]", "train.batch_size=1")
    looked: list[View] = []
    real = fitted.gradients
    fitted.gradients = lambda views, penalties: looked.extend(views) or real(views, penalties)  # type: ignore[assignment]
    half = fitted.schedule.scaled(15_000)
    for fitted.step in (0, half - 1, half):
        fitted.train_step()
    width = fitted.scene.train[0].camera.width
    assert [view.camera.width for view in looked] == [width // 2] * 2 + [width]
    small, full = looked[0], next(view for view in fitted.scene.train if view.name == looked[0].name)
    assert list(small.image.shape[:2]) == [small.camera.height, small.camera.width]
    torch.testing.assert_close(small.camera.K[:2], full.camera.K[:2] / 2)
    torch.testing.assert_close(small.image[3, 5], full.image[6:8, 10:12].mean((0, 1)))
    assert not fitted.batches._reduced, "small images that no later step needs"


def test_the_lightest_gaussians_go_and_moments_follow() -> None:
    """Catches the heaviest that go, a weight of the wrong rows, and moments or counts of other Gaussians."""
    fitted = trainer("3dgs", "train.densify.thin_to=0.5")
    fitted.train_step()
    model, N = fitted.model, len(fitted.model)
    weights = blend_weights(model, fitted.scene.train, fitted.renderer.antialias)
    kept = weights.argsort(descending=True, stable=True)[: round(N / 2)].sort().values
    means = model.splats["means"].detach().clone()
    moments = fitted.optimizer.moments[model.splats["means"]]["exp_avg"].clone()
    fitted.density.thin()
    assert torch.equal(model.splats["means"], means[kept])
    assert torch.equal(fitted.optimizer.moments[model.splats["means"]]["exp_avg"], moments[kept])
    assert len(fitted.hook(MinimumScale).least) == len(fitted.density.rule.unseen) == len(kept)
    at = max(fitted.schedule.scaled(15_600), fitted.schedule.densify_stop)
    assert [step for step in range(100) if fitted.schedule.thins(step)] == [at - 1]


def test_blend_weights_add_up_to_alpha() -> None:
    """Catches weights of another channel count or view: the weights of a pixel add up to its alpha."""
    fitted = trainer("3dgs")
    view = fitted.scene.train[0]
    seen = fitted.model.slice(CameraTime.of(view.camera, view.time))
    alpha = rasterize_slice(seen, view.camera, torch.zeros(3), fitted.model.backend).alpha
    weights = blend_weights(fitted.model, [view], antialias=False)
    torch.testing.assert_close(weights.sum(), alpha.detach().sum(), rtol=1e-4, atol=0)


def test_penalties_act_in_their_window_and_reach_the_gradient() -> None:
    """Catches a penalty that acts always or never, or that is added once for each view of a batch."""
    words = ("train.batch_size=2", "train.penalties.opacity.weight=3.0", "train.penalties.opacity.start=15000")
    plain, penalised = trainer("3dgs", "train.batch_size=2"), trainer("3dgs", *words)
    start = penalised.schedule.scaled(15_000)
    for step, acts in ((start - 2, False), (start - 1, True)):
        found = []
        for one in (plain, penalised):
            views = one.scene.train[:2]
            one.gradients(views, one.hook(Penalties).loss_terms(step, views))
            found.append(one.model.splats["opacities"].grad)
        opacities = torch.sigmoid(plain.model.splats["opacities"].detach())
        expected = 3.0 * opacities * (1 - opacities) / len(opacities)
        torch.testing.assert_close(found[1] - found[0], expected * acts, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("train.densify.kind=gradiant", "train.densify.kind 'gradiant' is not known. Did you mean 'gradient'"),
        ("train.penalties.opacity.stop=0", "train.penalties.opacity: expected stop above start"),
        ("train.penalties.size.weight=-1", "train.penalties.size.weight: expected"),
        ("train.coarse=[[2,3000],[4,15000]]", "factors falling and steps rising"),
        ("train.coarse=[[1,3000]]", "expected pairs (factor above 1"),
        ("train.coarse=[[]]", "expected pairs (factor above 1"),
        ("train.coarse=[[4,3000,1]]", "expected pairs (factor above 1"),
    ],
)
def test_faulty_schedules_are_refused(word: str, said: str) -> None:
    """Catches a typo that trains by another rule than was asked for."""
    with pytest.raises(InputError) as refused:
        check_values(compose("3dgs", 100, word))
    assert said in str(refused.value)


def test_every_penalty_has_its_settings() -> None:
    """Catches a penalty without a weight in the config, and a weight that nothing reads."""
    assert {field.name for field in fields(PenaltiesConfig)} == set(PENALTIES)


def test_relocation_and_averages_continue_from_a_checkpoint() -> None:
    """Catches random numbers or sums of relocation and of averages that a checkpoint does not have."""
    densify = ("train.densify.kind=mcmc", "train.densify.start=0", "train.densify.stop=50", "train.densify.every=10")
    lengths = ("train.iterations=60", "train.recipe_iterations=60", "train.average_from=40", "train.refine_from=0")
    words = (*densify, *lengths)
    whole, part = trainer("7dgs", *words), trainer("7dgs", *words)
    before = len(whole.model)
    whole.run(lambda _: None, "whole")
    stops = iter([True] * 54 + [False])
    part.run(lambda _: None, "part", lambda: next(stops))
    assert part.step == 55
    assert part.hook(Average).count == 1  # of step 50: it started anew with the round before
    state = copy.deepcopy(part.state_dict())
    resumed = trainer("7dgs", *words)
    resumed.load_state_dict(state)
    resumed.run(lambda _: None, "resumed")
    assert len(whole.model) > before
    assert whole.hook(Average).count == 0
    assert whole.hook(Average).kept == resumed.hook(Average).kept
    for name, value in whole.model.pack().items():
        assert torch.equal(value, resumed.model.pack()[name]), name
