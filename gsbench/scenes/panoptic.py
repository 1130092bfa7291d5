"""Load scenes of Panoptic Sports in the layout of Dynamic 3D Gaussians: every fixed camera at every time."""

import io
import os
import re
import zipfile
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.errors import InputError, one_line
from gsbench.process.memory import require
from gsbench.reading import read_file
from gsbench.scenes import files, shots
from gsbench.scenes.images import Rendition
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Points, Scene
from gsbench.scenes.shots import Lens, Shot

IMAGES = "ims"
MASKS = "seg"  # the folder of masks; a pixel is 1 where someone plays, 0 elsewhere
POINTS = "init_pt_cld.npz"
_NUMBER = re.compile(r"\d+(?=\D*$)")  # the last one in a name
_SHOWN = 4  # numbers that a sentence names
_MAX_POINTS = 1 << 30  # bytes of init_pt_cld.npz


@dataclass
class _Meta:
    """The keys of train_meta.json and test_meta.json. T times and C cameras; the keys have the file's names."""

    w: int  # pixels
    h: int
    k: list[list[list[list[float]]]]  # [T, C, 3, 3] intrinsics in pixels
    w2c: list[list[list[list[float]]]]  # [T, C, 4, 4] world to camera, OpenCV axes
    fn: list[list[str]]  # [T, C] images, relative to ims
    cam_id: list[list[int]]  # [T, C]


class _Split(NamedTuple):
    """The checked content of a file of cameras."""

    shots: list[Shot]  # by time, then by camera
    cameras: set[int]  # the numbers of the cameras
    times: int
    digest: str
    notes: list[str]


def load(root: Path, name: str, rendition: Rendition) -> Scene:
    """Load a scene in the layout of Dynamic 3D Gaussians (Luiten et al. 2024).

    - `train_meta.json` and `test_meta.json` have the cameras and the images of each time, the same number of times.
    - `ims/` has the images; `seg/`, if it is there, a mask of each as an 8-bit grey PNG (`View.regions`).
    - `init_pt_cld.npz`, if it is there, has the initial points as the array `data` [P, 7]: position, colour, mask.

    Times are 0 for the first to 1 for the last. A camera may move.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file and the field.
    """
    splits = {split: _read_split(root, root / f"{split}_meta.json") for split in ("train", "test")}
    train, test = splits["train"], splits["test"]
    if train.times != test.times:
        raise InputError(f"{root}: expected as many times in train and test, got {train.times} and {test.times}")
    notes = [*train.notes, *test.notes]
    if shared := sorted(train.cameras & test.cameras):
        notes.append(f"cameras {', '.join(map(str, shared))} of test are cameras of train too")
    notes += _out_of_step(train, test)
    loaded = shots.read([*train.shots, *test.shots], rendition)
    views = iter(loaded.views)  # first those of train
    digests = loaded.by_path(root)
    digests |= {f"{split}_meta.json": content.digest for split, content in splits.items()}
    points = None
    if os.path.lexists(root / POINTS):
        data = read_file(root / POINTS, str(root / POINTS), _MAX_POINTS)
        points, digests[POINTS] = _read_points(data, root / POINTS), files.digest(data)
    return standard_scene(
        name=name,
        train=list(islice(views, len(train.shots))),
        test=list(views),
        background=rendition.background,
        points=points,
        fingerprint=files.fingerprint(digests),
        notes=(*notes, *loaded.notes),
    )


def _read_split(root: Path, source: Path) -> _Split:
    """Read and check a file of cameras; the images are not read yet."""
    meta, digest, others = files.read_keys(_Meta, source)
    times, cameras = len(meta.fn), len((meta.fn or [[]])[0])
    row_lengths = {*map(len, meta.fn), *map(len, meta.cam_id)}
    if not cameras or row_lengths != {cameras} or len(meta.cam_id) != times:
        raise InputError(f"{source}: fn, cam_id: expected one image and number for each camera at each time")
    if min(meta.w, meta.h) < 1:
        raise InputError(f"{source}: w, h: expected the size of the images, got {meta.w}x{meta.h}")
    intrinsics = _array(meta.k, (times, cameras, 3, 3), f"{source}: k")
    poses = _array(meta.w2c, (times, cameras, 4, 4), f"{source}: w2c")
    has_masks = (root / MASKS).is_dir()
    listed = []
    for time in range(times):
        for camera, name in enumerate(meta.fn[time]):
            where = f"{source}: fn[{time}][{camera}]"
            path, stem = files.find_inside(root, f"{IMAGES}/{name}", where), files.without_suffix(name)
            mask = files.find_inside(root, f"{MASKS}/{stem}.png", where) if has_masks else None
            pose = poses[time, camera]
            shots.check_rigid(pose, f"{source}: w2c[{time}][{camera}]", "world-to-camera")
            lens = Lens(meta.w, meta.h, intrinsics[time, camera], shots.PINHOLE)
            _check_pinhole(lens.K, f"{source}: k[{time}][{camera}]")
            moment = time / max(1, times - 1)
            listed.append(Shot(path, mask, stem, f"{path} ({where})", moment, torch.from_numpy(pose), lens))
    if len({shot.path for shot in listed}) < len(listed):
        raise InputError(f"{source}: fn: expected each image once, some appear twice: look for a copied line")
    numbers = {number for row in meta.cam_id for number in row}
    return _Split(listed, numbers, times, digest, files.unread(source.name, others))


def _out_of_step(*splits: _Split) -> list[str]:
    """Return a sentence if images of one time have different numbers at the end of their names, as if of other times.

    A number that does not change with time, as in the names 000000/cam3, is of the camera.
    """
    rows = [[number for shot in split.shots for number in _NUMBER.findall(shot.name)] for split in splits]
    if any(len(row) != len(split.shots) for row, split in zip(rows, splits, strict=True)):
        return []
    numbers = [np.array(row, object).reshape(split.times, -1) for row, split in zip(rows, splits, strict=True)]
    by_time = np.concatenate(numbers, 1)  # [times, cameras] texts
    odd = np.flatnonzero((by_time != by_time[:, :1]).any(1))
    if not len(odd) or (by_time == by_time[0]).all():
        return []
    examples = ", ".join(sorted({*by_time[odd[0]]})[:_SHOWN])
    return [
        f"images of time {odd[0]} have different numbers in their names, such as {examples}: are they of one moment?"
    ]


def _array(nested: list[Any], shape: tuple[int, ...], where: str) -> NDArray[np.float64]:
    """Convert nested lists to an array; raise InputError if it has not the shape."""
    try:
        array = np.array(nested, np.float64)
    except ValueError:  # lists of different lengths
        array = np.empty(0)
    if array.shape != shape:
        raise InputError(f"{where}: expected numbers of shape {list(shape)} as fn has names, got another shape")
    return array


def _check_pinhole(K: NDArray[np.float64], where: str) -> None:
    """Raise InputError unless [3, 3] intrinsics are those of a pinhole without skew."""
    is_zero_elsewhere = not any((K[0, 1], K[1, 0], K[2, 0], K[2, 1]))
    if min(K[0, 0], K[1, 1]) < shots.SMALLEST or not is_zero_elsewhere or K[2, 2] != 1:
        raise InputError(f"{where}: expected fx 0 cx, 0 fy cy, 0 0 1 with positive fx and fy, got {K.tolist()}")


def _read_points(data: bytes, source: Path) -> Points:
    """Read positions and colours of the initial points; the mask of the points is not used."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        require(size, f"{source}: its arrays", "use fewer points")
        rows = np.asarray(np.load(io.BytesIO(data), allow_pickle=False)["data"], np.float64)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many types of exceptions for damaged files
        raise InputError(f"{source}: expected an archive with the array 'data': {one_line(error)[:80]}") from None
    if rows.ndim != 2 or rows.shape[1] != 7 or not len(rows) or not np.isfinite(rows).all():
        raise InputError(f"{source}: data: expected finite x y z r g b mask of each point, got {list(rows.shape)}")
    colors = rows[:, 3:6]
    if colors.min() < 0 or colors.max() > 1:
        raise InputError(f"{source}: data: expected colours in [0, 1], got {colors.min():.6g} to {colors.max():.6g}")
    return Points(torch.from_numpy(rows[:, :3].copy()), torch.from_numpy(colors.astype(np.float32)))
