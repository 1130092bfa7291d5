"""A data set small enough to break in every way: 8x6 pixels, two training frames, one of val and one of test."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike
from plyfile import PlyData, PlyElement

from gsbench import scenes
from gsbench.errors import InputError

# An OpenGL camera at (0, 0, 4) that looks down its own -z axis at the origin.
FRONT = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 4.0], [0, 0, 0, 1.0]]
# The same, from (4, 0, 0): x axis along -z of the world.
SIDE = [[0, 0, 1.0, 4.0], [0, 1.0, 0, 0], [-1.0, 0, 0, 0], [0, 0, 0, 1.0]]
COUNTS = {"train": 2, "val": 1, "test": 1}
IMAGES = ("train/r_0.png", "train/r_1.png", "val/r_0.png", "test/r_0.png")


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write grey [H, W], RGB or RGBA as PNG by OpenCV, whose order is BGR."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = pixels if pixels.ndim == 2 else np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], axis=-1)
    assert cv2.imwrite(str(path), bgr)


def write_images(root: Path, pixels: np.ndarray) -> None:
    """Write the same pixels as every image of the data set."""
    for name in IMAGES:
        write_image(root / name, pixels)


def edited(name: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Return what applies `change` to the content of a JSON file of a folder."""

    def apply(root: Path) -> None:
        content = json.loads((root / name).read_text())
        change(content)
        (root / name).write_text(json.dumps(content))

    return apply


def edit(root: Path, change: Callable[[dict[str, Any]], object], *splits: str) -> None:
    """Apply `change` to the content of transforms_<split>.json, that of train if no split is named."""
    for split in splits or ("train",):
        edited(f"transforms_{split}.json", change)(root)


def write_points(path: Path, means: ArrayLike, colors: ArrayLike, **columns: ArrayLike) -> None:
    """Write points [P, 3] with their colours, [P, 3] or one for all, and other columns of floats, as an ascii PLY."""
    kinds = [*((x, "f4") for x in "xyz"), *((x, "u1") for x in ("red", "green", "blue")), *((x, "f4") for x in columns)]
    table = np.zeros(len(np.asarray(means)), kinds)
    rgb = np.broadcast_to(colors, (len(table), 3))
    for (name, _), column in zip(kinds, (*np.transpose(means), *rgb.T, *columns.values()), strict=True):
        table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=True).write(str(path))


def write_tiny(root: Path) -> Path:
    random = np.random.default_rng(0)
    for split, count in COUNTS.items():
        frames = []
        for index in range(count):
            write_image(root / split / f"r_{index}.png", random.integers(0, 256, (6, 8, 4), np.uint8))
            matrix = SIDE if index else FRONT
            frames.append({"file_path": f"./{split}/r_{index}", "time": float(index), "transform_matrix": matrix})
        content = {"camera_angle_x": 0.8, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


def assert_refused(root: Path, apply: Callable[[Path], object], message: str) -> None:
    """Assert that a scene with a fault is refused in one line that matches a pattern."""
    apply(root)
    with pytest.raises(InputError, match=message) as caught:
        scenes.load(root)
    check_message(caught.value)


def check_message(error: InputError, *parts: str) -> None:
    """Assert that an error is one line that names all these parts."""
    assert "\n" not in str(error)
    for part in parts:
        assert part in str(error)
