"""Images of models beside the ground truth, cut from the files of runs and small enough for a page."""

import base64
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from gsbench.errors import printable
from gsbench.measure.images import GAP, HEADER, Pixels, enlargement, reduced
from gsbench.measure.record import Record
from gsbench.report.frame import Results
from gsbench.report.section import EMPTY, Section, number, section

FILE_NAME = "pictures.png"
BUDGET = 700_000  # bytes of all images as text, which leaves a page below 2 MB
IMAGES_BUDGET = 300_000  # bytes of the images of `images`
IMAGE_SIDE = 960  # pixels
# Longest side, quality and views of a scene, which are tried until the images fit.
STEPS = ((400, 92, 3), (400, 85, 3), (320, 80, 3), (256, 75, 3), (256, 75, 1), (160, 70, 1), (96, 60, 1), (48, 50, 1))

Strip = list[tuple[Pixels, Pixels, Pixels]]  # for each view: render, ground truth, error


@dataclass(frozen=True)
class Image:
    """An image with its caption and its size in pixels; the source is a data URL."""

    caption: str
    source: str
    width: int
    height: int


@dataclass(frozen=True)
class View:
    """The images of one view as data URLs: the ground truth, and the render and the error image of each model."""

    scene: str
    name: str
    truth: str
    render: dict[str, str]
    error: dict[str, str]
    scores: dict[str, str]  # PSNR of each model in this view, and over its moving pixels and those of objects
    width: int
    height: int

    @property
    def size(self) -> int:
        """Return the bytes of all images."""
        return len(self.truth) + sum(map(len, (*self.render.values(), *self.error.values())))


@section()
def gallery(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the section of images: example views of the first seed of each model, with the settings that most share."""
    strips: dict[str, dict[str, tuple[Record, Strip]]] = {}
    runs = chapter.finished.runs
    for run in runs[runs.main].sort_values(["scene", "seed", "model"], kind="stable").itertuples():
        models = strips.setdefault(run.scene, {})
        resolution = str(run.record.protocol.get("resolution"))
        if run.model not in models and (strip := cut(run.path.parent / FILE_NAME, resolution)):
            models[run.model] = run.record, strip
    for side, quality, most in STEPS:
        shown = [v for scene, models in strips.items() if models for v in _views(scene, models, side, quality, most)]
        if sum(view.size for view in shown) <= BUDGET:
            break
    while sum(view.size for view in shown) > BUDGET:
        shown.pop()
    if not shown:
        return None
    text = (
        "Compare two images of a view: drag the handle, or use the arrow keys. Errors are averaged over RGB, from "
        "black (0) to bright yellow (0.2 and more). PSNR is that of the view."
    )
    return Section("gallery", "Pictures", text, pd.DataFrame(), images=tuple(shown))


def images(files: list[tuple[str, Path | None]]) -> list[Image]:
    """Encode images with captions, at most IMAGES_BUDGET bytes in total; files that cannot be read are left out.

    If the images do not fit, they are compressed more, then the last ones are left out.
    """
    read = [(caption, cv2.imread(str(path), cv2.IMREAD_COLOR)) for caption, path in files if path and path.is_file()]
    pixels = [(caption, np.asarray(data, np.uint8)) for caption, data in read if data is not None]
    for quality in (90, 75, 60):
        shown = [Image(printable(c)[:200], _encode(p, IMAGE_SIDE, quality), p.shape[1], p.shape[0]) for c, p in pixels]
        if sum(len(image.source) for image in shown) <= IMAGES_BUDGET:
            break
    while sum(len(image.source) for image in shown) > IMAGES_BUDGET:
        shown.pop()
    return shown


def cut(path: Path, resolution: str) -> Strip:
    """Cut an image file into rows of (render, ground truth, error), each in the size of a view, such as "400x300".

    The list is empty if there is no file, or if it is not what `gsbench.measure.images.strip` makes of such views.
    """
    size = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", resolution)
    data = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if size is None or data is None:
        return []
    factor = enlargement(int(size[1]))
    width, height = factor * int(size[1]), factor * int(size[2])
    if data.shape[1] != 3 * width + 2 * GAP or (len(data) - HEADER + GAP) % (height + GAP):
        return []
    rows = [data[top : top + height : factor] for top in range(HEADER, len(data), height + GAP)]
    lefts = [column * (width + GAP) for column in range(3)]
    panels = [[np.asarray(row[:, left : left + width : factor], np.uint8) for left in lefts] for row in rows]
    return [(render, truth, error) for render, truth, error in panels]


def _views(scene: str, models: dict[str, tuple[Record, Strip]], side: int, quality: int, most: int) -> list[View]:
    """Encode the first `most` views that the image files of all models contain, `side` pixels long."""
    by_view = {
        model: dict(zip(_names(record, len(strip)), strip, strict=False))
        for model, (record, strip) in sorted(models.items())
    }
    first, *others = by_view.values()
    shown = []
    for name in [name for name in first if all(name in rows for rows in others)][:most]:
        render, error = (  # columns 0 and 2 of a Strip
            {model: _encode(rows[name][kind], side, quality) for model, rows in by_view.items()} for kind in (0, 2)
        )
        scores = {model: _score(models[model][0], name) for model in by_view}
        truth, (height, width) = _encode(first[name][1], side, quality), first[name][1].shape[:2]
        shown.append(View(scene, printable(name)[:60], truth, render, error, scores, width, height))
    return shown


def _names(record: Record, rows: int) -> list[str]:
    """Return the names of the views in an image file, which are evenly spaced among the evaluated views."""
    return [view.name for view in record.per_view[:: max(1, len(record.per_view) // max(1, rows))]]


def _score(record: Record, name: str) -> str:
    """Return the PSNR of a view as text; a region is left out if no view of the run has it."""
    view = next(view for view in record.per_view if view.name == name)
    if view.psnr is None:
        return ""
    regions = {"moving": view.psnr_moving, "object": view.psnr_object}
    texts = [
        f"{name} {EMPTY if psnr is None else number(psnr, 2)}"
        for name, psnr in regions.items()
        if name in record.regions
    ]
    return ", ".join([f"PSNR {number(view.psnr, 2)} dB", *texts])


def _encode(image: Pixels, side: int, quality: int) -> str:
    """Encode an image as WebP in a data URL; its longer side is reduced to at most `side` pixels."""
    _, data = cv2.imencode(".webp", reduced(image, side, by_longer_side=True), [cv2.IMWRITE_WEBP_QUALITY, quality])
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"
