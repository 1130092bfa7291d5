"""Write the slices of a model at several times as numbered PLY files, a sequence that SuperSplat plays as a clip."""

import shutil
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from gsbench.errors import InputError
from gsbench.measure.atomic import write_atomically
from gsbench.models.query import Query
from gsbench.run.load import LoadedRun
from gsbench.scenes.placement import gaussians_to_user
from gsbench.scenes.trained import PLY_ROW, ply_of
from gsbench.view.film import check_parent
from gsbench.view.gaussians import check_harmonics, drawn, trained_of

LEAST_FILES = 2  # SuperSplat takes a single file for a model that stands still
HEADER = 2048  # bytes; more than the header of a PLY has


class PlySequence(NamedTuple):
    """Describe a sequence of PLY files that was written."""

    paths: list[Path]
    counts: list[int]  # Gaussians of each file
    from_profiles: bool  # whether they stand for Beta profiles that look like them


def check_folder(folder: Path) -> None:
    """Raise InputError unless `folder` is an empty folder, or can be made."""
    check_parent(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--plys: expected a folder, {folder} is a file: name another")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"--plys: expected a new or an empty folder, {folder} has files, which a viewer would take "
                         f"for frames: name another")  # fmt: skip


def check_time(run: LoadedRun) -> None:
    """Raise InputError if the slices of a run are the same at all times."""
    if not run.scene.has_time:
        raise InputError(f"--plys: expected a scene with times, {run.scene.name} has none: use --ply")
    if "time" not in run.model.observes and not run.model.refines:
        name = run.config.model.name
        raise InputError(f"--plys: expected a model that changes with time, {name} does not: use --ply")


def names(count: int) -> list[str]:
    """Return the names of a sequence's files, one prefix and numbers of one width, by which viewers know a sequence."""
    digits = max(4, len(str(count - 1)))
    return [f"frame{i:0{digits}d}.ply" for i in range(count)]


def write_plys(run: LoadedRun, queries: list[Query], folder: Path, *, keep_harmonics: bool) -> PlySequence:
    """Write a PLY file of 3DGS for each query as frame0000.ply, frame0001.ply and so on into an empty or new folder.

    If this fails, the files that were written are removed. A progress bar is shown on stderr.

    Args:
        run: the loaded run.
        queries: the camera centre and the time of each file, at least two.
        folder: the folder; it is made if its parent exists.
        keep_harmonics: as for `trained_of`.

    Raises:
        InputError: as of `trained_of`; no Gaussian is drawn at one of the times; the disk has too little space; the
            folder has files.
    """
    check_folder(folder)
    model = run.model
    check_harmonics(model, keep_harmonics)
    counts = [int(drawn(model.slice(query)).sum()) for query in queries]
    if 0 in counts:
        time = queries[counts.index(0)].time
        raise InputError(f"--plys: no Gaussian can be seen from this place at time {time:g}, and viewers read no PLY "
                         f"without any: choose another place")  # fmt: skip
    disk = folder if folder.exists() else folder.parent
    size, free = sum(counts) * PLY_ROW + len(counts) * HEADER, shutil.disk_usage(disk).free
    if size > free:
        raise InputError(f"--plys: {len(counts)} files need {size / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free "
                         f"in {disk}: lower --fps or --seconds")  # fmt: skip
    paths = [folder / name for name in names(len(queries))]
    is_new, profiles = not folder.exists(), False
    folder.mkdir(exist_ok=True)
    try:
        for query, path in zip(tqdm(queries, desc=folder.name, unit="file"), paths, strict=True):
            trained = gaussians_to_user(trained_of(model, query, keep_harmonics=keep_harmonics), run.scene.placement)
            profiles = trained.from_profiles
            write_atomically(path, ply_of(trained))
    except BaseException:
        for path in paths:
            path.unlink(missing_ok=True)
        if is_new:
            folder.rmdir()
        raise
    return PlySequence(paths, counts, profiles)
