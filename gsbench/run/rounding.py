"""Measure by how much float32 changes the PSNR of a trained model, on a few of the evaluated views."""

import math

from gsbench.errors import one_line
from gsbench.measure.quality import capped_psnr, evenly
from gsbench.models.twins import exact_model, render_twins
from gsbench.train.loop import Trainer

VIEWS = 3  # evenly spaced; a view takes ten to twenty times as long as a frame


def psnr_float32(trainer: Trainer) -> tuple[float | None, str]:
    """Return the largest change of a view's PSNR by float32 in dB, or None and the reason why it is not measured.

    The image of the CPU kernels is compared with the same image in float64 (docs/stability.md). PSNR is capped
    (gsbench.measure.exact_views), so that a view that is rendered exactly has no change.
    """
    model, renderer = trainer.model, trainer.renderer
    if model.backend.name != "cpu":
        return None, f"needs raster.backend=cpu, whose images have a float64 twin; this run has {model.backend.name}"
    changes = []
    try:
        exact = exact_model(model)
        for view in evenly(trainer.views, VIEWS):
            found = render_twins(model, exact, view.camera, view.time, renderer.background, renderer.antialias)
            changes.append(abs(capped_psnr(found.image, view.image) - capped_psnr(found.exact.image, view.image)))
    except Exception as error:  # a user's model may compute in float32 alone, and fail in any way
        return None, f"the model has no image in float64: {one_line(error)}"
    if not all(map(math.isfinite, changes)):
        return None, "an image has a pixel that is not a number"
    return max(changes), ""
