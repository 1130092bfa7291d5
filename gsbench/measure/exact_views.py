"""Count a view whose render equals the image, which has an infinite PSNR, with a finite one in every mean and choice.

A camera that sees nothing of the scene has such a view: the model draws the background and nothing else. The rule is
one cap, MOST_PSNR, on the PSNR of each view (and of each channel or region of a view), before a mean is taken. A mean
over views is therefore finite, and it has the bits of the plain mean if no view reaches the cap. If two trainings have
equal means, or one that is not a number, PSNR cannot decide between them: the last one is taken.
"""

import math
from collections.abc import Sequence

# dB: a mean squared error of 1e-10. The rounding of an image to 8 bits has a mean squared error of (1 / 255)^2 / 12 in
# the pixels that show something: the true scene has a PSNR of 58.9 dB if all pixels do, and of 98.9 dB if one of 10,000
# does. Errors below the cap are therefore below what an image of 8 bits can tell.
MOST_PSNR = 100.0
NAMED = 3  # views that `sentence` names


def capped(psnr: float) -> float:
    """Return the PSNR with which a view counts in means and choices: at most MOST_PSNR dB; NaN stays NaN."""
    return MOST_PSNR if psnr > MOST_PSNR else psnr


def rank(psnr: float | None) -> float:
    """Return the value by which trainings are compared: the capped PSNR; -inf if it is NaN or missing.

    Equal ranks decide nothing.
    """
    return -math.inf if psnr is None or math.isnan(psnr) else capped(psnr)


def decides(psnr: float) -> bool:
    """Return whether a mean PSNR can show a loss of quality: it is a number, and not all views are at the cap."""
    return not math.isnan(psnr) and psnr < MOST_PSNR


def sentence(names: Sequence[str]) -> str:
    """Return a sentence that names the views whose PSNR is capped; there is at least one."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return (
        f"PSNR of {', '.join(names[:NAMED])}{more} is infinite or nearly so and counts as {MOST_PSNR:.0f} dB "
        f"(docs/protocol.md#exact-views)"
    )
