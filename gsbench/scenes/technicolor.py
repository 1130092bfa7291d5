"""Load scenes of the Technicolor light field data: a PNG for each frame and camera of a 4 x 4 camera array."""

import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gsbench.errors import InputError
from gsbench.reading import read_file
from gsbench.scenes import colmap, files, images, shots
from gsbench.scenes.images import Rendition, Size
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Scene, View
from gsbench.scenes.shots import Lens, Shot

CAMERAS = "cameras_parameters.txt"
COLUMNS = ("f", "cu", "cv", "ar", "sk", "qw", "qx", "qy", "qz", "tx", "ty", "tz")  # intrinsics, rotation, translation
DISTORTION = ("d1", "d2")  # coefficients of the original images, which have lens distortion
TEST_CAMERA = 10  # the camera that papers on this data hold out (row 2, column 2 of the array)
IMAGE = re.compile(r"(?P<scene>.+)_undist_(?P<frame>\d{5})_(?P<camera>\d{2})\.png")
_MAX_TEXT = 1 << 20  # bytes of cameras_parameters.txt
_UNIT = 1e-3  # tolerance of the length of quaternions


@dataclass(frozen=True)
class _Image:
    """Hold the path, the frame number and the camera number of an image file."""

    path: Path
    frame: int
    camera: int


def load(
    root: Path,
    name: str,
    rendition: Rendition,
    *,
    frames: tuple[int, int] | None = None,  # the first and the last
    repair: tuple[str, ...] = (),
) -> Scene:
    """Load a scene of the Technicolor light field data (Sabater et al. 2017).

    The folder has images `<Scene>_undist_<frame>_<camera>.png` and a table of cameras `cameras_parameters.txt` with
    intrinsics in pixels and poses (world to camera, OpenCV axes). Camera 10 is the test split, the others are for
    training. Times are 0 for the first frame to 1 for the last. Initial points come from a COLMAP model in `sparse/0`
    or from `points3d.ply`, if one of these exists.

    Names in `repair`, such as Birthday_undist_00173_09, are those of damaged images, each replaced by the image of the
    same camera one frame before. Names of other scenes are ignored, so that the scenes of a data set can share a list.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file. An image in `repair` is
            whole, is not loaded, is one of the test camera, or the image before it is missing or damaged too.
    """
    source = root / CAMERAS
    text = read_file(source, str(source), _MAX_TEXT)
    rows = _read_rows(text.decode("utf-8-sig", "replace"), source)
    if len(rows) <= TEST_CAMERA:
        raise InputError(
            f"{source}: expected more than {TEST_CAMERA} cameras, number {TEST_CAMERA} is the test view, "
            f"got {len(rows)}"
        )
    listed = _list_images(root, frames, len(rows))
    replaced = _replacements(repair, listed)
    views, digests, notes = _read_views(listed, replaced, rows, rendition)
    for image, before in replaced.items():
        print(f"{image.path}: damaged, replaced by {before.path.name} (data.repair)", file=sys.stderr)
    digests[CAMERAS] = files.digest(text)
    train = [view for image, view in zip(listed, views, strict=True) if image.camera != TEST_CAMERA]
    test = [view for image, view in zip(listed, views, strict=True) if image.camera == TEST_CAMERA]
    points, points_file = colmap.points_beside(root)
    return standard_scene(
        name=name,
        train=train,
        test=test,
        background=rendition.background,
        points=points,
        fingerprint=files.fingerprint(digests | points_file),
        repaired=tuple(image.path.stem for image in replaced),
        notes=(*files.unread(CAMERAS, rows[0].keys() - {*COLUMNS, *DISTORTION}), *notes),
    )


def _read_rows(text: str, source: Path) -> list[dict[str, float]]:
    """Parse the table of cameras and return a dictionary of each row, keyed by the column names of the header."""
    lines = [line.split() for line in text.splitlines() if line.strip()]
    header = lines[0] if lines else []
    missing = [name for name in COLUMNS if name not in header]
    if missing or len(set(header)) != len(header):
        raise InputError(f"{source}: expected a header with {' '.join(COLUMNS)}, got {' '.join(header)[:120]!a}")
    rows = []
    for i, values in enumerate(lines[1:]):
        where = f"{source}: camera {i}"
        if len(values) != len(header):
            raise InputError(f"{where}: expected {len(header)} numbers as the header has names, got {len(values)}")
        row = {
            name: files.number(value, 1e9, f"{where}: {name}: expected a number")
            for name, value in zip(header, values, strict=True)
        }
        for name in ("sk", *DISTORTION):
            if row.get(name, 0.0) != 0:
                raise InputError(
                    f"{where}: {name}: expected 0, a pinhole camera, got {row[name]}: take the release's "
                    f"*_undist_* images with their parameters, or undistort by cv2.undistort"
                )
        if row["f"] <= 0 or row["ar"] <= 0:
            raise InputError(f"{where}: expected positive f and ar, got {row['f']} and {row['ar']}")
        if abs(math.hypot(row["qw"], row["qx"], row["qy"], row["qz"]) - 1) > _UNIT:
            raise InputError(f"{where}: expected a unit quaternion qw qx qy qz")
        rows.append(row)
    return rows


def _camera(row: dict[str, float], size: Size) -> tuple[torch.Tensor, Lens]:
    """Return the viewmat [4, 4] and the lens of a row, by the names of COLUMNS, for images of a size."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_quat([row[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()  # scipy: w last
    viewmat[:3, 3] = row["tx"], row["ty"], row["tz"]
    K = np.array([[row["f"], 0, row["cu"]], [0, row["f"] * row["ar"], row["cv"]], [0, 0, 1]])
    return torch.from_numpy(viewmat), Lens(*size, K, shots.PINHOLE)


def _list_images(root: Path, frames: tuple[int, int] | None, cameras: int) -> list[_Image]:
    """List the image files, sorted by frame and then camera; raise InputError if an image is missing."""
    by_number: dict[tuple[int, int], Path] = {}  # by frame and camera
    scenes = set()
    for path in sorted(root.glob("*.png")):
        name = IMAGE.fullmatch(path.name)
        if name is None:
            continue
        scenes.add(name["scene"])
        frame, camera = int(name["frame"]), int(name["camera"])
        if camera >= cameras:
            raise InputError(f"{root / CAMERAS}: expected a row of camera {camera} of {path.name}, got {cameras} rows")
        if frames is None or frames[0] <= frame <= frames[1]:
            by_number[frame, camera] = files.find_inside(root, path.name, str(root))
    if len(scenes) > 1:
        raise InputError(f"{root}: expected images of one scene, got those of {', '.join(sorted(scenes))[:120]}")
    numbers = sorted({frame for frame, _ in by_number}) if frames is None else range(frames[0], frames[1] + 1)
    if not numbers:
        raise InputError(f"{root}: expected images <Scene>_undist_<frame>_<camera>.png, found none")
    for frame in numbers:
        for camera in range(cameras):
            if (frame, camera) not in by_number:
                raise InputError(
                    f"{root}: expected an image *_undist_{frame:05d}_{camera:02d}.png of every camera in "
                    f"{CAMERAS}, it is missing: copy it, or choose other scene.frames"
                )
    return [_Image(by_number[frame, camera], frame, camera) for frame in numbers for camera in range(cameras)]


def _replacements(names: tuple[str, ...], listed: list[_Image]) -> dict[_Image, _Image]:
    """Return the image that replaces each named image of this scene: that of the same camera, one frame before."""
    by_number = {(image.frame, image.camera): image for image in listed}
    scene = IMAGE.fullmatch(listed[0].path.name)
    replaced = {}
    for name in names:
        match = IMAGE.fullmatch(f"{name.removesuffix('.png')}.png")
        if match is None:
            raise InputError(f"data.repair: expected names such as Birthday_undist_00173_09, got {name!a:.80}")
        if scene is None or match["scene"] != scene["scene"]:
            continue
        frame, camera = int(match["frame"]), int(match["camera"])
        damaged, before = (by_number.get((number, camera)) for number in (frame, frame - 1))
        if damaged is None or before is None or camera == TEST_CAMERA:  # a test needs the true image
            raise InputError(
                f"data.repair: expected training images that are loaded, as those before them, got {name}: leave it "
                "out, or choose other scene.frames"
            )
        replaced[damaged] = before
    return replaced


def _read_views(
    listed: list[_Image],
    replaced: dict[_Image, _Image],
    rows: list[dict[str, float]],
    rendition: Rendition,
) -> tuple[list[View], dict[str, str], list[str]]:
    """Return the views of all images, the SHA-256 of each file by name, and what was decided about sizes.

    The name of a damaged image that is replaced also says by which image, so that a fingerprint depends on it.
    """
    first, last = listed[0].frame, listed[-1].frame
    size = shots.size_of(listed[0].path, str(listed[0].path))
    cameras = [_camera(row, size) for row in rows]
    by_path = {image.path: image for image in listed}
    listed_shots = [
        Shot(
            image.path,
            None,  # no mask
            image.path.stem,
            str(image.path),
            (image.frame - first) / max(1, last - first),
            *cameras[image.camera],
        )
        for image in listed
    ]

    def decode(shot: Shot, data: bytes) -> images.Pixels:  # the image before in place of a damaged one
        image = by_path[shot.path]
        if image not in replaced:
            return _decode(image, data)
        try:
            images.decode_photo(data, shot.where)
        except images.DamagedError:
            before = replaced[image]
            return _decode(before, images.read_image(before.path, str(before.path)))
        raise InputError(f"data.repair: expected a damaged image, {image.path} is whole: leave it out")

    loaded = shots.read(listed_shots, rendition, in_8_bits=rendition.downscale == 1, decode=decode)
    names = [image.path.name for image in listed]
    for i, image in enumerate(listed):
        if image in replaced:
            names[i] += f" replaced by {replaced[image].path.name}"
    return loaded.views, dict(zip(names, loaded.digests, strict=True)), loaded.notes


def _decode(image: _Image, data: bytes) -> images.Pixels:
    """Decode an opaque image; if a training image is damaged, the error names the option that replaces it."""
    try:
        decoded = images.decode_photo(data, str(image.path))
    except images.DamagedError as error:
        if image.camera == TEST_CAMERA:
            raise
        advice = f"replace it by the frame before with data.repair=[{image.path.stem}]"
        raise images.DamagedError(f"{error}, or {advice}") from error
    if decoded.shape[2] != 3:
        raise InputError(f"{image.path}: expected an opaque RGB image, got one with alpha")
    return decoded
