"""model=auto: which model it becomes, and with effects.compare=true the best on val, whatever interrupts the run."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from interrupted import Killed, assert_same_bits, bits, counted_steps, run_through_kills
from tiny_run import overrides, run_here, write_moving_square
from tiny_training import compose, moving_square

from gsbench.config import TrainConfig
from gsbench.errors import InputError
from gsbench.measure.record import FILE_NAME, ModelComparison, Record, TimeScreen
from gsbench.run import log, selection
from gsbench.run.identity import RunSpec
from gsbench.run.selection import FOLDER, candidates, check_candidates, check_compare, resolve
from gsbench.schedule import Schedule
from gsbench.train import checkpoint
from gsbench.train.divergence import DivergedError
from gsbench.train.loop import Trainer

STEPS, UNTIL = 30, 21  # of a run, and until the comparison
RUN = (f"train.iterations={STEPS}", "train.curve_points=10", "train.checkpoint_minutes=0", "protocol.pictures=0")
SLOW = "model.candidates.moving.lr.opacities.start=1e-4"  # so that another candidate than the first wins
COMPARED = ("model=auto", "effects.compare=true", SLOW, *RUN)
NAMES = ["7dgs", "4dgs", "7dgs_noagr", "6dgs"]


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


@pytest.mark.parametrize(
    ("decision", "model", "agr"), [("on", "7dgs", True), ("undecided", "7dgs", True), ("off", "6dgs", False)]
)
def test_a_scene_that_may_move_has_a_model_with_time(
    decision: str, model: str, agr: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches an undecided scene that loses its motion, AGR in a static model, and a screen for a model with a name."""
    monkeypatch.setattr(selection, "screen_time", lambda *_: TimeScreen(decision, "said", None, None, None, 0.0))
    for words, chosen in (
        (("auto", 10), (model, agr, decision)),
        (("auto", 10, "agr=false"), (model, False, decision)),
        (("4dgs", 10), ("4dgs", False, None)),
    ):
        config = compose(*words)
        resolved = resolve(RunSpec(config, {}, Path("nowhere"), config.model.name), moving_square())
        screened = resolved.screen.decision if resolved.screen else None
        assert (resolved.config.model.name, resolved.config.agr, screened) == chosen


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


def test_the_best_on_val_is_trained_to_the_end_with_its_bits(
    square: Path, whole: tuple[Record, Path], tmp_path: Path
) -> None:
    """Catches another choice than the best on val, a result that the model alone does not have, and hidden costs."""
    record, folder = whole
    comparison = comparison_in(record)
    values = {candidate.name: candidate.psnr_val for candidate in comparison.candidates}
    assert [*values] == NAMES
    assert comparison.iteration == UNTIL
    assert comparison.chosen == max(values, key=lambda name: values[name] or 0)
    assert len(set(values.values())) == len(NAMES)
    assert comparison.chosen == "4dgs", "if the first wins, nothing is tested here"
    alone, folder_alone = run_here(*overrides(square, tmp_path, "model=4dgs", "effects.gate=both", *RUN))
    assert record.metrics == alone.metrics
    assert_same_bits(bits(folder), bits(folder_alone))
    assert values[comparison.chosen] == alone.curve[6].psnr_val
    assert [point.psnr_val for point in record.curve] == [point.psnr_val for point in alone.curve]
    seconds = {candidate.name: candidate.seconds for candidate in comparison.candidates}
    others = sum(seconds.values()) - seconds["4dgs"]
    assert record.cost is not None
    assert record.cost.stage_s["compare"] == pytest.approx(others)
    assert record.cost.train_s > sum(seconds.values())
    assert record.curve[0].seconds > others, "a PSNR is reached only after the other candidates"
    effort = checkpoint.read(folder / checkpoint.FILE_NAME).state["effort"]
    assert effort["seconds"] > sum(seconds.values()), "CPU-seconds of the best alone"
    assert record.effects.refinement is False
    assert not (folder / FOLDER).exists()


@pytest.mark.parametrize("saves", [17, 4 * UNTIL + 1], ids=["midway", "chosen"])
def test_a_kill_repeats_no_step(
    saves: int, square: Path, whole: tuple[Record, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a candidate that is trained again, a lost choice, and other bits: killed after every few saves."""
    steps = counted_steps(monkeypatch)
    record, folder = run_through_kills(saves, monkeypatch, lambda: run_here(*overrides(square, tmp_path, *COMPARED)))
    assert steps["all"] == 3 * UNTIL + STEPS
    after, before = comparison_in(record), comparison_in(whole[0])
    for comparison in (after, before):
        comparison.candidates[:] = [replace(candidate, seconds=0.0) for candidate in comparison.candidates]
    assert after == before
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

    monkeypatch.setitem(log.TRACKERS, "json", Tracked)
    record, folder = run_here(*words)
    assert sent == [*(point.iteration for point in record.curve), STEPS], "a tracker lacks the steps of the comparison"
    monkeypatch.setattr(Trainer, "train_step", lambda _: pytest.fail("trained again"))
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
    """Catches a candidate of an earlier attempt that is taken although the user asked to start over."""
    save = checkpoint.save
    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "save", lambda *content: (save(*content), (_ for _ in ()).throw(Killed)))
        with pytest.raises(Killed):
            run_here(*overrides(square, tmp_path, *COMPARED))
    record, folder = run_here(*overrides(square, tmp_path, *COMPARED, "resume=false"))
    assert comparison_in(record).chosen == "4dgs"
    assert "continues from" not in capsys.readouterr().err
    assert not (folder / FOLDER).exists()


def test_a_candidate_that_fails_loses(square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a run that fails because some of its candidates did: on scene10_texture 6DGS prunes all Gaussians."""
    descend = Trainer.train_step

    def diverging(self: Trainer) -> None:
        if self.config.model.name == "4dgs" and self.step == 5:
            raise DivergedError("step 5: a loss of nan")
        descend(self)
        if self.config.model.name == "6dgs":
            self.rows.select(torch.zeros(0, dtype=torch.int64))

    monkeypatch.setattr(Trainer, "train_step", diverging)
    record, _ = run_here(*overrides(square, tmp_path, *COMPARED))
    comparison = comparison_in(record)
    reasons = {candidate.name: candidate.reason for candidate in comparison.candidates}
    assert reasons.pop("6dgs").startswith("no Gaussian is left")
    assert reasons == {"7dgs": None, "4dgs": "step 5: a loss of nan", "7dgs_noagr": None}
    assert comparison.chosen == "7dgs_noagr"
    monkeypatch.setattr(Trainer, "train_step", lambda _: (_ for _ in ()).throw(DivergedError("all")))
    failed, _ = run_here(*overrides(square, tmp_path / "all", *COMPARED))
    assert (failed.status, failed.on_demand) == ("diverged", None)


def test_a_static_scene_is_not_compared(square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches models with time that are trained on a scene which the screen calls static."""
    monkeypatch.setattr(selection, "screen_time", lambda *_: TimeScreen("off", "static", None, None, None, 0.0))
    record, folder = run_here(*overrides(square, tmp_path, *COMPARED))
    assert record.on_demand is not None
    assert record.on_demand.comparison is None
    assert not record.effects.time
    assert checkpoint.read(folder / checkpoint.FILE_NAME).config["model"]["name"] == "6dgs"


@pytest.mark.parametrize(
    ("model", "word", "message"),
    [("7dgs", "seed=0", "expected model=auto"), ("auto", "scene.eval_split=val", "got scene.eval_split=val")],
)
def test_settings_that_cannot_be_compared_are_refused(model: str, word: str, message: str) -> None:
    """Catches a key that does nothing, and results on the views by which the model was chosen."""
    with pytest.raises(InputError, match=message):
        check_compare(compose(model, 10, "effects.compare=true", word))
    check_compare(compose(model, 10, word))


def test_a_scene_without_val_is_refused_before_training() -> None:
    """Catches models that are compared on the views on which they are trained, and candidates of which one fails."""
    config = compose("auto", 10, "effects.compare=true")
    with pytest.raises(InputError, match=r"scene\.val_every=8 takes"):
        check_candidates(config, moving_square())
    scene = replace(moving_square(), val=moving_square().train[:2])
    check_candidates(config, scene)
    for word, message in (
        ("model.compared.moving_4dgs.lr.means.start=-1", r"candidate 4dgs: model\.lr\.means\.start: expected"),
        ("~model.compared.moving_4dgs.lr.scales", r"candidate 4dgs: model\.lr: .* 'scales' has none"),
        ("train.penalties.strain.weight=1", "candidate 6dgs: "),
    ):
        with pytest.raises(InputError, match=message):
            check_candidates(compose("auto", 10, "effects.compare=true", word), scene)


def test_candidates_are_those_of_the_settings() -> None:
    """Catches AGR in a candidate that has none, equal candidates twice, and names that hide one another."""
    by_label = candidates(compose("auto", 10, "effects.compare=true"))
    assert {label: (config.model.name, config.agr, config.model.gate) for label, config in by_label.items()} == {
        "7dgs": ("7dgs", True, "both"), "4dgs": ("4dgs", False, "both"), "7dgs_noagr": ("7dgs", False, "both"),
        "6dgs": ("6dgs", False, "both"),
    }  # fmt: skip
    assert list(candidates(compose("auto", 10, "agr=false"))) == ["7dgs_noagr", "4dgs", "6dgs"]
    changed = compose("auto", 10, "agr=false", "model.compared.moving_noagr.lr.means.start=1")
    with pytest.raises(InputError, match="two are '7dgs_noagr'"):
        candidates(changed)
    changed.model.compared = {"wrong": {"nam": "3dgs"}}
    with pytest.raises(InputError, match=r"model\.compared\.wrong: "):
        candidates(changed)


@pytest.mark.parametrize(("points", "stop", "after"), [(20, 15_000, 700), (10, 15_000, 700), (3, 15_000, 1000),
                                                       (1, 15_000, 1000), (20, 25_000, 850)])  # fmt: skip
def test_models_are_compared_at_a_point_of_the_curve_after_densification(points: int, stop: int, after: int) -> None:
    """Catches a comparison before 70 % of the steps, where PSNR is not measured, or of models that still grow."""
    config = TrainConfig(iterations=1000, curve_points=points)
    config.densify.stop = stop
    assert Schedule(config, 3, True).compares_after == after
