"""What a user learns when a training diverges: the step, the parameter, the Gaussian, and the case it resembles."""

import contextlib
import io
import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from numerics import audit
from tiny_training import compose, moving_square

from gsbench import models
from gsbench.scenes import View
from gsbench.train import checkpoint, divergence
from gsbench.train.batches import generator
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.divergence import DivergedError
from gsbench.train.loop import Trainer
from gsbench.train.step import ViewResult

POISONED = 7


def trainer(name: str, steps: int = 12) -> Trainer:
    config, scene = compose(name, steps, "train.densify.stop=1"), moving_square()
    config.train.curve_points = 1
    model = models.build(name, agr=config.agr, sh_degree=3, **config.model.options)
    assert scene.points is not None
    model.initialise(scene.points, scene.extent, generator(0))
    return Trainer(model, scene, scene.train, config)


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
    run = trainer("7dgs")
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


CHANGES = {
    "refinement_pushes_sizes": ("log_diagonal", 4, 40.0),
    "instant": ("log_diagonal", 3, -12.0),
    "static": ("log_diagonal", 3, 12.0),
    "needle": ("log_diagonal", 5, -15.0),
    "direction_off_the_sphere": ("directions", 0, 1e3),
    "larger_than_the_scene": ("log_diagonal", slice(4, 7), 9.0),
    "far_off_axis": ("means", 0, 1e5),
    "loud_harmonics": ("sh0", 0, 1e4),
}


@pytest.mark.parametrize("name", CHANGES)
def test_resemblance(name: str) -> None:
    """Catches a diagnosis that names a case there is none of, or another one than the Gaussian was made like."""
    model = trainer("7dgs").model
    parameter, at, value = CHANGES[name]
    model.splats[parameter].data[POISONED, at] = value
    assert name in audit.CASES
    assert divergence.resembles(model, POISONED) == name
    assert divergence.resembles(model, POISONED + 1) is None


def test_resemblance_of_the_whole_model() -> None:
    """Catches lambdas and quaternions that are not looked at, and a diagnosis without any Gaussian to blame."""
    model = trainer("7dgs").model
    assert "networks" in divergence.explain(model)
    for value, name in ((9.0, "oversensitive"), (-50.0, "insensitive")):
        model.log_lambda["time"].data.fill_(value)
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
