"""The layout of Dynamic 3D Gaussians: cameras, times, masks and points land where they should; faults are told."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scenes.capture import circle, has_estimated_up
from scenes.tiny_scene import assert_refused, edited, write_image

from gsbench import scenes

WIDTH, HEIGHT, TIMES, TEST_CAMERA = 12, 12, 3, 2
K = [[10.0, 0, 5.5], [0, 11.0, 6.5], [0, 0, 1]]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Five cameras at three times; the red of an image is its camera, the green its time; a mask is 1 at the right."""
    viewmats = circle(5)
    for split, cameras in (("train", [0, 1, 3, 4]), ("test", [TEST_CAMERA])):
        meta = {
            "w": WIDTH,
            "h": HEIGHT,
            "k": [[K] * len(cameras)] * TIMES,
            "w2c": [viewmats[cameras].tolist()] * TIMES,
            "fn": [[f"{camera}/{3 * time:06d}.png" for camera in cameras] for time in range(TIMES)],
            "cam_id": [cameras] * TIMES,
        }
        (tmp_path / f"{split}_meta.json").write_text(json.dumps(meta))
        for time in range(TIMES):
            for camera in cameras:
                pixels = np.full((HEIGHT, WIDTH, 3), (camera, 100 + time, 7), np.uint8)
                write_image(tmp_path / f"ims/{camera}/{3 * time:06d}.png", pixels)
                mask = (np.arange(WIDTH) >= WIDTH // 2).astype(np.uint8)[None].repeat(HEIGHT, 0)
                write_image(tmp_path / f"seg/{camera}/{3 * time:06d}.png", mask)
    return tmp_path


def edit(change: Callable[[dict[str, Any]], object], split: str = "train") -> Callable[[Path], None]:
    return edited(f"{split}_meta.json", change)


def test_cameras_times_masks_and_splits(root):
    """Catches cameras mixed with times, an inverted pose, a mask of another image, and a test camera that trains."""
    scene = scenes.load(root)
    assert has_estimated_up(scene)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (12, 0, 3)
    assert [view.name for view in scene.train[3:6]] == ["4/000000", "0/000003", "1/000003"]
    assert [view.time for view in scene.test] == [0.0, 0.5, 1.0]
    torch.testing.assert_close(scene.train[4].camera.viewmat, torch.from_numpy(circle(5)[0]).float())
    view = scene.test[1]
    torch.testing.assert_close(view.image[0, 0] * 255, torch.tensor([2.0, 101.0, 7.0]))
    torch.testing.assert_close(view.camera.viewmat, torch.from_numpy(circle(5)[TEST_CAMERA]).float())
    torch.testing.assert_close(view.camera.K, torch.tensor(K))
    assert view.regions is not None
    assert view.regions[0].tolist() == [0] * 6 + [1] * 6
    assert scene.points is None
    half = scenes.load(root, downscale=2).test[1]
    torch.testing.assert_close(half.camera.K[:2], torch.tensor(K)[:2] / 2)
    assert half.regions is not None
    assert half.regions[0].tolist() == [0] * 3 + [1] * 3


def test_whole_cameras_can_be_val(root):
    """Catches views that are not ordered by time and then camera, so that val_every would mix cameras."""
    scene = scenes.load(root).with_val(4)
    assert [view.name for view in scene.val] == ["4/000000", "4/000003", "4/000006"]


def test_initial_points(root):
    """Catches the mask of a point taken for its colour, and a file that the fingerprint does not cover."""
    without = scenes.load(root).fingerprint
    rows = np.array([(0.5, -0.25, 0.25, 1, 0.5, 0, 1), (0.25, 0.5, -0.5, 0, 0.25, 0.75, 0)])
    np.savez(root / "init_pt_cld.npz", data=rows)
    scene = scenes.load(root)
    assert scene.points is not None
    torch.testing.assert_close(scene.points.means.double().numpy(), rows[:, :3])
    torch.testing.assert_close(scene.points.colors.double().numpy(), rows[:, 3:6])
    assert scene.fingerprint != without


def test_what_is_not_understood_is_told(root):
    """Catches a key that is dropped in silence, and a camera of both splits."""
    edit(lambda content: content.update(gain=[1, 2]))(root)
    edit(lambda content: content.update(cam_id=[[3]] * TIMES), "test")(root)
    notes = scenes.load(root).notes
    assert "train_meta.json: keys that are not read: 'gain'" in notes
    assert "cameras 3 of test are cameras of train too" in notes


def test_times_that_are_out_of_step_are_told(root):
    """Catches test images of other moments than those of train, in silence, and numbers of cameras taken for times."""
    edit(lambda content: content.update(fn=content["fn"][::-1]), "test")(root)
    assert "images of time 0 have different numbers in their names, such as 000000, 000006: are" in str(
        scenes.load(root).notes
    )
    for time in range(TIMES):
        for camera in range(5):
            for folder in ("ims", "seg"):
                path = root / f"{folder}/{time}/cam{camera}.png"
                path.parent.mkdir(exist_ok=True)
                path.write_bytes((root / f"{folder}/{camera}/{3 * time:06d}.png").read_bytes())
    for split, cameras in (("train", [0, 1, 3, 4]), ("test", [TEST_CAMERA])):
        names = [[f"{time}/cam{camera}.png" for camera in cameras] for time in range(TIMES)]
        edit(lambda content, names=names: content.update(fn=names), split)(root)
    assert "are they of one moment" not in str(scenes.load(root).notes)


def points(**arrays: np.ndarray) -> Callable[[Path], object]:
    return lambda root: np.savez(root / "init_pt_cld.npz", **arrays)


FAULTS: list[tuple[Callable[[Path], object], str]] = [
    (lambda root: (root / "test_meta.json").unlink(), "test_meta.json: expected a file, found none"),
    (lambda root: (root / "train_meta.json").write_text("[]"), "expected a JSON object with w, h, k"),
    (edit(lambda content: content.pop("k")), r"train_meta\.json: .*missing required field k"),
    (edit(lambda content: content["fn"][1].pop()), "one image and number for each camera at each time"),
    (edit(lambda content: content.update(fn=[])), "one image and number"),
    (edit(lambda content: content.update(fn=content["fn"][:1] * 3)), "fn: expected each image once"),
    (edit(lambda content: content["k"].pop()), r"k: expected numbers of shape \[3, 4, 3, 3\]"),
    (edit(lambda content: content["w2c"][1][2].pop()), r"w2c: expected numbers of shape"),
    (edit(lambda content: content["w2c"][1][2][0].__setitem__(0, 3.0)), r"w2c\[1\]\[2\]: expected a rigid world-to"),
    (edit(lambda content: content["k"][1][2][0].__setitem__(1, 0.5)), r"k\[1\]\[2\]: expected fx 0 cx"),
    (edit(lambda content: content["k"][1][2][0].__setitem__(0, -1.0)), r"k\[1\]\[2\]: .* positive fx"),
    (edit(lambda content: content.update(w=2 * WIDTH)), f"expected 24x12 as its camera.* got {WIDTH}x{HEIGHT}"),
    (edit(lambda content: content.update(w=0)), "expected the size of the images"),
    (edit(lambda content: content["fn"][0].__setitem__(0, "../../secret.png")), r"fn\[0\]\[0\]: .* leaves it"),
    (edit(lambda content: [content[key].pop() for key in ("fn", "k", "w2c", "cam_id")], "test"), "got 3 and 2"),
    (lambda root: (root / "ims/3/000003.png").unlink(), r"ims/3/000003\.png .*fn\[1\]\[2\].*found none"),
    (lambda root: (root / "seg/3/000003.png").unlink(), r"seg/3/000003\.png .*found none"),
    (points(points=np.zeros((4, 7))), "init_pt_cld.npz: expected an archive with the array 'data'"),
    (points(data=np.zeros((4, 6))), r"expected finite x y z r g b mask of each point, got \[4, 6\]"),
    (points(data=np.full((4, 7), 200.0)), r"expected colours in \[0, 1\], got 200"),
    (points(data=np.array([{}])), "expected an archive"),
    (lambda root: (root / "init_pt_cld.npz").write_bytes(b"PK\3\4"), "expected an archive"),
]


@pytest.mark.parametrize(("apply", "message"), FAULTS)
def test_faulty_files_are_told(root, apply, message):
    """Catches lists that are read askew, cameras that are no pinholes, missing files, and pickles."""
    assert_refused(root, apply, message)
