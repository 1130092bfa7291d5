"""Load your own captures: images, a COLMAP model of their cameras, and times from file names or times.csv."""

import os
from pathlib import Path

import numpy as np
import torch

from gsbench.errors import InputError
from gsbench.scenes import colmap, files, shots, times
from gsbench.scenes.files import ImageFinder
from gsbench.scenes.lens import Lens
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.scene import Scene, hold_out
from gsbench.scenes.shots import MASKS, Shot

HELD_OUT = 8  # every eighth view in the order of time is a test view
IMAGES = "images"


def load(root: Path, *, downscale: int, background: tuple[float, float, float], resize: str | None = None) -> Scene:
    """Load a scene from images and a COLMAP model; see `gsbench.scenes.load` for the arguments.

    - `images/` has a PNG or a JPEG for each image that the model registers. If the one that the model names is missing,
      an image of the same name with another suffix is read.
    - `sparse/0/`, or `sparse/`, has the model: cameras, images and points3D, as .bin or .txt. Its points are the
      initial points. Of several models the one with the most images is read.
    - Times come from `times.csv` with the columns `name,time`, otherwise from a number in each name, which
      `gsbench.scenes.times` chooses. They are scaled to [0, 1]. If no name has a number, the scene has no times.
    - `masks/` may have an 8-bit grey PNG for each image, with the number of the object in each pixel.

    The distortion of lenses is undone by OpenCV. The principal point may lie anywhere. Every eighth image in the order
    of time and then of name is a test view, from the eighth on; the others are for training.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file.
    """
    name = Path(os.path.abspath(root)).name  # if the folder is a link, the name of the link
    root = root.resolve()
    folder, notes = colmap.largest_model(root / "sparse")
    cameras, posed, points = (colmap.read_part(folder, part) for part in ("cameras", "images", "points3D"))
    listed, digests, more = _list_shots(root, posed, colmap.read_cameras(cameras))
    initial = colmap.read_points(points)
    loaded = shots.read(listed, downscale=downscale, background=background, resize=resize)
    digests |= {
        shot.path.relative_to(root).as_posix(): digest for shot, digest in zip(listed, loaded.digests, strict=True)
    }
    digests |= {part.path.relative_to(root).as_posix(): files.digest(part.data) for part in (cameras, posed, points)}
    train, test = hold_out(loaded.views, HELD_OUT)
    return standard_scene(
        name=name,
        train=train,
        val=[],
        test=test,
        background=background,
        points=initial,
        fingerprint=files.fingerprint(digests),
        notes=(*more, *notes, *loaded.notes),
        up=None,
    )


def _list_shots(
    root: Path, posed: colmap.ModelFile, lenses: dict[int, Lens]
) -> tuple[list[Shot], dict[str, str], list[str]]:
    """Return the images of a model in the order of time, the SHA-256 of times.csv by name, if it exists, and notes."""
    listed = colmap.read_images(posed)
    if len(listed) < HELD_OUT:
        raise InputError(f"{posed.path}: expected at least {HELD_OUT} images, as one in {HELD_OUT} is a test view, "
                         f"got {len(listed)}", docs="data.md#your-own-capture")  # fmt: skip
    for image in listed:
        if image.camera not in lenses:
            raise InputError(f"{posed.path}: image {image.name[:80]!a}: expected a camera of the model, got number "
                             f"{image.camera}")  # fmt: skip
    names, viewmats = [image.name for image in listed], np.stack([image.viewmat for image in listed])
    places = times.places_of(viewmats, [lenses[image.camera].key for image in listed])
    timed, digests = times.of_images(root, names, viewmats, places, posed.path)
    result, finder = [], ImageFinder(root)
    for image, time in zip(listed, timed.values, strict=True):
        where = f"{posed.path}: image {image.name[:80]!a}"
        path = finder.find(f"{IMAGES}/{image.name}", where)
        name = files.without_suffix(path.relative_to(root / IMAGES).as_posix())
        mask = files.find_inside(root, f"{MASKS}/{name}.png", where) if (root / MASKS).is_dir() else None
        viewmat = torch.from_numpy(image.viewmat)
        named_by = f"{path} (named {image.name[:80]!a} in {posed.path.name})"
        result.append(Shot(path, mask, name, named_by, time, viewmat, lenses[image.camera]))
    ordered = sorted(result, key=lambda shot: (shot.time or 0.0, shot.name))
    return ordered, digests, timed.notes + finder.notes()
