"""Read the intrinsics of the files transforms*.json: those of a frame come before those of the whole file."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsbench.errors import InputError
from gsbench.scenes.lens import Lens

_SMALLEST = 1e-6  # pixels; smaller lengths become zero in single precision
_LARGEST = 1e30  # largest number in a file; its square in double and its sums in single precision are finite
_AGREE = 1e-3  # relative tolerance between two statements of one focal length
_AXES = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")  # as instant-ngp and nerfstudio write them
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_MODEL_KEYS = ("camera_model", "camera_type")
_FLAGS = ("is_fisheye", "fisheye", "equirectangular", "latlong", "orthographic")  # of cameras that are no pinholes
KEYS = frozenset((*_AXES[0], *_AXES[1], "cx", "cy", "w", "h", *_DISTORTION, "distortion_params", *_MODEL_KEYS, *_FLAGS))
_UNDISTORT = "undistort the images, for example by `colmap image_undistorter`"


@dataclass(frozen=True)
class Intrinsics:
    """Hold the checked intrinsics of a frame, in pixels of the full image; missing ones follow from its size."""

    where: str  # the file, and the frame if it has intrinsics of its own, for messages
    focal: tuple[float | None, float | None]  # along x and y
    angle: tuple[float | None, float | None]  # fields of view along x and y in radians
    principal: tuple[float | None, float | None]
    size: tuple[float | None, float | None]  # width and height that the file states
    y_of_file: bool  # whether the frame states a focal length or angle of x alone, and the file one of y

    def lens(self, size: tuple[int, int]) -> Lens:
        """Return the camera of an image of width x height pixels; it has another size if the file states both sides.

        Raises:
            InputError: the file states a width or a height alone that is not the image's, or two focal lengths for the
                same axis.
        """
        width, height = size
        if None not in self.size:
            width, height = (round(side or 0) for side in self.size)
        for key, stated, actual in zip("wh", self.size, (width, height), strict=True):
            if stated is not None and stated != actual:
                raise InputError(f"{self.where}: {key}: expected the images' own {actual}, got {stated}: scale all "
                                 "intrinsics with it, or write both w and h")  # fmt: skip
        fx, fy = (self._focal(axis, side) for axis, side in enumerate((width, height)))
        fx, fy = fx or fy or 0.0, fy or fx or 0.0
        if self.y_of_file and abs(fx - fy) > _AGREE * fx:
            raise InputError(f"{self.where}: {' or '.join(_AXES[0])}: expected fl_y too, as that of the whole file "
                             f"differs ({fy:.6g}, not {fx:.6g}): write it in the frame")  # fmt: skip
        cx, cy = (side / 2 if at is None else at for at, side in zip(self.principal, (width, height), strict=True))
        return Lens(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (0.0, 0.0, 0.0, 0.0))

    def _focal(self, axis: int, side: int) -> float | None:
        """Return the focal length along an axis of an image of `side` pixels; None if the file states none."""
        focal, angle = self.focal[axis], self.angle[axis]
        of_angle = None if angle is None else 0.5 * side / math.tan(0.5 * angle)
        if focal is not None and of_angle is not None and abs(of_angle - focal) > _AGREE * focal:
            keys = _AXES[axis]
            raise InputError(f"{self.where}: {keys[0]}: expected {of_angle:.6g} as {keys[1]} says for {side} pixels, "
                             f"got {focal:.6g}: leave out the wrong one, or write w and h of its images")  # fmt: skip
        return of_angle if focal is None else focal


def read(content: Mapping[str, Any], frame: Mapping[str, Any], source: str, where: str) -> Intrinsics:
    """Read the intrinsics of a frame: focal lengths or fields of view, principal point and size.

    Args:
        content: the JSON object of the whole file.
        frame: the JSON object of the frame, whose keys come first. A focal length there also replaces the file's field
            of view along this axis, and the reverse.
        source: the file, for messages.
        where: the file and the frame, for messages.

    Raises:
        InputError: a value is not a number in its range, there is neither focal length nor field of view, or the camera
            is not a pinhole.
    """
    of_frame = KEYS & frame.keys()
    replaced = {key for axis in _AXES if of_frame & {*axis} for key in axis} | of_frame
    merged = {key: content[key] for key in KEYS & content.keys() - replaced} | {key: frame[key] for key in of_frame}
    if not any(key in merged for axis in _AXES for key in axis):
        raise InputError(f"{where}: expected intrinsics as 'camera_angle_x' or 'fl_x' here or for the whole file, "
                         "found neither")  # fmt: skip
    where = where if of_frame else source
    _check_pinhole(merged, where)
    values = {key: number(merged[key], f"{where}: {key}") for key in ("cx", "cy", "w", "h", *_AXES[0], *_AXES[1])
              if key in merged}  # fmt: skip
    for key in ("fl_x", "fl_y", "w", "h"):
        if key in values and values[key] < _SMALLEST:
            raise InputError(f"{where}: {key}: expected a positive number of pixels, got {values[key]}")
    for _, key in _AXES:
        if key in values and not 1e-6 < values[key] < math.pi:
            raise InputError(f"{where}: {key}: expected radians between 0 and pi, got {values[key]}")
    x, y = ({*axis} for axis in _AXES)
    return Intrinsics(
        where,
        focal=(values.get("fl_x"), values.get("fl_y")),
        angle=(values.get("camera_angle_x"), values.get("camera_angle_y")),
        principal=(values.get("cx"), values.get("cy")),
        size=(values.get("w"), values.get("h")),
        y_of_file=bool(of_frame & x and not of_frame & y and y & content.keys()),
    )


def _check_pinhole(values: Mapping[str, Any], where: str) -> None:
    """Raise InputError if keys say that the camera is not a pinhole."""
    for key in _MODEL_KEYS:
        model = values.get(key, _MODELS[0])
        if not isinstance(model, str) or model.upper() not in _MODELS:
            raise InputError(f"{where}: {key}: expected a pinhole camera ({', '.join(_MODELS)}), got {brief(model)}: "
                             f"{_UNDISTORT}")  # fmt: skip
    for key in _FLAGS:
        if values.get(key, False) not in (False, 0):
            raise InputError(f"{where}: {key}: expected a pinhole camera, got {brief(values[key])}: {_UNDISTORT}")
    coefficients = [(key, values[key]) for key in _DISTORTION if key in values]
    listed = values.get("distortion_params", [])
    coefficients += [("distortion_params", value) for value in (listed if isinstance(listed, list) else [listed])]
    for key, value in coefficients:
        if (coefficient := number(value, f"{where}: {key}")) != 0:
            raise InputError(f"{where}: {key}: expected a pinhole camera, got {coefficient}: {_UNDISTORT}")


def number(value: object, where: str) -> float:
    """Convert a JSON value to a finite float; raise InputError for other values, also for true and false."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            result = float(value)
        except OverflowError:
            result = math.inf
        if abs(result) <= _LARGEST:
            return result
    raise InputError(f"{where}: expected a finite number, got {brief(value)}")


def brief(value: object) -> str:
    """Return a JSON value as a short text for an error message."""
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
