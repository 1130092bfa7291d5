"""The mean of parameters over the last steps: which steps are in it, when it starts anew, and when it is kept."""

import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_training import train, trainer

from gsbench.errors import InputError
from gsbench.train.hooks.average import Average


def average_of(start: int, steps: int = 100, *, first: int = 0) -> Average:
    """Two parameters that count steps, with an average from step `start` on; as a PSNR, small steps score high."""
    model = torch.nn.ParameterDict({"a": torch.zeros(3), "b": torch.zeros(())})
    train = SimpleNamespace(average_from=start, iterations=100)
    training: Any = SimpleNamespace(
        model=model, config=SimpleNamespace(train=train, scene=SimpleNamespace(eval_split="test")),
        schedule=SimpleNamespace(scaled=int), scene=SimpleNamespace(val=[None]), report=lambda _: None,
        psnr=lambda _: -float(model["a"].detach()[0]),
    )  # fmt: skip
    average = Average(training)
    count(average, range(first, steps))
    return average


def count(average: Average, steps: range) -> None:
    for step in steps:
        with torch.no_grad():
            average.training.model["a"].fill_(step)  # type: ignore[index]
            average.training.model["b"].fill_(-step)  # type: ignore[index]
            average.after_step(step)


def parameters(average: Average) -> tuple[list[float], float]:
    model: Any = average.training.model
    return model["a"].tolist(), float(model["b"].detach())


def test_it_is_the_mean_of_every_tenth_step_from_its_start() -> None:
    """Catches a mean of all steps, one that starts a step late, and a parameter that is left out."""
    average = average_of(50)
    assert average.after_measuring(90, -99.0) == -99.0  # before the last step
    assert average.after_measuring(100, -99.0) == pytest.approx(-70.0)  # of 50, 60, 70, 80, 90
    assert parameters(average) == ([70.0] * 3, -70.0)
    assert (average.kept, average.count, average.results()) == (50, 0, {"averaged": 50})


@pytest.mark.parametrize("psnr", [-69.0, -70.0, 0.0])
def test_the_last_parameters_stay_where_the_mean_is_no_better(psnr: float) -> None:
    """Catches a mean that replaces better parameters, and last parameters that are not put back."""
    average = average_of(50)
    assert average.after_measuring(100, psnr) == psnr
    assert parameters(average) == ([99.0] * 3, -99.0)
    assert (average.kept, average.count) == (0, 0)
    average.training.psnr = lambda _: float("nan")  # type: ignore[method-assign]
    count(average, range(60, 100))
    assert average.after_measuring(100, psnr) == psnr
    assert parameters(average) == ([99.0] * 3, -99.0)


def test_it_starts_anew_when_gaussians_change() -> None:
    """Catches means of rows that are others now."""
    average = average_of(50, steps=75)
    average.reindex(torch.arange(3), torch.zeros(3, dtype=torch.bool))
    count(average, range(75, 100))
    average.after_measuring(100, -99.0)
    assert parameters(average)[0] == pytest.approx([85.0] * 3)
    assert average.kept == 20  # iterations: the parameters of steps 80 to 99 have had a part in the mean


def test_a_checkpoint_has_it() -> None:
    """Catches a resumed training whose mean lacks the steps before, and state of another model."""
    whole, state = average_of(50), copy.deepcopy(average_of(50, steps=65).state_dict())
    resumed = average_of(50, 0)
    resumed.load_state_dict(state)
    count(resumed, range(65, 100))
    whole.after_measuring(100, -99.0)
    resumed.after_measuring(100, -99.0)
    assert parameters(whole) == parameters(resumed)
    resumed.load_state_dict(whole.state_dict())
    assert resumed.kept == 50  # so that the record of a finished training, measured later, says the same
    means = state["means"]
    for wrong in ({"count": 0}, {"count": -1}, {"kept": "all"}, {"first": -1}, {"means": means | {"2": torch.zeros(3)}},
                  {"means": means | {"0": torch.zeros(4)}}):  # fmt: skip
        with pytest.raises(InputError):
            resumed.load_state_dict(state | wrong)


@pytest.mark.parametrize(("split", "views", "kept"), [("test", True, 50), ("val", True, 0), ("test", False, 0)])
def test_parameters_are_averaged_where_val_may_choose(split: str, views: bool, kept: int) -> None:
    """Catches results on the views by which they were chosen, and means that nothing chose."""
    fitted = trainer("7dgs", "train.average_from=15000", f"scene.eval_split={split}", "train.patience=null")
    if not views:
        fitted.scene = replace(fitted.scene, val=[])
    real, last = fitted.psnr, [10.0, 20.0]
    fitted.psnr = lambda views: (  # type: ignore[method-assign]
        last.pop(0) if fitted.step == 99 and last and views is fitted.scene.val else real(views)
    )
    train(fitted)
    assert (fitted.hook(Average).kept, fitted.hook(Average).count) == (kept, 0)
