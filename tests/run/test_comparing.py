"""model=auto with effects.compare=true: the best candidate on val is trained to the end, whatever interrupts it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from interrupted import Killed, assert_same_bits, bits, counted_steps, run_through_kills
from tiny_run import overrides, run_here, write_moving_square
from tiny_training import compose, moving_square

from gsbench.config import Config, TrainConfig
from gsbench.effects import choose
from gsbench.errors import InputError
from gsbench.measure.record import FILE_NAME, ModelComparison, Record, TimeScreen
from gsbench.run import trackers
from gsbench.run.candidates import FOLDER
from gsbench.run.comparing import candidates, check_candidates, check_compare
from gsbench.schedule import Schedule
from gsbench.train import checkpoint
from gsbench.train.finite_check import DivergedError
from gsbench.train.loop import Trainer

STEPS, UNTIL = 30, 21  # of a run, and until the comparison
RUN = (f"train.iterations={STEPS}", "train.curve_points=10", "train.checkpoint_minutes=0", "protocol.pictures=0")
SLOW = "model.candidates.moving.lr.opacities.start=1e-4"  # so that another candidate than the first wins
COMPARED = ("model=auto", "effects.compare=true", SLOW, *RUN)
NAMES = ["7dgs", "4dgs", "7dgs_noagr", "6dgs"]


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_square(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def whole(square: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Path]:
    """An unbroken run that compares, which tests only read: its record and its folder."""
    return run_here(*overrides(square, tmp_path_factory.mktemp("whole"), *COMPARED))


def comparison_in(record: Record) -> ModelComparison:
    """The comparison of a finished run."""
    assert record.status == "ok", record.reason
    assert record.on_demand is not None
    assert record.on_demand.comparison is not None
    return record.on_demand.comparison


def test_the_best_on_val_is_trained_to_the_end_with_its_own_bits(
    square: Path, whole: tuple[Record, Path], tmp_path: Path
) -> None:
    """Catches another choice than the best on val, a result that the model alone does not have, and hidden costs."""
    record, folder = whole
    found = comparison_in(record)
    assert [one.name for one in found.candidates] == NAMES
    assert found.iteration == UNTIL
    values = {one.name: one.psnr_val for one in found.candidates}
    assert found.chosen == max(values, key=lambda name: values[name] or 0)
    assert len(set(values.values())) == len(NAMES)
    assert found.chosen == "4dgs", "if the first wins, nothing is tested here"
    alone, own = run_here(*overrides(square, tmp_path, "model=4dgs", "effects.gate=both", *RUN))
    assert record.metrics == alone.metrics
    assert_same_bits(bits(folder), bits(own))
    assert values[found.chosen] == alone.curve[6].psnr_val
    assert [point.psnr_val for point in record.curve] == [point.psnr_val for point in alone.curve]
    others = sum(one.seconds for one in found.candidates if one.name != found.chosen)
    assert record.cost is not None
    assert record.cost.stage_s["compare"] == pytest.approx(others)
    assert record.cost.train_s > sum(one.seconds for one in found.candidates)
    assert record.curve[0].seconds > others, "a PSNR is reached only after the other candidates"
    effort = checkpoint.read(folder / checkpoint.FILE_NAME).state["effort"]
    assert effort["seconds"] > sum(one.seconds for one in found.candidates), "CPU-seconds of the best alone"
    assert record.effects.refinement is False
    assert not (folder / FOLDER).exists()


@pytest.mark.parametrize("saves", [17, 4 * UNTIL + 1], ids=["midway", "chosen"])
def test_a_kill_repeats_no_step(
    saves: int, square: Path, whole: tuple[Record, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a candidate that is trained again, a lost choice, and other bits: killed after every few saves."""
    steps = counted_steps(monkeypatch)
    again = overrides(square, tmp_path, *COMPARED)
    record, folder = run_through_kills(saves, monkeypatch, lambda: run_here(*again))
    assert steps["all"] == 3 * UNTIL + STEPS
    mine, theirs = comparison_in(record), comparison_in(whole[0])
    assert [(one.name, one.psnr_val) for one in mine.candidates] == [
        (one.name, one.psnr_val) for one in theirs.candidates
    ]
    assert mine.chosen == theirs.chosen
    assert record.metrics == whole[0].metrics
    assert_same_bits(bits(folder), bits(whole[1]))
    assert not (folder / FOLDER).exists()
    assert [json.loads(line)["iteration"] for line in (folder / "curve.jsonl").read_text().splitlines()] == [
        point.iteration for point in record.curve
    ]


def test_a_finished_run_is_kept_and_measured_again_with_its_comparison(
    square: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a second call that trains, and a record that loses the comparison when images are measured again."""
    words, sent = overrides(square, tmp_path, *COMPARED, "log=json"), list[int]()

    class Tracked:
        def __init__(self, _: object) -> None: ...

        def add(self, step: int, _: object) -> None:
            sent.append(step)

        def end(self, _: str) -> None: ...

    monkeypatch.setitem(trackers.TRACKERS, "json", Tracked)
    record, folder = run_here(*words)
    assert sent == [*(point.iteration for point in record.curve), STEPS], "a tracker lacks the steps of the comparison"
    monkeypatch.setattr(Trainer, "_descend", lambda _: pytest.fail("trained again"))
    again, _ = run_here(*words)
    assert again == record
    assert "finished before, kept" in capsys.readouterr().out
    (folder / FILE_NAME).unlink()
    measured, _ = run_here(*words)
    assert comparison_in(measured) == comparison_in(record)
    assert measured.metrics == record.metrics


def test_resume_false_starts_every_candidate_over(
    square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a candidate of an earlier attempt that is taken although the user said to start over."""
    save = checkpoint.save
    monkeypatch.setattr(checkpoint, "save", lambda *given: (save(*given), (_ for _ in ()).throw(Killed)))
    with pytest.raises(Killed):
        run_here(*overrides(square, tmp_path, *COMPARED))
    monkeypatch.setattr(checkpoint, "save", save)
    record, folder = run_here(*overrides(square, tmp_path, *COMPARED, "resume=false"))
    assert comparison_in(record).chosen == "4dgs"
    assert "continues from" not in capsys.readouterr().err
    assert not (folder / FOLDER).exists()


def test_a_candidate_that_fails_loses(square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a run that fails because some of its candidates did: on scene10_texture 6DGS prunes all Gaussians."""
    descend = Trainer._descend

    def diverging(self: Trainer) -> None:
        if self.config.model.name == "4dgs" and self.step == 5:
            raise DivergedError("step 5: a loss of nan")
        descend(self)
        if self.config.model.name == "6dgs":
            self.rows.select(torch.zeros(0, dtype=torch.int64))

    monkeypatch.setattr(Trainer, "_descend", diverging)
    record, _ = run_here(*overrides(square, tmp_path, *COMPARED))
    found = comparison_in(record)
    reasons = {one.name: one.reason for one in found.candidates}
    assert reasons.pop("6dgs").startswith("no Gaussian is left")
    assert reasons == {"7dgs": None, "4dgs": "step 5: a loss of nan", "7dgs_noagr": None}
    assert found.chosen == "7dgs_noagr"
    monkeypatch.setattr(Trainer, "_descend", lambda _: (_ for _ in ()).throw(DivergedError("all")))
    failed, _ = run_here(*overrides(square, tmp_path / "all", *COMPARED))
    assert (failed.status, failed.on_demand) == ("diverged", None)


def test_a_static_scene_is_not_compared(square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches models with time that are trained on a scene which the screen calls static."""
    monkeypatch.setattr(choose, "screen", lambda *_: TimeScreen("off", "said", None, None, None, 0.0))
    record, folder = run_here(*overrides(square, tmp_path, *COMPARED))
    assert record.on_demand is not None
    assert record.on_demand.comparison is None
    assert not record.effects.time
    assert checkpoint.read(folder / checkpoint.FILE_NAME).config["model"]["name"] == "6dgs"


@pytest.mark.parametrize(
    ("model", "word", "said"),
    [("7dgs", "seed=0", "expected model=auto"), ("auto", "scene.eval_split=val", "got scene.eval_split=val")],
)
def test_settings_that_cannot_be_compared_are_refused(model: str, word: str, said: str) -> None:
    """Catches a key that does nothing, and results on the views by which the model was chosen."""
    with pytest.raises(InputError, match=said):
        check_compare(compose(model, 10, "effects.compare=true", word))
    check_compare(compose(model, 10, word))


def test_a_scene_without_val_is_refused_before_training() -> None:
    """Catches models that are compared on the views on which they are trained, and candidates of which one fails."""
    config = compose("auto", 10, "effects.compare=true")
    with pytest.raises(InputError, match=r"scene\.val_every=8 takes"):
        check_candidates(config, moving_square())
    scene = replace(moving_square(), val=moving_square().train[:2])
    check_candidates(config, scene)
    for word, said in (
        ("model.compared.moving_4dgs.lr.means.start=-1", r"candidate 4dgs: model\.lr\.means\.start: expected"),
        ("~model.compared.moving_4dgs.lr.scales", r"candidate 4dgs: model\.lr: .* 'scales' has none"),
    ):
        with pytest.raises(InputError, match=said):
            check_candidates(compose("auto", 10, "effects.compare=true", word), scene)
    config.train.penalties.strain.weight = 1.0
    with pytest.raises(InputError, match="candidate 6dgs: "):
        check_candidates(config, scene)


def test_candidates_are_those_of_the_settings() -> None:
    """Catches AGR in a candidate that has none of its own, equal candidates twice, and names that hide one another."""
    config: Config = compose("auto", 10, "effects.compare=true")
    assert {name: (one.model.name, one.agr, one.model.gate) for name, one in candidates(config).items()} == {
        "7dgs": ("7dgs", True, "both"), "4dgs": ("4dgs", False, "both"), "7dgs_noagr": ("7dgs", False, "both"),
        "6dgs": ("6dgs", False, "both"),
    }  # fmt: skip
    assert list(candidates(compose("auto", 10, "agr=false"))) == ["7dgs_noagr", "4dgs", "6dgs"]
    changed = compose("auto", 10, "agr=false", "model.compared.moving_noagr.lr.means.start=1")
    with pytest.raises(InputError, match="two are '7dgs_noagr'"):
        candidates(changed)
    changed.model.compared = {"mine": {"nam": "3dgs"}}
    with pytest.raises(InputError, match=r"model\.compared\.mine: "):
        candidates(changed)


@pytest.mark.parametrize(
    ("words", "after"),
    [({}, 700), ({"curve_points": 10}, 700), ({"curve_points": 3}, 1000), ({"curve_points": 1}, 1000)],
)
def test_models_are_compared_at_a_point_of_the_curve(words: dict[str, int], after: int) -> None:
    """Catches a comparison before 70 % of the steps, or where PSNR on val is not measured."""
    config = TrainConfig(iterations=1000, **words)
    assert Schedule(config, 3, True).compares_after == after


def test_models_are_compared_after_densification() -> None:
    """Catches a comparison of models that still grow, or whose opacities were just reset."""
    config = TrainConfig(iterations=1000)
    config.densify.stop = 25_000
    assert Schedule(config, 3, True).compares_after == 850
