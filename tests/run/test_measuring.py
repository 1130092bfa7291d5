"""What a finished training is measured by: PSNR at the iteration that was best on val, and at the last one."""

from pathlib import Path

import pytest
from tiny_run import overrides, run_here, write_moving_square

from gsbench.scenes import View
from gsbench.train.loop import Trainer

# PSNR on val and on the evaluated split after 10, 20 and 30 of 30 iterations: val is highest in the middle, test later.
SCRIPTED = {10: (20.0, 30.0), 20: (24.0, 31.0), 30: (22.0, 33.0)}


@pytest.mark.parametrize(
    ("split", "on_val", "on_test"), [("test", 31.0, 33.0), ("val", None, 24.0)], ids=["of test", "of val"]
)
def test_the_best_iteration_is_chosen_on_val(
    split: str, on_val: float | None, on_test: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches PSNR on val in place of that on test, the last iteration or the best on test in place of the best on val,
    and a number where results are measured on val themselves."""

    def psnr(trainer: Trainer, views: list[View]) -> float:
        names = {view.name.split("/")[0] for view in views}
        at = min(trainer.step + 1, max(SCRIPTED))
        return {"val": SCRIPTED[at][0], "test": SCRIPTED[at][1], "train": 40.0}[names.pop()]

    monkeypatch.setattr(Trainer, "psnr", psnr)
    data = write_moving_square(tmp_path / "data")
    record, _ = run_here(*overrides(data, tmp_path / "results", "model=3dgs", f"scene.eval_split={split}",
                                    "train.curve_points=3", "protocol.best_on_test=true"))  # fmt: skip
    assert record.metrics is not None
    assert [point.psnr_val for point in record.curve] == [20.0, 24.0, 22.0]
    assert record.metrics["psnr_best_on_val"] == on_val
    assert record.metrics["psnr_best_on_test"] == on_test
    assert ("psnr_best_on_val" in record.missing) == (on_val is None)
    assert record.metrics["psnr_train"] == 40.0
