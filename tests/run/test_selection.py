"""A run that chooses on val: a model for model=auto with effects.compare, or a length for train.lengths."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import MagicMock

import pytest
import torch
from interrupted import Killed, assert_same_bits, bits, counted_steps, run_through_kills
from tiny_run import overrides, run_here, write_moving_square
from tiny_training import NARROW, compose, moving_square

from gsbench.errors import InputError
from gsbench.measure.record import FILE_NAME, Candidate, Record, TimeScreen
from gsbench.measure.speed import RenderTimes
from gsbench.run import load, log, measuring, progress, selection
from gsbench.run.identity import RunSpec
from gsbench.run.selection import FOLDER, choose_model, lengths
from gsbench.run.settings import candidates, label_of
from gsbench.scenes import View
from gsbench.train import checkpoint
from gsbench.train.divergence import DivergedError
from gsbench.train.hooks.choices import length_name
from gsbench.train.loop import Trainer


class Choice(NamedTuple):
    """A run that chooses, and what must come of it."""

    words: tuple[str, ...]
    alone: tuple[str, ...]  # of a run of the best candidate alone
    names: tuple[str, ...]  # of the candidates that are trained
    best: str
    compared_after: int  # iterations of the best
    iterations: int  # of the best in the end
    steps: int  # of all trainings together
    planned: int  # steps, before any is known to be the best
    saves: dict[str, int]  # after which a run is killed
    failing: tuple[str, str]  # a candidate that diverges, and one that loses all Gaussians
    then: str  # the best of the others


# SH degree 2 alone is that of the best candidate's own schedule; each step is saved.
RUN = ("train.checkpoint_minutes=0", "protocol.pictures=0", "train.sh_every=10000")
OF_MODELS = (*RUN, "train.iterations=30", "train.curve_points=10")
OF_LENGTHS = (*RUN, "model=7dgs", "train.curve_points=2")
FIELD = "model.compared.moving_field"
SLOW = "model.candidates.moving.lr.opacities.start=1e-4"  # so that another candidate than the first wins
NARROW_FIELD = [option.replace("model", FIELD, 1) for option in NARROW["hexplane"]]
MODELS = Choice(
    ("model=auto", "effects.compare=true", SLOW, *NARROW_FIELD, *OF_MODELS),
    ("model=hexplane", *NARROW["hexplane"], *OF_MODELS),
    ("7dgs", "hexplane", "4dgs", "7dgs_noagr", "6dgs"),
    "hexplane",
    21,
    30,
    4 * 21 + 30,
    4 * 21 + 30,
    {"midway": 17, "chosen": 5 * 21 + 1},
    failing=("hexplane", "6dgs"),
    then="4dgs",
)
LENGTHS = Choice(
    (*OF_LENGTHS, "train.iterations=80", "train.lengths=4"),
    (*OF_LENGTHS, "train.iterations=20"),
    ("iterations=10", "iterations=20", "iterations=40"),
    "iterations=20",
    20,
    20,
    10 + 20 + 40,
    10 + 20 + 40 + 80,
    {"midway": 7, "chosen": 71},
    failing=("iterations=10", "iterations=40"),
    then="iterations=20",
)
LOSS = {40: 8.0}  # dB that val loses at a length, as if 40 steps learnt the training views by heart


@pytest.fixture(scope="module", autouse=True)
def overfitting() -> Iterator[None]:
    """Lower PSNR on val by LOSS."""
    psnr = Trainer.psnr

    def lowered(self: Trainer, views: list[View]) -> float:
        loss = LOSS.get(self.config.train.iterations, 0.0) if views is self.scene.val else 0.0
        return psnr(self, views) - loss

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Trainer, "psnr", lowered)
        yield


@pytest.fixture(scope="module", params=[MODELS, LENGTHS], ids=["models", "lengths"])
def choice(request: pytest.FixtureRequest) -> Choice:
    chosen: Choice = request.param
    return chosen


@pytest.fixture(scope="module")
def whole(choice: Choice, square: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Path]:
    """An unbroken run that chooses, which tests only read: its record and its folder."""
    return run_here(*overrides(square, tmp_path_factory.mktemp("whole"), *choice.words))


def chosen_in(record: Record) -> tuple[str, int, list[Candidate]]:
    """The best candidate in the record of a run, after how many iterations it was chosen, and all candidates."""
    assert record.status == "ok", record.reason
    if record.length_choice is not None:
        kept = record.length_choice.kept
        return length_name(kept), kept, record.length_choice.tried
    comparison = record.on_demand.comparison
    return comparison.chosen, comparison.iteration, comparison.candidates


def logged(folder: Path) -> list[int]:
    return [json.loads(line)["iteration"] for line in (folder / "curve.jsonl").read_text().splitlines()]


def untimed(candidate: Candidate) -> Candidate:
    """A candidate without what its machine took."""
    return replace(candidate, seconds=0.0, frame_ms=None)


def screen(decision: str, seconds: float = 0.0) -> TimeScreen:
    return TimeScreen(decision, "of the test", None, None, None, seconds)


# ---- both choices


def test_the_best_on_val_has_the_bits_of_its_training_alone(choice, whole, square, tmp_path):
    """Catches another choice than the best on val, other bits than the candidate alone has, and hidden costs."""
    record, folder = whole
    best, after, tried = chosen_in(record)
    psnr, seconds = ({each.name: getattr(each, name) for each in tried} for name in ("psnr_val", "seconds"))
    assert (best, after, tuple(psnr)) == (choice.best, choice.compared_after, choice.names)
    assert best == max(psnr, key=lambda name: psnr[name]) != choice.names[0], "if the first wins, nothing is tested"
    assert len(set(psnr.values())) == len(tried)
    alone, folder_alone = run_here(*overrides(square, tmp_path, *choice.alone))
    assert record.metrics == alone.metrics
    assert_same_bits(bits(folder), bits(folder_alone))
    assert [point.psnr_val for point in record.curve] == [point.psnr_val for point in alone.curve]
    assert [psnr[best]] == [point.psnr_val for point in alone.curve if point.iteration == after]
    assert logged(folder) == [point.iteration for point in record.curve]
    loaded = load.load_run(folder)
    assert (loaded.step, len(loaded.model)) == (choice.iterations, record.cost.num_gaussians)
    assert loaded.model.active.sh_degree == 2
    assert not (folder / FOLDER).exists()

    others = sum(seconds.values()) - seconds[best]
    assert record.cost.stage_s["compare"] == pytest.approx(others)
    assert ("screen" in record.cost.stage_s) == (choice is MODELS)
    assert record.cost.train_s >= 0.999 * sum(seconds.values())
    assert record.curve[0].seconds > others, "a PSNR is reached only after the other candidates"
    effort = checkpoint.read(folder / checkpoint.FILE_NAME).state["effort"]
    assert effort["seconds"] > others, "CPU-seconds of the best alone"


@pytest.mark.parametrize("when", ["midway", "chosen"])
def test_a_kill_repeats_no_step(when, choice, whole, square, tmp_path, monkeypatch):
    """Catches a candidate that is trained again, a lost choice, and other bits: killed after every few saves."""
    steps, words = counted_steps(monkeypatch), overrides(square, tmp_path, *choice.words)
    record, folder = run_through_kills(choice.saves[when], monkeypatch, lambda: run_here(*words))
    assert steps["all"] == choice.steps
    (*best, tried), (*best_before, before) = chosen_in(record), chosen_in(whole[0])
    assert best == best_before
    assert [*map(untimed, tried)] == [*map(untimed, before)]
    assert record.metrics == whole[0].metrics
    assert_same_bits(bits(folder), bits(whole[1]))
    assert not (folder / FOLDER).exists()
    assert logged(folder) == [point.iteration for point in record.curve]


def test_a_finished_run_is_kept_and_measured_again_with_its_choice(choice, square, tmp_path, capsys, monkeypatch):
    """Catches a second call that trains, a record that loses the choice when images are measured again, and a tracker
    that lacks the steps before the choice, and a progress that starts over with each candidate."""
    words, tracker = overrides(square, tmp_path, *choice.words, "log=json"), MagicMock()
    reports: list[progress.Progress] = []
    monkeypatch.setattr(progress, "EVERY", 0.0)
    monkeypatch.setattr(progress, "write", lambda _, each: reports.append(each))
    monkeypatch.setitem(log.TRACKERS, "json", tracker)
    record, folder = run_here(*words)
    sent = [step for (step, _), _ in tracker().add.call_args_list]
    assert sent == [*(point.iteration for point in record.curve), choice.iterations]
    trainings = [(each.step, each.seconds) for each in reports if each.seconds and each.steps == choice.planned]
    assert trainings[-1][0] == choice.steps
    assert all(list(values) == sorted(values) for values in zip(*trainings, strict=True))
    assert reports[-1].step == reports[-1].steps
    name = choice.best.removeprefix("iterations=")
    assert re.search(rf"{name} (iterations is kept|is trained to the end)", capsys.readouterr().err)
    monkeypatch.setattr(Trainer, "train_step", lambda _: pytest.fail("trained again"))
    assert run_here(*words)[0] == record
    assert "finished before, kept" in capsys.readouterr().out
    (folder / FILE_NAME).unlink()
    measured, _ = run_here(*words)
    assert chosen_in(measured) == chosen_in(record)
    assert measured.metrics == record.metrics


def test_a_candidate_that_fails_loses(choice, square, tmp_path, monkeypatch):
    """Catches a run that fails because some of its candidates did: on scene10_texture 6DGS prunes all Gaussians."""
    descend, (diverging, emptied) = Trainer.train_step, choice.failing

    def failing(self: Trainer) -> None:
        name = label_of(self.config) if choice is MODELS else length_name(self.config.train.iterations)
        if name == diverging and self.step == 5:
            raise DivergedError("step 5: a loss of nan")
        descend(self)
        if name == emptied:
            self.rows.select(torch.zeros(0, dtype=torch.int64))

    monkeypatch.setattr(Trainer, "train_step", failing)
    best, _, tried = chosen_in(run_here(*overrides(square, tmp_path, *choice.words))[0])
    assert best == choice.then
    reasons = {each.name: (each.reason or "")[:13] for each in tried}
    assert reasons == dict.fromkeys(choice.names, "") | {diverging: "step 5: a los", emptied: "no Gaussian i"}
    monkeypatch.setattr(Trainer, "train_step", lambda _: (_ for _ in ()).throw(DivergedError("all")))
    failed, _ = run_here(*overrides(square, tmp_path / "all", *choice.words))
    assert (failed.status, failed.on_demand, failed.length_choice) == ("diverged", None, None)
    assert f"candidates can be chosen; {choice.names[0]}: all" in str(failed.reason)


# ---- model=auto


@pytest.mark.parametrize(
    ("decision", "words", "model", "agr"),
    [
        ("on", ("auto",), "7dgs", True),
        ("undecided", ("auto",), "7dgs", True),
        ("off", ("auto",), "6dgs", False),
        ("on", ("auto", "agr=false"), "7dgs", False),
    ],
)
def test_a_scene_that_may_move_has_a_model_with_time(decision, words, model, agr, monkeypatch):
    """Catches an undecided scene that loses its motion, and AGR in a static model."""
    monkeypatch.setattr(selection, "screen_time", lambda *_: screen(decision))
    config = compose(words[0], 10, *words[1:])
    chosen = choose_model(RunSpec(config, {}, Path("nowhere"), config.model.name), moving_square())
    assert (chosen.config.model.name, chosen.config.agr, chosen.screen.decision) == (model, agr, decision)


def test_a_scene_without_times_is_static_and_not_compared(tmp_path):
    """Catches model=auto that is refused, as AGR is, for images without times, and models with time that it trains."""
    data = write_moving_square(tmp_path / "data")
    for path in data.glob("*/*.json"):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            del frame["time"]
        path.write_text(json.dumps(content))
    record, folder = run_here(*overrides(data, tmp_path / "results", *MODELS.words, "effects.gate=off"))
    assert (record.status, record.reason) == ("ok", None)
    assert (record.on_demand.screen.decision, record.on_demand.screen.reason) == ("off", "the views have no times")
    assert record.on_demand.comparison is None
    assert (record.effects.time, record.effects.refinement) == (False, False)
    assert checkpoint.read(folder / checkpoint.FILE_NAME).config["model"]["name"] == "6dgs"


def test_resume_false_starts_every_candidate_over(square, tmp_path, monkeypatch, capsys):
    """Catches a candidate of an earlier attempt that is taken although the user asked to start over."""
    save = checkpoint.save
    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "save", lambda *content: (save(*content), (_ for _ in ()).throw(Killed)))
        with pytest.raises(Killed):
            run_here(*overrides(square, tmp_path, *MODELS.words))
    record, folder = run_here(*overrides(square, tmp_path, *MODELS.words, "resume=false"))
    assert chosen_in(record)[0] == MODELS.best
    assert "continues from" not in capsys.readouterr().err
    assert not (folder / FOLDER).exists()


def test_candidates_are_those_of_the_settings():
    """Catches AGR in a candidate that has none, equal candidates twice, and names that hide one another."""
    by_label = candidates(compose("auto", 10, "effects.compare=true"))
    assert {label: (config.model.name, config.agr, config.model.gate) for label, config in by_label.items()} == {
        "7dgs": ("7dgs", True, "both"),
        "hexplane": ("hexplane", False, "both"),
        "4dgs": ("4dgs", False, "both"),
        "7dgs_noagr": ("7dgs", False, "both"),
        "6dgs": ("6dgs", False, "both"),
    }
    assert list(candidates(compose("auto", 10, "agr=false"))) == ["7dgs_noagr", "hexplane", "4dgs", "6dgs"]
    changed = compose("auto", 10, "agr=false", "model.compared.moving_noagr.lr.means.start=1")
    with pytest.raises(InputError, match="two are '7dgs_noagr'"):
        candidates(changed)
    changed.model.compared = {"wrong": {"nam": "3dgs"}}
    with pytest.raises(InputError, match=r"model\.compared\.wrong: "):
        candidates(changed)


@pytest.mark.parametrize(("most", "best"), [(5.0, "hexplane"), (4.9, "4dgs")])
def test_a_field_is_chosen_without_gates_and_within_the_budget(most, best, square, tmp_path, capsys, monkeypatch):
    """Catches a field that gates refuse, slower frames than allowed, and prices that are not recorded or printed."""
    ms = {"7dgs": 2.0, "hexplane": 5.0}
    times = lambda trainer, _: (RenderTimes(0.0, ms.get(trainer.config.model.name, 1.0), 9.0), {})  # noqa: E731
    monkeypatch.setattr(measuring, "time_frames", times)
    words = ("model=auto", "effects.compare=true", f"effects.most_frame_ms={most}", *NARROW_FIELD, *OF_MODELS)
    record, folder = run_here(*overrides(square, tmp_path, *words))
    chosen, _, tried = chosen_in(record)
    by_name = {each.name: each for each in tried}
    assert (chosen, {name: each.frame_ms for name, each in by_name.items()}) == (
        best,
        {"7dgs": 2.0, "hexplane": 5.0, "4dgs": 1.0, "7dgs_noagr": 2.0, "6dgs": 1.0},
    )
    assert max(tried, key=lambda each: each.psnr_val or 0.0).name == "hexplane", "else no budget is needed"
    config = load.load_run(folder).config
    assert (config.model.name, config.effects.gate) == (best, "off" if best == "hexplane" else "both")
    assert ("gates cannot simplify hexplane" in record.on_demand.notes) == (best == "hexplane")
    assert by_name["hexplane"].reason == (None if best == "hexplane" else "more than effects.most_frame_ms=4.9")
    field = by_name["hexplane"]
    row = f"hexplane {field.psnr_val:.2f} {field.seconds:.1f} 5.00 {field.reason or ''}".split()
    assert row in [line.split() for line in capsys.readouterr().err.splitlines()]


def test_candidates_end_where_their_seconds_do(square, tmp_path, monkeypatch):
    """Catches a candidate that trains on although it cannot be chosen, and one that is chosen nevertheless."""
    steps, words = counted_steps(monkeypatch), ("effects.most_seconds=1e-9", *MODELS.words)
    record, _ = run_here(*overrides(square, tmp_path, *words))
    assert (record.status, steps["all"]) == ("failed", 5 * 3), "a tenth of 30 iterations each"
    expected = "none of 5 candidates can be chosen; 7dgs: more than effects.most_seconds=1e-09 after 3 iterations"
    assert expected in str(record.reason)


# ---- train.lengths


def test_each_length_is_twice_the_one_before():
    """Catches a last length that is not the one which was asked for, and odd numbers that are not halved."""
    assert [
        (each.train.iterations, each.train.lengths) for each in lengths(compose("7dgs", 75, "train.lengths=3")).values()
    ] == [(18, None), (37, None), (75, None)]


def test_the_longest_is_kept_if_each_is_better(square, tmp_path, monkeypatch, capsys):
    """Catches trainings that end before the longest although PSNR on val still rises, lengths of another model than
    the screen of model=auto chose, seconds of the screen that are lost, and the same points told for each length."""
    for length, loss in ((10, 1.0), (40, -1.0), (80, -2.0)):
        monkeypatch.setitem(LOSS, length, loss)
    monkeypatch.setattr(selection, "screen_time", lambda *_: screen("off", seconds=5.0))
    record, folder = run_here(*overrides(square, tmp_path, *LENGTHS.words, "model=auto"))
    best, _, tried = chosen_in(record)
    assert (best, len(tried)) == ("iterations=80", 4)
    assert capsys.readouterr().err.count("seen by at least one camera") == 1
    assert not record.effects.time
    assert record.cost.stage_s["screen"] == 5.0
    assert load.load_run(folder).config.model.name == "6dgs"
