"""`train.patience`: the iteration with the best PSNR on val is kept, and a training that no longer gains stops."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from interrupted import assert_resumes, assert_same_bits
from tiny_training import compose, moving_square, train, trainer

from gsbench.errors import InputError
from gsbench.gates.hook import Gating
from gsbench.run.checks import check_scene
from gsbench.run.settings import check_values
from gsbench.train.hooks.early_stop import EarlyStop
from gsbench.train.loop import Trainer

PATIENT = ("train.curve_points=20", "train.patience=0.2", "train.densify.every=5", "train.densify.reset_every=1000000",
           "effects.gate=end", "train.sh_every=1", "train.refine_from=1")  # fmt: skip


def with_val(psnr: dict[int, float], *more: str) -> Trainer:
    """A trainer of 100 iterations whose PSNR on val, by iteration, is given: it rises where nothing is given."""
    fitted = trainer("7dgs", *PATIENT, *more)
    real = fitted.psnr
    fitted.psnr = lambda views: (  # type: ignore[method-assign]
        psnr.get(fitted.step + 1, fitted.step / 100) if views is fitted.scene.val else real(views)
    )
    return fitted


def parameters_at(iteration: int) -> list[torch.Tensor]:
    """The parameters after so many iterations of a training without patience."""
    fitted = train(trainer("7dgs", *PATIENT, "train.patience=null", "effects.gate=off"), until=iteration)
    return [p.detach().clone() for p in fitted.model.parameters()]


@pytest.mark.parametrize("best", [40, 75])  # during densification, and after it
def test_a_training_stops_after_its_best_and_keeps_it(best: int) -> None:
    """Catches a training that goes on, one that keeps its last state, and a state that the next steps have changed."""
    fitted = with_val({best: 50.0}, "effects.gate=off")
    saved: list[dict[str, Any]] = []
    fitted.run(saved.append, "square")
    stop = fitted.hook(EarlyStop).stop
    assert stop is not None
    assert (stop.kept, stop.iteration) == (best, max(best, fitted.schedule.densify_stop) + 20)
    assert fitted.curve.points[-1].iteration == stop.iteration
    assert fitted.step == 100  # so that the run is finished for all who ask
    kept = [p.detach() for p in fitted.model.parameters()]
    assert_same_bits([p.data for p in kept], [p.data for p in parameters_at(best)])
    assert saved[-1]["hooks"]["early_stop"]["kept"] is None  # nothing is left to go back to


def test_a_training_that_gains_to_the_end_is_that_without_patience() -> None:
    """Catches a training that patience changes where it has nothing to do, such as one without its average."""
    fitted = train(with_val({}, "effects.gate=off"))
    assert fitted.hook(EarlyStop).stop is not None
    assert (fitted.hook(EarlyStop).stop.kept, fitted.hook(EarlyStop).stop.iteration) == (100, 100)
    assert_same_bits([p.data for p in fitted.model.parameters()], [p.data for p in parameters_at(100)])


def test_a_training_is_not_over_before_it_is_measured_again() -> None:
    """Catches a patience shorter than the time between two measurements that stops a training which still gains."""
    fitted = train(with_val({}, "effects.gate=off", "train.curve_points=4", "train.patience=0.05"))
    assert [point.iteration for point in fitted.curve.points] == [25, 50, 75, 100]


def test_effects_are_removed_from_the_gaussians_that_are_kept() -> None:
    """Catches gates at the end whose rows are those of the last iteration: more Gaussians than the kept one has."""
    fitted = train(with_val({40: 50.0}))
    assert 0 < len(fitted.model) <= len(parameters_at(40)[0])
    assert fitted.hook(Gating).gates


def test_a_killed_run_keeps_the_same_iteration() -> None:
    """Catches a checkpoint that has lost the best iteration, or how long ago it was."""
    assert_resumes(lambda: with_val({60: 50.0}, "effects.gate=off"), 67)


@pytest.mark.parametrize(
    "changed", [{"best": 3}, {"best": ("a", 1.0)}, {"kept": 3}, {"kept": {}}, {"stop": {"iteration": "x"}}, {}]
)
def test_a_damaged_checkpoint_is_refused(changed: dict[str, Any]) -> None:
    """Catches a stack trace from what a checkpoint says was kept."""
    fitted = with_val({})
    state = fitted.state_dict()
    state["hooks"]["early_stop"] = state["hooks"]["early_stop"] | changed if changed else {}
    with pytest.raises(InputError, match=r"^checkpoint: "):
        fitted.load_state_dict(state)


def test_what_patience_needs_is_asked_at_the_door() -> None:
    """Catches a run that watches nothing, or that is measured on what it was chosen by."""
    fitted, config = trainer("7dgs"), compose("7dgs", 100, "train.patience=0.2")
    check_scene(fitted.model, fitted.scene, config)
    with pytest.raises(InputError, match=r"^train\.patience: expected views of val"):
        check_scene(fitted.model, replace(moving_square(), val=[]), config)
    config.scene.eval_split = "val"
    with pytest.raises(InputError, match=r"^train\.patience: expected results on test"):
        check_scene(fitted.model, fitted.scene, config)
    check_values(config)
    for word in ("train.average_from=15000", "train.lengths=2", "effects.compare=true"):
        with pytest.raises(InputError, match=rf"^train\.patience: expected {word.partition('=')[0]}=(null|false)"):
            check_values(compose("7dgs", 100, "train.patience=0.2", word))
