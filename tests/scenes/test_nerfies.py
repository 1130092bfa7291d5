"""The layout of Nerfies: cameras, times and splits land where they should, distortion is undone, faults are told."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scenes.capture import circle, has_estimated_up
from scenes.tiny_scene import assert_refused, edited, write_image

from gsbench import scenes
from gsbench.reading import parse
from gsbench.scenes.nerfies import CameraFile, camera_of

WIDTH, HEIGHT, IDS = 32, 24, ("left_000", "right_000", "left_003", "right_003")
ROTATION = [
    [0.9396926207859084, 0.0, 0.3420201433256687],
    [-0.0593911746138847, -0.984807753012208, 0.16317591116653482],
    [0.33682408883346515, -0.17364817766693033, -0.9254165783983234],
]


def camera(viewmat: np.ndarray, **changes: Any) -> dict[str, Any]:
    """A camera of images of 64 x 48 pixels in rgb/1x."""
    values = {
        "orientation": viewmat[:3, :3].tolist(),
        "position": (-viewmat[:3, :3].T @ viewmat[:3, 3]).tolist(),
        "focal_length": 40.0,
        "principal_point": [33.0, 23.0],
        "skew": 0.0,
        "pixel_aspect_ratio": 1.1,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential": [0.0, 0.0],
        "image_size": [2 * WIDTH, 2 * HEIGHT],
    }
    return values | changes


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two times of a rig; the left camera trains at the first, the right at the second. Red is the image's number."""
    train, val = ["left_000", "right_003"], ["right_000", "left_003"]
    write = {
        "dataset.json": {"ids": IDS, "train_ids": train, "val_ids": val, "count": 4},
        "metadata.json": {name: {"warp_id": int(name[-1]), "camera_id": 0, "appearance_id": 0} for name in IDS},
        **{f"camera/{name}.json": camera(circle(4)[i]) for i, name in enumerate(IDS)},
    }
    (tmp_path / "camera").mkdir()
    for name, content in write.items():
        (tmp_path / name).write_text(json.dumps(content))
    for i, name in enumerate(IDS):
        write_image(tmp_path / f"rgb/2x/{name}.png", np.full((HEIGHT, WIDTH, 3), (50 * i, 9, 7), np.uint8))
    return tmp_path


def test_a_camera_of_the_release():
    """Catches an orientation that is transposed, a lost aspect ratio, and distortion in another order."""
    content = camera(
        np.eye(4),
        orientation=ROTATION,
        position=[0.1, -0.3, 0.2],
        focal_length=1500.0,
        principal_point=[538.0, 955.0],
        pixel_aspect_ratio=1.01,
        image_size=[1072, 1920],
        radial_distortion=[0.05, -0.02, 0.0],
        tangential=[0.001, -0.002],
    )
    viewmat, lens = camera_of(parse(CameraFile, content, ""), "")
    np.testing.assert_allclose(viewmat[:3, 3].numpy(), (-0.16237329, -0.32213839, 0.09930645), rtol=0, atol=1e-8)
    half = lens.resized(536, 960)
    assert half is not None
    np.testing.assert_allclose(half.K, [[750, 0, 269], [0, 757.5, 477.5], [0, 0, 1]], rtol=0, atol=1e-12)
    x = viewmat.numpy() @ (1.31047227, -0.72094453, -2.57624974, 1)
    pixel = half.K @ x[:3] / x[2]
    np.testing.assert_allclose(pixel[:2], (315.21439119, 450.09116385), rtol=0, atol=1e-5)  # the point has 8 decimals
    distorted, _ = cv2.projectPoints(x[None, :3], np.zeros(3), np.zeros(3), half.K, np.array(half.distortion))
    np.testing.assert_allclose(distorted[0, 0], (315.20377160, 450.09678750), rtol=0, atol=1e-5)


def test_cameras_times_and_splits(root):
    """Catches images mixed with cameras, a test view that trains, and intrinsics of another size."""
    scene = scenes.load(root)
    assert has_estimated_up(scene)
    assert [view.name for view in (*scene.train, *scene.test)] == ["left_000", "right_003", "right_000", "left_003"]
    assert [view.time for view in (*scene.train, *scene.test)] == [0.0, 1.0, 0.0, 1.0]
    for view in (*scene.train, *scene.test):
        i = IDS.index(view.name)
        assert round(float(view.image[0, 0, 0]) * 255) == 50 * i
        torch.testing.assert_close(view.camera.viewmat, torch.from_numpy(circle(4)[i]).float(), atol=1e-5, rtol=0)
        torch.testing.assert_close(view.camera.K, torch.tensor([[20.0, 0, 16.5], [0, 22, 11.5], [0, 0, 1]]))
    assert "dataset.json: keys that are not read: 'count'" in scene.notes
    times = json.loads((root / "metadata.json").read_text())
    (root / "metadata.json").write_text(json.dumps({name: {**of, "time_id": 3} for name, of in times.items()}))
    (root / "points.npy").touch()
    notes = {"metadata.json: keys that are not read: 'time_id'", "points.npy is not read"}
    assert {*scenes.load(root).notes} - {*scene.notes} == notes


LEFT = "camera/left_000.json"
FAULTS: list[tuple[Callable[[Path], object], str]] = [
    (edited("dataset.json", lambda content: content.pop("val_ids")), "missing required field val_ids"),
    (edited("dataset.json", lambda content: content.update(val_ids=[])), "as of HyperNeRF's vrig scenes.* got 2 and 0"),
    (edited("dataset.json", lambda content: content.update(val_ids=["left_000"])), "each image once.* 2 different"),
    (edited("dataset.json", lambda content: content["train_ids"].append("../../secret")), "'../../secret'"),
    (edited("metadata.json", lambda content: content.pop("left_003")), "metadata.json: 'left_003': expected an object"),
    (edited("metadata.json", lambda content: content["left_003"].update(warp_id=-1)), "'left_003': expected an object"),
    (edited("metadata.json", lambda content: [x.update(warp_id=0) for x in content.values()]), "several times"),
    (edited(LEFT, lambda content: content.update(skew=0.1)), "left_000.json: skew, radial_distortion: expected 0"),
    (edited(LEFT, lambda content: content.update(radial_distortion=[0, 0, 1])), "k1 k2 0"),
    (edited(LEFT, lambda content: content.update(focal_length=-1)), "positive focal lengths"),
    (edited(LEFT, lambda content: content.update(position=[1, 2])), "left_000.json: position: expected"),
    (edited(LEFT, lambda content: content.update(orientation=[[1, 0, 0]] * 3)), "orientation: .*rigid"),
    (lambda root: (root / LEFT).unlink(), "camera/left_000.json: expected a file"),
    (lambda root: (root / "rgb/2x/left_003.png").unlink(), "rgb/2x/left_003.png .*expected a file"),
]


@pytest.mark.parametrize(("apply", "message"), FAULTS)
def test_faulty_files_are_told(root, apply, message):
    """Catches scenes without a test camera, images without a time, and lenses that are not undone."""
    assert_refused(root, apply, message)
