"""`train.patience`: the iteration with the best PSNR on val is kept, and a training that no longer gains stops."""

from typing import Any

import pytest
from interrupted import assert_same_bits
from tiny_training import train, trainer

from gsbench.errors import InputError
from gsbench.gates.hook import Gating
from gsbench.train.hooks.early_stop import EarlyStop
from gsbench.train.loop import Trainer

PATIENT = (
    *("train.curve_points=20", "train.patience=0.2", "train.sh_every=1", "train.refine_from=1"),
    *("train.densify.every=5", "train.densify.reset_every=1000000", "effects.gate=end"),
)


def with_val(psnr: dict[int, float], *more: str) -> Trainer:
    """A trainer of 100 iterations whose PSNR on val, by iteration, is given: it rises where nothing is given."""
    fitted = trainer("7dgs", *PATIENT, *more)
    real = fitted.psnr
    fitted.psnr = lambda views: (
        psnr.get(fitted.step + 1, fitted.step / 100) if views is fitted.scene.val else real(views)
    )
    return fitted


@pytest.mark.parametrize(
    ("psnr", "kept", "words"),
    [
        ({40: 50.0}, 40, ()),  # during densification
        ({75: 50.0}, 75, ()),  # after it
        ({}, 100, ()),  # it gains to the end
        ({}, 100, ("train.curve_points=4", "train.patience=0.05")),  # not over before it is measured again
    ],
)
def test_a_training_stops_after_its_best_and_keeps_it(psnr, kept, words):
    """Catches a training that goes on, one that keeps its last state, a state that the next steps have changed, and a
    training that patience changes where it has nothing to do."""
    fitted, saved = with_val(psnr, "effects.gate=off", *words), list[dict[str, Any]]()
    fitted.run(saved.append, "square")
    stop = fitted.hook(EarlyStop).stop
    assert (stop.kept, stop.iteration) == (kept, min(100, max(kept, fitted.schedule.densify_stop) + 20))
    assert fitted.curve.points[-1].iteration == stop.iteration
    assert fitted.step == 100  # so that the run is finished for all who ask
    plain = train(trainer("7dgs", *PATIENT, *words, "train.patience=null", "effects.gate=off"), until=kept)
    assert_same_bits(*({**each.model.state_dict()} for each in (fitted, plain)))
    assert saved[-1]["hooks"]["early_stop"]["kept"] is None  # nothing is left to go back to
    assert "early_stop" not in fitted.state_of_gaussians()["hooks"]  # or a kept state would hold the one before it


def test_effects_are_removed_from_the_gaussians_that_are_kept():
    """Catches gates at the end whose rows are those of the last iteration: more Gaussians than the kept one has."""
    fitted, plain = train(with_val({40: 50.0})), train(with_val({40: 50.0}, "effects.gate=off"))
    assert 0 < len(fitted.model) <= len(plain.model)
    assert fitted.hook(Gating).gates


@pytest.mark.parametrize(
    "changed", [{"best": 3}, {"best": ("a", 1.0)}, {"kept": 3}, {"kept": {}}, {"stop": {"iteration": "x"}}, {}]
)
def test_a_damaged_checkpoint_is_refused(changed):
    """Catches a stack trace from what a checkpoint says was kept."""
    fitted = with_val({})
    state = fitted.state_dict()
    state["hooks"]["early_stop"] = state["hooks"]["early_stop"] | changed if changed else {}
    with pytest.raises(InputError, match=r"^checkpoint: "):
        fitted.load_state_dict(state)
