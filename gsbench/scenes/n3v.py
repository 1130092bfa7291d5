"""Load scenes of Neural 3D Video: films of fixed cameras, decoded once, to files that are read when needed."""

import hashlib
import io
import math
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.process.memory import require
from gsbench.reading import read_file
from gsbench.scenes import colmap, files, images, shots
from gsbench.scenes.images import Pixels, Rendition, Size
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Camera, Scene, View
from gsbench.scenes.shots import Lens

POSES = "poses_bounds.npy"
TEST_CAMERA = "cam00"
DECODED = "decoded"  # the folder of the frames, as [frames, height, width, 3] bytes for each camera
_FILM = re.compile(r"cam\d\d(?:\.(?i:mp4))?")
_LIKE_FILM = re.compile(r"cam(?:era)?\D?(\d{1,9})(?:\.(?:mp4|mov|mkv|avi|webm|m4v))?", re.IGNORECASE)
_UNSTEADY = 0.2  # relative difference of a step between frames from the usual one, above which a line tells it
_SAME_RATE = 0.01  # relative difference of the frames a second of films of one rate, such as 29.97 and 30
_MAX_POSES = 1 << 20  # bytes of poses_bounds.npy
_ROW = 17  # numbers of a camera: a matrix [3, 5], and the depths of the nearest and farthest points
_MOVING = 8  # bytes a pixel of the reduced test film while its moving part is found (gsbench.measure.regions)


@dataclass(frozen=True)
class _Film:
    """The frames of a camera: a video, or a folder with an image for each frame, in the order of their numbers."""

    name: str  # such as cam00
    path: Path
    images: tuple[Path, ...]  # of a folder
    count: int  # of frames
    size: Size
    rate: float | None = None  # frames a second of a video

    def digest(self) -> str:
        """Return the SHA-256 of the video, or that of the images."""
        if self.images:
            return files.fingerprint(
                {path.name: files.digest(images.read_image(path, str(path))) for path in self.images}
            )
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def decoded(self, first: int, last: int, moments: list[float]) -> Iterator[Pixels]:  # each [H, W, 3] RGB
        """Yield the frames from `first` to `last`, counted from 0; a video may end before its header says.

        The milliseconds of a video's frames, from its first one on, are appended to `moments`.
        """
        for path in self.images[first : last + 1]:
            yield images.decode_photo(images.read_image(path, str(path)), str(path))
        if not self.images:
            yield from islice(images.video_frames(self.path, moments), first, last + 1)


def load(
    root: Path,
    name: str,
    rendition: Rendition,
    *,
    frames: tuple[int, int] | None = None,  # the first and the last, from 0
    leave_out: tuple[str, ...] = (),  # training cameras, such as cam13
) -> Scene:
    """Load a scene of Neural 3D Video (Li et al. 2022).

    - `cam00.mp4`, `cam01.mp4`, .. are films of fixed cameras; a folder `cam00/`, or `cam00/images/`, with an image for
      each frame may replace a film. cam00 is the test split, the others are for training.
    - `poses_bounds.npy` [cameras, 17] has a row of each film in the order of their names, see `camera_of`.
    - Initial points come from a COLMAP model in `sparse/0` or from `points3d.ply`, if one of these exists.

    Times are 0 for the first frame to 1 for the last. Frames are decoded once, into the folder `decoded`: one file for
    each camera, which is mapped into memory, so that an image takes memory only while it is used. A file is named
    after the camera, the frames, their size, and a hash of the film and the filter.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file.
    """
    films, notes = _list_films(root)
    source = root / POSES
    data = read_file(source, str(source), _MAX_POSES)
    rows = dict(zip(films, _read_rows(data, source, films), strict=True))  # of all films, also those left out
    films = _without(films, leave_out)
    first, last = _range(films, frames)
    size = images.reduced_size(films[0].size, rendition.downscale, str(films[0].path))
    needed = memory_needed(films[0].size, size, last - first + 1)
    require(needed, f"{root}: frames while they are decoded and measured", "use a larger scene.downscale")
    cameras = [_camera(film, rows[film], size, source) for film in films]
    # Before frames are decoded, which takes minutes, because these files may be damaged.
    points, points_file = colmap.points_beside(root)
    digests = {film.path.name: film.digest() for film in films} | {POSES: files.digest(data)}
    paths = _decoded_files(root, films, digests, (first, last), rendition, size)
    by_film = [
        _views(film, camera, path, (first, last), rendition)
        for film, camera, path in zip(films, cameras, paths, strict=True)
    ]
    count = len(films) * (last - first + 1)
    notes.append(
        f"{count} images of {size[0]}x{size[1]}, frames {first} to {last}, are read from {DECODED} when needed, "
        f"{3e-9 * count * size[0] * size[1]:.3g} GB on disk; memory for frames: {needed / 1e9:.2g} GB"
    )
    notes.append(f"{POSES}: depths are not read; no distortion is stated")
    notes += [f"cameras left out: {', '.join(leave_out)}"] if leave_out else []
    others = "" if points_file else ", ".join(sorted(path.name for path in root.glob("*.ply")))[:80]
    notes.append(f"initial points: {f'those of {next(iter(points_file))}' if points_file else 'random'}")
    notes[-1] += f"; not read: {others}" if others else ""
    test, *train = by_film  # the test camera is cam00, the first
    return standard_scene(
        name=name,
        train=[view for views in zip(*train, strict=True) for view in views],  # by frame, then by camera
        test=test,
        background=rendition.background,
        points=points,
        fingerprint=files.fingerprint(digests | points_file),
        notes=tuple(notes),
    )


def camera_of(
    row: NDArray[np.float64],  # [17] of poses_bounds.npy
    where: str,
) -> tuple[Tensor, Lens]:  # [4, 4] float64
    """Return the viewmat and the intrinsics of a camera in the format of LLFF (Mildenhall et al. 2019).

    The first 15 numbers are a matrix [3, 5] by rows. Its columns are, in world axes, the camera's axes down, right and
    backwards, its position, and height, width and focal length in pixels. The principal point is the centre.
    """
    down, right, backwards, position, (height, width, focal) = row[:15].reshape(3, 5).T
    viewmat = np.eye(4)
    viewmat[:3, :3] = right, down, -backwards
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    shots.check_rigid(viewmat, where, "world-to-camera")
    if min(width, height) < 1 or width % 1 or height % 1 or not focal > shots.SMALLEST:
        raise InputError(f"{where}: expected height, width and focal length in pixels, got {height} {width} {focal}")
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return torch.from_numpy(viewmat), Lens(int(width), int(height), K, shots.PINHOLE)


def memory_needed(
    size: Size,  # of the films
    reduced: Size,  # of the images
    frames: int,
) -> int:
    """Return the bytes of memory that frames take while they are decoded, and then while the test film is measured."""
    return max(images.DECODING * size[0] * size[1], _MOVING * frames * reduced[0] * reduced[1])


def _camera(film: _Film, row: NDArray[np.float64], size: Size, source: Path) -> Camera:
    """Return the camera of a film's frames reduced to `size`; raise InputError if its row has other proportions."""
    viewmat, lens = camera_of(row, f"{source}: {film.name}")
    resized = lens.resized(*film.size)
    if resized is None:
        raise InputError(
            f"{film.path}: expected {lens.width}x{lens.height} as {source.name}, or both sides resized by one ratio, "
            f"got {film.size[0]}x{film.size[1]}: use films that are not cropped"
        )
    K = np.diag([size[0] / film.size[0], size[1] / film.size[1], 1]) @ resized.K
    return Camera(viewmat, torch.from_numpy(K.astype(np.float32)), *size)


def _list_films(root: Path) -> tuple[list[_Film], list[str]]:
    """Return the films in the order of their names, and sentences on what is not read; check that all have one size."""
    paths: dict[str, Path] = {}
    notes = []
    listed = sorted(os.listdir(root))  # cam00 before cam00.mp4
    for name in filter(_FILM.fullmatch, listed):
        camera = os.path.splitext(name)[0]
        if camera in paths:
            notes.append(f"{name} is read, and not the folder {camera}")
        paths[camera] = files.find_inside(root, name, str(root))
    numbers = {int(camera[3:]) for camera in paths}
    if others := [name for name in listed if (like := _LIKE_FILM.fullmatch(name)) and int(like[1]) not in numbers]:
        raise InputError(
            f"{root}: expected films cam00.mp4 to cam99.mp4, or folders cam00 to cam99 of their frames, got "
            f"{', '.join(others)[:80]} too: rename them, or move them away"
        )
    if TEST_CAMERA not in paths or len(paths) < 2:
        raise InputError(f"{root}: expected {TEST_CAMERA}, the test camera, and others, got {', '.join(paths)[:120]}")
    if missing := [f"cam{n:02d}" for n in range(int(max(paths)[3:])) if f"cam{n:02d}" not in paths]:
        notes.append(f"there is no {', '.join(missing)[:80]}: rows of {POSES} are of the other films, in their order")
    films = [_open(camera, path) for camera, path in sorted(paths.items())]
    for film in films:
        if film.size != films[0].size:
            expected, actual = (f"{x.size[0]}x{x.size[1]}" for x in (films[0], film))
            raise InputError(f"{film.path}: expected {expected} as {films[0].path.name}, got {actual}")
    folders = [film for film in films if film.images]
    starts = {_number_of(film.images[0].name) for film in folders}
    if len(starts) > 1:
        firsts = ", ".join(f"{film.name}/{film.images[0].name}" for film in folders)
        notes.append(f"the first frames have different numbers, and are taken to be of one time: {firsts:.120}")
    return films, notes


def _number_of(name: str) -> int | None:
    """Return the number at the end of the name of a PNG or JPEG; None for other files."""
    stem = files.without_suffix(name)
    number = re.search(r"\d{1,9}$", stem) if stem != name else None
    return None if number is None else int(number[0])


def _open_folder(camera: str, path: Path) -> _Film:
    """Return the film of a folder of images, whose numbers must be consecutive."""
    folder = path / "images" if (path / "images").is_dir() else path
    numbered = sorted((number, file) for file in os.listdir(folder) if (number := _number_of(file)) is not None)
    if not numbered:
        raise InputError(f"{folder}: expected a PNG or JPEG for each frame, with its number at the end of the name")
    for (before, _), (after, name_after) in pairwise(numbered):
        if after != before + 1:
            raise InputError(f"{folder}: expected frame {before + 1} after frame {before}, got {name_after}")
    listed = tuple(files.find_inside(folder, image, str(folder)) for _, image in numbered)
    return _Film(camera, path, listed, len(listed), shots.size_of(listed[0], str(listed[0])))


def _open(camera: str, path: Path) -> _Film:
    """Return a film without decoding it; raise InputError if it is no MP4 and no folder of images."""
    if path.is_dir():
        return _open_folder(camera, path)
    if not path.is_file():
        raise InputError(f"{path}: expected a film or a folder of frames, found neither")
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if start[4:] != b"ftyp":  # other formats can name files and hosts, which OpenCV would open
        raise InputError(f"{path}: expected an MP4, the file is of another kind or damaged: copy it again")
    with images.open_video(path) as video:
        rate = video.get(cv2.CAP_PROP_FPS)
        count, width, height = (
            int(video.get(key))
            for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
    if min(count, width, height) < 1:
        raise InputError(f"{path}: OpenCV cannot decode this film: copy it again, or write its frames to {camera}/")
    return _Film(camera, path, (), count, (width, height), rate)


def _read_rows(data: bytes, source: Path, films: Sequence[_Film]) -> NDArray[np.float64]:  # [cameras, 17]
    """Read poses_bounds.npy; raise InputError unless it has a row of finite numbers for each film."""
    try:
        rows = np.asarray(np.load(io.BytesIO(data), allow_pickle=False), np.float64)
    except (ValueError, EOFError, TypeError) as error:
        raise InputError(f"{source}: expected an array as numpy.save writes: {one_line(error)[:80]}") from None
    if not np.isfinite(rows).all():
        raise InputError(f"{source}: expected finite numbers, some are not: copy it again")
    if rows.shape[1:] != (_ROW,):
        raise InputError(
            f"{source}: expected {_ROW} numbers for each film, 15 of the pose and 2 depths as of LLFF, got an array "
            f"{list(rows.shape)}: write it so"
        )
    if len(rows) != len(films):
        raise InputError(
            f"{source}: expected a row for each of {len(films)} films, {films[0].name} to {films[-1].name}, got "
            f"{len(rows)}: keep all films, and leave cameras out by scene.leave_out"
        )
    return rows


def _without(films: Sequence[_Film], leave_out: Sequence[str]) -> list[_Film]:
    """Return the films that are used; raise InputError if one to leave out is not there or is the test camera."""
    names = [film.name for film in films]
    if wrong := [name for name in leave_out if name not in names or name == TEST_CAMERA]:
        raise InputError(
            f"scene.leave_out: expected training cameras, such as {names[-1]}, got {', '.join(wrong)[:80]!a}"
        )
    kept = [film for film in films if film.name not in leave_out]
    if len(kept) < 2:
        raise InputError("scene.leave_out: expected cameras that are left for training, got all")
    return kept


def _range(films: Sequence[_Film], frames: tuple[int, int] | None) -> tuple[int, int]:
    """Return the first and the last frame.

    Raises:
        InputError: films are too short, have frames at different rates, or, without `frames`, differ in length.
    """
    rates = [(film.rate, film) for film in films if film.rate]
    if rates:
        (slow, slowest), (fast, fastest) = (choice(rates, key=lambda pair: pair[0]) for choice in (min, max))
        if fast > slow * (1 + _SAME_RATE):
            raise InputError(
                f"{fastest.path}: expected {slow:.4g} frames a second as {slowest.path.name}, got {fast:.4g}: are "
                f"frames of one number of one time? Convert the films to one rate, or leave it out by scene.leave_out"
            )
    shortest, longest = (choice(films, key=lambda film: film.count) for choice in (min, max))
    first, last = frames or (0, shortest.count - 1)
    if frames is None and shortest.count != longest.count:
        raise InputError(
            f"{shortest.path}: expected {longest.count} frames as {longest.path.name}, got {shortest.count}: are they "
            f"in step? Then choose scene.frames=[0,{shortest.count - 1}]"
        )
    if last >= shortest.count:
        raise InputError(f"{shortest.path}: expected frame {last}, got {shortest.count}: choose other scene.frames")
    return first, last


def _decoded_files(
    root: Path,
    films: Sequence[_Film],
    digests: Mapping[str, str],  # SHA-256 by the name of the film
    frames: tuple[int, int],
    rendition: Rendition,
    size: Size,
) -> list[Path]:
    """Return the files of the reduced frames of films; those that do not exist are written, if all fit on the disk."""
    folder, count = root / DECODED, frames[1] - frames[0] + 1
    needed = 3 * count * size[0] * size[1]  # bytes of a file
    hashes = [files.digest(f"{digests[film.path.name]} {rendition.resize}".encode())[:12] for film in films]
    paths = [
        folder / f"{film.name}_{frames[0]}-{frames[1]}_{size[0]}x{size[1]}_{digits}.rgb"
        for film, digits in zip(films, hashes, strict=True)
    ]
    try:
        folder.mkdir(exist_ok=True)
        missing = [i for i, path in enumerate(paths) if not path.is_file() or path.stat().st_size != needed]
        if len(missing) * needed > (free := shutil.disk_usage(folder).free):
            raise InputError(
                f"{folder}: expected {len(missing) * needed / 1e9:.1f} GB for frames of {len(missing)} films, got "
                f"{free / 1e9:.1f}: free some, or use a larger scene.downscale"
            )
        for i in missing:
            print(f"{films[i].path}: frames {frames[0]} to {frames[1]} are decoded to {paths[i]}", file=sys.stderr)
            _decode(films[i], frames, rendition, size, paths[i])
    except OSError as error:
        raise InputError(f"{one_line(error)}: expected a scene's folder in which {DECODED} can be written") from None
    return paths


def _views(film: _Film, camera: Camera, path: Path, frames: tuple[int, int], rendition: Rendition) -> list[View]:
    """Return the views of a film, whose pixels map the file of its frames."""
    first, last = frames
    shape = last - first + 1, camera.height, camera.width, 3
    pixels = torch.from_file(str(path), shared=False, size=math.prod(shape), dtype=torch.uint8).view(shape)
    views = []
    for frame, image in enumerate(pixels, first):
        time = (frame - first) / max(1, last - first)
        views.append(View(f"{film.name}/{frame:04d}", camera, time, image, rendition.background, is_on_disk=True))
    return views


def _decode(film: _Film, frames: tuple[int, int], rendition: Rendition, size: Size, path: Path) -> None:
    """Write the reduced frames of a film to a file, which appears only when it is whole."""
    part = path.with_name(f"{path.name}.{os.getpid()}")
    written, moments = 0, list[float]()
    try:
        with part.open("wb") as file:
            for pixels in film.decoded(*frames, moments):
                if pixels.shape != (film.size[1], film.size[0], 3) or pixels.dtype != np.uint8:
                    height, width, channels = pixels.shape
                    raise InputError(
                        f"{film.path}: frame {frames[0] + written}: expected opaque RGB of 8 bits and "
                        f"{film.size[0]}x{film.size[1]} as others, got {channels} channels of {8 * pixels.itemsize} "
                        f"bits and {width}x{height}: convert it"
                    )
                file.write(np.ascontiguousarray(images.reduce_8_bits(pixels, rendition, size)).data)
                written += 1
        if written != frames[1] - frames[0] + 1:
            raise InputError(
                f"{film.path}: expected {film.count} frames as its header says, the film ends before frame "
                f"{frames[0] + written}: copy it again, or choose other scene.frames"
            )
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    steps = np.diff(moments)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if (off := np.abs(steps - usual) > _UNSTEADY * usual + 1).any():  # + 1: milliseconds may be rounded
        frame = int(off.argmax()) + 1
        print(
            f"{film.path}: frame {frame} comes {steps[frame - 1]:.4g} ms after the one before, others {usual:.4g} ms: "
            f"are frames missing, or is its rate variable? Equal steps are supposed: convert it by ffmpeg -r",
            file=sys.stderr,
        )
