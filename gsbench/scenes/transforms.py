"""Load scenes from JSON files of cameras: transforms_{train,val,test}.json (Blender) or transforms.json (nerfstudio).

The Blender layout is that of NeRF-synthetic, D-NeRF and 7DGS-PBR.
What is missing, damaged or contradictory raises `InputError`; `where` is the file and the field.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.reading import MAX_JSON, parse_json, read_file
from gsbench.scenes import files, shots, times
from gsbench.scenes.files import ImageFinder
from gsbench.scenes.images import Rendition, Size
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.points import read_ply
from gsbench.scenes.scene import HELD_OUT, UP, Scene, View, hold_out
from gsbench.scenes.shots import MASKS, Lens, Shot, Shots

NERFSTUDIO = "transforms.json"
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
# The transform by which nerfstudio made the poses from COLMAP's is part of the poses, and of the points.
_NERFSTUDIO_KEYS = frozenset((*_SPLITS, "ply_file_path", "applied_transform", "applied_scale"))
_FRAME_KEYS = {"file_path", "transform_matrix", "time", "rotation"}  # NeRF-synthetic's rotation is not part of the pose
_OWN_TIMES = "give them their own times"
_LARGEST = 1e30  # largest number in a file; its square in double and its sums in single precision are finite
_AGREE = 1e-3  # relative tolerance between two statements of one focal length
_AXES = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")  # as instant-ngp and nerfstudio write them
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_MODEL_KEYS = ("camera_model", "camera_type")
_FLAGS = ("is_fisheye", "fisheye", "equirectangular", "latlong", "orthographic")  # of cameras that are no pinholes
_LENS_KEYS = frozenset(
    (*_AXES[0], *_AXES[1], "cx", "cy", "w", "h", *_DISTORTION, "distortion_params", *_MODEL_KEYS, *_FLAGS)
)
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

    def lens(self, size: Size) -> Lens:
        """Return the camera of an image of width x height pixels; it has another size if the file states both sides."""
        width, height = size
        if None not in self.size:
            width, height = (round(side or 0) for side in self.size)  # or 0: for mypy
        for key, stated, actual in zip("wh", self.size, (width, height), strict=True):
            if stated is not None and stated != actual:
                raise InputError(
                    f"{self.where}: {key}: expected the images' own {actual}, got {stated}: scale all "
                    "intrinsics with it, or write both w and h"
                )
        fx, fy = (self._focal(axis, side) for axis, side in enumerate((width, height)))
        fx, fy = fx or fy or 0.0, fy or fx or 0.0  # at least one is stated; without the other, pixels are square
        if self.y_of_file and abs(fx - fy) > _AGREE * fx:
            raise InputError(
                f"{self.where}: {' or '.join(_AXES[0])}: expected fl_y too, as that of the whole file "
                f"differs ({fy:.6g}, not {fx:.6g}): write it in the frame"
            )
        cx, cy = (side / 2 if at is None else at for at, side in zip(self.principal, (width, height), strict=True))
        return Lens(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (0.0, 0.0, 0.0, 0.0))

    def _focal(self, axis: int, side: int) -> float | None:
        """Return the focal length along an axis of an image of `side` pixels; None if the file states none."""
        focal, angle = self.focal[axis], self.angle[axis]
        of_angle = None if angle is None else 0.5 * side / math.tan(0.5 * angle)
        if focal is not None and of_angle is not None and abs(of_angle - focal) > _AGREE * focal:
            keys = _AXES[axis]
            raise InputError(
                f"{self.where}: {keys[0]}: expected {of_angle:.6g} as {keys[1]} says for {side} pixels, "
                f"got {focal:.6g}: leave out the wrong one, or write w and h of its images"
            )
        return of_angle if focal is None else focal


@dataclass(frozen=True)
class Frame:
    """Hold a checked entry of the list `frames` of a JSON file; its image is not read yet."""

    path: Path
    mask: Path | None  # file of the object number of each pixel
    name: str  # relative to the scene's folder: "train/r_000.png"
    where: str  # the image's path and the field that names it, for messages
    time: float | None
    viewmat: Tensor  # [4, 4] float64
    intrinsics: Intrinsics


@dataclass(frozen=True)
class Split:
    """Hold the checked content of a JSON file."""

    source: Path
    frames: list[Frame]
    content: dict[str, Any]  # of the file
    digest: str
    notes: list[str]


def load_blender(root: Path, name: str, rendition: Rendition) -> Scene:
    """Load a scene in the Blender layout.

    Each file transforms_{train,val,test}.json has

    - `frames`, a list of objects with `file_path` (relative to the folder; the suffix may be missing),
      `transform_matrix` (camera to world, OpenGL axes), and optionally `time`;
    - `camera_angle_x` in radians and optionally `camera_angle_y`, or `fl_x` and optionally `fl_y`, `cx`, `cy`, `w`, `h`
      in pixels of the full image. A frame may have its own.

    Times outside of [0, 1] are scaled over all splits together. transforms_val.json may be missing. A file points3d.ply
    is ignored, because in these data sets it has random points.

    An optional folder `masks` beside the images has an 8-bit grey PNG for each image, with the number of the object in
    each pixel (`View.regions`). Masks are measured with (`psnr_object`), not trained with.
    """
    finder = ImageFinder(root)
    splits = {split: _read_split(root, f"transforms_{split}.json", finder) for split in ("train", "test")}
    if os.path.lexists(root / "transforms_val.json"):  # a broken link is an error, not a data set without val
        splits["val"] = _read_split(root, "transforms_val.json", finder)
    timed, notes = _times(list(splits.values()))
    size = shots.size_of(splits["train"].frames[0].path, splits["train"].frames[0].where)  # shots.read refuses others
    listed = [
        shot for split, part in zip(splits.values(), timed, strict=True) for shot in _shots_of(split.frames, part, size)
    ]
    loaded = shots.read(listed, rendition)
    in_order = iter(loaded.views)
    views = {name: list(islice(in_order, len(split.frames))) for name, split in splits.items()}
    frames = [frame for split in splits.values() for frame in split.frames]
    digests = {frame.name: digest for frame, digest in zip(frames, loaded.digests, strict=True)}
    digests |= {split.source.name: split.digest for split in splits.values()}
    if times.table_of(root):
        notes.append(f"{times.TABLE} is not read: the times are those of transforms_*.json")
    notes += [*(note for split in splits.values() for note in split.notes), *finder.notes(), *loaded.notes]
    return standard_scene(
        name=name,
        train=views["train"],
        val=views.get("val", []),
        test=views["test"],
        background=rendition.background,
        fingerprint=files.fingerprint(digests),
        up=UP,
        notes=(*notes, *_shared_views(views, loaded)),
    )


def load_nerfstudio(root: Path, name: str, rendition: Rendition) -> Scene:
    """Load a scene from transforms.json.

    The file has what `load_blender` reads from each of its files. `train_filenames`, `val_filenames` and
    `test_filenames` may list the images of each split by their `file_path`. Otherwise every eighth image in the order
    of time and then of name is a test view, from the eighth on. Times come from times.csv, otherwise from `time` in the
    frames, otherwise from the names of the images (`gsbench.scenes.times`). The points of `ply_file_path` are the
    initial points.
    """
    finder = ImageFinder(root)
    split = _read_split(root, NERFSTUDIO, finder, _NERFSTUDIO_KEYS)
    if split.frames[0].time is None or times.table_of(root):
        _check_all_or_none([split])
        timed, digests = times.of_images(root, _named_images(split))
    else:
        (values,), lines = _times([split])
        timed, digests = times.Times(values, lines), {}
    size = shots.size_of(split.frames[0].path, split.frames[0].where)
    listed_shots = _shots_of(split.frames, timed.values, size)
    loaded = shots.read(listed_shots, rendition)
    digests |= dict(zip([frame.name for frame in split.frames], loaded.digests, strict=True))
    train, val, test, how = _split_views(split, finder, loaded.views)
    shared = _shared_views({"train": train, "val": val, "test": test}, loaded)
    points = split.content.get("ply_file_path")
    initial = None
    if points is not None:
        if not isinstance(points, str):
            raise InputError(f"{split.source}: ply_file_path: expected the path of a PLY, got {_brief(points)}")
        path = files.find_inside(root, points, f"{split.source}: ply_file_path")
        initial = read_ply(path)
        digests[path.relative_to(root).as_posix()] = files.digest(path.read_bytes())
    return standard_scene(
        name=name,
        train=train,
        val=val,
        test=test,
        background=rendition.background,
        points=initial,
        fingerprint=files.fingerprint(digests | {NERFSTUDIO: split.digest}),
        notes=(how, *timed.notes, *split.notes, *finder.notes(), *loaded.notes, *shared),
    )


def _read_split(
    root: Path,  # the scene's folder, resolved
    name: str,  # of the file, such as transforms_train.json
    finder: ImageFinder,
    keys: frozenset[str] = frozenset(),  # of the whole file that the caller reads; unknown others get a note
) -> Split:
    """Read and check a file of cameras."""
    source = root / name
    data = read_file(source, str(source), MAX_JSON)
    content = parse_json(data, str(source))
    if not isinstance(content, dict):
        raise InputError(f"{source}: expected a JSON object with 'frames', got {_brief(content)}")
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{source}: frames: expected a list of frames, got {_brief(frames)}")
    if not frames:
        raise InputError(f"{source}: frames: expected at least one frame, got an empty list")
    checked = [_read_frame(root, content, frame, source, index, finder) for index, frame in enumerate(frames)]
    index_of: dict[Path, int] = {}
    for index, frame in enumerate(checked):
        if index_of.setdefault(frame.path, index) != index:
            raise InputError(
                f"{source}: frames[{index}].file_path: expected each image once, frames[{index_of[frame.path]}] has "
                f"{frame.name[:80]!a} too: remove one of the two"
            )
    unread = (content.keys() - _LENS_KEYS - {"frames", *keys}) | (
        {key for frame in frames for key in frame} - _LENS_KEYS - _FRAME_KEYS
    )
    return Split(source, checked, content, files.digest(data), files.unread(name, unread))


def _shots_of(frames: Sequence[Frame], timed: Sequence[float | None], size: Size) -> list[Shot]:
    """Return what is needed to read the images of frames; `size` is the width and height of the first image."""
    return [
        Shot(
            frame.path,
            frame.mask,
            files.without_suffix(frame.name),
            frame.where,
            time,
            frame.viewmat,
            frame.intrinsics.lens(size),
        )
        for frame, time in zip(frames, timed, strict=True)
    ]


def _named_images(split: Split) -> times.NamedImages:
    """Return the names of a file's frames, their poses, and which of them have the same pose and intrinsics."""
    viewmats = np.stack([frame.viewmat.numpy() for frame in split.frames])
    lenses = [(frame.intrinsics.focal, frame.intrinsics.angle) for frame in split.frames]
    names = [frame.name for frame in split.frames]
    return times.NamedImages(names, viewmats, times.places_of(viewmats, lenses), split.source)


def _read_frame(
    root: Path, content: dict[str, Any], frame: object, source: Path, index: int, finder: ImageFinder
) -> Frame:
    """Check entry number `index` of the list `frames` of a JSON file: image path, time, intrinsics and camera pose."""
    where = f"{source}: frames[{index}]"
    if not isinstance(frame, dict):
        raise InputError(f"{where}: expected an object with 'file_path' and 'transform_matrix', got {_brief(frame)}")
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}.file_path: expected the image's path, got {_brief(name)}")
    path = finder.find(name, f"{where}.file_path")
    time = _number(frame["time"], f"{where}.time") if "time" in frame else None
    viewmat = _viewmat(frame.get("transform_matrix"), f"{where}.transform_matrix")
    named_by = f"{path} ({source.name}, frames[{index}].file_path)"
    mask = path.parent / MASKS / f"{files.without_suffix(path.name)}.png" if (path.parent / MASKS).is_dir() else None
    camera = _read_intrinsics(content, frame, str(source), where)
    return Frame(path, mask, path.relative_to(root).as_posix(), named_by, time, viewmat, camera)


def _viewmat(
    matrix: object,  # [4, 4] nested lists: camera to world, OpenGL axes (x right, y up, z backward)
    where: str,
) -> Tensor:  # [4, 4] float64: world to camera, OpenCV axes (x right, y down, z forward)
    """Convert a camera-to-world matrix in OpenGL axes to a world-to-camera matrix in OpenCV axes."""
    rows = matrix if isinstance(matrix, list) else []
    if len(rows) != 4 or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got {_brief(matrix)}")
    c2w: NDArray[np.float64] = np.array([[_number(value, where) for value in row] for row in rows])
    shots.check_rigid(c2w, where, "camera-to-world")
    turned = c2w[:3, :3] * [1, -1, -1]  # the columns are the camera's axes; y and z are reversed
    viewmat = np.eye(4)
    viewmat[:3, :3] = turned.T
    viewmat[:3, 3] = -turned.T @ c2w[:3, 3]
    return torch.from_numpy(viewmat)


def _times(splits: list[Split]) -> tuple[list[list[float | None]], list[str]]:
    """Return the times of each file's frames in [0, 1] by their field `time`, or None for all, and notes."""
    _check_all_or_none(splits)
    if splits[0].frames[0].time is None:
        return [[None] * len(split.frames) for split in splits], []
    # or 0.0: for mypy, as all have a time
    fields = {str(split.source): [frame.time or 0.0 for frame in split.frames] for split in splits}
    for split in splits:
        times.check_distinct(_named_images(split), fields[str(split.source)], split.source, _OWN_TIMES)
    timed, notes = times.of_fields(fields)
    return [timed[str(split.source)] for split in splits], notes


def _check_all_or_none(splits: Sequence[Split]) -> None:
    """Raise InputError if some frames of a data set have a time and others do not."""
    all_frames = [(split, index, frame) for split in splits for index, frame in enumerate(split.frames)]
    first = all_frames[0][2].time
    for split, index, frame in all_frames:
        if (frame.time is None) != (first is None):
            has, other = ("no time", "has one") if frame.time is None else ("a time", "has none")
            raise InputError(
                f"{split.source}: frames[{index}].time: this frame has {has} and the first frame {other}: "
                "give a time to all frames or to none"
            )


def _shared_views(views: dict[str, list[View]], loaded: Shots) -> list[str]:
    """Return sentences on images that two splits share, with the same pose and time."""
    digests = dict(zip(map(id, loaded.views), loaded.digests, strict=True))
    keys_of = {
        split: [(digests[id(view)], view.camera.viewmat.numpy().tobytes(), view.time) for view in listed]
        for split, listed in views.items()
    }
    notes = []
    for part, other in (("test", "train"), ("test", "val"), ("val", "train")):
        if part in keys_of and other in keys_of:
            shared = set(keys_of[other])
            if count := sum(key in shared for key in keys_of[part]):
                notes.append(
                    f"{count} of {len(keys_of[part])} views of {part} are views of {other} too (image, pose "
                    f"and time are equal): PSNR on {part} is not that of unseen views"
                )
    return notes


def _split_views(
    split: Split, finder: ImageFinder, views: list[View]
) -> tuple[list[View], list[View], list[View], str]:
    """Return the views of train, val and test, and a sentence that says how they were split."""
    lists: list[Any] = [split.content.get(key) for key in _SPLITS]
    if lists == [None, None, None]:
        if len(views) < HELD_OUT:
            raise InputError(
                f"{split.source}: frames: expected at least {HELD_OUT}, as one in {HELD_OUT} is a test "
                f"view, got {len(views)}: list train_filenames and test_filenames"
            )
        train, test = hold_out(sorted(views, key=lambda view: (view.time or 0.0, view.name)), HELD_OUT)
        return train, [], test, f"split: every {HELD_OUT}th view in the order of time is a test view"
    by_path = {frame.path: view for frame, view in zip(split.frames, views, strict=True)}
    by_split: list[list[View]] = []
    for key, names in zip(_SPLITS, lists, strict=True):
        where, of_split = f"{split.source}: {key}", dict[int, View]()  # by id, as views have no hash
        if not isinstance(names, list):
            names = [] if names is None else [names]  # a single value is read as a list of one, or refused
        for name in names:
            view = by_path.get(finder.find(name, where)) if isinstance(name, str) else None
            if view is None:
                raise InputError(f"{where}: expected file_path of frames, got {_brief(name)}: add its frame")
            if id(view) in of_split:
                raise InputError(f"{where}: expected each image once, got {_brief(name)} twice: remove one of the two")
            of_split[id(view)] = view
        by_split.append([*of_split.values()])
    train, val, test = by_split
    if not train or not test:
        raise InputError(
            f"{split.source}: expected images in train_filenames and test_filenames, got {len(train)} and "
            f"{len(test)}: list them, or leave out all three lists"
        )
    return train, val, test, f"split: as the file lists, {len(train)}, {len(val)} and {len(test)} of {len(views)} views"


def _read_intrinsics(content: Mapping[str, Any], frame: Mapping[str, Any], source: str, where: str) -> Intrinsics:
    """Read the intrinsics of a frame: focal lengths or fields of view, principal point and size.

    The keys of the frame come before those of the whole file, `content`. A focal length there also replaces the file's
    field of view along this axis, and the reverse.
    """
    of_frame = _LENS_KEYS & frame.keys()
    # A key of the frame replaces both keys of its axis.
    replaced = {key for axis in _AXES if of_frame & {*axis} for key in axis} | of_frame
    merged = {key: content[key] for key in _LENS_KEYS & content.keys() - replaced} | {
        key: frame[key] for key in of_frame
    }
    if not any(key in merged for axis in _AXES for key in axis):
        raise InputError(
            f"{where}: expected intrinsics as 'camera_angle_x' or 'fl_x' here or for the whole file, found neither"
        )
    where = where if of_frame else source
    _check_pinhole(merged, where)
    values = {
        key: _number(merged[key], f"{where}: {key}")
        for key in ("cx", "cy", "w", "h", *_AXES[0], *_AXES[1])
        if key in merged
    }
    for key in ("fl_x", "fl_y", "w", "h"):
        if key in values and values[key] < shots.SMALLEST:
            raise InputError(f"{where}: {key}: expected a positive number of pixels, got {values[key]}")
    for _, key in _AXES:
        if key in values and not 1e-6 < values[key] < math.pi:
            raise InputError(f"{where}: {key}: expected radians between 0 and pi, got {values[key]}")
    x_keys, y_keys = ({*axis} for axis in _AXES)
    return Intrinsics(
        where,
        focal=(values.get("fl_x"), values.get("fl_y")),
        angle=(values.get("camera_angle_x"), values.get("camera_angle_y")),
        principal=(values.get("cx"), values.get("cy")),
        size=(values.get("w"), values.get("h")),
        y_of_file=bool(of_frame & x_keys and not of_frame & y_keys and y_keys & content.keys()),
    )


def _check_pinhole(values: Mapping[str, Any], where: str) -> None:
    """Raise InputError if keys say that the camera is not a pinhole."""
    for key in _MODEL_KEYS:
        model = values.get(key, _MODELS[0])
        if not isinstance(model, str) or model.upper() not in _MODELS:
            raise InputError(
                f"{where}: {key}: expected a pinhole camera ({', '.join(_MODELS)}), got {_brief(model)}: {_UNDISTORT}"
            )
    for key in _FLAGS:
        if values.get(key, False) not in (False, 0):
            raise InputError(f"{where}: {key}: expected a pinhole camera, got {_brief(values[key])}: {_UNDISTORT}")
    coefficients = [(key, values[key]) for key in _DISTORTION if key in values]
    params = values.get("distortion_params", [])
    coefficients += [("distortion_params", value) for value in (params if isinstance(params, list) else [params])]
    for key, value in coefficients:
        if (coefficient := _number(value, f"{where}: {key}")) != 0:
            raise InputError(f"{where}: {key}: expected a pinhole camera, got {coefficient}: {_UNDISTORT}")


def _number(value: object, where: str) -> float:
    """Convert a JSON value to a finite float; raise InputError for other values, also for true and false."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            result = float(value)
        except OverflowError:
            result = math.inf
        if abs(result) <= _LARGEST:
            return result
    raise InputError(f"{where}: expected a finite number, got {_brief(value)}")


def _brief(value: object) -> str:
    """Return a JSON value as a short text for an error message."""
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
