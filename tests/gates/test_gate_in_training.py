"""Gates in a training, model=auto, and the gate of a finished run, as a user meets them."""

import copy
import json
import math
from collections.abc import Mapping
from dataclasses import replace

import pytest
import tiny_training
import torch
from interrupted import assert_same_bits
from tiny_run import gsbench, overrides
from tiny_training import compose, moving_square

from gsbench.errors import InputError
from gsbench.gates import __main__ as command
from gsbench.gates import hook
from gsbench.gates.hook import (
    LAST_RATE,
    LOSS_IN_TRAINING,
    LOSS_WITH_AGR,
    Gating,
    become,
    gaussians_of,
    without_direction,
)
from gsbench.measure import record
from gsbench.measure.record import Gate
from gsbench.models import CameraTime
from gsbench.run.load import load_run
from gsbench.scenes.scene import Scene, View
from gsbench.schedule import Schedule
from gsbench.train.loop import Trainer
from gsbench.train.optim import NO_FACTORS
from gsbench.train.renderer import Renderer

STEPS = 100


def trainer(*words: str, model: str = "7dgs", scene: Scene | None = None) -> Trainer:
    """A trainer that resets no opacities."""
    return tiny_training.trainer(model, "train.densify.reset_every=1000000", *words, scene=scene)


def end(training: Trainer) -> dict[str, object]:
    """Train to the end; return the last state, without the seconds that no two runs share."""
    states: list[dict[str, object]] = []
    training.run(lambda state: states.append(copy.deepcopy(state)), "test")
    last = states[-1]
    return {key: last[key] for key in ("model", "optimizer", "density")}


@pytest.fixture(autouse=True)
def few_steps_recover(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings of a test are short."""
    monkeypatch.setattr("gsbench.schedule.STEPS_TO_RECOVER", 20)
    monkeypatch.setattr("gsbench.gates.hook.LEAST_IN_TRAINING", 10)


def test_a_gated_training_resumes_with_the_same_bits(monkeypatch):
    """Catches a checkpoint that lacks what a gate decided: broken off after the gate, and gone on from there."""
    monkeypatch.setattr("gsbench.gates.hook.LOSS_WITH_AGR", 3.0)
    whole = trainer("effects.gate=both")
    expected = end(whole)
    assert whole.hook(Gating).gates[0].step == 60
    assert whole.model.effect_sets is not None
    first = trainer("effects.gate=both")
    states: list[dict[str, object]] = []
    first.run(lambda state: states.append(copy.deepcopy(state)), "test", lambda: first.step < 75)
    second = trainer("effects.gate=both")
    second.load_state_dict(states[-1])
    assert second.model.effect_sets is not None
    assert second.hook(Gating).gates == first.hook(Gating).gates
    assert_same_bits(end(second), expected)


@pytest.mark.parametrize("model", ["4dgs", "7dgs", "stg"])
def test_long_lived_gaussians_become_static(model):
    """Catches a rule that acts at another step, on short lives or anew, and a checkpoint that lacks what it did."""
    words = ("effects.static_above=0.3",)
    first = trainer(*words, model=model)
    first.run(lambda _: None, "test", lambda: first.step < 59)
    assert first.model.effect_sets is None
    long_lived = int((first.model.lifetimes()[1] > 0.3).sum())
    states: list[dict[str, object]] = []
    first.run(lambda state: states.append(copy.deepcopy(state)), "test", lambda: first.step < 75)
    static = first.model.count_by_effects()["static"]
    assert 0 < static < len(first.model)
    assert abs(static - long_lived) < 0.2 * static  # one more step and one round of densification
    early, late = (first.model.slice(CameraTime.at(torch.tensor([0.0, 0, -4]), time)) for time in (0.1, 0.9))
    assert torch.equal(early.means[-static:], late.means[-static:])
    assert not torch.equal(early.opacities[:-static], late.opacities[:-static])
    second = trainer(*words, model=model)
    second.load_state_dict(states[-1])
    assert_same_bits(end(second), end(first))
    with pytest.raises(InputError, match=r"effects\.static_above: .* of 3dgs have none"):
        trainer(*words, model="3dgs")


def test_off_is_off_and_few_gaussians_are_gated_at_the_end_only(monkeypatch):
    """Catches a gate that was not asked for, one of a model that needs all Gaussians, and one left out in silence."""
    training = trainer("effects.gate=both")
    monkeypatch.setattr("gsbench.gates.hook.LEAST_IN_TRAINING", len(training.model) * 100)
    end(training)
    assert [gate.step for gate in training.hook(Gating).gates if gate.step is not None] == []
    assert "at step 60 the model has" in training.hook(Gating).notes[0]
    monkeypatch.setattr(Gating, "simplify", lambda *_, **__: pytest.fail("a gate was asked"))
    plain = trainer("effects.gate=off")
    end(plain)
    assert plain.model.effect_sets is None


def test_what_is_frozen_stays(monkeypatch):
    """Catches momentum that moves on what a gate froze, and kept entries that no longer learn."""
    monkeypatch.setattr("gsbench.gates.hook.LOSS_WITH_AGR", 20.0)
    monkeypatch.setattr("gsbench.gates.gate.SHARES", (0.2,))
    training = trainer("effects.gate=both")
    training.run(lambda _: None, "test", lambda: training.step < 61)
    effect_sets = training.model.effect_sets
    assert effect_sets.conditioned < len(training.model)
    before = {name: value.detach().clone() for name, value in training.model.splats.items()}
    training.run(lambda _: None, "test", lambda: training.step < 70)
    masks = training.model.used_entries(effect_sets)
    for name, value in training.model.splats.items():
        mask = masks[name].expand_as(value) if name in masks else torch.ones_like(value, dtype=torch.bool)
        assert torch.equal(value[~mask], before[name][~mask]), name
        assert not mask.any() or not torch.equal(value[mask], before[name][mask]), name


def test_when_a_model_is_gated():
    """Catches a gate while Gaussians are still cloned and split, or with no steps left to recover."""

    def due(*words: str) -> list[int]:
        schedule = Schedule(compose("7dgs", STEPS, *words).train, 3, True)
        return [step for step in range(STEPS) if schedule.gates(step)]

    assert due() == [59]
    assert due("train.densify.stop=21000") == [69]
    assert due("train.densify.stop=29000") == []


@pytest.mark.parametrize(("model", "loss"), [("7dgs", LOSS_WITH_AGR), ("7dgs_noagr", LOSS_IN_TRAINING)])
def test_what_a_gate_in_training_may_cost(model, loss, monkeypatch):
    """Catches models without AGR, which do not make up for it, gated as freely as those with it."""
    asked: list[tuple[int | None, float]] = []
    monkeypatch.setattr(Gating, "simplify", lambda _, step, db, __: asked.append((step, db)))
    end(trainer("effects.gate=both", model=model))
    assert asked == [(60, loss), (None, 0.05)]


@pytest.mark.parametrize("words", [(), ("effects.gate=both",)])
def test_agr_slows_down_after_a_gate(words):
    """Catches a gated training whose AGR swings to the end, an ungated training that is slowed, and rates of others."""
    training, rates = trainer(*words), []

    def note(step: int, factors: Mapping[str, float] = NO_FACTORS) -> dict[str, float]:
        rates.append(original(step, factors))
        return rates[-1]

    original, training.optimizer.rates_at = training.optimizer.rates_at, note
    end(training)
    agr, others = [rate["refinement"] for rate in rates], [rate["opacities"] for rate in rates]
    assert agr[0] == agr[59] == pytest.approx(2e-4)
    assert others[0] == others[-1]
    gated = bool(words) and training.hook(Gating).gates[0].step == 60
    assert gated == bool(words)
    assert agr[60] == pytest.approx(2e-4)
    assert agr[-1] == pytest.approx(2e-4 * LAST_RATE ** (39 / 40) if gated else 2e-4)


def test_a_gate_is_checked_on_views_that_the_probe_did_not_look_at(monkeypatch):
    """Catches a loss measured on the views that the gate was fitted to, or on those that the run is evaluated by."""
    probed: list[list[View]] = []
    checked: list[list[View]] = []
    monkeypatch.setattr(hook, "probe", lambda _, views, *__, **___: probed.append(views))
    monkeypatch.setattr(Renderer, "psnr", lambda _, __, views: 30.0 + len(checked.append(views) or views))
    monkeypatch.setattr(hook, "gate_within", lambda model, _, __, measure, ___: measure(model) and None)
    training, square = trainer("effects.gate=end"), moving_square(views=17)
    views, every_eighth = square.train, square.train[::8]
    others = [view for i, view in enumerate(views) if i % 8]
    for val, train, split, expected, notes in (
        (views[:3], views[3:], "test", (views[3:], views[:3]), 1),
        (views[:3], views, "val", (others, every_eighth), 1),
        ([], views, "test", (others, every_eighth), 1),
        ([], views[:8], "test", (views[:8], views[:8]), 2),  # too few to hold any out, which is said
    ):
        training.config.scene.eval_split = split
        of = Trainer(training.model, replace(square, val=val, train=train), [], training.config)
        of.hook(Gating).simplify(None, 0.05, 10)
        names = [[view.name for view in asked] for asked in (probed.pop(), checked.pop())]
        assert names == [[view.name for view in asked] for asked in expected]
        assert len(of.hook(Gating).notes) == notes


@pytest.mark.parametrize(
    ("scores", "line"),
    [
        ([30.0, 20.0], "no simplification cost at most"),
        ([100.0, 100.0], "a PSNR of 100 dB on val cannot show a loss"),
        ([math.nan], "a PSNR of nan dB on val cannot show a loss"),
    ],
)
def test_a_psnr_that_cannot_show_a_loss_removes_nothing(scores, line, monkeypatch):
    """Catches effects that are removed because all views are exact before and after, and a loss of inf - inf."""
    training = trainer("effects.gate=end")
    shown = iter([*scores, *[scores[-1]] * 20, scores[0]])
    monkeypatch.setattr(Renderer, "psnr", lambda *_: scores[0] if len(scores) < 2 else next(shown))
    training.hook(Gating).simplify(None, 0.05, 10)
    assert not training.hook(Gating).gates
    assert line in training.hook(Gating).notes[-1]


def fit(x: float) -> Gate:
    """A gate at the end that has measured nothing yet."""
    return Gate(share=x, predicted_db=0.0, measured_db=0.0, rows={}, orders={}, bytes_before=2, bytes=1)


def test_what_a_gate_costs_is_what_the_images_lost():
    """Catches a loss with the wrong sign, or of the wrong model: of the gate at the end, and of freezing direction."""
    training = trainer()
    ungated, training.hook(Gating).gates = gaussians_of(training.model), [fit(0.1)]
    before = training.psnr(training.views)
    faint = {name: x.clone() for name, x in ungated[0].items()} | {"opacities": ungated[0]["opacities"] - 1}
    become(training.model, (faint, None))
    after = training.psnr(training.views)
    assert abs(after - before) > 0.1
    training.hook(Gating).compare(ungated, training.views)
    assert training.hook(Gating).gates[0].eval_loss_db == pytest.approx(before - after, abs=1e-6)
    frozen = without_direction(training.model, training.scene.train)
    direction = training.hook(Gating).direction
    assert direction.loss_db == pytest.approx(after - training.renderer.psnr(frozen, training.views), abs=1e-9)
    assert direction.loss_db != 0


def test_auto_and_a_gate_after_the_fact(square, tmp_path, capsys):
    """Catches model=auto that says nothing of what it chose, a loaded run of another model, a gate that spoils the old.
    The scene has six views, which are too few to tell: it is simulated, and that is said."""
    done = gsbench(*overrides(square, tmp_path, "model=auto", "train.iterations=60"))
    assert done.returncode == 0, done.stderr
    assert "too few; 12 are needed" in done.stderr + done.stdout
    (folder,) = tmp_path.glob("dnerf/square/auto,*/seed0")
    auto = record.read(folder / record.FILE_NAME)
    assert auto.model == "auto"
    assert auto.effects.time
    assert auto.on_demand.screen.decision == "undecided"
    assert auto.cost.stage_s["screen"] > 0
    loaded = load_run(folder)
    assert loaded.config.model.name == "7dgs"
    assert len(loaded.model) == auto.cost.num_gaussians

    plain = gsbench(*overrides(square, tmp_path, "model=7dgs", "train.iterations=60"))
    assert plain.returncode == 0, plain.stderr
    (old,) = tmp_path.glob("dnerf/square/7dgs,*/seed0")
    kept = {path.name: path.read_bytes() for path in old.iterdir()}
    capsys.readouterr()
    assert command.main(["--checkpoint", str(old), "--budget-db", "1", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert {path.name: path.read_bytes() for path in old.iterdir()} == kept
    (new,) = tmp_path.glob("dnerf/square/7dgs,*,gate=end,budget_db=1.0/seed0")
    gated = record.read(new / record.FILE_NAME)
    assert gated.on_demand is not None
    assert answer["written"] == str(new)
    assert [gate["rows"] for gate in answer["on_demand"]["gates"]] == [gate.rows for gate in gated.on_demand.gates]
    assert len(gated.on_demand.gates) + len(gated.on_demand.notes) >= 1
    assert len(load_run(new).model) <= len(load_run(old).model)
    capsys.readouterr()
    assert command.main(["--checkpoint", str(new)]) == 2
    assert "not gated at its end" in capsys.readouterr().err
    assert command.main(["--checkpoint", str(old), "--data-root", str(tmp_path / "nowhere")]) == 2
    assert "name its folder by --data-root" in capsys.readouterr().err
