"""Write how exact the float32 images of a model are: as text, as JSON, and as a picture of error and bound."""

import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from gsbench.measure.atomic import write_atomically
from gsbench.measure.images import ROUNDING_SCALE, STEPS, to_bytes
from gsbench.stability.float32_error import FLAT, MOVED, OPAQUE, Exactness, ViewExactness

ROUNDING = 1 / math.sqrt(12)  # RMS error of rounding to 8 bits, in steps
VIEW_TITLES = (
    "view",
    "largest error",
    "RMS",
    "largest bound",
    "median bound",
    "undecided pixels",
    "PSNR, dB",
    "changed by float32",
    "at most",
)
MEANINGS = {
    "flat": f"its shortest axis is below 1/{1 / FLAT:.0f} of its longest",
    "far": f"rounding of world coordinates moves its mean by more than 1/{1 / MOVED:.0f} pixel",
    "huge": "it covers more than the image",
    "opaque": f"its opacity is above {OPAQUE}",
    "skipped": "rounding may decide whether its alpha reaches 1/255, in the pixels with most of its share",
    "stopped": "rounding may decide whether a pixel ends before it",
    "order": "its depth equals another one's within rounding",
}


def text(exactness: Exactness) -> str:
    """Return the errors of all views, the ten worst Gaussians and the verdict as Markdown."""
    parts = [
        f"{exactness.title}: {exactness.gaussians} Gaussians. Pixel values are in steps of 8 bits (1/255).",
        table(VIEW_TITLES, [_cells(view) for view in exactness.views]),
    ]
    if exactness.worst:
        rows = [
            [str(worst.index), worst.view, str(worst.pixels), f"{worst.bound:.2g}", ", ".join(worst.why) or "-"]
            for worst in exactness.worst
        ]
        words = dict.fromkeys(word for worst in exactness.worst for word in worst.why)
        titles = ["Gaussian", "view", "pixels", "sum of their bounds", "why"]
        parts += ["Gaussians that add most to the bounds:", table(titles, rows)]
        parts += ["\n".join(f"{word}: {MEANINGS[word]}." for word in words)] if words else []
    return "\n\n".join([*parts, verdict(exactness)])


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose columns after the first are aligned at the right."""
    lines = [titles, ["---", *["---:"] * (len(titles) - 1)], *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _cells(view: ViewExactness) -> list[str]:
    cells = [view.name, *(f"{x:.1e}" for x in (view.largest, view.rms, view.bound, view.median_bound))]
    cells.append(f"{100 * view.undecided:.2f} %")
    if view.psnr is None:
        return [*cells, "-", "-", "-"]
    return [*cells, f"{view.psnr:.4f}", f"{view.psnr_change:+.1e}", f"{view.psnr_bound:.1e}"]


def verdict(exactness: Exactness) -> str:
    """Return a sentence that compares the error of float32 with that of rounding to 8 bits."""
    share = ROUNDING / max(max(view.rms for view in exactness.views), 1e-300)
    eight = f"Rounding to 8 bits changes an image {share:,.0f} times as much as float32 (RMS of the worst view)."
    change = exactness.psnr_change
    if change is None:
        return eight
    mean = abs(fmean(view.psnr_change or 0.0 for view in exactness.views))  # if one has a photograph, all have
    return f"Float32 changes the mean PSNR by {mean:.1e} dB, that of one view by {change:.1e} dB. {eight}"


def json_of(exactness: Exactness) -> str:
    """Return all numbers and the verdict as JSON."""
    numbers = {name: value for name, value in vars(exactness).items() if name != "shown"}
    return json.dumps(numbers | {"verdict": verdict(exactness)}, indent=1, default=asdict)


def draw(exactness: Exactness, path: Path) -> None:
    """Write a picture of the view with the largest bound: the image, the error of float32, and its bound."""
    name, image, exact = exactness.shown
    error = STEPS * (image.double() - exact.image).abs().amax(-1)
    figure = Figure(figsize=(12, 4), layout="constrained")  # not of pyplot, which looks for a screen
    axes = figure.subplots(1, 3)
    axes[0].imshow(to_bytes(exact.image.float().numpy()))
    scale = LogNorm(*ROUNDING_SCALE)
    for pane, values in zip(axes[1:], (error, STEPS * exact.bound), strict=True):
        drawn = pane.imshow(np.clip(values.numpy(), *ROUNDING_SCALE), norm=scale, cmap="inferno")
    for pane, title in zip(axes, (f"{exactness.title}\n{name}", "error of float32", "bound"), strict=True):
        longest = max(map(len, title.splitlines()))
        pane.set_title(title, fontsize=min(12, 400 / longest))  # a long one stays over its pane
        pane.set(xticks=[], yticks=[])
    figure.colorbar(drawn, ax=axes[1:], label="steps of 8 bits")
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=110)
    write_atomically(path, png.getvalue())
