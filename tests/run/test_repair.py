"""A run on a release with a damaged image: it is refused, or its record says which image was replaced."""

from pathlib import Path

import cv2
import numpy as np
from scenes.test_technicolor import COUNT, HEADER, damage, row
from tiny_run import run_here

from gsbench.scenes.technicolor import CAMERAS


def test_the_record_says_what_was_replaced(tmp_path: Path) -> None:
    """Catches an option that the run does not pass on, and numbers of a repaired scene that look like any other's."""
    folder = tmp_path / "Tiny"
    folder.mkdir()
    (folder / CAMERAS).write_text("\n".join([HEADER, *map(row, range(COUNT))]))
    image = np.random.default_rng(0).integers(0, 256, (12, 12, 3), np.uint8)
    for frame in (3, 4):
        for camera in range(COUNT):
            assert cv2.imwrite(str(folder / f"Tiny_undist_{frame:05d}_{camera:02d}.png"), image)
    words = ["+exp=technicolor", "model=3dgs", f"data.root={tmp_path}", "scene=custom", "scene.name=Tiny",
             "data.initial_points=20", "train.iterations=1", "protocol.pictures=0", f"results={tmp_path}"]  # fmt: skip
    assert "repaired" not in run_here(*words)[0].protocol
    damage(folder, "Tiny_undist_00004_09")
    assert "data.repair=[Tiny_undist_00004_09]" in (run_here(*words)[0].reason or "")
    record, made = run_here(*words, "data.repair=[Tiny_undist_00004_09]")
    assert record.status == "ok", record.reason
    assert record.protocol["repaired"] == "Tiny_undist_00004_09"
    assert record.provenance.config["data"]["repair"] == ["Tiny_undist_00004_09"]
    assert "repair" in made.parent.name
