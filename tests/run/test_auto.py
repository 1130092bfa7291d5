"""Which model model=auto becomes, for each answer of the screen."""

import pytest

from gsbench.effects import choose
from gsbench.measure.record import TimeScreen
from gsbench.run import auto
from gsbench.stability.training_cases import compose, moving_square


@pytest.mark.parametrize(
    ("decision", "model", "agr"), [("on", "7dgs", True), ("undecided", "7dgs", True), ("off", "6dgs", False)]
)
def test_what_is_not_known_to_be_static_is_simulated(
    decision: str, model: str, agr: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an undecided scene that loses its motion, and AGR, which moves Gaussians with time, in a static model."""
    monkeypatch.setattr(choose, "screen", lambda *_: TimeScreen(decision, "said", None, None, None, 0.0))
    config, screen = auto.resolve(compose("auto", 10), moving_square())
    assert (config.model.name, config.agr, screen.decision) == (model, agr, decision)
    without = auto.resolve(compose("auto", 10, "agr=false"), moving_square())[0]
    assert (without.model.name, without.agr) == (model, False)
