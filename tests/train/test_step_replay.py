"""A training whose steps are repeated has the bits of one whose steps are not."""

import math
from typing import Any

import pytest
import torch
from interrupted import assert_same_bits, without_times
from tiny_training import near_and_far, train, trainer

from gsbench.train.divergence import DivergedError
from gsbench.train.loop import Trainer
from gsbench.train.step import Step

MODELS = (
    *("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr", "7dgs_nodir"),
    *("dbs", "deformable", "dgs", "ex4dgs", "freetime", "freetime_plus", "hexplane", "ndgs", "scgs", "sharptime"),
    *("stg", "stg_full", "ubs"),
)


def trained(fitted: Trainer) -> object:
    return without_times(train(fitted).state_dict())


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(("model", "overrides"), [*((name, ()) for name in MODELS), ("7dgs", ("effects.gate=both",))])
def test_a_training_has_the_same_bits(model, overrides, repeats, monkeypatch):
    """Catches a step that depends on what neither signature nor repetition reads, or on the number of threads."""
    replayed = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        repeats["done"] = 0
        replayed.append(trained(trainer(model, *overrides)))
        assert repeats["done"] > 4 * 50
    monkeypatch.setattr(Step, "_signature", lambda *_: None)
    repeats["done"] = 0
    launched = trained(trainer(model, *overrides))
    assert repeats["done"] == 0
    for each in replayed:
        assert_same_bits(each, launched)


def test_a_view_with_more_intersections_is_not_repeated(repeats, monkeypatch):
    """Catches lists of tiles that write beyond their memory, which was made for the view that was recorded."""
    monkeypatch.setattr("gsbench.kernels.raster.ROOM", 1.0)
    all_losses = []
    for signature in (Step._signature, lambda *_: None):
        monkeypatch.setattr(Step, "_signature", signature)
        fitted, losses = trainer("3dgs", "train.batch_size=1", scene=near_and_far()), []
        for fitted.step in range(24):
            fitted.train_step()
            losses.append(fitted.finite_check.loss)
        all_losses.append(losses)
    assert all_losses[0] == all_losses[1]
    assert repeats["done"] > 0
    assert repeats["outdated"] > 0


def test_a_value_that_is_not_finite_is_found_in_a_repetition(repeats):
    """Catches a training that goes on with NaN, because the rasterizer's check was not repeated."""
    fitted = trainer("7dgs")
    train(fitted, until=4)
    assert repeats["done"] > 0
    with torch.no_grad():
        fitted.model.splats["means"][0, 0] = math.nan
    fitted.step = 4
    with pytest.raises(DivergedError, match="step 4"):
        fitted.train_step()


def test_moments_and_statistics_may_move(repeats, monkeypatch):
    """Catches repeated updates of the memory in which Adam's moments or density statistics were before."""
    states = []
    for signature in (Step._signature, lambda *_: None):
        monkeypatch.setattr(Step, "_signature", signature)
        fitted = train(trainer("3dgs"), until=14)
        fitted.rows.moved(torch.arange(len(fitted.model)))  # the parameters stay where they are
        states.append(without_times(train(fitted, until=18).state_dict()))
    assert_same_bits(*states)
    assert repeats["done"] > 0


def test_an_attribute_of_a_model_may_change(repeats):
    """Catches a model of another author whose option, which a schedule of its own changes, is read only once."""
    fitted = trainer("3dgs")
    shade, light, attributes = fitted.model.shade, [], vars(fitted.model)

    def brighter(*arguments: Any) -> torch.Tensor:
        light.append(attributes["light"])
        return shade(*arguments) * light[-1]

    attributes |= {"light": 1.0, "shade": brighter}
    for fitted.step in range(5):
        fitted.train_step()
    assert repeats["done"] > 0
    attributes["light"] = 0.5
    fitted.train_step()
    assert light[-1] == 0.5
