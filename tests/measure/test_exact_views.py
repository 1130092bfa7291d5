"""Views that are rendered exactly: one finite rule for every mean, and the last candidate where PSNR cannot decide."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_run import SIZE, overrides, run_here
from tiny_training import compose, moving_square

from gsbench.errors import InputError
from gsbench.measure import record as records
from gsbench.measure.curve import Curve, Point
from gsbench.measure.exact_views import MOST_PSNR, capped, decides, rank, sentence
from gsbench.measure.quality import evaluate, psnr
from gsbench.measure.record import Record, ViewScore
from gsbench.measure.speed import Effort
from gsbench.run.selection import Candidate, Result, best, highest
from gsbench.run.setup import build
from gsbench.train.divergence import DivergedError
from gsbench.train.loop import Trainer

AWAY = [[1, 0, 0, 0], [0, 0, -1, 9], [0, 1, 0, 0], [0, 0, 0, 1]]  # looks away from the scene: renders the background
RUN = ("model=3dgs", "train.curve_points=4", "train.checkpoint_minutes=0", "protocol.pictures=0")


@given(st.lists(st.floats(0, 99.9), min_size=1), st.integers(0, 3))
def test_a_cap_changes_no_mean_of_lower_numbers(scores, exact):
    """Catches a rule that changes results without an exact view, and a mean with some that is not finite."""
    assert [capped(score) for score in scores] == scores
    assert fmean(map(capped, scores + [math.inf] * exact)) == fmean(scores + [MOST_PSNR] * exact) <= MOST_PSNR


def test_numbers_that_are_none_decide_nothing():
    """Catches a NaN that is above a number, or that `max` and `>` let pass because it came first."""
    assert sorted([30.0, None, math.inf, math.nan, 130.0, 29.0], key=rank)[-2:] == [math.inf, 130.0]
    assert rank(None) == rank(math.nan) < rank(-5.0) < rank(99.0) < rank(math.inf) == rank(130.0)
    assert math.isnan(capped(math.nan))
    assert [decides(item) for item in (30.0, MOST_PSNR, math.nan)] == [True, False, False]


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.3, 0.6, 0.9)])
def test_one_exact_view_leaves_every_mean_finite(background):
    """Catches a PSNR of a split that is infinite as one of its views is empty, and a mean without this view."""
    empty = torch.tensor(background).expand(16, 16, 3)
    other = torch.full((16, 16, 3), 0.5)
    scores = evaluate([("a", empty, empty), ("b", other + 0.1, other)], background=background)
    assert scores.metrics["psnr"] == fmean([100.0, psnr(other + 0.1, other)])
    assert scores.metrics["psnr_channel_mean"] == pytest.approx(60.0, abs=1e-4)
    assert scores.metrics["psnr_background_only"] == fmean([100.0, psnr(empty, other)])
    assert scores.metrics["ssim"] is not None
    assert [item.psnr for item in scores.per_view] == [100.0, psnr(other + 0.1, other)]
    assert [item.exact for item in scores.per_view] == [["a"], []]
    alone = evaluate([("b", other + 0.1, other)], background=background)
    assert alone.metrics["psnr"] == psnr(other + 0.1, other)  # to the last bit


def test_errors_too_small_for_a_square_are_exact_and_no_number_is_named():
    """Catches a squared error that underflows to zero, one above it that counts more than zero does, and an empty
    metric whose reason does not say which of many views was at fault."""
    truth = torch.full((16, 16, 3), 0.5, dtype=torch.float64)
    for error, psnr_db in ((1e-200, 100.0), (1e-12, 100.0), (0.0, 100.0), (1e-4, pytest.approx(80.0))):
        assert evaluate([("a", truth * 0 + error, truth * 0)], background=(0.0, 0.0, 0.0)).metrics["psnr"] == psnr_db
    scores = evaluate([("a", truth + 0.1, truth), ("b", truth * math.nan, truth)], background=(0.0, 0.0, 0.0))
    assert scores.metrics["psnr"] is scores.metrics["ssim"] is None
    assert scores.missing["psnr"] == scores.missing["ssim"] == "not a number in b"
    assert scores.metrics["psnr_background_only"] is not None


def test_exact_views_and_regions_are_named():
    """Catches a region at the cap that nobody is told of, a view named thrice, and a line of a thousand names."""
    assert ViewScore("a", psnr=30.0, psnr_object=100.0).exact == ["a (object)"]
    assert ViewScore("a", psnr=100.0, psnr_object=100.0, psnr_moving=100.0).exact == ["a"]
    assert "PSNR of a, b, c is infinite" in sentence(["a", "b", "c"])
    assert "a, b, c and 97 more is infinite" in sentence(["a", "b", "c", *"d" * 97])


def test_the_best_of_equal_points_is_the_last():
    """Catches the first iteration, the least trained, that is called the best."""
    curve = Curve([Point(1, 0.0, 30.0), Point(2, 0.0, 100.0), Point(3, 0.0, 100.0), Point(4, 0.0, None)])
    assert curve.best == curve.points[2]
    assert curve.equal_to(3) == curve.points[1:3]
    assert curve.equal_to(1) == curve.points[:1]
    assert Curve([Point(1, 0.0, None)] * 2).best is Curve().best is None


def result(name: str, psnr_val: float | None, error: DivergedError | None = None) -> Result:
    return Result(Candidate(name, psnr_val, 1.0, str(error) if error else None), 10, Effort(), error)


@pytest.mark.parametrize(
    ("scores", "chosen"),
    [
        ([100.0, 100.0, 100.0], 2),
        ([None, None], 1),
        ([None, 20.0], 1),
        ([20.0, None], 0),
        ([30.0, 20.0], 0),
        ([20.0, 30.0, 30.0, 25.0], 2),
    ],
)
def test_the_last_of_equal_candidates_is_taken(scores, chosen):
    """Catches the first candidate, which is the shortest training, that is taken as nothing speaks against it."""
    results = [result(str(i), score) for i, score in enumerate(scores)]
    assert best(results) is results[chosen]
    failed = result("failed", None, DivergedError("step 5"))
    assert highest([*results, failed]) is results[chosen]
    with pytest.raises(DivergedError, match="none of 2 candidates can be chosen; failed: step 5"):
        best([failed, replace(failed, candidate=replace(failed.candidate, name="other"))])


def with_away(square: Path, root: Path, split: str, whole: bool = False) -> Path:
    """The moving square with an empty view more in a split, or with nothing but empty views."""
    shutil.copytree(square, root)
    path = root / "square" / f"transforms_{split}.json"
    content = json.loads(path.read_text())
    assert cv2.imwrite(str(root / "square" / split / "away.png"), np.zeros((SIZE, SIZE, 4), np.uint8))
    frame = {"file_path": f"./{split}/away", "time": 0.5, "transform_matrix": AWAY}
    content["frames"] = [frame] if whole else [*content["frames"], frame]
    path.write_text(json.dumps(content))
    return root


def ok(record: Record) -> dict[str, Any]:
    assert record.status == "ok", record.reason
    return record.metrics


def test_empty_views_are_counted_and_named(square, tmp_path, capsys):
    """Catches "PSNR inf dB" and an empty metric, on test or train, and a mean that hides that a view is at the cap."""
    data = with_away(with_away(square, tmp_path / "t", "train"), tmp_path / "d", "test")
    record, folder = run_here(*overrides(data, tmp_path, *RUN, "train.iterations=1"))
    plain, _ = run_here(*overrides(tmp_path / "t", tmp_path / "plain", *RUN, "train.iterations=1"))
    scores, before = ok(record), ok(plain)
    of_others = [view.psnr for view in plain.per_view]
    assert (scores["psnr"], before["psnr"]) == (fmean([100.0, *of_others]), fmean(of_others))
    assert None not in (scores["psnr_best_on_val"], scores["psnr_float32"])
    assert math.isfinite(scores["psnr_train"])
    assert (record.exact, plain.exact) == (["test/away"], [])
    assert records.read(folder / records.FILE_NAME).exact == ["test/away"]
    assert "PSNR of test/away is infinite or nearly so and counts as 100 dB" in capsys.readouterr().out


@pytest.mark.parametrize("words", [("train.lengths=2",), ("train.patience=0.2",), ("train.average_from=15",), ()])
def test_an_empty_val_view_changes_no_choice(words, square, tmp_path):
    """Catches the first length, iteration or parameters that are kept because PSNR on val is always infinite."""
    record, _ = run_here(*overrides(with_away(square, tmp_path / "d", "val"), tmp_path, *RUN, *words))
    plain, _ = run_here(*overrides(square, tmp_path / "plain", *RUN, *words))
    assert ok(record) == ok(plain)
    assert record.stop == plain.stop
    assert record.averaged == plain.averaged
    choices = [run.length_choice and (run.length_choice.kept, len(run.length_choice.tried)) for run in (record, plain)]
    assert choices[0] == choices[1]
    assert record.exact == ["val/away"]
    shifted = [(100.0 + 2 * (p.psnr_val or math.nan)) / 3 for p in plain.curve]
    assert [p.psnr_val for p in record.curve] == pytest.approx(shifted)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("train.lengths=2",), "PSNR cannot decide between iterations=15, iterations=30, so the last of them is taken"),
        (("train.patience=0.2",), "PSNR on val is equal at 4 steps, 8 to 30: it cannot decide, and the last of them"),
        (("train.average_from=15",), "it cannot decide, and the last are kept"),
    ],
)
def test_a_val_of_empty_views_decides_nothing(words, line, square, tmp_path, capsys):
    """Catches a training that stops early, or in silence, as no view of val can tell one from another."""
    data = with_away(square, tmp_path / "d", "val", whole=True)
    record, _ = run_here(*overrides(data, tmp_path, *RUN, *words))
    whole, _ = run_here(*overrides(square, tmp_path / "whole", *RUN))
    assert ok(record)["psnr"] == ok(whole)["psnr"]
    assert line in " ".join(capsys.readouterr().err.split())
    assert record.length_choice is None or record.length_choice.kept == 30
    assert record.stop is None or record.stop.kept == 30
    assert record.averaged == 0
    assert record.metrics["psnr_best_on_val"] == record.metrics["psnr"], "the last iteration is the best"


def test_an_image_of_val_that_is_not_a_number_is_refused():
    """Catches choices on a PSNR that is NaN at every step, because an image of val or test is."""
    scene, config = moving_square(views=4), compose("3dgs", 10)
    broken = replace(scene.train[0], name="val/broken", pixels=scene.train[0].pixels * math.nan)
    model = build(config)
    assert scene.points is not None
    model.initialise(scene.points, scene.extent, torch.Generator().manual_seed(0))
    for val, views in (([broken], scene.test), ([], [broken])):
        with pytest.raises(InputError, match="val/broken: expected an image of finite values"):
            Trainer(model, replace(scene, val=val), views, config)
