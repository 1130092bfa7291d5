"""Load scenes in the Blender layout of NeRF-synthetic, D-NeRF and 7DGS-PBR: transforms_*.json and PNG images."""

import json
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.reading import MAX_JSON, parse_json, read_file
from gsbench.scenes import files, images
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Camera, Scene, View

_RIGID_TOLERANCE = 1e-4  # D-NeRF writes single precision: its trex is orthonormal to 2.2e-6
_SMALLEST = 1e-6  # pixels; smaller lengths become zero in single precision
_LARGEST = 1e30  # largest number in a file; its square in double and its sums in single precision are finite
_MASKS = "masks"  # the folder beside the images with the object number of each pixel, in PNG files of the same names
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # as instant-ngp and nerfstudio write them


@dataclass(frozen=True)
class _Intrinsics:
    """Hold the camera intrinsics of a JSON file, in pixels of the full image; missing ones follow from the size."""

    angle_x: float | None  # horizontal field of view in radians; None if the focal length is given
    focal: tuple[float, float] | None
    principal: tuple[float | None, float | None]
    size: tuple[float | None, float | None]  # width and height that the file states

    def matrix(self, width: int, height: int, downscale: int) -> Tensor:  # [3, 3] float32
        """Compute the intrinsics K of an image of width x height pixels after it was reduced by `downscale`.

        The first two rows of K are divided by the factor, because pixel centres are at +0.5.
        """
        if self.focal is not None:
            fx, fy = self.focal
        else:
            assert self.angle_x is not None
            fx = fy = 0.5 * width / math.tan(0.5 * self.angle_x)
        cx = width / 2 if self.principal[0] is None else self.principal[0]
        cy = height / 2 if self.principal[1] is None else self.principal[1]
        s = 1 / downscale
        return torch.tensor([[fx * s, 0, cx * s], [0, fy * s, cy * s], [0, 0, 1]], dtype=torch.float32)


@dataclass(frozen=True)
class _Frame:
    """Hold a checked entry of the list `frames` of a JSON file; its image is not read yet."""

    path: Path
    mask: Path | None  # file of the object number of each pixel
    name: str  # relative to the scene's folder: "train/r_000.png"
    where: str  # the image's path and the field that names it, for messages
    time: float | None
    viewmat: Tensor  # [4, 4] float64


@dataclass(frozen=True)
class _Split:
    """Hold the checked content of the file transforms_<split>.json."""

    source: Path
    intrinsics: _Intrinsics
    frames: list[_Frame]
    digest: str


def load(root: Path, *, downscale: int, background: tuple[float, float, float], resize: str | None = None) -> Scene:
    """Load a scene in the Blender layout; see `gsbench.scenes.load` for the arguments.

    Each file transforms_{train,val,test}.json has

    - `camera_angle_x` in radians, or `fl_x` and optionally `fl_y`, `cx`, `cy`, `w`, `h` in pixels of the full image;
    - `frames`, a list of objects with `file_path` (relative to the folder), `transform_matrix` (camera to world, OpenGL
      axes), and optionally `time` in [0, 1].

    transforms_val.json may be missing. A file points3d.ply is ignored, because in these data sets it has random points.

    An optional folder `masks` beside the images has an 8-bit grey PNG for each image, with the number of the object in
    each pixel (`View.regions`). Masks are not used in training or measurement.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file and field.
    """
    name = Path(os.path.abspath(root)).name  # if the folder is a link, the name of the link
    root = root.resolve()
    splits = {"train": _read_split(root, "train"), "test": _read_split(root, "test")}
    if os.path.lexists(root / "transforms_val.json"):  # a broken link is an error, not a data set without val
        splits["val"] = _read_split(root, "val")
    _check_times(splits)
    views, digests = _read_views(root, splits, downscale, background, resize)
    digests |= {split.source.name: split.digest for split in splits.values()}
    return standard_scene(
        name=name,
        train=views["train"],
        val=views.get("val", []),
        test=views["test"],
        background=background,
        points=None,
        fingerprint=files.fingerprint(digests),
    )


def _read_split(root: Path, name: str) -> _Split:
    """Read and check the file transforms_<name>.json in the folder `root`."""
    source = root / f"transforms_{name}.json"
    data = read_file(source, str(source), MAX_JSON)
    content = parse_json(data, str(source))
    if not isinstance(content, dict):
        raise InputError(f"{source}: expected a JSON object with 'frames', got a {type(content).__name__}")
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{source}: frames: expected a list of frames, got {_brief(frames)}")
    if not frames:
        raise InputError(f"{source}: frames: expected at least one frame, the {name} split is empty")
    return _Split(
        source,
        _read_intrinsics(content, source),
        [_read_frame(root, frame, source, index) for index, frame in enumerate(frames)],
        files.digest(data),
    )


def _read_intrinsics(content: dict[str, Any], source: Path) -> _Intrinsics:
    """Read the intrinsics of a JSON file: focal length and principal point in pixels, or the field of view."""
    given = ("camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h", *_DISTORTION)
    values = {key: _number(content[key], f"{source}: {key}") for key in given if key in content}
    for key in _DISTORTION:
        if values.get(key, 0) != 0:
            raise InputError(f"{source}: {key}: expected a pinhole camera, got {values[key]}: undistort the images")
    for key in ("fl_x", "fl_y", "w", "h"):
        if key in values and values[key] < _SMALLEST:
            raise InputError(f"{source}: {key}: expected a positive number of pixels, got {values[key]}")
    angle = values.get("camera_angle_x")
    if angle is not None and not 1e-6 < angle < math.pi:
        raise InputError(f"{source}: camera_angle_x: expected radians between 0 and pi, got {angle}")
    focal = (values["fl_x"], values.get("fl_y", values["fl_x"])) if "fl_x" in values else None
    if focal is None and angle is None:
        raise InputError(f"{source}: expected intrinsics as 'camera_angle_x' or 'fl_x', found neither")
    return _Intrinsics(angle, focal, (values.get("cx"), values.get("cy")), (values.get("w"), values.get("h")))


def _read_frame(root: Path, frame: object, source: Path, index: int) -> _Frame:
    """Check entry number `index` of the list `frames` of a JSON file: image path, time and camera pose."""
    where = f"{source}: frames[{index}]"
    if not isinstance(frame, dict):
        raise InputError(f"{where}: expected an object with 'file_path' and 'transform_matrix', got {_brief(frame)}")
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}.file_path: expected the image's path, got {_brief(name)}")
    with_suffix = name if name.lower().endswith(".png") else f"{name}.png"
    path = files.find_inside(root, with_suffix, f"{where}.file_path")
    time = None
    if "time" in frame:
        time = _number(frame["time"], f"{where}.time")
        if not 0 <= time <= 1:
            raise InputError(f"{where}.time: expected a time in [0, 1], got {time}")
    viewmat = _viewmat(frame.get("transform_matrix"), f"{where}.transform_matrix")
    named_by = f"{path} ({source.name}, frames[{index}].file_path)"
    mask = path.parent / _MASKS / path.name if (path.parent / _MASKS).is_dir() else None
    return _Frame(path, mask, path.relative_to(root).as_posix(), named_by, time, viewmat)


def _viewmat(
    matrix: object,  # [4, 4] nested lists: camera to world, OpenGL axes (x right, y up, z backward)
    where: str,
) -> Tensor:  # [4, 4] float64: world to camera, OpenCV axes (x right, y down, z forward)
    """Convert a camera-to-world matrix in OpenGL axes to a world-to-camera matrix in OpenCV axes.

    Raises:
        InputError: the matrix is not a rigid motion.
    """
    rows = matrix if isinstance(matrix, list) else []
    if len(rows) != 4 or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got {_brief(matrix)}")
    c2w: NDArray[np.float64] = np.array([[_number(value, where) for value in row] for row in rows])
    if not np.allclose(c2w[3], [0, 0, 0, 1], rtol=0, atol=_RIGID_TOLERANCE):
        raise InputError(f"{where}: expected the last row 0 0 0 1, got {c2w[3].tolist()}")
    rotation = c2w[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    determinant = np.linalg.det(rotation)
    if error > _RIGID_TOLERANCE or determinant < 0:
        raise InputError(
            f"{where}: expected a rigid camera-to-world matrix (R^T R = I to {_RIGID_TOLERANCE}, det R = +1), got an "
            f"error of {error:.2g} and a determinant of {determinant:.6g}: take out scale, shear and mirroring"
        )
    turned = rotation * [1, -1, -1]
    viewmat = np.eye(4)
    viewmat[:3, :3] = turned.T
    viewmat[:3, 3] = -turned.T @ c2w[:3, 3]
    return torch.from_numpy(viewmat)


def _check_times(splits: dict[str, _Split]) -> None:
    """Raise InputError if some frames of a data set have a time and others do not."""
    first = splits["train"].frames[0].time
    for split in splits.values():
        for index, frame in enumerate(split.frames):
            if (frame.time is None) != (first is None):
                has, other = ("no time", "has one") if frame.time is None else ("a time", "has none")
                raise InputError(
                    f"{split.source}: frames[{index}].time: this frame has {has} and the first training frame {other}: "
                    "give a time to all frames or to none"
                )


def _read_views(
    root: Path,
    splits: dict[str, _Split],
    downscale: int,
    background: tuple[float, float, float],
    resize: str | None,
) -> tuple[dict[str, list[View]], dict[str, str]]:
    """Read all images by several threads.

    Images of a small scene are stored as floats, those of a large scene in 8 bits. All images must have the same size.

    Returns:
        The views of each split, and the SHA-256 of each image file by name.
    """
    listed = [(split, frame) for split in splits.values() for frame in split.frames]
    first = listed[0][1]
    data = images.read_image(first.path, first.where)
    expected = images.png_size(data, first.where)
    in_8_bits = resize is None and images.stays_in_8_bits(data, expected, len(listed), downscale)

    def read(entry: tuple[_Split, _Frame]) -> tuple[View, str]:
        split, frame = entry
        data = images.read_image(frame.path, frame.where)
        _check_size(images.png_size(data, frame.where), expected, split, frame)
        decoded = images.decode_png(data, frame.where)
        is_kept = in_8_bits and decoded.dtype.name == "uint8"
        if is_kept:
            image = torch.from_numpy(decoded)
        else:
            image = images.composite(decoded, background, downscale, frame.where, resize)
        camera = Camera(frame.viewmat, split.intrinsics.matrix(*expected, downscale), image.shape[1], image.shape[0])
        alpha = None if is_kept else images.alpha_of(decoded, downscale)
        regions = None if frame.mask is None else _read_mask(root, frame, expected, downscale)
        name = frame.name[: -len(".png")]
        return View(name, camera, frame.time, image, background, alpha, regions), files.digest(data)

    masked = any(frame.mask is not None for _, frame in listed)
    kept = (4 if in_8_bits else 13) + masked  # bytes a pixel; alpha and object number have one byte each
    threads = images.count_readers(expected, len(listed), downscale, first.where, kept)
    with images.quiet_opencv(), ThreadPoolExecutor(threads) as pool:
        decoded = pool.map(read, listed)
        digests = {}
        views: dict[str, list[View]] = {name: [] for name in splits}
        for name, split in splits.items():
            for frame in split.frames:
                view, digests[frame.name] = next(decoded)
                views[name].append(view)
    return views, digests


def _read_mask(root: Path, frame: _Frame, size: tuple[int, int], downscale: int) -> Tensor:  # [H, W] 8 bits
    """Read the mask of an image: a PNG with the number of the object in each pixel. Raise InputError if this fails."""
    assert frame.mask is not None
    where = f"{frame.mask} (the mask of {frame.name}; without a folder '{_MASKS}' a scene has no regions)"
    path = files.find_inside(root, frame.mask.relative_to(root).as_posix(), where)
    return images.decode_regions(images.read_image(path, where), size, downscale, where)


def _check_size(size: tuple[int, int], expected: tuple[int, int], split: _Split, frame: _Frame) -> None:
    """Raise InputError if an image has another size than the first image, or than its JSON file states."""
    if size != expected:
        raise InputError(
            f"{frame.where}: expected {expected[0]}x{expected[1]} as the first training image, got {size[0]}x{size[1]}"
        )
    for key, claimed, actual in zip(("w", "h"), split.intrinsics.size, size, strict=True):
        if claimed is not None and claimed != actual:
            raise InputError(
                f"{split.source}: {key}: expected the images' own {actual}, got {claimed}: scale all intrinsics with it"
            )


def _number(value: object, where: str) -> float:
    """Convert a JSON value to a finite float; raise InputError for other values, also for true and false."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if abs(number) <= _LARGEST:
            return number
    raise InputError(f"{where}: expected a finite number, got {_brief(value)}")


def _brief(value: object) -> str:
    """Return a JSON value as a short text for an error message."""
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
