"""The minimum lifetime of Gaussians: half the gap between the times of the training views."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from test_wiring import trainer
from tiny_training import moving_square

from gsbench.models import build
from gsbench.train.densify.minimum_lifetime import MinimumLifetime


def views(*times: float | None) -> list[Any]:
    return [SimpleNamespace(time=time) for time in times]


@pytest.mark.parametrize(
    ("times", "least"),
    [
        ((0.0, 0.1, 0.2, 0.0, 0.1, 0.2), 0.05),  # two cameras that see the same times
        ((0.7, 0.0, 0.1, 0.2), 0.05),  # a pause between the recordings
        ((0.5, 0.5), None),
        ((None, None), None),
    ],
)
def test_it_is_half_the_gap_between_the_times_of_training(times: tuple[Any, ...], least: float | None) -> None:
    """Catches the gap between views of the same time, the mean or longest gap, and a static scene or model with one."""
    assert MinimumLifetime(build("4dgs"), views(*times)).least == (least and pytest.approx(least))
    for name in ("3dgs", "dbs_static", "ubs_static"):
        assert MinimumLifetime(build(name), views(*times)).least is None


def test_every_step_of_a_training_holds_it() -> None:
    """Catches a training that never calls it, or computes the gap from views of val or test."""
    square = moving_square()
    scene = replace(square, train=[replace(v, time=t) for v, t in zip(square.train, (0.0, 1.0) * 50, strict=False)])
    fitted = trainer("freetime", "effects.gate=off", scene=scene)
    fitted.model.splats["durations"].data.fill_(-9.0)
    fitted._descend()
    assert fitted.model.splats["durations"].detach().exp().min() == pytest.approx(0.5)
