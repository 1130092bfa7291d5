"""Losses and gradients that are not finite: they are noticed, are not applied, and are explained to the user."""

import contextlib
import io
import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from numerics import audit
from tiny_training import moving_square, trainer
from torch import nn

from gsbench import models
from gsbench.kernels.adam import are_finite
from gsbench.scenes import View
from gsbench.train import checkpoint, divergence
from gsbench.train.batches import generator
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.divergence import DivergedError, FiniteCheck
from gsbench.train.loop import Trainer
from gsbench.train.step import ViewResult


def parameter(gradient: list[float]) -> nn.Parameter:
    p = nn.Parameter(torch.zeros(len(gradient)))
    p.grad = torch.tensor(gradient)
    return p


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_the_parameter_is_named_at_its_step(bad: float) -> None:
    """Catches a bad gradient that reaches its parameter, or is blamed on another parameter or step."""
    groups = {"means": [parameter([1.0, 2.0])], "refinement": [parameter([1.0]), parameter([0.0, bad])]}
    finite_check = FiniteCheck("cpu")
    with pytest.raises(DivergedError, match=r"step 3: the gradient of 'refinement' is not finite \(loss 0.5\)"):
        finite_check.check(3, torch.tensor(0.5), groups)
    with pytest.raises(DivergedError, match="step 4: the loss is nan"):
        FiniteCheck("cpu").check(4, torch.tensor(math.nan), {"means": [parameter([1.0])]})


def test_finite_values_whose_sum_is_not_are_let_through() -> None:
    """Catches a check of the sum alone, and a parameter without a gradient taken for a fault."""
    unused = nn.Parameter(torch.zeros(1))
    finite_check = FiniteCheck("cpu")
    finite_check.check(0, torch.tensor(0.25), {"means": [parameter([3e38, 3e38])], "unused": [unused]})
    assert finite_check.loss == 0.25


def test_a_bad_step_found_later_changes_nothing_meanwhile() -> None:
    """Catches a GPU's training, looked at now and then, that applies a bad gradient, or a good one after it."""
    finite_check = FiniteCheck("cpu")
    finite_check.every = 4
    fitted = nn.Parameter(torch.zeros(3))
    adam = torch.optim.Adam([fitted], lr=0.1, fused=True)
    adam.found_inf = finite_check.skip  # type: ignore[attr-defined]
    before = []

    def train() -> None:
        for step in range(1, 20):
            fitted.grad = torch.full((3,), math.nan if step == 6 else 1.0)
            before.append(fitted.detach().clone())
            finite_check.check(step, torch.tensor(float(step)), {"means": [fitted]})
            adam.step()

    with pytest.raises(DivergedError, match=r"step 6: the gradient of 'means' is not finite \(loss 6.0\)"):
        train()
    assert len(before) == 8  # steps 1 to 8, the second to be looked at
    assert not torch.equal(before[4], before[5])  # step 5 was applied ..
    assert torch.equal(before[5], before[6])  # .. step 6 was not ..
    assert torch.equal(before[6], before[7])  # .. nor was step 7
    assert fitted.isfinite().all()


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(("array", "place"), [(0, 0), (39, 4), (17, 299_999)])
def test_one_bad_number_among_many_arrays_is_found(array: int, place: int) -> None:
    """Catches a kernel call that leaves out the last arrays, the last numbers, or what another thread found."""
    torch.set_num_threads(2)
    arrays = [torch.full((300_000,) if i == 17 else (5,), 3e38) for i in range(40)]
    assert are_finite([*arrays, torch.zeros(0)])
    arrays[array][place] = math.nan
    assert not are_finite(arrays)


POISONED = 7


def poison(run: Trainer, parameter: str, after: int) -> None:
    """From so many steps on, the last entry of one Gaussian's gradient is NaN."""
    gradients, steps = run.gradients, [0]

    def poisoned(batch: Sequence[View], *penalties: object) -> list[ViewResult]:
        views = gradients(batch, *penalties)
        steps[0] += 1
        if steps[0] > after:
            gradient = run.model.splats[parameter].grad
            assert gradient is not None
            gradient[POISONED].view(-1)[-1] = math.nan
        return views

    run.gradients = poisoned  # type: ignore[assignment]


def test_the_step_the_parameter_the_gaussian_and_the_case(tmp_path: Path) -> None:
    """Catches a NaN that is noticed steps later, is blamed on something else, or reaches a parameter or checkpoint."""
    run = trainer("7dgs", "train.curve_points=1")
    run.model.splats["log_diagonal"].data[POISONED, 3] = 12.0  # e^12 clips: static
    run.config.train.checkpoint_minutes = 0  # after every step
    poison(run, "log_diagonal", after=5)
    path = tmp_path / "checkpoint.pt"
    with contextlib.redirect_stderr(io.StringIO()), pytest.raises(DivergedError, match=r"step 5.*'log_diagonal'"):
        run.run(lambda state: checkpoint.save(path, Checkpoint("training", "data", state)), "poisoned")
    assert divergence.explain(run.model) == (
        "the first is Gaussian 7 of 80 in 'log_diagonal' (1 in all): it resembles the stability case 'static'"
    )
    assert all(p.isfinite().all() for p in run.model.parameters())
    state = checkpoint.load(path, "training", "data", "cpu")
    assert state is not None
    assert state["step"] == 5
    assert all(value.isfinite().all() for value in state["model"].values())


CHANGES = [
    ("refinement_pushes_sizes", "log_diagonal", 4, 40.0),
    ("instant", "log_diagonal", 3, -12.0),
    ("static", "log_diagonal", 3, 12.0),
    ("needle", "log_diagonal", 5, -15.0),
    ("direction_off_the_sphere", "directions", 0, 1e3),
    ("larger_than_the_scene", "log_diagonal", slice(4, 7), 9.0),
    ("far_off_axis", "means", 0, 1e5),
    ("loud_harmonics", "sh0", 0, 1e4),
]


def test_resemblance() -> None:
    """Catches a diagnosis that names a case there is none of, or another one than the Gaussian was made like.

    Also lambdas and quaternions that are not looked at, and a diagnosis without any Gaussian to blame.
    """
    model = trainer("7dgs").model
    for name, parameter, at, value in CHANGES:
        splats = model.splats[parameter].data
        before = splats[POISONED].clone()
        splats[POISONED, at] = value
        assert name in audit.CASES
        assert divergence.resembles(model, POISONED) == name
        assert divergence.resembles(model, POISONED + 1) is None
        splats[POISONED] = before
    assert "networks" in divergence.explain(model)
    for log_lambda, name in ((9.0, "oversensitive"), (-50.0, "insensitive")):
        model.log_lambda["time"].data.fill_(log_lambda)
        assert divergence.resembles(model, 0) == name
    rotated = trainer("4dgs").model
    rotated.splats["left_quats"].data[0] *= 1e-6
    assert divergence.resembles(rotated, 0) == "vanishing_quaternion"


def test_resemblance_in_time_is_in_clips() -> None:
    """Catches sizes in time of 4DGS that are compared in the scene's unit: a clip is as long as 100 units here."""
    model = trainer("4dgs").model
    model.clock.fill_(100.0)
    for clips, name in ((-11.0, "instant"), (-8.0, None), (3.0, None), (11.0, "static")):
        model.splats["scales"].data[POISONED, :3] = clips / 2
        model.splats["scales"].data[POISONED, 3] = math.log(100.0) + clips
        assert divergence.resembles(model, POISONED) == name, clips


def test_without_harmonics() -> None:
    """Catches a diagnosis that takes the largest of no coefficients, so that the run leaves no record."""
    model, points = models.build("3dgs", sh_degree=0), moving_square().points
    assert points is not None
    model.initialise(points, 4.4, generator(0))
    for parameter in model.splats.values():
        parameter.grad = torch.zeros_like(parameter)
    assert "learning rates" in divergence.explain(model)
    model.splats["sh0"].data[POISONED] = 1e4
    gradient = model.splats["sh0"].grad
    assert gradient is not None
    gradient[POISONED].view(-1)[-1] = math.nan
    assert "Gaussian 7 of 80 in 'sh0' (1 in all): it resembles the stability case 'loud" in divergence.explain(model)
