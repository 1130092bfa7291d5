"""Name runs by what differs between them, and write on an image which run it shows and what was measured of it."""

import functools
import math
import os
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.measure.images import Pixels
from gsbench.report import plausible
from gsbench.run.load import LoadedRun
from gsbench.run.settings import label_of

FONTS = Path(matplotlib.get_data_path(), "fonts", "ttf")
DARK = 0.35  # what the paper of a label leaves of the image behind it
LEAST_SIZE = 5.0  # pixels of the font

Label = tuple[str, ...]  # the rows of a label: a name, and then what was measured


def short_names(runs: Sequence[LoadedRun]) -> list[str]:
    """Return a name for each run: its model, and the words of its variant that not all of the runs have.

    Where these are equal, words of its other folders follow, those of seedK first, until no two runs have one name.
    Runs that no word distinguishes have their folders as names.
    """
    names = [[label_of(run.config)] for run in runs]
    for folders in zip_longest(*(_folders_by_weight(run.folder) for run in runs), fillvalue=""):
        words_of_runs = [folder.split(",") for folder in folders]
        shared = set.intersection(*map(set, words_of_runs))
        for name, words in zip(names, words_of_runs, strict=True):
            name += [word for word in words if word and word not in (*shared, name[0])]  # name[0]: the model
        if len(set(map(tuple, names))) == len(runs):
            return list(map(" ".join, names))
    return [str(run.folder) for run in runs]


def _folders_by_weight(folder: Path) -> list[str]:
    """Return the names in EXPERIMENT/SCENE/MODEL,VARIANT/seedK, those first that a user knows runs by."""
    *outer, model, seed = ("", *Path(os.path.abspath(folder)).parts)  # "": the path may be "/" alone
    return [model, seed, *reversed(outer)]


def measurements(run: LoadedRun) -> Label:
    """Return what was measured of a run, in rows: PSNR of the evaluated views, Gaussians, MB and iterations."""
    steps, planned = f"{run.step:,}", f"{run.config.train.iterations:,}"
    return (
        _psnr(run),
        f"{len(run.model):,} Gaussians",
        f"{run.model.stored_bytes() / 1e6:,.2f} MB",
        f"{steps} iterations" if steps == planned else f"{steps} of {planned} iterations",
    )


def _psnr(run: LoadedRun) -> str:
    """Return the PSNR in the record of a run, or in a few words why there is none."""
    split, path = run.config.scene.eval_split, run.folder / record.FILE_NAME
    if not path.exists():  # the run was interrupted
        return f"no PSNR on {split} yet"
    try:
        psnr = (plausible.read(path).metrics or {}).get("psnr")
    except InputError:
        return f"{record.FILE_NAME} is not valid"
    return f"no PSNR on {split}" if psnr is None else f"{psnr:.2f} dB PSNR on {split}"


def labelled(image: Pixels, edge: int, left: Label, right: Label | None = None) -> Pixels:
    """Return an image with a label at the top on each side of the column `edge`; `right` is None for one image alone.

    Labels are as large in any resolution of the window's image.
    """
    height, width = image.shape[:2]
    size = max(LEAST_SIZE, min(math.sqrt(width * height) / 64, width / 28))
    image = image.copy()
    ink = _ink(left, size)
    _write(image, ink, edge - 1 - ink.shape[1])  # the line between the images is in the column before `edge`, or there
    if right is not None:
        _write(image, _ink(right, size), edge + 1)
    return image


@functools.lru_cache(maxsize=64)
def _ink(label: Label, size: float) -> Pixels:
    """Draw the rows of a label, the first one bold, [h, w]: 255 is ink, 0 is paper."""
    fonts = [ImageFont.truetype(FONTS / name, size) for name in ("DejaVuSans-Bold.ttf", "DejaVuSans.ttf")]
    rows = [(text, fonts[i > 0]) for i, text in enumerate(label)]
    margin, line = size / 2, 1.3 * size
    width = math.ceil(max(font.getlength(text) for text, font in rows) + 2 * margin)
    paper = Image.new("L", (width, math.ceil(line * len(rows) + 2 * margin)))
    for i, (text, font) in enumerate(rows):
        ImageDraw.Draw(paper).text((margin, margin + i * line), text, fill=255, font=font)
    return np.asarray(paper)


def _write(image: Pixels, ink: Pixels, left: int) -> None:
    """Write a label at the top of an image, white on darkened pixels, from the column `left` on, as far as it fits."""
    start, end = max(left, 0), min(left + ink.shape[1], image.shape[1])
    ink = ink[: image.shape[0], start - left : max(end, start) - left, None]
    behind = image[: ink.shape[0], start : start + ink.shape[1]]
    behind[:] = np.maximum(DARK * behind, ink)
