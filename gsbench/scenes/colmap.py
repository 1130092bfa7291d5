"""Load captures: images, a COLMAP model of their cameras (.bin or .txt), and times from file names or times.csv.

What is missing, damaged or contradictory raises `InputError`, which names the file and the record.
"""

import math
import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsbench.errors import InputError
from gsbench.reading import read_file
from gsbench.scenes import files, shots, times
from gsbench.scenes.files import ImageFinder
from gsbench.scenes.images import Rendition
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.points import read_ply
from gsbench.scenes.scene import HELD_OUT, Points, Scene, hold_out
from gsbench.scenes.shots import MASKS, Lens, Shot

IMAGES = "images"  # the folder of the images
_MAX_FILE = 1 << 32  # bytes
# COLMAP, "Output format": the fixed parts of the records of its binary files.
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, number of the model, width, height; then the parameters of the model
_IMAGE = struct.Struct("<I4d3dI")  # id, quaternion (w first), translation, id of the camera; then name and keypoints
_POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, length of the track
_KEYPOINT = 24  # bytes of a keypoint of an image
_TRACK = 8  # bytes of an element of a track: the number of the image and that of the keypoint
_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
_PARAMETERS = {  # of the models that are read: f or fx fy, the principal point, the distortion
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
_LARGEST = 1e9  # the largest number in a model
_UNIT = 1e-3  # tolerance of the length of quaternions


class ModelFile(NamedTuple):
    """Hold the path and the content of a file of a model."""

    path: Path
    data: bytes


@dataclass(frozen=True)
class PosedImage:
    """Hold the name, the pose and the camera of an image that COLMAP registered."""

    name: str  # relative to the folder of the images
    viewmat: NDArray[np.float64]  # [4, 4] world to camera, OpenCV axes
    camera: int  # id, a key of `read_cameras`


def load(root: Path, name: str, rendition: Rendition) -> Scene:
    """Load a scene from images and a COLMAP model.

    - `images/` has a PNG or a JPEG for each image that the model registers. If the one that the model names is missing,
      an image of the same name with another suffix is read.
    - `sparse/0/`, or `sparse/`, has the model: cameras, images and points3D, as .bin or .txt. Its points are the
      initial points. Of several models the one with the most images is read.
    - Times come from `times.csv` with the columns `name,time`, otherwise from a number in each name, which
      `gsbench.scenes.times` chooses. They are scaled to [0, 1]. If no name has a number, the scene has no times.
    - `masks/` may have an 8-bit grey PNG for each image, with the number of the object in each pixel.

    The distortion of lenses is undone by OpenCV. The principal point may lie anywhere. Every eighth image in the order
    of time and then of name is a test view, from the eighth on; the others are for training.
    """
    folder, notes = largest_model(root / "sparse")
    model = cameras, posed, points = [read_part(folder, part) for part in ("cameras", "images", "points3D")]
    texts = [text.name for part in model if (text := part.path.with_suffix(".txt")) != part.path and text.exists()]
    if texts:
        notes.append(f"{', '.join(texts)} in {folder.relative_to(root)} are not read, as there are .bin files")
    if (folder / "test.txt").exists():  # of the code of 3DGS
        notes.append(f"test.txt in {folder.relative_to(root)} is not read: every {HELD_OUT}th image is a test view")
    listed, digests, time_notes = _list_shots(root, posed, read_cameras(cameras))
    initial = read_points(points)
    loaded = shots.read(listed, rendition)
    digests |= loaded.by_path(root)
    digests |= {part.path.relative_to(root).as_posix(): files.digest(part.data) for part in model}
    train, test = hold_out(loaded.views, HELD_OUT)
    return standard_scene(
        name=name,
        train=train,
        test=test,
        background=rendition.background,
        points=initial,
        fingerprint=files.fingerprint(digests),
        notes=(*time_notes, *notes, *loaded.notes),
    )


def _list_shots(root: Path, posed: ModelFile, lenses: dict[int, Lens]) -> tuple[list[Shot], dict[str, str], list[str]]:
    """Return the images of a model in the order of time, the SHA-256 of times.csv by name, if it exists, and notes."""
    posed_images = read_images(posed)
    if len(posed_images) < HELD_OUT:
        raise InputError(
            f"{posed.path}: expected at least {HELD_OUT} images, as one in {HELD_OUT} is a test view, "
            f"got {len(posed_images)}",
            docs="data.md#your-own-capture",
        )
    for image in posed_images:
        if image.camera not in lenses:
            raise InputError(
                f"{posed.path}: image {image.name[:80]!a}: expected a camera of the model, got number {image.camera}"
            )
    names, viewmats = [image.name for image in posed_images], np.stack([image.viewmat for image in posed_images])
    keys = [lenses[image.camera].key for image in posed_images]
    timed, digests = times.of_images(root, times.NamedImages(names, viewmats, keys, posed.path))
    listed_shots, finder, image_of_view = [], ImageFinder(root), dict[str, str]()
    for image, time in zip(posed_images, timed.values, strict=True):
        where = f"{posed.path}: image {image.name[:80]!a}"
        path = finder.find(f"{IMAGES}/{image.name}", where)
        name = files.without_suffix(path.relative_to(root / IMAGES).as_posix())
        if (other := image_of_view.setdefault(name, image.name)) != image.name:
            raise InputError(
                f"{where}: expected a file of its own, and a name that differs in more than its suffix, got "
                f"{path.relative_to(root).as_posix()[:80]!a}, and {other[:80]!a} is there too: rename or remove one"
            )
        mask = files.find_inside(root, f"{MASKS}/{name}.png", where) if (root / MASKS).is_dir() else None
        viewmat = torch.from_numpy(image.viewmat)
        named_by = f"{path} (named {image.name[:80]!a} in {posed.path.name})"
        listed_shots.append(Shot(path, mask, name, named_by, time, viewmat, lenses[image.camera]))
    ordered = sorted(listed_shots, key=lambda shot: (shot.time or 0.0, shot.name))  # either all have a time or none
    return ordered, digests, timed.notes + finder.notes() + _unregistered(root, ordered)


def _unregistered(root: Path, listed: Sequence[Shot]) -> list[str]:
    """Return a sentence on images in the folder that the model does not have, if there are any."""
    known = {shot.path for shot in listed}
    paths = [Path(folder, name) for folder, _, names in os.walk(root / IMAGES) for name in names]
    images = [path for path in paths if files.without_suffix(path.name) != path.name]
    others = sorted({*images} - known)
    if not others:
        return []
    first = others[0].relative_to(root).as_posix()
    return [f"{len(others)} images are not in the COLMAP model and are left out, such as {first[:80]!a}"]


def read_part(folder: Path, part: str) -> ModelFile:
    """Read one of the parts `cameras`, `images` and `points3D` of a model, whose folder is for example sparse/0."""
    for path in (folder / f"{part}.bin", folder / f"{part}.txt"):
        if path.exists():
            return ModelFile(path, read_file(path, str(path), _MAX_FILE))
    raise InputError(
        f"{folder}: expected {part}.bin or {part}.txt of COLMAP, found neither", docs="data.md#your-own-capture"
    )


def largest_model(sparse: Path) -> tuple[Path, list[str]]:
    """Return the folder of the model with the most images in `sparse` and its subfolders, and what was left out.

    COLMAP writes a folder 0, 1, .. for each part of a capture that it could not join. Of equals, the first is taken, 2
    before 10, and `sparse` itself last.
    """
    folders = sorted(sparse.iterdir(), key=lambda path: (len(path.name), path.name)) if sparse.is_dir() else []
    models = [
        folder for folder in (*folders, sparse) if any((folder / f"images.{kind}").exists() for kind in ("bin", "txt"))
    ]
    if len(models) < 2:
        return models[0] if models else sparse, []
    counts = {folder: len(read_images(read_part(folder, "images"))) for folder in models}
    largest = max(models, key=counts.__getitem__)
    rest = ", ".join(
        f"{folder.relative_to(sparse.parent)} has {counts[folder]}" for folder in models if folder != largest
    )
    return largest, [
        f"several COLMAP models: {largest.relative_to(sparse.parent)} with the most images, "
        f"{counts[largest]}, is read; {rest}"
    ]


def read_cameras(file: ModelFile) -> dict[int, Lens]:
    """Return the lenses of a model by the ids of their cameras."""
    rows = _text_cameras(file) if file.path.suffix == ".txt" else _binary_cameras(file)
    by_id = {}
    for camera, model, width, height, values in rows:
        if camera in by_id:
            raise InputError(f"{file.path}: camera {camera} appears twice: write the model again")
        by_id[camera] = _lens(model, width, height, values, f"{file.path}: camera {camera}")
    return by_id


def read_images(file: ModelFile) -> list[PosedImage]:
    """Return the registered images of a model."""
    rows = _text_images(file) if file.path.suffix == ".txt" else _binary_images(file)
    by_name: dict[str, PosedImage] = {}
    for name, pose, camera in rows:
        where = f"{file.path}: image {name[:80]!a}"
        if name in by_name:
            raise InputError(f"{where} appears twice: write the model again")
        if not all(abs(value) < _LARGEST for value in pose) or abs(math.hypot(*pose[:4]) - 1) > _UNIT:
            raise InputError(f"{where}: expected a unit quaternion qw qx qy qz and a translation, got {pose}")
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix()  # scipy has w last
        viewmat[:3, 3] = pose[4:]
        by_name[name] = PosedImage(name, viewmat, camera)
    return list(by_name.values())


def points_beside(root: Path) -> tuple[Points | None, dict[str, str]]:
    """Return the initial points of a folder that has its cameras elsewhere, and the digest of their file by its name.

    They are those of the COLMAP model in `sparse/0`, or of `points3d.ply`, in any case. Without both there are none.
    """
    if (root / "sparse" / "0").is_dir():
        file = read_part(root / "sparse" / "0", "points3D")
        return read_points(file), {file.path.relative_to(root).as_posix(): files.digest(file.data)}
    for name in sorted(os.listdir(root), reverse=True):  # the lower case first
        if name.lower() == "points3d.ply":
            return read_ply(root / name), {name: files.digest((root / name).read_bytes())}
    return None, {}


def read_points(file: ModelFile) -> Points:
    """Return positions (float64) and colours of the points of a model."""
    path = file.path
    rows = _text_points(file) if path.suffix == ".txt" else _binary_points(file)
    values = np.array(rows, np.float64).reshape(-1, 6)  # x y z, r g b from 0 to 255
    if not len(values):
        raise InputError(f"{path}: expected at least one point, where Gaussians start: run `colmap point_triangulator`")
    if not (np.abs(values[:, :3]) <= np.finfo(np.float32).max).all():
        raise InputError(f"{path}: expected finite positions, some are not")
    if values[:, 3:].min() < 0 or values[:, 3:].max() > 255:
        raise InputError(f"{path}: expected colours from 0 to 255, some are outside")
    colors = torch.from_numpy(values[:, 3:].astype(np.float32)) / 255
    return Points(torch.from_numpy(values[:, :3].copy()), colors)


def _lens(model: str, width: int, height: int, values: tuple[float, ...], where: str) -> Lens:
    """Check the numbers of a camera and return its intrinsics and distortion."""
    names = _PARAMETERS[model]
    if len(values) != len(names) or not all(abs(value) < _LARGEST for value in values):
        raise InputError(f"{where}: expected {model} with {' '.join(names)}, got {values}")
    parameters = dict(zip(names, values, strict=True))
    fx, fy = (parameters.get(name, parameters.get("f", 0.0)) for name in ("fx", "fy"))
    if not (min(fx, fy) > shots.SMALLEST and min(width, height) > 0):
        raise InputError(f"{where}: expected positive focal lengths and sizes, got {fx} {fy} for {width}x{height}")
    K = np.array([[fx, 0, parameters["cx"]], [0, fy, parameters["cy"]], [0, 0, 1]])
    k1, k2, p1, p2 = (parameters.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
    return Lens(width, height, K, (k1, k2, p1, p2))


def _check_model(model: str, where: str) -> str:
    """Return the name of a lens model; raise InputError if it is not read."""
    if model not in _PARAMETERS:
        raise InputError(
            f"{where}: expected a camera {', '.join(_PARAMETERS)}, got {model[:40]!a}: undo its "
            "distortion by `colmap image_undistorter`, which writes PINHOLE",
            docs="data.md#your-own-capture",
        )
    return model


_CameraRow = tuple[int, str, int, int, tuple[float, ...]]  # id, model, width, height, parameters
_ImageRow = tuple[str, tuple[float, ...], int]  # name, quaternion (w first) and translation, id of the camera


def _binary_cameras(file: ModelFile) -> Iterator[_CameraRow]:
    """Yield the cameras of cameras.bin."""
    reader = _Reader(file)
    for _ in range(reader.unpack(_COUNT)[0]):
        camera, model, width, height = reader.unpack(_CAMERA)
        model_name = _MODELS[model] if 0 <= model < len(_MODELS) else f"model {model}"
        names = _PARAMETERS[_check_model(model_name, f"{file.path}: camera {camera}")]
        yield camera, model_name, width, height, reader.unpack(struct.Struct(f"<{len(names)}d"))
    reader.finish()


def _text_cameras(file: ModelFile) -> Iterator[_CameraRow]:
    """Yield the cameras of cameras.txt, whose lines have an id, a model, width, height and the model's parameters."""
    for line_number, line in _lines(file):
        if line:
            words = line.split()
            with _expects("a camera's id, model, width, height and parameters", file, line_number, line):
                identifier, width, height = int(words[0]), int(words[2]), int(words[3])
                values = tuple(float(word) for word in words[4:])
            yield identifier, _check_model(words[1], f"{file.path}: line {line_number}"), width, height, values


def _binary_images(file: ModelFile) -> Iterator[_ImageRow]:
    """Yield the images of images.bin, whose lengths differ because each has a name and keypoints."""
    reader = _Reader(file)
    for _ in range(reader.unpack(_COUNT)[0]):
        _, *pose, camera = reader.unpack(_IMAGE)
        name = reader.text()
        reader.skip(_KEYPOINT * reader.unpack(_COUNT)[0])
        yield name, tuple(pose), camera
    reader.finish()


def _text_images(file: ModelFile) -> Iterator[_ImageRow]:
    """Yield the images of images.txt, each of which has two lines: the second lists keypoints and may be empty."""
    lines = _lines(file)
    for line_number, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)  # the name is last, and may have spaces
        with _expects("an image's id, qw qx qy qz tx ty tz, camera and name", file, line_number, line):
            row = words[9], tuple(float(word) for word in words[1:8]), int(words[8])
        line_number, line = next(lines, (line_number + 1, ""))  # an editor may have removed an empty last line
        if not _are_keypoints(line.split()):
            raise InputError(
                f"{file.path}: line {line_number}: expected the keypoints (x y id ..) of image "
                f"{row[0][:40]!a} or an empty line, got {line[:60]!a}: write an empty line after each "
                "image",
                docs="data.md#your-own-capture",
            )
        yield row


def _are_keypoints(words: list[str]) -> bool:
    """Return whether words are x, y and the number of a point in turn."""
    try:
        for kind, column in zip((float, float, int), (words[::3], words[1::3], words[2::3]), strict=True):
            for word in column:
                kind(word)
    except ValueError:
        return False
    return len(words) % 3 == 0


def _binary_points(file: ModelFile) -> list[tuple[float, ...]]:
    """Return (x, y, z, r, g, b) of each point of points3D.bin; records differ in length, because each has a track."""
    reader = _Reader(file)
    rows: list[tuple[float, ...]] = []
    for _ in range(reader.unpack(_COUNT)[0]):
        _, x, y, z, red, green, blue, _, track = reader.unpack(_POINT)
        reader.skip(_TRACK * track)
        rows.append((x, y, z, red, green, blue))
    reader.finish()
    return rows


def _text_points(file: ModelFile) -> list[tuple[float, ...]]:
    """Return (x, y, z, r, g, b) of each point of points3D.txt; an id is before them, an error and a track behind."""
    rows: list[tuple[float, ...]] = []
    for line_number, line in _lines(file):
        if line:
            with _expects("an id, x y z and a colour", file, line_number, line):
                x, y, z, red, green, blue = (float(word) for word in line.split()[1:7])
            rows.append((x, y, z, red, green, blue))
    return rows


def _lines(file: ModelFile) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file that are no comments, without spaces around them, with their numbers from 1."""
    for number, line in enumerate(file.data.decode("utf-8-sig", "replace").split("\n"), 1):
        if not line.strip().startswith("#"):
            yield number, line.strip()


@contextmanager
def _expects(what: str, file: ModelFile, number: int, line: str) -> Iterator[None]:
    """Raise an InputError that names the line if its words are no numbers, or too few, within a `with` block."""
    try:
        yield
    except (ValueError, IndexError):
        raise InputError(f"{file.path}: line {number}: expected {what}, got {line[:60]!a}") from None


class _Reader:
    """Reads the records of a binary file one after another; raises InputError at the end of a truncated file."""

    def __init__(self, file: ModelFile) -> None:
        self._path, self._data, self._at = file.path, file.data, 0

    def unpack(self, record: struct.Struct) -> tuple[Any, ...]:
        """Read a record of fixed length."""
        self.skip(record.size)
        return record.unpack_from(self._data, self._at - record.size)

    def text(self) -> str:
        """Read a text that ends with a zero byte."""
        start, end = self._at, self._data.find(b"\0", self._at)
        self.skip((end if end >= 0 else len(self._data)) + 1 - start)  # without a zero byte too far, which is refused
        return self._data[start:end].decode("utf-8", "replace")

    def skip(self, size: int) -> None:
        """Advance by `size` bytes."""
        self._at += size
        if self._at > len(self._data):
            raise InputError(
                f"{self._path}: truncated, its records need more than its {len(self._data)} bytes: copy it again"
            )

    def finish(self) -> None:
        """Raise InputError unless all bytes were read."""
        if self._at != len(self._data):
            raise InputError(
                f"{self._path}: expected {self._at} bytes for its records, got {len(self._data)}: copy it again"
            )
