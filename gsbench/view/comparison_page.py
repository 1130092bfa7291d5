"""Write a static page that compares two models on each test view (``python -m gsbench.view A B --page OUT.html``)."""

import statistics
from collections.abc import Sequence
from pathlib import Path

import jinja2
import numpy as np

from gsbench.errors import InputError
from gsbench.measure.atomic import write_atomically
from gsbench.measure.images import ERROR_SCALE, Pixels, data_url, error_image
from gsbench.run.load import LoadedRun, scene_of
from gsbench.run.setup import evaluated_views
from gsbench.view.frame import FrameRequest, renderers_of
from gsbench.view.training_views import ViewComparison, compare

_PAGE = """\
{% macro picture(image, caption) %}<img src="{{ url(image) }}" alt="{{ caption }}">{% endmacro %}
<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
{% set title %}{{ scene }}: {{ names[0] }} and {{ names[1] }}{% endset %}
<title>{{ title }}</title>
<style>
body { font: 15px/1.4 system-ui, sans-serif; margin: 1em auto; max-width: 75em; padding: 0 0.7em }
section { display: grid; grid-template-columns: repeat(auto-fit, minmax(12em, 1fr)); gap: 0.5em }
h2 { font-size: 1em; margin: 1.2em 0 0.3em }
figure { margin: 0 }
img { width: 100%; display: block; image-rendering: pixelated }
.wipe { position: relative }
.wipe img + img { position: absolute; top: 0; clip-path: inset(0 0 0 var(--at, 50%)) }
input { width: 100%; margin: 0 }
</style>
<h1>{{ title }}</h1>
<p>Mean PSNR of {{ count }} views: {{ names[0] }} {{ "%.2f" % means[0] }} dB,
{{ names[1] }} {{ "%.2f" % means[1] }} dB. The slider moves the border between the renders.
Errors and differences are means of RGB: black is 0, yellow {{ scale }} or more.</p>
{% for view, left, right, difference in views %}
<h2>{{ view.name }}{% if view.time is not none %}, time {{ "%.2f" % view.time }}{% endif %}:
{% set ahead = "%.2f" % (right.psnr - left.psnr) | abs %}
{% if ahead == "0.00" %}equal PSNR
{% else %}{{ (right if right.psnr > left.psnr else left).name }} is {{ ahead }} dB better
{% endif %}</h2>
<section><figure><div class="wipe">{{ picture(left.render, names[0]) }}{{ picture(right.render, names[1]) }}</div>
<input type="range" value="50" aria-label="border"
oninput="this.previousElementSibling.style.setProperty('--at', this.value + '%')">
<figcaption>{{ names[0] }} | {{ names[1] }}</figcaption></figure>
{% for image, caption in [(left.truth, "ground truth"),
                          (left.error, "error of %s, %.2f dB" % (names[0], left.psnr)),
                          (right.error, "error of %s, %.2f dB" % (names[1], right.psnr)),
                          (difference, "difference of the renders")] %}
<figure>{{ picture(image, caption) }}<figcaption>{{ caption }}</figcaption></figure>
{% endfor %}
</section>
{% endfor %}
"""


def write_page(runs: Sequence[LoadedRun], path: Path, data_root: str | None = None) -> None:
    """Write an HTML file with both models' renders of each evaluated view; it needs no other file and no network.

    Raises:
        InputError: there are not two runs, they are of different scenes, or the data set cannot be loaded.
    """
    if len(runs) != 2:
        raise InputError(f"--page: expected two runs to compare, got {len(runs)}")
    renderers = renderers_of(runs)
    views = evaluated_views(scene_of(runs[0], data_root), runs[0].config.scene.eval_split)
    lefts, rights = ([compare(side, view, FrameRequest(view.time)) for view in views] for side in renderers)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.globals["url"] = data_url
    page = environment.from_string(_PAGE).render(
        scene=runs[0].scene.name,
        count=len(views),
        names=[renderer.name for renderer in renderers],
        means=[statistics.fmean(comparison.psnr for comparison in side) for side in (lefts, rights)],
        scale=ERROR_SCALE,
        views=zip(views, lefts, rights, map(_difference, lefts, rights), strict=True),
    )
    write_atomically(path, page.encode())


def _difference(left: ViewComparison, right: ViewComparison) -> Pixels:
    return error_image(*(np.divide(side.render, 255, dtype=np.float32) for side in (left, right)))
