"""Losses and gradients that are not finite: they are noticed, are not applied, and are explained to the user."""

import math
from collections.abc import Sequence

import pytest
import torch
from tiny_training import moving_square, trainer
from torch import nn

from gsbench import models
from gsbench.scenes import View
from gsbench.train import checkpoint, divergence
from gsbench.train.batches import generator
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.divergence import DivergedError, FiniteCheck
from gsbench.train.step import PartResult


def parameter(gradient: list[float] | None) -> nn.Parameter:
    p = nn.Parameter(torch.zeros(2))
    p.grad = None if gradient is None else torch.tensor(gradient)
    return p


@pytest.mark.parametrize(
    ("loss", "gradient", "message"),
    [
        *(
            (0.5, [0.0, bad], r"step 3: the gradient of 'refinement' is not finite \(loss 0.5\)")
            for bad in (math.nan, math.inf, -math.inf)
        ),
        (math.nan, [0.0, 1.0], "step 3: the loss is nan"),
        (0.5, [3e38, 3e38], None),  # finite, and its sum is not
        (0.5, None, None),
    ],
)
def test_the_parameter_is_named_at_its_step(loss, gradient, message):
    """Catches a bad gradient that reaches its parameter, or is blamed on another parameter or step, a check of the sum
    alone, and a parameter without a gradient taken for a fault."""
    groups = {"means": [parameter([1.0, 2.0])], "refinement": [parameter([1.0, 1.0]), parameter(gradient)]}
    check = FiniteCheck("cpu")
    check.check(torch.tensor([loss]), groups)
    if message is None:
        check.end(3)
        assert check.loss == loss
    else:
        with pytest.raises(DivergedError, match=message):
            check.end(3)


def test_a_bad_step_found_later_changes_nothing_meanwhile():
    """Catches a GPU's training, looked at now and then, that applies a bad gradient, or a good one after it."""
    finite_check = FiniteCheck("cpu")
    finite_check.every = 4
    fitted = nn.Parameter(torch.zeros(3))
    adam = torch.optim.Adam([fitted], lr=0.1, fused=True)
    adam.found_inf = finite_check.skip
    before = []

    def train() -> None:
        for step in range(1, 20):
            fitted.grad = torch.full((3,), math.nan if step == 6 else 1.0)
            before.append(fitted.detach().clone())
            finite_check.check(torch.tensor([float(step)]), {"means": [fitted]})
            adam.step()
            finite_check.end(step)

    with pytest.raises(DivergedError, match=r"step 6: the gradient of 'means' is not finite \(loss 6.0\)"):
        train()
    moved = [not torch.equal(a, b) for a, b in zip(before, [*before[1:], fitted.detach()], strict=True)]
    assert moved == [True] * 5 + [False] * 3  # steps 1 to 8, the second to be looked at


POISONED = 7


def test_the_step_the_parameter_and_the_gaussian(tmp_path):
    """Catches a NaN that is noticed steps later, is blamed on something else, or reaches a parameter or checkpoint."""
    run = trainer("7dgs", "train.curve_points=1", "train.checkpoint_minutes=0")
    real = run.gradients

    def poisoned(batch: Sequence[View], *penalties: object) -> list[PartResult]:
        views = real(batch, *penalties)
        if run.step == 5:
            run.model.splats["log_diagonal"].grad[POISONED, -1] = math.nan
        return views

    poisoned.replay = real.replay
    run.gradients = poisoned
    path = tmp_path / "checkpoint.pt"
    with pytest.raises(DivergedError, match=r"step 5.*'log_diagonal'"):
        run.run(lambda state: checkpoint.save(path, Checkpoint("training", "data", state)), "poisoned")
    assert divergence.explain(run.model) == "the first is Gaussian 7 of 80 in 'log_diagonal' (1 in all)"
    assert all(p.isfinite().all() for p in run.model.parameters())
    state = checkpoint.load(path, "training", "data", "cpu")
    assert state["step"] == 5
    assert all(value.isfinite().all() for value in state["model"].values())


def test_without_harmonics():
    """Catches a diagnosis of no coefficients, which leaves no record, and one without any Gaussian to blame."""
    model, points = models.build("3dgs", sh_degree=0), moving_square().points
    model.initialise(points, 4.4, generator(0))
    for p in model.splats.values():
        p.grad = torch.zeros_like(p)
    assert "learning rates" in divergence.explain(model)
    assert "networks" in divergence.explain(trainer("7dgs").model)
    model.splats["sh0"].data[POISONED] = 1e4
    model.splats["sh0"].grad[POISONED].view(-1)[-1] = math.nan
    assert "Gaussian 7 of 80 in 'sh0' (1 in all)" in divergence.explain(model)
