"""Load scenes in nerfstudio's layout: one file transforms.json with the cameras of all images."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from gsbench.errors import InputError
from gsbench.scenes import blender, files, shots, times
from gsbench.scenes.captured import HELD_OUT
from gsbench.scenes.files import ImageFinder
from gsbench.scenes.intrinsics import brief
from gsbench.scenes.placement import standard_scene
from gsbench.scenes.points import read_ply
from gsbench.scenes.scene import Scene, View, hold_out

SOURCE = "transforms.json"
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
# The transform by which nerfstudio made the poses from COLMAP's is part of the poses, and of the points.
_KEYS = frozenset((*_SPLITS, "ply_file_path", "applied_transform", "applied_scale"))


def load(root: Path, *, downscale: int, background: tuple[float, float, float], resize: str | None = None) -> Scene:
    """Load a scene from transforms.json; see `gsbench.scenes.load` for the arguments.

    The file has what `gsbench.scenes.blender` reads from each of its files. `train_filenames`, `val_filenames` and
    `test_filenames` may list the images of each split by their `file_path`. Otherwise every eighth image in the order
    of time and then of name is a test view, from the eighth on. Times come from times.csv, otherwise from `time` in the
    frames, otherwise from the names of the images (`gsbench.scenes.times`). The points of
    `ply_file_path` are the initial points.

    Raises:
        InputError: something is missing, damaged or contradictory; the message names the file and field.
    """
    name = Path(os.path.abspath(root)).name  # if the folder is a link, the name of the link
    root = root.resolve()
    finder = ImageFinder(root)
    split = blender.read_split(root, SOURCE, finder, _KEYS)
    timed, digests = _times(root, split)
    size = shots.size_of(split.frames[0].path, split.frames[0].where)
    listed = blender.shots_of(split.frames, timed.values, size)
    loaded = shots.read(listed, downscale=downscale, background=background, resize=resize)
    digests |= dict(zip([frame.name for frame in split.frames], loaded.digests, strict=True))
    train, val, test, how = _split_views(split, finder, loaded.views)
    by_view = dict(zip(map(id, loaded.views), loaded.digests, strict=True))
    views = {"train": train, "val": val, "test": test}
    parts = {part: [by_view[id(view)] for view in views[part]] for part in views}
    points = split.content.get("ply_file_path")
    initial = None
    if points is not None:
        if not isinstance(points, str):
            raise InputError(f"{split.source}: ply_file_path: expected the path of a PLY, got {brief(points)}")
        path = files.find_inside(root, points, f"{split.source}: ply_file_path")
        initial = read_ply(path)
        digests[path.relative_to(root).as_posix()] = files.digest(path.read_bytes())
    return standard_scene(
        name=name,
        train=train,
        val=val,
        test=test,
        background=background,
        points=initial,
        fingerprint=files.fingerprint(digests | {SOURCE: split.digest}),
        notes=(how, *timed.notes, *split.notes, *finder.notes(), *loaded.notes, *blender.shared_views(views, parts)),
        up=None,
    )


def _times(root: Path, split: blender.Split) -> tuple[times.Times, dict[str, str]]:
    """Return the times of the frames in [0, 1], and the SHA-256 of times.csv by name, if there is one.

    They are from times.csv, otherwise from the frames, otherwise from the names of the images.
    """
    blender.check_all_or_none([split])
    places, names = blender.places_of(split.frames), [frame.name for frame in split.frames]
    if split.frames[0].time is None or times.table_of(root):
        viewmats = np.stack([frame.viewmat.double().numpy() for frame in split.frames])
        return times.of_images(root, names, viewmats, places, split.source)
    fields = [frame.time or 0.0 for frame in split.frames]
    times.check_distinct(names, fields, places, str(split.source))
    timed, notes = times.of_fields({SOURCE: fields})
    return times.Times(timed[SOURCE], notes), {}


def _split_views(
    split: blender.Split, finder: ImageFinder, views: list[View]
) -> tuple[list[View], list[View], list[View], str]:
    """Return the views of train, val and test, and a sentence that says how they were split."""
    lists: list[Any] = [split.content.get(key) for key in _SPLITS]
    if lists == [None, None, None]:
        if len(views) < HELD_OUT:
            raise InputError(f"{split.source}: frames: expected at least {HELD_OUT}, as one in {HELD_OUT} is a test "
                             f"view, got {len(views)}: list train_filenames and test_filenames")  # fmt: skip
        train, test = hold_out(sorted(views, key=lambda view: (view.time or 0.0, view.name)), HELD_OUT)
        return train, [], test, f"split: every {HELD_OUT}th view in the order of time is a test view"
    by_path = {frame.path: view for frame, view in zip(split.frames, views, strict=True)}
    parts: list[list[View]] = []
    for key, names in zip(_SPLITS, lists, strict=True):
        where, part = f"{split.source}: {key}", []
        for name in [] if names is None else names if isinstance(names, list) else [names]:
            view = by_path.get(finder.find(name, where)) if isinstance(name, str) else None
            if view is None:
                raise InputError(f"{where}: expected file_path of frames, got {brief(name)}: add its frame")
            part.append(view)
        parts.append(part)
    train, val, test = parts
    if not train or not test:
        raise InputError(f"{split.source}: expected images in train_filenames and test_filenames, got {len(train)} and "
                         f"{len(test)}: list them, or leave out all three lists")  # fmt: skip
    return train, val, test, f"split: as the file lists, {len(train)}, {len(val)} and {len(test)} of {len(views)} views"
