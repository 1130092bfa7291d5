"""What a finished training is measured by, PSNR at its best iteration on val too, and the line that it ends with."""

import json
import shutil
from dataclasses import replace

import pytest
from report.records import make
from tiny_run import overrides, run_here

from gsbench.measure.curve import Point
from gsbench.measure.record import Stop
from gsbench.run.execution import summary
from gsbench.scenes import View
from gsbench.train.loop import Trainer

# PSNR on val and on the evaluated split after 10, 20 and 30 of 30 iterations: val is highest in the middle, test later.
SCRIPTED = {10: (20.0, 30.0), 20: (24.0, 31.0), 30: (22.0, 33.0)}


@pytest.mark.parametrize(("split", "on_val", "on_test"), [("test", 31.0, 33.0), ("val", None, 24.0)])
def test_the_best_iteration_is_chosen_on_val(split, on_val, on_test, square, tmp_path, monkeypatch):
    """Catches PSNR on val in place of that on test, the last iteration or the best on test in place of the best on val,
    and a number where results are measured on val themselves."""

    def psnr(trainer: Trainer, views: list[View]) -> float:
        at = min(trainer.step + 1, max(SCRIPTED))
        return {"val": SCRIPTED[at][0], "test": SCRIPTED[at][1], "train": 40.0}[views[0].name.split("/")[0]]

    monkeypatch.setattr(Trainer, "psnr", psnr)
    words = ("model=3dgs", f"scene.eval_split={split}", "train.curve_points=3", "protocol.best_on_test=true")
    record, _ = run_here(*overrides(square, tmp_path, *words))
    assert [point.psnr_val for point in record.curve] == [20.0, 24.0, 22.0]
    assert record.metrics["psnr_best_on_val"] == on_val
    assert record.metrics["psnr_best_on_test"] == on_test
    assert ("psnr_best_on_val" in record.missing) == (on_val is None)
    assert record.metrics["psnr_train"] == 40.0


@pytest.mark.parametrize(
    ("last", "sentence"),
    [
        (24.5, "PSNR on val was 0.50 dB higher at iteration 600: a shorter training may be better"),
        (24.95, None),
        (25.2, None),
        (None, None),
    ],
)
def test_a_training_that_was_better_earlier_says_so(last, sentence):
    """Catches a training that overfits in silence, and one that is called too long for less than seeds differ by."""
    record = replace(make(), curve=[Point(300, 1.0, 24.0), Point(600, 2.0, 25.0), Point(900, 3.0, last)])
    assert (sentence or "PSNR") in summary(record)
    for silent in (replace(record, stop=Stop(iteration=900, kept=600)), replace(record, curve=[]), make()):
        assert "higher" not in summary(silent)
    assert sentence or "higher" not in summary(record)


def test_views_at_the_cap_are_named():
    """Catches a PSNR that nobody can tell from one without a view that is rendered exactly."""
    exact = summary(replace(make(), exact=["test/r_3"]))
    assert ". PSNR of test/r_3 is infinite or nearly so and counts as 100 dB" in exact
    assert "counts as" not in summary(make())


def test_the_line_of_a_run_begins_with_its_psnr():
    """Catches a run that seems to have no PSNR, and a stack trace for one that has none."""
    psnr = make().metrics["psnr"]
    assert summary(make()).startswith(f"PSNR {psnr:.2f} dB, ")
    assert summary(replace(make(), metrics={"psnr": None})).startswith("PSNR - dB, ")


def test_a_film_has_its_flicker_in_the_record(square, tmp_path):
    """Catches numbers of 8 bits in place of floats, a film without a picture, and a static model that moves."""
    data = shutil.copytree(square, tmp_path / "data")
    path = data / "square/transforms_test.json"
    content = json.loads(path.read_text())
    images = (("./test/r_0", 0.0), ("./train/r_2", 0.4), ("./test/r_1", 1.0))
    content["frames"] = [content["frames"][0] | {"file_path": name, "time": time} for name, time in images]
    path.write_text(json.dumps(content))
    floats, folder = run_here(*overrides(data, tmp_path, "model=4dgs"))
    assert floats.status == "ok", floats.reason
    assert floats.metrics["flicker"] > 0 == floats.metrics["flicker_truth"]
    assert floats.metrics["drift_3d"] > 0 < floats.metrics["drift_3d_px"]
    assert floats.regions["static"].views == 3
    assert (folder / "flicker.png").is_file()
    static, _ = run_here(*overrides(data, tmp_path, "model=3dgs"))
    assert static.metrics["drift_3d"] == 0 == static.metrics["drift_3d_px"]
    in_8_bits, _ = run_here(*overrides(data, tmp_path, "model=4dgs", "protocol.quantise=true"))
    assert in_8_bits.metrics["psnr"] != floats.metrics["psnr"]
    assert in_8_bits.metrics["flicker"] == floats.metrics["flicker"]
