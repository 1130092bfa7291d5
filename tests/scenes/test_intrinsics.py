"""Intrinsics of transforms*.json: those of frames, fields of view along both axes, camera models, image sizes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_scene import check_message, edit, write_image, write_images

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.scenes.shots import Lens

WIDTH, HEIGHT = 8, 6  # of the tiny scene
ANGLE = 4 / math.tan(0.4)  # the focal length that the tiny scene states as a field of view
WITHOUT: dict[str, Any] = {"camera_angle_x": None}


def write(root: Path, file: dict[str, Any], frame: dict[str, Any]) -> None:
    """Set keys of transforms_train.json and of its second frame, of which None stands for no field of view."""
    edit(root, lambda content: [content.update(file), content["frames"][1].update(frame)])
    if file.get("camera_angle_x", 0.8) is None:
        edit(root, lambda content: content.pop("camera_angle_x"))


def numbers(view: scenes.View) -> tuple[float, float, float, float]:
    K = view.camera.K.tolist()
    return K[0][0], K[1][1], K[0][2], K[1][2]


@pytest.mark.parametrize(
    ("file", "frame", "first", "second"),
    [
        ({}, {"fl_x": 20.0, "fl_y": 22.0, "cx": 3.0, "cy": 2.0}, (ANGLE, ANGLE, 4, 3), (20, 22, 3, 2)),
        ({}, {"fl_x": 20.0}, (ANGLE, ANGLE, 4, 3), (20, 20, 4, 3)),
        ({}, {"camera_angle_x": 2 * math.atan(4 / 20)}, (ANGLE, ANGLE, 4, 3), (20, 20, 4, 3)),
        ({}, {"cx": 3.5, "w": 8, "h": 6}, (ANGLE, ANGLE, 4, 3), (ANGLE, ANGLE, 3.5, 3)),
        ({"fl_x": ANGLE, "fl_y": 12.0, "cx": 3}, {"fl_x": 20.0, "fl_y": 22.0}, (ANGLE, 12, 3, 3), (20, 22, 3, 3)),
        ({"fl_x": ANGLE, "fl_y": 20.0}, {"fl_x": 20.0}, (ANGLE, 20, 4, 3), (20, 20, 4, 3)),
        ({"camera_angle_y": 2 * math.atan(3 / 15)}, {}, (ANGLE, 15, 4, 3), (ANGLE, 15, 4, 3)),
        ({"camera_angle_y": 2 * math.atan(3 / 15), "fl_y": 15.001}, {}, (ANGLE, 15.001, 4, 3), (ANGLE, 15.001, 4, 3)),
        (WITHOUT | {"camera_angle_y": 2 * math.atan(3 / 15)}, {}, (15, 15, 4, 3), (15, 15, 4, 3)),
        (WITHOUT | {"fl_x": 10.0, "fl_y": 12.0, "cx": 3.0, "cy": 5.0}, {}, (10, 12, 3, 5), (10, 12, 3, 5)),
        (WITHOUT | {"fl_x": 10.0, "w": 8, "h": 6}, {}, (10, 10, 4, 3), (10, 10, 4, 3)),
    ],
)
def test_a_frame_comes_before_its_file(tiny, file, frame, first, second):
    """Catches intrinsics of frames that are left out, and those of one frame used for another."""
    write(tiny, file, frame)
    views = scenes.load(tiny).train
    assert numbers(views[0]) == pytest.approx(first)
    assert numbers(views[1]) == pytest.approx(second)


@pytest.mark.parametrize(
    ("file", "count", "words"),
    [
        ({"fl_x": 10.0, "cx": 0.5, "cy": 0.5}, 2, "focal lengths 10 and 10, principal point 0.5 and 0.5 for 8x6"),
        ({"fl_x": 10.0, "cx": 9.0}, 2, "principal point 9 and 3 for 8x6: are they in pixels"),
        ({"fl_x": 0.7}, 2, "focal lengths 0.7 and 0.7"),
        ({"fl_x": 10.0, "cx": 1.0, "cy": 5.0}, 0, ""),
        ({"fl_x": 0.8}, 0, ""),
    ],
)
def test_intrinsics_in_other_units_are_told(tiny, file, count, words):
    """Catches parts of the width or millimetres that are read as pixels, which shows every camera a wrong picture."""
    write(tiny, WITHOUT | file, {})
    notes = " ".join(scenes.load(tiny).notes)
    assert (f"{count} of 4 images are of a camera" in notes) == (count > 0)
    assert words in notes


REFUSED: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "fl_x and the angle": ({"fl_x": 10.0}, {}, "fl_x: expected 9.46089 as camera_angle_x says for 8 pixels, got 10"),
    "fl_y and the angle": ({"fl_x": ANGLE, "fl_y": 15.0, "camera_angle_y": 1.0}, {}, "fl_y: expected 5.49"),
    "both in a frame": ({}, {"fl_x": 20.0, "camera_angle_x": 0.8}, r"frames\[1\]: fl_x: expected"),
    "x without y": ({"fl_x": ANGLE, "fl_y": 12.0}, {"fl_x": 20.0}, r"frames\[1\]: fl_x or camera_angle_x: expected"),
    "angle_y": ({"camera_angle_y": 3.2}, {}, "camera_angle_y: expected radians"),
    "distorted frame": ({}, {"k1": 0.1}, r"frames\[1\]: k1: expected a pinhole camera"),
    "k5": ({"k5": 0.1}, {}, "k5: expected a pinhole"),
    "list of coefficients": ({}, {"distortion_params": [0, 0.1]}, "distortion_params: expected a pinhole"),
    "fisheye": ({"is_fisheye": True}, {}, "is_fisheye: expected a pinhole camera, got true: undistort"),
    "fisheye in a frame": ({"is_fisheye": False}, {"is_fisheye": 1}, r"frames\[1\]: is_fisheye"),
    "no model": ({"camera_model": None}, {}, "camera_model: expected a pinhole camera"),
    "panorama": ({"equirectangular": True}, {}, "equirectangular"),
    "size of a frame alone": (
        {"w": 8, "h": 6, "cx": 3.0},
        {"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 20.0, "cy": 6.0},
        r"frames\[1\]: cx: expected its own, as its w or h is not that of the whole file",
    ),
    "size of a frame": ({}, {"w": 16, "h": 8}, "expected 16x8 as its camera, .*, got 8x6"),
    "width alone": ({}, {"w": 16}, r"frames\[1\]: w: expected the images' own 8, got 16"),
    "half a pixel": ({}, {"w": 16.5, "h": 12}, r"frames\[1\]: w: "),
} | {
    f"model {model}": ({}, {"camera_model": model}, r"frames\[1\]: camera_model: expected a pinhole camera .*undistort")
    for model in ("OPENCV_FISHEYE", "EQUIRECTANGULAR", "ORTHOGRAPHIC", "fisheye", "THIN_PRISM_FISHEYE", "FOV", 3)
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_pinhole_or_contradicts_is_refused(tiny, kind):
    """Catches a fisheye read as a pinhole, and one of two numbers that contradict taken in silence."""
    file, frame, words = REFUSED[kind]
    write(tiny, file, frame)
    with pytest.raises(InputError, match=words) as caught:
        scenes.load(tiny)
    check_message(caught.value)


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "opencv", "RADIAL"])
def test_pinholes_by_any_name(tiny, model):
    """Catches nerfstudio's files, whose model is OPENCV even if its coefficients are zero, refused."""
    coefficients = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    write(tiny, {"camera_model": model, "is_fisheye": False, **coefficients}, {"distortion_params": [0.0] * 6})
    assert numbers(scenes.load(tiny).train[1])[0] == pytest.approx(ANGLE)


def test_images_smaller_than_the_file_says(tiny, capsys):
    """Catches images of a folder images_2 refused, or read with the intrinsics of the full size, in silence."""
    values = {"w": 17, "h": 12, "fl_x": 20.0, "fl_y": 30.0, "cx": 8.5, "cy": 5.0}
    edit(tiny, lambda content: [content.pop("camera_angle_x"), content.update(values)], "train", "val", "test")
    scene = scenes.load(tiny)
    expected = (20 * 8 / 17, 15, 4, 2.5)
    assert numbers(scene.train[0]) == pytest.approx(expected)
    assert scene.notes == (
        "images of 8x6 are resized from those of their camera, 17x12, whose intrinsics are scaled with them",
    )
    assert capsys.readouterr().err == f"tiny: {scene.notes[0]}\n"
    assert numbers(scenes.load(tiny, downscale=2).train[0]) == pytest.approx([value / 2 for value in expected])
    edit(tiny, lambda content: content.update(h=13))
    write_image(tiny / "train/r_1.png", np.zeros((7, 8, 3), np.uint8))  # each fits 17 x 13
    with pytest.raises(InputError, match="expected 8x6 as the first image, got 8x7"):
        scenes.load(tiny)


@pytest.mark.parametrize(
    ("image", "camera", "fits"),
    [
        ((8, 6), (16, 12), True),
        ((8, 6), (15, 11), True),
        ((8, 6), (32, 24), True),
        ((8, 6), (12, 9), True),
        ((8, 6), (4, 3), True),
        ((65, 49), (33, 25), True),
        ((33, 25), (65, 49), True),
        ((32, 24), (65, 49), True),
        ((1600, 1037), (5187, 3361), True),
        ((8, 6), (16, 16), False),
        ((8, 6), (8, 7), False),
        ((8, 6), (4, 4), False),
        ((640, 470), (640, 480), False),
        ((638, 478), (640, 480), False),
        ((24, 24), (65, 49), False),
    ],
)
def test_one_ratio(image, camera, fits):
    """Catches a cropped image taken for a reduced one, and rounded sizes refused."""
    lens = Lens(*camera, np.eye(3), (0, 0, 0, 0)).resized(*image)
    assert (lens is not None) == fits
    if lens is not None:
        assert lens.K.diagonal() == pytest.approx([image[0] / camera[0], image[1] / camera[1], 1])


def test_odd_sizes_are_rounded(tiny, capsys):
    """Catches a refusal of 65 x 49, K divided by the factor where the sides are rounded, and another image."""
    random = np.random.default_rng(0)
    ramp = np.stack([*np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, 1, 11)), np.zeros((11, 13))], -1)
    write_images(tiny, (random.integers(0, 2, (11, 13, 3)) + np.rint(ramp * 250)).astype(np.uint8))
    whole, reduced = scenes.load(tiny).train[0], scenes.load(tiny, downscale=2).train[0]
    assert (reduced.camera.width, reduced.camera.height) == (7, 6)
    assert reduced.image.shape == (6, 7, 3)
    assert numbers(reduced) == pytest.approx(
        [k * side for k, side in zip(numbers(whole), (7 / 13, 6 / 11) * 2, strict=True)]
    )
    centers = (np.arange(7) + 0.5) * 13 / 7 - 0.5
    assert reduced.image[3, 1:-1, 0].numpy() == pytest.approx(centers[1:-1] / 12 * 250 / 255, abs=0.005)
    assert "images of 13x11 are reduced to 7x6, as 2 does not divide their size" in capsys.readouterr().err
    assert scenes.load(tiny, downscale=2, resize="pillow").train[0].image.shape == (6, 7, 3)


def test_unknown_keys_are_named_once(tiny, capsys):
    """Catches a key that nobody reads and nobody hears of, and a line for each frame."""
    write(tiny, {"aabb_scale": 16, "a\nb": 1}, {"depth_path": "x", "rotation": 0.1})
    scene = scenes.load(tiny)
    assert scene.notes == (r"transforms_train.json: keys that are not read: 'a\nb', 'aabb_scale', 'depth_path'",)
    assert capsys.readouterr().err.count("\n") == 1
