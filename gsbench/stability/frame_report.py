"""Write how exact the float32 images of a model are: as text, as JSON, and as a picture of error and bound."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.colors import LogNorm

from gsbench.measure.images import ROUNDING_SCALE, STEPS, to_bytes
from gsbench.stability.frame import Exactness, ViewExactness
from gsbench.stability.plots import save_figure

ROUNDING = 1 / math.sqrt(12)  # RMS error of rounding to 8 bits, in steps
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth")
MEANINGS = {
    "flat": "its shortest axis is below 1/1000 of its longest",
    "far": "rounding of world coordinates moves its mean by more than 1/1000 pixel",
    "huge": "it covers more than the image",
    "opaque": "its opacity is above 0.99",
    "indefinite": "the papers' formula makes its covariance indefinite in float32",
    "skipped": "rounding may decide whether its alpha reaches 1/255, in the pixels with most of its share",
    "stopped": "rounding may decide whether a pixel ends before it",
    "order": "its depth equals another one's within rounding",
}


def text(found: Exactness) -> str:
    """Return the errors of all views, the ten worst Gaussians and the verdict as Markdown."""
    lines = [f"{found.title}: {found.gaussians} Gaussians. Pixel values are in steps of 8 bits (1/255).", "",
             "| view | largest error | RMS | largest bound | median bound | undecided pixels | PSNR, dB | changed by "
             "float32 | at most |",
             "| --- |" + " ---: |" * 8]  # fmt: skip
    lines += [_row(view) for view in found.views]
    if found.worst:
        lines += ["", "| Gaussian | view | pixels | sum of their bounds | why |", "| ---: | --- | ---: | ---: | --- |"]
        lines += [f"| {one.index} | {one.view} | {one.pixels} | {one.bound:.2g} | {', '.join(one.why) or '-'} |"
                  for one in found.worst]  # fmt: skip
        named = dict.fromkeys(word for one in found.worst for word in one.why)
        lines += ["", *(f"{word}: {MEANINGS[word]}." for word in named)]
    return "\n".join([*lines, "", verdict(found)])


def _row(view: ViewExactness) -> str:
    cells = [f"{x:.1e}" for x in (view.largest, view.rms, view.bound, view.median_bound)]
    cells.append(f"{100 * view.undecided:.2f} %")
    if view.psnr is not None:
        cells += [f"{view.psnr:.4f}", f"{view.psnr_change:+.1e}", f"{view.psnr_bound:.1e}"]
    else:
        cells += ["-"] * 3
    return f"| {view.name} | {' | '.join(cells)} |"


def verdict(found: Exactness) -> str:
    """Return a sentence that compares the error of float32 with the digits of PSNR and with rounding to 8 bits."""
    share = ROUNDING / max(max(view.rms for view in found.views), 1e-300)
    eight = f"Rounding to 8 bits changes an image {share:,.0f} times as much as float32 (RMS of the worst view)."
    change = found.psnr_change
    if change is None:
        return eight
    mean = abs(fmean(view.psnr_change or 0.0 for view in found.views))
    return f"Float32 changes {_decimal(mean)} of the mean PSNR ({mean:.1e} dB; one view by {change:.1e} dB). {eight}"


def _decimal(change: float) -> str:
    """Name the first decimal of a number that a change of this size alters."""
    place = math.ceil(-math.log10(change)) if change > 0 else len(ORDINALS) + 1
    if place < 1:
        return "the digits before the point"
    return f"the {ORDINALS[place - 1]} decimal" if place <= len(ORDINALS) else "no decimal"


def json_of(found: Exactness) -> str:
    """Return all numbers and the verdict as JSON."""
    plain: dict[str, Any] = {
        "title": found.title, "gaussians": found.gaussians, "views": [asdict(view) for view in found.views],
        "worst": [asdict(one) for one in found.worst], "verdict": verdict(found),
    }  # fmt: skip
    return json.dumps(plain, indent=1)


def draw(found: Exactness, path: Path) -> None:
    """Write a picture of the view with the largest bound: the image, the error of float32, and its bound."""
    name, image, exact = found.shown
    error = STEPS * (image.double() - exact.image).abs().amax(-1)
    figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
    axes[0].imshow(to_bytes(exact.image.float().numpy()))
    scale = LogNorm(*ROUNDING_SCALE)
    for pane, values in zip(axes[1:], (error, STEPS * exact.bound), strict=True):
        drawn = pane.imshow(np.clip(values.numpy(), *ROUNDING_SCALE), norm=scale, cmap="inferno")
    for pane, title in zip(axes, (f"{found.title}, {name}", "error of float32", "bound"), strict=True):
        pane.set(title=title, xticks=[], yticks=[])
    figure.colorbar(drawn, ax=axes[1:], label="steps of 8 bits")
    save_figure(figure, path)
