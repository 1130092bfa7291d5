"""What a training does around its steps: the curve, resets, seconds, the progress bar, and the rates of each step."""

import re
import time
from typing import Any

import pytest
import torch
from tiny_training import train, trainer

from gsbench.errors import InputError
from gsbench.kernels.adam import adam_all
from gsbench.measure.speed import StageClock
from gsbench.train.hooks import Hook
from gsbench.train.hooks.best import Best
from gsbench.train.optim import rate_at


def test_the_curve_is_of_val_and_the_best_of_the_evaluated_split():
    """Catches a curve measured on test, and a best on val that stores val's own score."""
    fitted = trainer()
    scores = {id(fitted.scene.val): [20.0, 21.0, 20.5], id(fitted.views): [15.0, 14.0, 16.0]}
    fitted.psnr = lambda views: scores[id(views)].pop(0)
    for step in (0, 1, 2):
        fitted.step = step
        fitted._measure()
    assert [point.psnr_val for point in fitted.curve.points] == [20.0, 21.0, 20.5]
    best = fitted.hook(Best).scores
    assert (best.val, best.eval_at_best_val, best.eval) == (21.0, 14.0, None)


def test_opacities_are_reset_when_the_schedule_says_and_after_measuring():
    """Catches a reset that is never called, is called every step, leaves any of Adam's two moments, or lowers far, and
    a curve, and a best on val, of models whose opacities were lowered a moment ago."""
    fitted, measured = trainer(), list[float]()
    fitted.schedule.resets, fitted.schedule.measures = lambda step: step == 1, lambda _: True
    opacities = fitted.model.splats["opacities"]
    opacities.data.fill_(2.0)
    fitted.psnr = lambda _: measured.append(opacities.max().sigmoid().item()) or 1.0
    ceiling = 2 * fitted.config.model.min_opacity
    for step in (0, 1):
        fitted.run(lambda _: None, "a step", goes_on=lambda: False)
        assert (opacities.max().sigmoid().item() == pytest.approx(ceiling, rel=1e-3)) == (step == 1)
    assert min(measured) > 0.5
    state = fitted.optimizer.moments[opacities]
    assert not state["exp_avg"].any()
    assert not state["exp_avg_sq"].any()


def test_rates_fall_in_the_optimizer(monkeypatch):
    """Catches rates that are set once, or rates to another parameter: those of a step reach Adam."""
    fitted, rates = trainer("7dgs"), {}

    def note(parameters: list[torch.Tensor], *arguments: Any) -> None:
        rates.update({p.data_ptr(): float(rate) for p, rate in zip(parameters, arguments[4], strict=True)})
        adam_all(parameters, *arguments)

    monkeypatch.setattr("gsbench.train.optim.adam_all", note)
    for step in (0, 50, 99):
        fitted.step = step
        fitted.train_step()
        for name, parameters in fitted.model.groups().items():
            rate = rate_at(fitted.config.model.lr[name], step, fitted.config.train, fitted.scene.extent)
            assert all(rates.get(p.data_ptr(), rate) == pytest.approx(rate) for p in parameters), name
        assert len(rates) >= 10


def test_the_bar_tells_seconds_and_val_without_reading_the_clock(capsys, monkeypatch):
    """Catches a bar that says neither, and one that waits for a GPU at every step to say it."""
    fitted = trainer("3dgs", "train.curve_points=4")
    reads, seconds = [], StageClock.seconds.fget
    monkeypatch.setattr(StageClock, "seconds", property(lambda clock: reads.append(1) or seconds(clock)))
    train(fitted)
    assert len(reads) == 4 + 1  # the points of the curve, and the checkpoint at the end
    last = capsys.readouterr().err.split("\r")[-1]
    assert fitted.curve.progress in last
    assert re.search(r"\d+ s of training, val \d+\.\d\d dB \([+-]\d", last)


def test_the_seconds_of_a_training_are_the_wall_clock_of_its_steps(monkeypatch):
    """Catches Python between stages that no second holds, val, checkpoints and reports that are held to be training,
    a curve of another clock, and a stopped run that loses seconds or counts them twice."""
    now, saved = [0.0], list[dict[str, Any]]()

    def after(seconds: float, result: Any = None) -> Any:
        now[0] += seconds
        return result

    def step() -> None:
        after(0.75)
        with fitted.stages("loss"):
            after(2.0)
        after(0.25)

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    settings = ("3dgs", "train.iterations=10", "train.curve_points=5", "train.densify.stop=0")
    for _ in range(2):  # the second training continues the first, which ends after three steps
        fitted = trainer(*settings)
        fitted.train_step, fitted.psnr = step, lambda _: after(100.0, 20.0)
        if saved:
            fitted.load_state_dict(saved[-1])
        goes_on = lambda fitted=fitted: after(1e4, fitted.step != 3)  # noqa: E731
        fitted.run(lambda state: after(1000.0, saved.append(state)), "square", goes_on)
    assert fitted.step == 10
    assert fitted.stages.seconds == pytest.approx({"loss": 20.0, "other": 10.0})
    assert [(p.iteration, p.seconds) for p in fitted.curve.points] == [(n, 3.0 * n) for n in (2, 4, 6, 8, 10)]


def test_a_hook_has_a_name():
    """Catches a hook whose training fails at its end, when a checkpoint asks for the name."""
    with pytest.raises(InputError, match="Nameless: expected the hook's `name`"):
        type("Nameless", (Hook,), {})
