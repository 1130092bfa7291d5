"""Write how exact the float32 images of a model are: as text, as JSON, and as a picture of error and bound."""

import io
import json
import math
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.colors import LogNorm

from gsbench.measure.atomic import write_atomically
from gsbench.measure.images import ROUNDING_SCALE, STEPS, to_bytes
from gsbench.stability.float32_error import PERCENTILES, Conditioning, Exactness, ViewExactness

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


def text(exactness: Exactness) -> str:
    """Return the errors of all views, the ten worst Gaussians, the conditioning and the verdict as Markdown."""
    lines = [f"{exactness.title}: {exactness.gaussians} Gaussians. Pixel values are in steps of 8 bits (1/255).", "",
             "| view | largest error | RMS | largest bound | median bound | undecided pixels | PSNR, dB | changed by "
             "float32 | at most |",
             "| --- |" + " ---: |" * 8]  # fmt: skip
    lines += [_row(view) for view in exactness.views]
    if exactness.worst:
        lines += ["", "| Gaussian | view | pixels | sum of their bounds | why |", "| ---: | --- | ---: | ---: | --- |"]
        lines += [f"| {culprit.index} | {culprit.view} | {culprit.pixels} | {culprit.bound:.2g} | "
                  f"{', '.join(culprit.why) or '-'} |" for culprit in exactness.worst]  # fmt: skip
        named = dict.fromkeys(word for culprit in exactness.worst for word in culprit.why)
        lines += ["", *(f"{word}: {MEANINGS[word]}." for word in named)]
    if exactness.conditioning:
        lines += ["", *_conditioning(exactness.conditioning)]
    return "\n".join([*lines, "", verdict(exactness)])


def _row(view: ViewExactness) -> str:
    cells = [f"{x:.1e}" for x in (view.largest, view.rms, view.bound, view.median_bound)]
    cells.append(f"{100 * view.undecided:.2f} %")
    if view.psnr is not None:
        cells += [f"{view.psnr:.4f}", f"{view.psnr_change:+.1e}", f"{view.psnr_bound:.1e}"]
    else:
        cells += ["-"] * 3
    return f"| {view.name} | {' | '.join(cells)} |"


def _conditioning(conditioning: Conditioning) -> list[str]:
    return [
        f"| condition number of | {' | '.join(f'{p:g} %' for p in PERCENTILES)} |",
        "| --- |" + " ---: |" * len(PERCENTILES),
        *(f"| {name} | {' | '.join(f'{x:.1e}' for x in values)} |"
          for name, values in conditioning.condition_numbers.items()),
        "",
        *(f"{scheme} in float32: {100 * share:.2f} % indefinite, 99th percentile of the error "
          f"{conditioning.error[scheme]:.1e}" for scheme, share in conditioning.indefinite.items()),
    ]  # fmt: skip


def verdict(exactness: Exactness) -> str:
    """Return a sentence that compares the error of float32 with the digits of PSNR and with rounding to 8 bits."""
    share = ROUNDING / max(max(view.rms for view in exactness.views), 1e-300)
    eight = f"Rounding to 8 bits changes an image {share:,.0f} times as much as float32 (RMS of the worst view)."
    change = exactness.psnr_change
    if change is None:
        return eight
    mean = abs(fmean(view.psnr_change or 0.0 for view in exactness.views))
    return f"Float32 changes {_decimal(mean)} of the mean PSNR ({mean:.1e} dB; one view by {change:.1e} dB). {eight}"


def _decimal(change: float) -> str:
    """Name the first decimal of a number that a change of this size alters."""
    place = math.ceil(-math.log10(change)) if change > 0 else len(ORDINALS) + 1
    if place < 1:
        return "the digits before the point"
    return f"the {ORDINALS[place - 1]} decimal" if place <= len(ORDINALS) else "no decimal"


def json_of(exactness: Exactness) -> str:
    """Return all numbers and the verdict as JSON."""
    numbers = {name: value for name, value in vars(exactness).items() if name != "shown"}
    return json.dumps(numbers | {"verdict": verdict(exactness)}, indent=1, default=asdict)


def draw(exactness: Exactness, path: Path) -> None:
    """Write a picture of the view with the largest bound: the image, the error of float32, and its bound."""
    name, image, exact = exactness.shown
    error = STEPS * (image.double() - exact.image).abs().amax(-1)
    figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
    axes[0].imshow(to_bytes(exact.image.float().numpy()))
    scale = LogNorm(*ROUNDING_SCALE)
    for pane, values in zip(axes[1:], (error, STEPS * exact.bound), strict=True):
        drawn = pane.imshow(np.clip(values.numpy(), *ROUNDING_SCALE), norm=scale, cmap="inferno")
    for pane, title in zip(axes, (f"{exactness.title}, {name}", "error of float32", "bound"), strict=True):
        pane.set(title=title, xticks=[], yticks=[])
    figure.colorbar(drawn, ax=axes[1:], label="steps of 8 bits")
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=110)
    plt.close(figure)
    write_atomically(path, png.getvalue())
