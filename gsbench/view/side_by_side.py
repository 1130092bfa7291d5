"""Write a static page that compares two models on each test view (``python -m gsbench.view A B --page OUT.html``)."""

import html
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gsbench.effects.gate import most_cost
from gsbench.errors import InputError
from gsbench.measure.atomic import write_atomically
from gsbench.measure.images import ERROR_SCALE, Pixels, data_url, error_image
from gsbench.run.checks import evaluated_views
from gsbench.run.load import LoadedRun, scene_of
from gsbench.scenes import View
from gsbench.view.frame import FrameRenderer, FrameRequest
from gsbench.view.labels import short_names
from gsbench.view.nearest import ViewComparison, compare

_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 1em auto; max-width: 75em; padding: 0 0.7em }}
section {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(12em, 1fr)); gap: 0.5em }}
h2 {{ font-size: 1em; margin: 1.2em 0 0.3em }}
figure {{ margin: 0 }}
img {{ width: 100%; display: block; image-rendering: pixelated }}
.wipe {{ position: relative }}
.wipe img + img {{ position: absolute; top: 0; clip-path: inset(0 0 0 var(--at, 50%)) }}
input {{ width: 100%; margin: 0 }}
</style>
<h1>{title}</h1>
<p>{summary}</p>
{views}
"""
_SLIDE = "this.previousElementSibling.style.setProperty('--at', this.value + '%')"


def write_page(runs: list[LoadedRun], path: Path, data_root: str | None = None) -> None:
    """Write an HTML file with both models' renders of each evaluated view; it needs no other file and no network.

    Raises:
        InputError: there are not two runs, they are of different scenes, or the data set cannot be loaded.
    """
    if len(runs) != 2:
        raise InputError(f"--page: expected two runs to compare, got {len(runs)}")
    first, second = runs
    if first.scene.fingerprint != second.scene.fingerprint:
        raise InputError(f"--page: expected runs of one scene, got {first.scene.name} in {first.folder} and other data "
                         f"in {second.folder}")  # fmt: skip
    views = evaluated_views(scene_of(first, data_root), first.config.scene.eval_split)
    write_atomically(path, page(runs, views).encode())


def page(runs: list[LoadedRun], views: Iterable[View]) -> str:
    """Return the HTML that compares two models on the given views."""
    renderers = [
        FrameRenderer(run, name, most_cost(run.model)) for run, name in zip(runs, short_names(runs), strict=True)
    ]
    compared = [(view, [compare(one, view, FrameRequest(view.time)) for one in renderers]) for view in views]
    names = [html.escape(renderer.name) for renderer in renderers]
    means = [sum(pair[i].psnr for _, pair in compared) / len(compared) for i in (0, 1)]
    said = ", ".join(f"{name} {mean:.2f} dB" for name, mean in zip(names, means, strict=True))
    summary = (f"Mean PSNR of {len(compared)} views: {said}. The slider moves the border between the renders. "
               f"Errors and differences are means of RGB: black is 0, yellow {ERROR_SCALE} or more.")  # fmt: skip
    title = f"{html.escape(runs[0].scene.name)}: {names[0]} and {names[1]}"
    return _PAGE.format(title=title, summary=summary, views="\n".join(_view(view, *pair) for view, pair in compared))


def _view(view: View, one: ViewComparison, two: ViewComparison) -> str:
    """Return the HTML of one view: the two renders under a slider, the truth, both errors and the difference."""
    when = "" if view.time is None else f", time {view.time:.2f}"
    names = html.escape(one.name), html.escape(two.name)
    difference = error_image(*(np.divide(x.render, 255, dtype=np.float32) for x in (one, two)))
    wipe = (f'<figure><div class="wipe">{_image(one.render, names[0])}{_image(two.render, names[1])}</div>'
            f'<input type="range" value="50" aria-label="border" oninput="{_SLIDE}">'
            f"<figcaption>{names[0]} | {names[1]}</figcaption></figure>")  # fmt: skip
    others = {
        "ground truth": one.truth,
        f"error of {names[0]}, {one.psnr:.2f} dB": one.error,
        f"error of {names[1]}, {two.psnr:.2f} dB": two.error,
        "difference of the renders": difference,
    }
    figures = "".join(
        f"<figure>{_image(image, caption)}<figcaption>{caption}</figcaption></figure>"
        for caption, image in others.items()
    )
    better, gain = names[two.psnr > one.psnr], abs(two.psnr - one.psnr)
    heading = f"{html.escape(view.name)}{when}: {better} is {gain:.2f} dB better"
    return f"<h2>{heading}</h2><section>{wipe}{figures}</section>"


def _image(image: Pixels, alternative: str) -> str:
    """Return an HTML image with the pixels in it."""
    return f'<img src="{data_url(image)}" alt="{alternative}">'
