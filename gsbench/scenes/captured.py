"""Load your own captures: images, a COLMAP model of their cameras, and times from file names or times.csv."""

import csv
import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.reading import read_file
from gsbench.scenes import colmap, files, images
from gsbench.scenes.lens import Lens
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Camera, Scene, View, hold_out

HELD_OUT = 8  # every eighth view in the order of time is a test view
IMAGES, MASKS, TIMES = "images", "masks", "times.csv"
_MAX_TIMES = 1 << 26  # bytes of times.csv
_JPEG = (".jpg", ".jpeg")  # suffixes in lower case
_LARGEST = 1e30  # the largest time, in any unit


@dataclass(frozen=True)
class _Shot:
    """Hold the checked description of an image; the image itself is not read yet."""

    path: Path
    mask: Path | None  # file of the object number of each pixel
    name: str  # relative to the folder of the images, without suffix
    where: str  # the path and the file that names it, for messages
    time: float | None
    viewmat: Tensor  # [4, 4] float64
    lens: Lens


def load(root: Path, *, downscale: int, background: tuple[float, float, float], resize: str | None = None) -> Scene:
    """Load a scene from images and a COLMAP model; see `gsbench.scenes.load` for the arguments.

    - `images/` has a PNG or a JPEG for each image that the model registers. For `x.jpg` of the model, `x.png` is read
      if there is no `x.jpg`.
    - `sparse/0/`, or `sparse/`, has the model: cameras, images and points3D, as .bin or .txt. Its points are the
      initial points.
    - Times come from `times.csv` with the columns `name,time`, otherwise from the last number in each file name. They
      are scaled to [0, 1]. If no name has a number, the scene has no times.
    - `masks/` may have an 8-bit grey PNG for each image, with the number of the object in each pixel.

    The distortion of lenses is undone by OpenCV. The principal point may lie anywhere. Every eighth image in the order
    of time and then of name is a test view, from the eighth on; the others are for training.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file.
    """
    name = Path(os.path.abspath(root)).name  # if the folder is a link, the name of the link
    root = root.resolve()
    folder = root / "sparse" / "0" if (root / "sparse" / "0").is_dir() else root / "sparse"
    cameras, posed, points = (colmap.read_part(folder, part) for part in ("cameras", "images", "points3D"))
    shots, digests = _list_shots(root, posed, colmap.read_cameras(cameras))
    initial = colmap.read_points(points)
    views, digests_of_images = _read_views(root, shots, downscale, background, resize)
    digests |= digests_of_images
    digests |= {part.path.relative_to(root).as_posix(): files.digest(part.data) for part in (cameras, posed, points)}
    train, test = hold_out(views, HELD_OUT)
    return standard_scene(
        name=name,
        train=train,
        val=[],
        test=test,
        background=background,
        points=initial,
        fingerprint=files.fingerprint(digests),
        up=None,
    )


def _list_shots(root: Path, posed: colmap.ModelFile, lenses: dict[int, Lens]) -> tuple[list[_Shot], dict[str, str]]:
    """Return the images of a model in the order of time, and the SHA-256 of times.csv by name, if there is one."""
    listed = colmap.read_images(posed)
    if len(listed) < HELD_OUT:
        raise InputError(f"{posed.path}: expected at least {HELD_OUT} images, as one in {HELD_OUT} is a test view, "
                         f"got {len(listed)}", docs="data.md#your-own-capture")  # fmt: skip
    table = root / TIMES
    given = read_file(table, str(table), _MAX_TIMES) if os.path.lexists(table) else None
    times = _times_of_names(listed, posed.path) if given is None else _times_of_table(given, table, listed)
    shots = []
    for image, time in zip(listed, times, strict=True):
        where = f"{posed.path}: image {image.name[:80]!a}"
        if image.camera not in lenses:
            raise InputError(f"{where}: expected a camera of the model, got number {image.camera}")
        name = PurePosixPath(image.name).with_suffix(".png") if PurePosixPath(image.name).name else ""
        path = _find_image(root, image.name, str(name), where)
        mask = files.find_inside(root, f"{MASKS}/{name}", where) if (root / MASKS).is_dir() else None
        viewmat = torch.from_numpy(image.viewmat)
        named_by = f"{path} (named {image.name[:80]!a} in {posed.path.name})"
        shots.append(_Shot(path, mask, str(name).removesuffix(".png"), named_by, time, viewmat, lenses[image.camera]))
    digests = {} if given is None else {TIMES: files.digest(given)}
    return sorted(shots, key=lambda shot: (shot.time or 0.0, shot.name)), digests


def _find_image(root: Path, name: str, as_png: str, where: str) -> Path:
    """Return the path of an image: that of the JPEG which the model names, if it is there, otherwise that of a PNG."""
    if PurePosixPath(name).suffix.lower() in _JPEG:
        path = files.find_inside(root, f"{IMAGES}/{name}", where)
        if path.is_file():
            return path
    return files.find_inside(root, f"{IMAGES}/{as_png}", where)


def _times_of_table(data: bytes, path: Path, listed: list[colmap.PosedImage]) -> list[float | None]:
    """Return the time of each image from the table times.csv, scaled to [0, 1]; other rows of it are not used."""
    try:
        rows = list(csv.reader(data.decode("utf-8-sig").splitlines(), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected a table name,time: {error}", docs="data.md#your-own-capture") from None
    if not rows or [word.strip() for word in rows[0]] != ["name", "time"]:
        raise InputError(
            f"{path}: expected the first line name,time, got {','.join(rows[0] if rows else [])[:60]!a}",
            docs="data.md#your-own-capture",
        )
    table: dict[str, float] = {}
    for number, row in enumerate(rows[1:], 2):
        if len(row) != 2 or row[0] in table:
            raise InputError(f"{path}: line {number}: expected a name, once, and its time, got {','.join(row)[:60]!a}")
        table[row[0]] = _number(row[1], f"{path}: line {number}")
    missing = [image.name for image in listed if image.name not in table]
    if missing:
        raise InputError(
            f"{path}: expected a time of each image of the model, got none of {missing[0][:80]!a}: add it",
            docs="data.md#your-own-capture",
        )
    return _scaled([table[image.name] for image in listed])


def _times_of_names(listed: list[colmap.PosedImage], source: Path) -> list[float | None]:
    """Return the time of each image from the last number in its file name, scaled to [0, 1]; None without numbers."""
    numbers = [re.findall(r"[0-9]+", PurePosixPath(image.name).stem)[-1:] for image in listed]
    if not any(numbers):
        return [None] * len(listed)
    for image, found in zip(listed, numbers, strict=True):
        if not found:
            raise InputError(f"{source}: image {image.name[:80]!a}: expected a number in its name, as others have: "
                             f"rename it, or write {TIMES}", docs="data.md#your-own-capture")  # fmt: skip
    return _scaled([_number(found[0], f"{source}: image {found[0][:40]}") for found in numbers])


def _scaled(times: list[float]) -> list[float | None]:
    """Map the first time to 0 and the last to 1."""
    first = min(times)
    length = max(times) - first or 1.0
    return [(time - first) / length for time in times]


def _number(text: str, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not abs(number) <= _LARGEST:
        raise InputError(f"{where}: expected a time, got {text[:40]!a}")
    return number


def _read_views(
    root: Path, shots: list[_Shot], downscale: int, background: tuple[float, float, float], resize: str | None
) -> tuple[list[View], dict[str, str]]:
    """Read and undistort all images by several threads; return their views, and the SHA-256 of each file by name."""
    first = shots[0]
    data = images.read_image(first.path, first.where)
    size = images.photo_size(data, first.where)
    in_8_bits = resize is None and images.stays_in_8_bits(data, size, len(shots), downscale)

    def read(shot: _Shot) -> tuple[View, str]:
        data = images.read_image(shot.path, shot.where)
        _check_size(images.photo_size(data, shot.where), size, shot)
        decoded = images.decode_photo(data, shot.where)
        if decoded.shape[2] == 4 and any(shot.lens.distortion):
            raise InputError(f"{shot.where}: expected an image without alpha, as its camera has distortion: undo it by "
                             "`colmap image_undistorter`")  # fmt: skip
        pixels = shot.lens.undistort(decoded, shot.where)
        is_kept = in_8_bits and pixels.dtype == np.uint8
        if is_kept:
            image = torch.from_numpy(pixels)
        else:
            image = images.composite(pixels, background, downscale, shot.where, resize)
        K = np.diag([1 / downscale, 1 / downscale, 1]) @ shot.lens.pinhole()
        camera = Camera(shot.viewmat, torch.from_numpy(K.astype(np.float32)), image.shape[1], image.shape[0])
        alpha = None if is_kept else images.alpha_of(decoded, downscale)
        regions = None if shot.mask is None else _read_mask(shot, shot.mask, downscale)
        return View(shot.name, camera, shot.time, image, background, alpha, regions), files.digest(data)

    kept = (4 if in_8_bits else 13) + any(shot.mask is not None for shot in shots)  # bytes a pixel, alpha and mask too
    threads = images.count_readers(size, len(shots), downscale, first.where, kept)
    with images.quiet_opencv(), ThreadPoolExecutor(threads) as pool:
        read_all = list(pool.map(read, shots))
    digests = {
        shot.path.relative_to(root).as_posix(): digest for shot, (_, digest) in zip(shots, read_all, strict=True)
    }
    return [view for view, _ in read_all], digests


def _check_size(size: tuple[int, int], expected: tuple[int, int], shot: _Shot) -> None:
    """Raise InputError if an image has another size than its camera, or than the first image."""
    own = shot.lens.width, shot.lens.height
    if size != own:
        raise InputError(f"{shot.where}: expected {own[0]}x{own[1]} as its camera in COLMAP, got {size[0]}x{size[1]}: "
                         "use the images that COLMAP saw, and scene.downscale")  # fmt: skip
    if size != expected:
        raise InputError(f"{shot.where}: expected {expected[0]}x{expected[1]} as the first image, got "
                         f"{size[0]}x{size[1]}: use images of one size", docs="data.md#your-own-capture")  # fmt: skip


def _read_mask(shot: _Shot, path: Path, downscale: int) -> Tensor:  # [H, W] 8 bits
    """Read and undistort the mask of an image: a PNG with the number of the object in each pixel."""
    where = f"{path} (the mask of {shot.name}; without a folder '{MASKS}' a scene has no regions)"
    whole = images.decode_regions(images.read_image(path, where), (shot.lens.width, shot.lens.height), 1, where).numpy()
    plain = shot.lens.undistort(whole, where, cv2.INTER_NEAREST)
    return torch.from_numpy(plain[downscale // 2 :: downscale, downscale // 2 :: downscale].copy())
