"""Which model model=auto becomes, for each answer of the screen."""

import json
from pathlib import Path

import pytest
from tiny_run import overrides, run_here, write_moving_square
from tiny_training import compose, moving_square

from gsbench.config import Config
from gsbench.effects import choose
from gsbench.measure.record import TimeScreen
from gsbench.run.identity import Run
from gsbench.run.resolve import resolve


def run_of(config: Config) -> Run:
    """A run of a config, without a folder."""
    return Run(config, {}, Path("nowhere"), config.model.name, "", [])


@pytest.mark.parametrize(
    ("decision", "model", "agr"), [("on", "7dgs", True), ("undecided", "7dgs", True), ("off", "6dgs", False)]
)
def test_what_is_not_known_to_be_static_is_simulated(
    decision: str, model: str, agr: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an undecided scene that loses its motion, and AGR, which moves Gaussians with time, in a static model."""
    monkeypatch.setattr(choose, "screen", lambda *_: TimeScreen(decision, "said", None, None, None, 0.0))
    chosen = resolve(run_of(compose("auto", 10)), moving_square())
    assert (chosen.config.model.name, chosen.config.agr) == (model, agr)
    assert chosen.screen is not None
    assert chosen.screen.decision == decision
    without = resolve(run_of(compose("auto", 10, "agr=false")), moving_square()).config
    assert (without.model.name, without.agr) == (model, False)


def test_other_models_are_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a screen, and its second, in a run that names its model."""
    monkeypatch.setattr(choose, "screen", lambda *_: pytest.fail("the scene was screened"))
    config = compose("7dgs", 10)
    assert resolve(run_of(config), moving_square()).config is config


def test_a_scene_without_times_is_static(tmp_path: Path) -> None:
    """Catches model=auto that is refused, as AGR is, for a scene whose images have no times."""
    data = write_moving_square(tmp_path / "data")
    for path in data.glob("*/*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            del frame["time"]
        path.write_text(json.dumps(content))
    record, _ = run_here(*overrides(data, tmp_path / "results", "model=auto", "effects.gate=off"))
    assert (record.status, record.reason) == ("ok", None)
    assert record.on_demand is not None
    assert record.on_demand.screen is not None
    assert (record.on_demand.screen.decision, record.on_demand.screen.reason) == ("off", "the views have no times")
    assert (record.effects.time, record.effects.refinement) == (False, False)
