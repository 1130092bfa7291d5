"""The mean of parameters over the last steps: which steps are in it, when it starts anew, and when it is kept."""

import copy
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_training import train, trainer

from gsbench.errors import InputError
from gsbench.train.hooks.average import Average


def average_from(start: int) -> Average:
    """An average of two parameters from step `start` on; as a PSNR on val, small parameters score high."""
    model = torch.nn.ParameterDict({"a": torch.zeros(3), "b": torch.zeros(())})
    train = SimpleNamespace(average_from=start, iterations=100)
    training: Any = SimpleNamespace(
        model=model,
        config=SimpleNamespace(train=train, scene=SimpleNamespace(eval_split="test")),
        schedule=SimpleNamespace(scaled=int),
        scene=SimpleNamespace(val=[None]),
        report=lambda _: None,
        psnr=lambda _: -float(model["a"].detach()[0]),
    )
    return Average(training)


def count(average: Average, *steps: int) -> Average:
    """Let the parameters be the number of the step, in each of some steps."""
    for step in range(*steps):
        for value, parameter in zip((step, -step), average.training.model.parameters(), strict=True):
            parameter.data.fill_(value)
        average.after_step(step)
    return average


@pytest.mark.parametrize(
    ("psnr", "ends_at", "kept"),
    [(-99.0, 70.0, 50), (-69.0, 99.0, 0), (-70.0, 99.0, 0), (0.0, 99.0, 0), (math.nan, 70.0, 50)],
)
def test_it_is_the_mean_of_every_tenth_step_if_this_is_better(psnr, ends_at, kept):
    """Catches a mean of all steps, one that starts a step late, a parameter that is left out, a mean that replaces
    better parameters, and last parameters that are not put back."""
    average = count(average_from(50), 100)
    assert average.after_measuring(90, -99.0) == -99.0  # before the last step
    assert average.after_measuring(100, psnr) == pytest.approx(-70.0 if kept else psnr)  # of 50, 60, 70, 80, 90
    assert [p.tolist() for p in average.training.model.parameters()] == [[ends_at] * 3, -ends_at]
    assert (average.kept, average.count, average.results()) == (kept, 0, {"averaged": kept})


def test_it_starts_anew_when_gaussians_change():
    """Catches means of rows that are others now."""
    average = count(average_from(50), 75)
    average.reindex(torch.arange(3), torch.zeros(3, dtype=torch.bool))
    count(average, 75, 100).after_measuring(100, -99.0)
    assert next(average.training.model.parameters()).tolist() == pytest.approx([85.0] * 3)
    assert average.kept == 20  # iterations: the parameters of steps 80 to 99 have had a part in the mean


def test_a_checkpoint_has_it():
    """Catches a resumed training whose mean lacks the steps before, and state of another model."""
    whole, resumed = count(average_from(50), 100), average_from(50)
    state = copy.deepcopy(count(average_from(50), 65).state_dict())
    resumed.load_state_dict(state)
    count(resumed, 65, 100)
    for average in (whole, resumed):
        average.after_measuring(100, -99.0)
    assert [p.tolist() for p in whole.training.model.parameters()] == [
        p.tolist() for p in resumed.training.model.parameters()
    ]
    resumed.load_state_dict(whole.state_dict())
    assert resumed.kept == 50  # so that the record of a finished training, measured later, says the same
    means = state["means"]
    for wrong in (
        {"count": 0},
        {"count": -1},
        {"kept": "all"},
        {"first": -1},
        {"means": means | {"2": torch.zeros(3)}},
        {"means": means | {"0": torch.zeros(4)}},
    ):
        with pytest.raises(InputError):
            resumed.load_state_dict(state | wrong)


@pytest.mark.parametrize(("split", "views", "kept"), [("test", 3, 50), ("val", 3, 0), ("test", 0, 0)])
def test_parameters_are_averaged_where_val_may_choose(split, views, kept):
    """Catches results on the views by which they were chosen, and means that nothing chose."""
    fitted = trainer("7dgs", "train.average_from=15000", f"scene.eval_split={split}", "train.patience=null")
    fitted.scene = replace(fitted.scene, val=fitted.scene.val[:views])
    scores = [10.0, 20.0]
    fitted.psnr = lambda views: scores.pop(0) if fitted.step == 99 and scores and views is fitted.scene.val else 1.0
    train(fitted)
    assert (fitted.hook(Average).kept, fitted.hook(Average).count) == (kept, 0)
