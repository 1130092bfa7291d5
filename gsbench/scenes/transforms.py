"""Load scenes from JSON files of cameras: transforms_{train,val,test}.json (Blender) or transforms.json (nerfstudio).

The Blender layout is that of NeRF-synthetic, D-NeRF and 7DGS-PBR.
What is missing, damaged or contradictory raises `InputError`; `where` is the file and the field.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from gsbench.scenes.shots import MASKS, PINHOLE, Lens, Shot, Shots

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
_ON_LENSES = "data.md#cameras-and-images"  # in the docs
_UNREAD = ("points3d.ply", "fused.ply")  # random points, which 3DGS and 4DGS write beside these data sets


@dataclass(frozen=True)
class CameraFile:
    """Hold the checked content of a JSON file; its images are not read yet."""

    source: Path
    shots: list[Shot]  # with the times that the file states
    content: dict[str, Any]
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
    is not read, because in these data sets it has random points; a note says so.

    An optional folder `masks` beside the images has an 8-bit grey PNG for each image, with the number of the object in
    each pixel (`View.regions`). Masks are measured with (`psnr_object`), not trained with.
    """
    reader = _Reader(root)
    splits = {split: reader.read(f"transforms_{split}.json") for split in ("train", "test")}
    if os.path.lexists(root / "transforms_val.json"):  # a broken link is an error, not a data set without val
        splits["val"] = reader.read("transforms_val.json")
    timed, notes = _timed(root, list(splits.values()))
    loaded = shots.read([shot for part in timed for shot in part], rendition)
    in_order = iter(loaded.views)
    views = {name: list(islice(in_order, len(split.shots))) for name, split in splits.items()}
    digests = loaded.by_path(root) | {split.source.name: split.digest for split in splits.values()}
    if times.table_of(root):
        notes.append(f"{times.TABLE} is not read: the times are those of transforms_*.json")
    notes += [f"{ply} is not read: the initial points are random" for ply in _UNREAD if (root / ply).exists()]
    notes += [*(note for split in splits.values() for note in split.notes), *reader.finder.notes(), *loaded.notes]
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
    reader = _Reader(root)
    split = reader.read(NERFSTUDIO, _NERFSTUDIO_KEYS)
    if split.shots[0].time is None or times.table_of(root):
        _check_all_or_none([split])
        of_images, digests = times.of_images(root, _named_images(root, split))
        listed, lines = _with_times(split.shots, of_images.values), of_images.notes
    else:
        ((listed,), lines), digests = _timed(root, [split]), {}
    loaded = shots.read(listed, rendition)
    digests |= loaded.by_path(root)
    train, val, test, how = _split_views(split, reader.finder, loaded.views)
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
        notes=(how, *lines, *split.notes, *reader.finder.notes(), *loaded.notes, *shared),
    )


class _Reader:
    """Reads the files of cameras of a scene, whose images all have the size of the first one."""

    def __init__(self, root: Path) -> None:
        """Store the scene's folder, which is resolved."""
        self._root, self.finder = root, ImageFinder(root)
        self._size: Size | None = None  # of the first image

    def read(
        self,
        name: str,  # of the file, such as transforms_train.json
        keys: frozenset[str] = frozenset(),  # of the whole file that the caller reads; unknown others get a note
    ) -> CameraFile:
        """Read and check a file of cameras."""
        source = self._root / name
        data = read_file(source, str(source), MAX_JSON)
        content = parse_json(data, str(source))
        if not isinstance(content, dict):
            raise InputError(f"{source}: expected a JSON object with 'frames', got {_brief(content)}")
        frames = content.get("frames")
        if not isinstance(frames, list):
            raise InputError(f"{source}: frames: expected a list of frames, got {_brief(frames)}")
        if not frames:
            raise InputError(f"{source}: frames: expected at least one frame, got an empty list")
        listed = [self._shot(content, frame, source, index) for index, frame in enumerate(frames)]
        index_of: dict[str, int] = {}  # by the name of the view
        for index, shot in enumerate(listed):
            if (first := index_of.setdefault(shot.name, index)) != index:
                raise InputError(
                    f"{source}: frames[{index}].file_path: expected each image once, frames[{first}] has "
                    f"{listed[first].path_in(self._root)[:80]!a} too: remove one of the two, or rename it if it is "
                    "another image"
                )
        unread = (content.keys() - _LENS_KEYS - {"frames", *keys}) | (
            {key for frame in frames for key in frame} - _LENS_KEYS - _FRAME_KEYS
        )
        return CameraFile(source, listed, content, files.digest(data), files.unread(name, unread))

    def _shot(self, content: dict[str, Any], frame: object, source: Path, index: int) -> Shot:
        """Check entry number `index` of `frames`: image path, time, camera pose and intrinsics."""
        where = f"{source}: frames[{index}]"
        if not isinstance(frame, dict):
            raise InputError(
                f"{where}: expected an object with 'file_path' and 'transform_matrix', got {_brief(frame)}"
            )
        named = frame.get("file_path")
        if not isinstance(named, str) or not named:
            raise InputError(f"{where}.file_path: expected the image's path, got {_brief(named)}")
        path = self.finder.find(named, f"{where}.file_path")
        time = _number(frame["time"], f"{where}.time") if "time" in frame else None
        viewmat = _viewmat(frame.get("transform_matrix"), f"{where}.transform_matrix")
        named_by = f"{path} ({source.name}, frames[{index}].file_path)"
        self._size = self._size or shots.size_of(path, named_by)
        lens = _read_lens(content, frame, self._size, str(source), where)
        masks, name = path.parent / MASKS, files.without_suffix(path.relative_to(self._root).as_posix())
        mask = masks / f"{files.without_suffix(path.name)}.png" if masks.is_dir() else None
        return Shot(path, mask, name, named_by, time, viewmat, lens)


def _named_images(root: Path, split: CameraFile) -> times.NamedImages:
    """Return the names, poses and lenses of a file's images."""
    names = [shot.path_in(root) for shot in split.shots]
    viewmats = np.stack([shot.viewmat.numpy() for shot in split.shots])
    return times.NamedImages(names, viewmats, [shot.lens.key for shot in split.shots], split.source)


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


def _timed(root: Path, splits: list[CameraFile]) -> tuple[list[list[Shot]], list[str]]:
    """Return the shots of each file with times in [0, 1] by their field `time`, or without times, and notes."""
    _check_all_or_none(splits)
    if splits[0].shots[0].time is None:
        return [split.shots for split in splits], []
    # or 0.0: for mypy, as all have a time
    fields = {str(split.source): [shot.time or 0.0 for shot in split.shots] for split in splits}
    for split in splits:
        times.check_distinct(_named_images(root, split), fields[str(split.source)], split.source, _OWN_TIMES)
    timed, notes = times.of_fields(fields)
    return [_with_times(split.shots, timed[str(split.source)]) for split in splits], notes


def _with_times(listed: Sequence[Shot], timed: Sequence[float | None]) -> list[Shot]:
    return [replace(shot, time=time) for shot, time in zip(listed, timed, strict=True)]


def _check_all_or_none(splits: Sequence[CameraFile]) -> None:
    """Raise InputError if some frames of a data set have a time and others do not."""
    first = splits[0].shots[0].time
    for split in splits:
        for index, shot in enumerate(split.shots):
            if (shot.time is None) != (first is None):
                has, other = ("no time", "has one") if shot.time is None else ("a time", "has none")
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
    split: CameraFile, finder: ImageFinder, views: list[View]
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
    by_path = {shot.path: view for shot, view in zip(split.shots, views, strict=True)}
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


def _read_lens(content: Mapping[str, Any], frame: Mapping[str, Any], size: Size, source: str, where: str) -> Lens:
    """Read the intrinsics of a frame whose image has the given size: focal lengths or fields of view, and the rest.

    The keys of the frame come before those of the whole file, `content`. A focal length there also replaces the file's
    field of view along this axis, and the reverse. The lens has another size than the image if w and h say so.
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
    of_another_size = any(key in of_frame and content.get(key, frame[key]) != frame[key] for key in ("w", "h"))
    if of_another_size and (missing := {"fl_x", "fl_y", "cx", "cy"} & merged.keys() - of_frame):
        raise InputError(
            f"{where}: {', '.join(sorted(missing))}: expected its own, as its w or h is not that of the whole file: "
            "write them in the frame"
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
    width, height = (round(values["w"]), round(values["h"])) if {"w", "h"} <= values.keys() else size
    for key, actual in (("w", width), ("h", height)):
        if (stated := values.get(key, actual)) != actual:
            raise InputError(
                f"{where}: {key}: expected the images' own {actual}, got {stated}: scale all "
                "intrinsics with it, or write both w and h"
            )
    fx, fy = (_focal(values, axis, side, where) for axis, side in zip(_AXES, (width, height), strict=True))
    fx, fy = fx or fy, fy or fx  # at least one is stated; without the other, pixels are square
    x_keys, y_keys = ({*axis} for axis in _AXES)
    is_y_of_file = bool(of_frame & x_keys and not of_frame & y_keys and y_keys & content.keys())
    if is_y_of_file and abs(fx - fy) > _AGREE * fx:
        raise InputError(
            f"{where}: {' or '.join(_AXES[0])}: expected fl_y too, as that of the whole file "
            f"differs ({fy:.6g}, not {fx:.6g}): write it in the frame"
        )
    cx, cy = values.get("cx", width / 2), values.get("cy", height / 2)
    return Lens(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), PINHOLE)


def _focal(values: Mapping[str, float], keys: tuple[str, str], side: int, where: str) -> float:
    """Return the focal length along an axis of an image of `side` pixels; 0 if no key states it."""
    focal, angle = (values.get(key, 0.0) for key in keys)
    of_angle = 0.5 * side / math.tan(0.5 * angle) if angle else 0.0
    if focal and angle and abs(of_angle - focal) > _AGREE * focal:
        raise InputError(
            f"{where}: {keys[0]}: expected {of_angle:.6g} as {keys[1]} says for {side} pixels, "
            f"got {focal:.6g}: leave out the wrong one, or write w and h of its images"
        )
    return focal or of_angle


def _check_pinhole(values: Mapping[str, Any], where: str) -> None:
    """Raise InputError if keys say that the camera is not a pinhole."""
    for key in _MODEL_KEYS:
        model = values.get(key, _MODELS[0])
        if not isinstance(model, str) or model.upper() not in _MODELS:
            raise InputError(
                f"{where}: {key}: expected a pinhole camera ({', '.join(_MODELS)}), got {_brief(model)}: {_UNDISTORT}",
                docs=_ON_LENSES,
            )
    for key in _FLAGS:
        if values.get(key, False) not in (False, 0):
            raise InputError(
                f"{where}: {key}: expected a pinhole camera, got {_brief(values[key])}: {_UNDISTORT}", docs=_ON_LENSES
            )
    coefficients = [(key, values[key]) for key in _DISTORTION if key in values]
    params = values.get("distortion_params", [])
    coefficients += [("distortion_params", value) for value in (params if isinstance(params, list) else [params])]
    for key, value in coefficients:
        if (coefficient := _number(value, f"{where}: {key}")) != 0:
            raise InputError(
                f"{where}: {key}: expected a pinhole camera, got {coefficient}: {_UNDISTORT}", docs=_ON_LENSES
            )


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
