"""Load scenes of HyperNeRF's rig of two moving cameras (vrig) in the layout of Nerfies: a JSON file for each image."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.reading import MAX_JSON, parse_json, read_file
from gsbench.scenes import files, shots
from gsbench.scenes.images import Rendition
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Scene
from gsbench.scenes.shots import Lens, Shot

SPLITS = "dataset.json"
TIMES = "metadata.json"
CAMERAS = "camera"
IMAGES = "rgb/2x"  # the size of published numbers; `downscale` counts from there
_MOST_TIMES = 1 << 20
_KNOWN_OF_IMAGE = {"warp_id", "camera_id", "appearance_id"}  # of metadata.json; appearance_id repeats warp_id
_UNREAD = ("points.npy", "scene.json")  # the points and the bounds of a release's own training

Vector = tuple[float, float, float]


@dataclass
class _Splits:
    """The keys of dataset.json: names of images."""

    ids: list[str]
    train_ids: list[str]
    val_ids: list[str]  # of the other camera of the rig at the time of a training image


@dataclass
class CameraFile:
    """The keys of camera/<id>.json, in pixels of the images in rgb/1x; the axes are OpenCV's."""

    orientation: tuple[Vector, Vector, Vector]  # rows of a rotation from world to camera
    position: Vector  # in world space
    focal_length: float
    principal_point: tuple[float, float]
    image_size: tuple[int, int]  # width and height
    skew: float = 0.0
    pixel_aspect_ratio: float = 1.0  # the focal length along y is so many times that along x
    radial_distortion: Vector = (0.0, 0.0, 0.0)  # k1 k2 k3
    tangential_distortion: tuple[float, float] = (0.0, 0.0)  # p1 p2
    tangential: tuple[float, float] = (0.0, 0.0)  # the same, by the name that some files have


def load(root: Path, name: str, rendition: Rendition) -> Scene:
    """Load a scene of HyperNeRF (Park et al. 2021) that was taken by a rig of two cameras.

    - `dataset.json` has the names of the images: those of `val_ids` are the test split.
    - `metadata.json` has the time of each image, `warp_id`, which is divided by the largest.
    - `camera/<id>.json` has the camera of an image, whose distortion is undone, and `rgb/2x/<id>.png` the image.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file and the field.
    """
    splits, digest, others = files.read_keys(_Splits, root / SPLITS)
    names = [*splits.train_ids, *splits.val_ids]
    if not splits.train_ids or not splits.val_ids or len({*names}) != len(names):
        raise InputError(
            f"{root / SPLITS}: expected train_ids and val_ids, as of HyperNeRF's vrig scenes, and each image once, got "
            f"{len(splits.train_ids)} and {len(splits.val_ids)} images, {len({*names})} different"
        )
    digests = {SPLITS: digest}
    warps, digests[TIMES], of_image = _read_warps(root / TIMES, names)
    if not (last := max(warps.values())):
        raise InputError(f"{root / TIMES}: warp_id: expected images of several times, all are 0")
    listed, unread = [], set[str]()
    for image in names:
        where = f"{root / SPLITS}: image {image[:80]!a}"
        source = files.find_inside(root, f"{CAMERAS}/{image}.json", where)
        content, digests[f"{CAMERAS}/{image}.json"], keys = files.read_keys(CameraFile, source)
        unread |= keys
        viewmat, lens = camera_of(content, str(source))
        path = files.find_inside(root, f"{IMAGES}/{image}.png", where)
        listed.append(Shot(path, None, image, f"{path} ({where})", warps[image] / last, viewmat, lens))
    loaded = shots.read(listed, rendition)
    digests |= loaded.by_path(root)
    count = len(splits.train_ids)
    return standard_scene(
        name=name,
        train=loaded.views[:count],
        test=loaded.views[count:],
        background=rendition.background,
        fingerprint=files.fingerprint(digests),
        notes=(
            *files.unread(SPLITS, others),
            *files.unread(TIMES, of_image - _KNOWN_OF_IMAGE),
            *files.unread(f"{CAMERAS}/*.json", unread),
            *([f"{rest} images of {SPLITS} are in no split"] if (rest := len({*splits.ids} - {*names})) else []),
            *(f"{file} is not read" for file in _UNREAD if (root / file).exists()),
            *loaded.notes,
        ),
    )


def _read_warps(source: Path, names: Sequence[str]) -> tuple[dict[str, int], str, set[str]]:
    """Return the number of the time of each image, the SHA-256 of metadata.json, and the keys that its images have."""
    data = read_file(source, str(source), MAX_JSON)
    content = parse_json(data, str(source))
    warps, keys = {}, set[str]()
    for name in names:
        item = content.get(name) if isinstance(content, dict) else None
        warp = item.get("warp_id") if isinstance(item, dict) else None
        if type(warp) is not int or not 0 <= warp < _MOST_TIMES:
            raise InputError(f"{source}: {name[:80]!a}: expected an object with warp_id, the number of its time")
        warps[name] = warp
        keys |= {*(item or ())}
    return warps, files.digest(data), keys


def camera_of(content: CameraFile, where: str) -> tuple[Tensor, Lens]:  # [4, 4] float64
    """Return the viewmat and the lens of a camera; raise InputError if it has skew or a third radial term."""
    orientation, position = np.array(content.orientation), np.array(content.position)
    cx, cy = content.principal_point
    k1, k2, k3 = content.radial_distortion
    p1, p2 = content.tangential_distortion if any(content.tangential_distortion) else content.tangential
    viewmat = np.eye(4)
    viewmat[:3, :3] = orientation
    viewmat[:3, 3] = -orientation @ position
    shots.check_rigid(viewmat, f"{where}: orientation", "world-to-camera")
    width, height = content.image_size
    fx, fy = content.focal_length, content.focal_length * content.pixel_aspect_ratio
    if min(width, height) < 1 or min(fx, fy) < shots.SMALLEST:
        raise InputError(f"{where}: expected positive focal lengths and sizes, got {fx} {fy} for {width}x{height}")
    if content.skew or k3:
        raise InputError(f"{where}: skew, radial_distortion: expected 0 and k1 k2 0, got {content.skew} and k3 = {k3}")
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return torch.from_numpy(viewmat), Lens(width, height, K, (k1, k2, p1, p2))
