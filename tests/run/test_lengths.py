"""train.lengths: the best length on val is kept, whatever interrupts the run."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from interrupted import assert_same_bits, bits, counted_steps, run_through_kills
from tiny_run import overrides, run_here
from tiny_training import compose, moving_square

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.measure.record import FILE_NAME, LengthChoice, Record, TimeScreen
from gsbench.models import GaussianModel
from gsbench.report.sections.curves import events
from gsbench.run import checks, load, selection
from gsbench.run.selection import FOLDER, lengths
from gsbench.run.setup import build
from gsbench.scenes import View
from gsbench.train.divergence import DivergedError
from gsbench.train.loop import Trainer

OTHERS = ("model=7dgs", "train.curve_points=2", "train.checkpoint_minutes=0", "protocol.pictures=0")
RUN = (*OTHERS, "train.iterations=80", "train.lengths=4")  # 10, 20, 40 and 80 steps
LOSS = {40: 30.0}  # dB that val loses at a length, so that 20 is the best that is tried


@pytest.fixture(autouse=True)
def overfitting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lower PSNR on val of a training of 40 steps, as if it learnt the training views by heart."""
    psnr = Trainer.psnr
    monkeypatch.setattr(Trainer, "psnr", lambda self, views: psnr(self, views) - lost(self, views))


def lost(trainer: Trainer, views: list[View]) -> float:
    return LOSS.get(trainer.config.train.iterations, 0.0) if views is trainer.scene.val else 0.0


def model() -> GaussianModel:
    """A model without Gaussians, to check with a scene."""
    return build(compose("3dgs", 10))


def choice_in(record: Record) -> LengthChoice:
    """The choice of a finished run."""
    assert record.status == "ok", record.reason
    assert record.length_choice is not None
    return record.length_choice


def test_the_best_length_on_val_is_kept_with_its_own_bits(
    square: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches the longest that is kept although it is worse, a length that need not be trained, and hidden costs."""
    record, folder = run_here(*overrides(square, tmp_path, *RUN))
    choice = choice_in(record)
    assert [each.name for each in choice.tried] == ["iterations=10", "iterations=20", "iterations=40"]
    assert choice.kept == 20
    assert "the training of 20 iterations is kept" in capsys.readouterr().err
    alone, folder_alone = run_here(*overrides(square, tmp_path / "alone", *OTHERS, "train.iterations=20"))
    assert record.metrics == alone.metrics
    assert_same_bits(bits(folder), bits(folder_alone))
    assert [point.psnr_val for point in record.curve] == [point.psnr_val for point in alone.curve]
    assert choice.tried[1].psnr_val == alone.curve[-1].psnr_val
    others = choice.tried[0].seconds + choice.tried[2].seconds
    assert record.cost is not None
    assert record.cost.stage_s["compare"] == pytest.approx(others)
    assert record.cost.train_s == pytest.approx(sum(each.seconds for each in choice.tried))
    assert record.curve[0].seconds > others, "a PSNR is reached only after the other lengths"
    assert not (folder / FOLDER).exists()
    assert [json.loads(line)["iteration"] for line in (folder / "curve.jsonl").read_text().splitlines()] == [10, 20]
    loaded = load.load_run(folder)
    assert (loaded.step, len(loaded.model)) == (20, record.cost.num_gaussians), "the viewer shows another model"
    assert record.cost.stage_s.keys() >= {"compare"}
    assert "screen" not in record.cost.stage_s


def test_the_schedule_is_that_of_the_kept_length(square: Path, tmp_path: Path) -> None:
    """Catches a short training that is measured with the SH degree that the longest has after so many steps."""
    words = ("model=3dgs", "train.sh_every=10000")
    record, folder = run_here(*overrides(square, tmp_path, *RUN, *words))
    alone, _ = run_here(*overrides(square, tmp_path / "alone", *OTHERS, *words, "train.iterations=20"))
    assert record.metrics == alone.metrics
    assert load.load_run(folder).model.active.sh_degree == 2
    assert events(record)[0][0] < 20


def test_the_longest_is_kept_if_each_is_better(square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches trainings that end before the longest although PSNR on val still rises."""
    monkeypatch.setitem(LOSS, 40, -1.0)
    monkeypatch.setitem(LOSS, 80, -2.0)
    monkeypatch.setitem(LOSS, 10, 1.0)
    choice = choice_in(run_here(*overrides(square, tmp_path, *RUN))[0])
    assert (choice.kept, len(choice.tried)) == (80, 4)


@pytest.mark.parametrize("saves", [7, 71], ids=["midway", "chosen"])
def test_a_kill_repeats_no_step(saves: int, square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a length that is trained again, a lost choice, and other bits: killed after every few saves."""
    whole, unbroken = run_here(*overrides(square, tmp_path / "whole", *RUN))
    steps = counted_steps(monkeypatch)
    again = overrides(square, tmp_path, *RUN)
    record, folder = run_through_kills(saves, monkeypatch, lambda: run_here(*again))
    assert steps["all"] == 10 + 20 + 40
    assert [(each.name, each.psnr_val) for each in choice_in(record).tried] == [
        (each.name, each.psnr_val) for each in choice_in(whole).tried
    ]
    assert record.metrics == whole.metrics
    assert_same_bits(bits(folder), bits(unbroken))
    assert not (folder / FOLDER).exists()


def test_a_finished_run_is_kept_and_measured_again_with_its_choice(
    square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a second call that trains, and a record that loses the choice when images are measured again."""
    words = overrides(square, tmp_path, *RUN)
    record, folder = run_here(*words)
    monkeypatch.setattr(Trainer, "train_step", lambda _: pytest.fail("trained again"))
    assert run_here(*words)[0] == record
    (folder / FILE_NAME).unlink()
    measured, _ = run_here(*words)
    assert choice_in(measured) == choice_in(record)
    assert measured.metrics == record.metrics


def test_a_length_that_fails_loses(square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a run that fails because one length did: on a rig of the suite, 3DGS prunes all Gaussians at 2,000."""
    descend, failing = Trainer.train_step, {10, 40}

    def diverging(self: Trainer) -> None:
        if self.config.train.iterations in failing and self.step == 5:
            raise DivergedError("step 5: a loss of nan")
        descend(self)

    monkeypatch.setattr(Trainer, "train_step", diverging)
    choice = choice_in(run_here(*overrides(square, tmp_path, *RUN))[0])
    assert [each.reason for each in choice.tried] == ["step 5: a loss of nan", None, "step 5: a loss of nan"]
    assert choice.kept == 20
    failing |= {20, 80}
    failed, _ = run_here(*overrides(square, tmp_path / "all", *RUN))
    assert (failed.status, failed.length_choice) == ("diverged", None)


def test_the_model_that_auto_chose_has_several_lengths(
    square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches lengths of another model than the screen chose, and seconds of the screen that are lost."""
    monkeypatch.setattr(selection, "screen_time", lambda *_: TimeScreen("off", "said", None, None, None, 5.0))
    record, folder = run_here(*overrides(square, tmp_path, *RUN, "model=auto"))
    assert choice_in(record).kept == 20
    assert not record.effects.time
    assert record.on_demand is not None
    assert record.cost is not None
    assert record.cost.stage_s["screen"] == 5.0
    assert load.load_run(folder).config.model.name == "6dgs"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("effects.compare=true",), "train.lengths: expected effects.compare=false"),
        (("train.patience=0.2",), "train.patience: expected train.lengths=null"),
        (("scene.eval_split=val",), "train.lengths: expected results on test"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(words: tuple[str, ...], message: str) -> None:
    """Catches a key that does nothing, and results on the views by which the length was chosen."""
    square = moving_square()
    scene, config = replace(square, val=square.train[:1]), compose("3dgs", 10, "train.lengths=2", *words)
    asked = (
        checks.check_values
        if len(words) and "val" not in words[0]
        else lambda _: checks.check_scene(model(), scene, config)
    )
    with pytest.raises(InputError, match=message):
        asked(config)


def test_a_length_without_a_step_or_a_val_is_refused() -> None:
    """Catches a training of no step, which would be the first, and a choice on no views."""
    checks.check_values(compose("3dgs", 8, "train.lengths=4"))
    with pytest.raises(InputError, match=r"train\.lengths=4: expected at least 8 iterations to halve 3 times, got"):
        checks.check_values(compose("3dgs", 7, "train.lengths=4"))
    with pytest.raises(InputError, match="expected 2 to 8, got 1"):
        checks.check_values(compose("3dgs", 8, "train.lengths=1"))
    with pytest.raises(InputError, match=r"train\.lengths: expected views of val to choose the length"):
        checks.check_scene(model(), moving_square(), compose("3dgs", 10, "train.lengths=2"))


def test_each_length_is_twice_the_one_before() -> None:
    """Catches a last length that is not the one which was asked for, and odd numbers that are not halved."""
    config: Config = compose("7dgs", 75, "train.lengths=3")
    assert [(each.train.iterations, each.train.lengths) for each in lengths(config).values()] == [
        (18, None), (37, None), (75, None)
    ]  # fmt: skip
