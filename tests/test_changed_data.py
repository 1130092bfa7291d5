"""Check that a run is done again once its images have changed, by images of the test split alone."""

from pathlib import Path

import cv2
import numpy as np
from tiny_run import SIZE, gsbench, overrides, write_moving_square

from gsbench.measure import record


def test_changed_data_runs_again_and_training_views_keep_their_score(tmp_path: Path) -> None:
    """Catches a result of other data that is passed off as this one's, and a psnr_train measured on another split.

    The training and what is measured on its views stay the same to the bit.
    """
    data, runs = write_moving_square(tmp_path / "data"), []
    arguments = overrides(data, tmp_path / "results", "model=3dgs")
    for is_changed in (False, True):
        done = gsbench(*arguments)
        assert done.returncode == 0, done.stderr
        assert ("running again" in done.stderr) == is_changed, done.stderr
        (path,) = record.find(tmp_path / "results")
        metrics = record.read(path).metrics
        assert metrics is not None
        runs.append(metrics)
        for image in (data / "square" / "test").glob("*.png"):
            assert cv2.imwrite(str(image), np.full((SIZE, SIZE, 4), 255, np.uint8))
    assert runs[0]["psnr"] != runs[1]["psnr"]
    assert runs[0]["psnr_train"] == runs[1]["psnr_train"]
