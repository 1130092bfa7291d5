"""Load scenes in the Blender layout of NeRF-synthetic, D-NeRF and 7DGS-PBR: transforms_*.json and the images they name.

`read_split` reads one such file; nerfstudio's transforms.json is of the same kind (`gsbench.scenes.nerfstudio`).
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.reading import MAX_JSON, parse_json, read_file
from gsbench.scenes import files, intrinsics, shots, times
from gsbench.scenes.files import ImageFinder
from gsbench.scenes.intrinsics import Intrinsics, brief, number
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Scene, View
from gsbench.scenes.shots import MASKS, Shot

_RIGID_TOLERANCE = 1e-4  # D-NeRF writes single precision: its trex is orthonormal to 2.2e-6
_FRAME_KEYS = {"file_path", "transform_matrix", "time", "rotation"}  # NeRF-synthetic's rotation is not part of the pose
_MOST_KEYS = 8  # named in a sentence


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


def load(root: Path, *, downscale: int, background: tuple[float, float, float], resize: str | None = None) -> Scene:
    """Load a scene in the Blender layout; see `gsbench.scenes.load` for the arguments.

    Each file transforms_{train,val,test}.json has

    - `frames`, a list of objects with `file_path` (relative to the folder; the suffix may be missing),
      `transform_matrix` (camera to world, OpenGL axes), and optionally `time`;
    - `camera_angle_x` in radians and optionally `camera_angle_y`, or `fl_x` and optionally `fl_y`, `cx`, `cy`, `w`, `h`
      in pixels of the full image. A frame may have its own.

    Times outside of [0, 1] are scaled over all splits together. transforms_val.json may be missing. A file points3d.ply
    is ignored, because in these data sets it has random points.

    An optional folder `masks` beside the images has an 8-bit grey PNG for each image, with the number of the object in
    each pixel (`View.regions`). Masks are not used in training or measurement.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file and field.
    """
    name = Path(os.path.abspath(root)).name  # if the folder is a link, the name of the link
    root = root.resolve()
    finder = ImageFinder(root)
    splits = {split: read_split(root, f"transforms_{split}.json", finder) for split in ("train", "test")}
    if os.path.lexists(root / "transforms_val.json"):  # a broken link is an error, not a data set without val
        splits["val"] = read_split(root, "transforms_val.json", finder)
    timed, notes = _times(splits)
    size = shots.size_of(splits["train"].frames[0].path, splits["train"].frames[0].where)
    listed = [shot for split in splits for shot in shots_of(splits[split].frames, timed[split], size)]
    loaded = shots.read(listed, downscale=downscale, background=background, resize=resize)
    views, parts, at = {}, {}, 0
    for split in splits:
        part = slice(at, at := at + len(splits[split].frames))
        views[split], parts[split] = loaded.views[part], loaded.digests[part]
    digests = {
        frame.name: digest for split in splits for frame, digest in zip(splits[split].frames, parts[split], strict=True)
    }
    digests |= {split.source.name: split.digest for split in splits.values()}
    if times.table_of(root):
        notes.append(f"{times.TABLE} is not read: the times are those of transforms_*.json")
    notes += [*(note for split in splits.values() for note in split.notes), *finder.notes(), *loaded.notes]
    return standard_scene(
        name=name,
        train=views["train"],
        val=views.get("val", []),
        test=views["test"],
        background=background,
        points=None,
        fingerprint=files.fingerprint(digests),
        notes=(*notes, *shared_views(views, parts)),
    )


def read_split(root: Path, name: str, finder: ImageFinder, keys: frozenset[str] = frozenset()) -> Split:
    """Read and check a file of cameras in the folder `root`.

    Args:
        root: the scene's folder, resolved.
        name: the file, such as transforms_train.json.
        finder: finds the images.
        keys: keys of the whole file that the caller reads; others that are not known get a note.

    Raises:
        InputError: the file is missing, damaged, or has a value that is not read; the message names the field.
    """
    source = root / name
    data = read_file(source, str(source), MAX_JSON)
    content = parse_json(data, str(source))
    if not isinstance(content, dict):
        raise InputError(f"{source}: expected a JSON object with 'frames', got a {type(content).__name__}")
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{source}: frames: expected a list of frames, got {brief(frames)}")
    if not frames:
        what = name.removeprefix("transforms_").removesuffix(".json")
        raise InputError(f"{source}: frames: expected at least one frame, the {what} split is empty")
    checked = [_read_frame(root, content, frame, source, index, finder) for index, frame in enumerate(frames)]
    unread = sorted(content.keys() - intrinsics.KEYS - {"frames", *keys})
    unread += sorted({key for frame in frames for key in frame} - intrinsics.KEYS - _FRAME_KEYS - set(unread))
    listed = ", ".join(f"{key[:40]!a}" for key in unread[:_MOST_KEYS]) + (", .." if len(unread) > _MOST_KEYS else "")
    notes = [f"{name}: keys that are not read: {listed}"] if unread else []
    return Split(source, checked, content, files.digest(data), notes)


def shots_of(frames: Sequence[Frame], timed: Sequence[float | None], size: tuple[int, int]) -> list[Shot]:
    """Return what is needed to read the images of frames; `size` is the width and height of the first image."""
    return [
        Shot(frame.path, frame.mask, files.without_suffix(frame.name), frame.where, time, frame.viewmat,
             frame.intrinsics.lens(size))
        for frame, time in zip(frames, timed, strict=True)
    ]  # fmt: skip


def places_of(frames: Sequence[Frame]) -> list[Any]:
    """Return a key of each frame that is equal for frames with the same pose and intrinsics."""
    viewmats = np.stack([frame.viewmat.double().numpy() for frame in frames])
    return list(times.places_of(viewmats, [(frame.intrinsics.focal, frame.intrinsics.angle) for frame in frames]))


def _read_frame(
    root: Path, content: dict[str, Any], frame: object, source: Path, index: int, finder: ImageFinder
) -> Frame:
    """Check entry number `index` of the list `frames` of a JSON file: image path, time, intrinsics and camera pose."""
    where = f"{source}: frames[{index}]"
    if not isinstance(frame, dict):
        raise InputError(f"{where}: expected an object with 'file_path' and 'transform_matrix', got {brief(frame)}")
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}.file_path: expected the image's path, got {brief(name)}")
    path = finder.find(name, f"{where}.file_path")
    time = number(frame["time"], f"{where}.time") if "time" in frame else None
    viewmat = _viewmat(frame.get("transform_matrix"), f"{where}.transform_matrix")
    named_by = f"{path} ({source.name}, frames[{index}].file_path)"
    mask = path.parent / MASKS / f"{files.without_suffix(path.name)}.png" if (path.parent / MASKS).is_dir() else None
    camera = intrinsics.read(content, frame, str(source), where)
    return Frame(path, mask, path.relative_to(root).as_posix(), named_by, time, viewmat, camera)


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
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got {brief(matrix)}")
    c2w: NDArray[np.float64] = np.array([[number(value, where) for value in row] for row in rows])
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


def _times(splits: dict[str, Split]) -> tuple[dict[str, list[float | None]], list[str]]:
    """Return the times of each split's frames in [0, 1], or None for all, and sentences on how they were read.

    Raises:
        InputError: only some frames have a time, or frames with equal pose, intrinsics and time have different images.
    """
    check_all_or_none(splits.values())
    if splits["train"].frames[0].time is None:
        return {name: [None] * len(split.frames) for name, split in splits.items()}, []
    for split in splits.values():
        times.check_distinct(
            [frame.name for frame in split.frames], [frame.time for frame in split.frames], places_of(split.frames),
            str(split.source),
        )  # fmt: skip
    fields = {str(split.source): [frame.time or 0.0 for frame in split.frames] for split in splits.values()}
    timed, notes = times.of_fields(fields)
    return {name: timed[str(split.source)] for name, split in splits.items()}, notes


def check_all_or_none(splits: Iterable[Split]) -> None:
    """Raise InputError if some frames of a data set have a time and others do not."""
    listed = [(split, index, frame) for split in splits for index, frame in enumerate(split.frames)]
    first = listed[0][2].time
    for split, index, frame in listed:
        if (frame.time is None) != (first is None):
            has, other = ("no time", "has one") if frame.time is None else ("a time", "has none")
            raise InputError(
                f"{split.source}: frames[{index}].time: this frame has {has} and the first frame {other}: "
                "give a time to all frames or to none"
            )


def shared_views(views: dict[str, list[View]], digests: dict[str, list[str]]) -> list[str]:
    """Return sentences on images that two splits share, with the same pose and time."""
    seen = {
        split: [(digest, view.camera.viewmat.numpy().tobytes(), view.time) for view, digest in
                zip(views[split], digests[split], strict=True)]
        for split in views
    }  # fmt: skip
    notes = []
    for one, other in (("test", "train"), ("test", "val"), ("val", "train")):
        if one in seen and other in seen:
            shared = set(seen[other])
            if count := sum(key in shared for key in seen[one]):
                notes.append(f"{count} of {len(seen[one])} views of {one} are views of {other} too (image, pose and "
                             f"time are equal): PSNR on {one} is not that of unseen views")  # fmt: skip
    return notes
