"""Cut the example images of runs from their files, and make them small enough to embed in the HTML report."""

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsbench.measure.images import GAP, HEADER, Pixels
from gsbench.measure.record import Record, ViewScore
from gsbench.report.layout import EMPTY
from gsbench.report.page.content import Image
from gsbench.report.page.messages import plain, shorten

FILE_NAME = "pictures.png"
BUDGET = 900_000  # bytes of all images as text, which leaves the page below 2 MB
IMAGES_BUDGET = 300_000  # bytes of the images of `images`, in addition to BUDGET
IMAGE_SIDE = 960  # pixels
STEPS = ((400, 92, 3), (400, 85, 3), (320, 80, 3), (256, 75, 3), (256, 75, 1), (160, 70, 1), (96, 60, 1), (48, 50, 1))


@dataclass(frozen=True)
class GalleryView:
    """The images of one view as data URLs: the ground truth, and the render and the error image of each model."""

    scene: str
    name: str
    truth: str
    render: dict[str, str]
    error: dict[str, str]
    scores: dict[str, str]  # PSNR of each model in this view, and over its moving pixels and those of objects
    width: int
    height: int


StripRow = tuple[Pixels, Pixels, Pixels]  # render, truth, error


def gallery(records: list[Record], folder: Path) -> list[GalleryView]:
    """Return the example views of the first seed of each model, with images of at most BUDGET bytes in total.

    If the images do not fit, they are compressed more. If this is not enough, they are made smaller, then reduced to
    one view for each scene, and finally left out.
    """
    strips = _strips(records, folder)
    for side, quality, views in STEPS:
        shown = [view for scene, models in strips.items() for view in _views(scene, models, side, quality, views)]
        if sum(_size(view) for view in shown) <= BUDGET:
            return shown
    while shown and sum(_size(view) for view in shown) > BUDGET:
        shown.pop()
    return shown


def _strips(records: list[Record], folder: Path) -> dict[str, dict[str, tuple[Record, list[StripRow]]]]:
    """Find for each scene and model the first seed with an image file, and return its record and images.

    The file has one row of render, ground truth and error image for each view.
    """
    at = places(folder, FILE_NAME)
    found: dict[str, dict[str, tuple[Record, list[StripRow]]]] = {}
    for r in sorted(records, key=lambda r: r.seed):
        path = at.get(r.path)
        models = found.setdefault(r.scene, {})
        if path and r.model not in models and (rows := cut_strip(path)):
            models[r.model] = r, rows
    return {scene: dict(sorted(models.items())) for scene, models in sorted(found.items()) if models}


def places(folder: Path, name: str) -> dict[Path, Path]:
    """Return all files with a certain name below a folder of results, in a dictionary by the path of their run."""
    return {Path(*path.parts[-5:-1]): path for path in sorted(folder.resolve().rglob(name))}


def images(of: list[tuple[str, Path]]) -> list[Image]:
    """Encode images with captions, at most IMAGES_BUDGET bytes in total; files that cannot be read are left out.

    If the images do not fit, they are compressed more. If this is not enough, the last ones are left out.
    """
    read = [(caption, data) for caption, path in of if (data := cv2.imread(str(path), cv2.IMREAD_COLOR)) is not None]
    for quality in (90, 75, 60):
        shown = [_image(caption, np.asarray(data, np.uint8), quality) for caption, data in read]
        if sum(len(one.source) for one in shown) <= IMAGES_BUDGET:
            return shown
    while sum(len(one.source) for one in shown) > IMAGES_BUDGET:
        shown.pop()
    return shown


def _image(caption: str, image: Pixels, quality: int) -> Image:
    return Image(caption, _encode(image, IMAGE_SIDE, quality), image.shape[1], image.shape[0])


def cut_strip(path: Path) -> list[StripRow]:
    """Cut an image file into rows of (render, ground truth, error image), and undo the enlargement of small images.

    The list is empty if the file has another layout.
    """
    data = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if data is None:
        return []
    image = np.asarray(data, np.uint8)
    width = (image.shape[1] - 2 * GAP) // 3
    body = image[HEADER:]
    height = _row_height(body)
    if width < 1 or height < 1 or 3 * width + 2 * GAP != image.shape[1]:
        return []
    rows = []
    for top in range(0, len(body) - height + 1, height + GAP):
        line = body[top : top + height]
        parts = [line[:, left : left + width] for left in (0, width + GAP, 2 * (width + GAP))]
        factor = _enlargement(parts)
        rows.append((parts[0][::factor, ::factor], parts[1][::factor, ::factor], parts[2][::factor, ::factor]))
    return rows


def _row_height(body: Pixels) -> int:
    """Return the height of a row of images; a grey band separates it from the row below."""
    grey = (body == body[:, :1, :1]).all((1, 2))
    inside = [y for y in range(1, len(body) - GAP) if grey[y : y + GAP].all() and (body[y : y + GAP] == 200).all()]
    return inside[0] if inside else len(body)


def _enlargement(parts: list[Pixels]) -> int:
    """Return the integer factor by which images were enlarged without interpolation, or 1 if they were not enlarged."""
    for factor in range(8, 1, -1):
        if all(not (p.shape[0] % factor or p.shape[1] % factor) and _blocks(p, factor) for p in parts):
            return factor
    return 1


def _blocks(image: Pixels, factor: int) -> bool:
    small = image[::factor, ::factor]
    return bool((small.repeat(factor, 0).repeat(factor, 1) == image).all())


def _views(
    scene: str, models: dict[str, tuple[Record, list[StripRow]]], side: int, quality: int, most: int
) -> list[GalleryView]:
    """Encode the views that the image files of all models contain."""
    shown = []
    shared = min(len(rows) for _, rows in models.values())
    names = _names(next(iter(models.values()))[0], shared)
    for i in range(min(shared, most)):
        truth = next(iter(models.values()))[1][i][1]
        encoded = {
            m: (_encode(rows[i][0], side, quality), _encode(rows[i][2], side, quality))
            for m, (_, rows) in models.items()
        }
        render, error = ({m: pair[k] for m, pair in encoded.items()} for k in (0, 1))
        height, width = truth.shape[:2]
        scores = {m: _score(record, len(rows), i) for m, (record, rows) in models.items()}
        shown.append(GalleryView(scene, names[i], _encode(truth, side, quality), render, error, scores, width, height))
    return shown


def _shown_views(record: Record, rows: int) -> list[ViewScore]:
    """Return the views in an image file, which are evenly spaced among the evaluated views."""
    return record.per_view[:: max(1, len(record.per_view) // max(1, rows))][:rows]


def _score(record: Record, rows: int, i: int) -> str:
    """Return the PSNR of row `i` of an image file as text; a region is left out if no view of the run has it."""
    views = _shown_views(record, rows)
    view = views[i] if i < len(views) else None
    if view is None or view.psnr is None:
        return ""
    values = {"moving": view.psnr_moving, "object": view.psnr_object}
    found = {name: value for name, value in values.items() if name in record.regions}
    said = [f"{name} {EMPTY if value is None else plain(value)}" for name, value in found.items()]
    return ", ".join([f"PSNR {plain(view.psnr)} dB", *said])


def _names(record: Record, rows: int) -> list[str]:
    """Return the names of the views in an image file."""
    spaced = [shorten(view.name, 60) for view in _shown_views(record, rows)]
    return [*spaced, *(f"view {i + 1}" for i in range(len(spaced), rows))]


def _encode(image: Pixels, side: int, quality: int) -> str:
    """Encode an image as WebP in a data URL; its longer side is reduced to at most `side` pixels."""
    scale = side / max(image.shape[:2])
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"


def _size(view: GalleryView) -> int:
    return len(view.truth) + sum(map(len, (*view.render.values(), *view.error.values())))
