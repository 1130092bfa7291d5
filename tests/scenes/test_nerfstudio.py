"""A folder with nerfstudio's transforms.json: its cameras, split, times and points."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from capture import circle, has_estimated_up
from tiny_scene import assert_refused, edited, write_image, write_points

from gsbench import scenes

COUNT = 17
MEANS, COLORS = [[0, 0, 1], [1, 2, 3]], [[255, 0, 0], [0, 255, 51]]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A scene of 17 images without times, and a file that has its images in another order."""
    frames = []
    for i, viewmat in enumerate(circle(COUNT)):
        write_image(tmp_path / "images" / f"frame_{i:05d}.png", np.full((6, 8, 3), 10 * i, np.uint8))
        matrix = (np.linalg.inv(viewmat) @ np.diag([1, -1, -1, 1])).tolist()
        frames.append({"file_path": f"images/frame_{i:05d}.png", "transform_matrix": matrix, "colmap_im_id": i})
    order = np.random.default_rng(0).permutation(COUNT)
    content = {"w": 8, "h": 6, "fl_x": 9.0, "fl_y": 9.5, "cx": 4.25, "cy": 3.0, "camera_model": "OPENCV"}
    content |= dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    content |= {"frames": [frames[i] for i in order], "applied_transform": np.eye(4)[:3].tolist()}
    content["ply_file_path"] = "sparse_pc.ply"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    write_points(tmp_path / "sparse_pc.ply", MEANS, COLORS)
    return tmp_path


def content_of(root: Path) -> dict[str, Any]:
    return json.loads((root / "transforms.json").read_text())


def change(root: Path, **values: Any) -> None:
    edited("transforms.json", lambda content: content.update(values))(root)


def test_it_is_read(root):
    """Catches a message that names other files, cameras of other images, another split, and points left out."""
    scene = scenes.load(root)
    assert has_estimated_up(scene)
    assert [len(scene.train), len(scene.val), len(scene.test)] == [15, 0, 2]
    assert [view.name for view in scene.test] == ["images/frame_00007", "images/frame_00015"]
    for view in (*scene.train, *scene.test):
        i = int(view.name[-5:])
        assert view.time == pytest.approx(i / 16)
        assert float(view.image[0, 0, 0]) == pytest.approx(10 * i / 255)
        torch.testing.assert_close(view.camera.viewmat.double(), torch.from_numpy(circle(COUNT)[i]), rtol=0, atol=1e-6)
        assert view.camera.K.tolist() == [[9, 0, 4.25], [0, 9.5, 3], [0, 0, 1]]
    assert scene.points is not None
    torch.testing.assert_close(scene.points.means, torch.tensor([[0.0, 0, 1], [1, 2, 3]]))
    torch.testing.assert_close(scene.points.colors, torch.tensor([[1.0, 0, 0], [0, 1, 0.2]]))
    text = "\n".join(scene.notes)
    assert "every 8th view in the order of time is a test view" in text
    assert "times: the number in each name, 0 to 16" in text
    assert "keys that are not read: 'colmap_im_id'" in text


def test_its_own_split(root):
    """Catches a split that the file states and that is not used."""
    names = [f"images/frame_{i:05d}.png" for i in range(COUNT)]
    change(root, train_filenames=names[:10], val_filenames=names[10:12], test_filenames=[names[16]])
    scene = scenes.load(root)
    assert [len(scene.train), len(scene.val)] == [10, 2]
    assert [view.name for view in scene.test] == ["images/frame_00016"]
    assert scene.notes[0] == "split: as the file lists, 10, 2 and 1 of 17 views"


def test_times_of_the_file_or_of_a_table(root):
    """Catches times of frames that give way to numbers of names, and a times.csv not read or not in the fingerprint."""
    plain = content_of(root)["frames"]
    change(root, frames=[frame | {"time": -float(frame["file_path"][-9:-4])} for frame in plain])
    timed = scenes.load(root)
    change(root, frames=plain)
    before = scenes.load(root).fingerprint
    (root / "times.csv").write_text("name,time\n" + "".join(f"frame_{i:05d},{-i}\n" for i in range(COUNT)))
    tabled = scenes.load(root)
    for scene in (timed, tabled):
        assert [view.name for view in scene.test] == ["images/frame_00009", "images/frame_00001"]
    assert tabled.fingerprint != before


def test_fingerprint(root):
    """Catches other points, another file or another image under the same fingerprint."""
    before = {scenes.load(root).fingerprint}
    write_points(root / "sparse_pc.ply", [[0, 0, 1], [1, 2, 4]], COLORS)
    before.add(scenes.load(root).fingerprint)
    change(root, fl_x=9.25)
    before.add(scenes.load(root).fingerprint)
    write_image(root / "images" / "frame_00003.png", np.full((6, 8, 3), 1, np.uint8))
    assert scenes.load(root).fingerprint not in before
    assert len(before) == 3


FAULTS: list[tuple[dict[str, Any] | Callable[[Path], None], str]] = [
    ({"camera_model": "OPENCV_FISHEYE"}, "transforms.json: camera_model: expected a pinhole.*data.md#cameras"),
    ({"k1": 0.02}, "transforms.json: k1: .*undistort.*data.md#cameras"),
    ({"ply_file_path": "../x.ply"}, "ply_file_path: expected a path inside"),
    ({"ply_file_path": 3}, "ply_file_path: expected the path of a PLY"),
    ({"ply_file_path": "none.ply"}, "none.ply"),
    ({"train_filenames": ["images/frame_00000.png"]}, "1 and 0: list them"),
    ({"train_filenames": ["images/x.png"]}, "train_filenames: expected file_path of frames, got .*add its frame"),
    (
        {"train_filenames": ["images/frame_00000.png"] * 2, "test_filenames": ["images/frame_00001.png"]},
        "train_filenames: expected each image once",
    ),
    ({"test_filenames": 3}, "test_filenames: expected file_path of frames, got 3"),
    ({"frames": []}, "at least one frame"),
    ({"w": math.inf}, "w: expected a finite number"),
    (
        edited("transforms.json", lambda content: content.update(frames=content["frames"][:7])),
        "at least 8, .*list train_filenames and test_filenames",
    ),
    (
        edited("transforms.json", lambda content: content["frames"][3].update(time=0.5)),
        r"frames\[3\]\.time: this frame has a time and the first",
    ),
]


@pytest.mark.parametrize(("fault", "words"), FAULTS)
def test_what_is_wrong_is_one_line(root, fault, words):
    """Catches a stack trace, lists that name images of no frame, and a scene without a test view."""
    assert_refused(root, fault if callable(fault) else lambda folder: change(folder, **fault), words)


def test_views_that_train_and_test_share_are_told(root):
    """Catches lists that overlap, and a frame that is there twice, which may be once in train and once in test."""
    names = [frame["file_path"] for frame in content_of(root)["frames"]]
    change(root, train_filenames=names, test_filenames=names[:2])
    assert any("2 of 2 views of test are views of train too" in note for note in scenes.load(root).notes)
