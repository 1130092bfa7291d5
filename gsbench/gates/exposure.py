"""Remove differences of exposure from images that were taken from the same camera position.

The model of an image of a static scene is y = clip(a x + b). The colours x are the same for all images, and each image
and channel has a gain a and an offset b. Gains and offsets are fitted by least absolute deviations (Schlossmacher
1973), so objects that move through less than half of the image are outliers and do not change the fit. x is the median
of (y - b) / a over the images without saturated pixels, so x may exceed 1. The residuals are noise or a change of the
scene.
"""

import numpy as np
from numpy.typing import NDArray

LEVEL_8_BIT = 1 / 255
ROUNDS = 3  # how often gain and offset are fitted and x is computed again
REWEIGHTINGS = 8  # iterations of the least absolute deviations
FIT_PIXELS = 500  # number of pixels that the fit uses
LEAST_PIXELS = 16  # with fewer valid pixels nothing is fitted
BLACK = 0.01  # relative weight of an added black pixel: if all other pixels are alike, only a gain is fitted
GAINS = (0.25, 4.0)  # range of the gain

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


def changes(
    images: Array,  # [n, H, W, 3] of one camera place, in [0, 1]
) -> Array:  # [n, H, W, 3]
    """Return the difference of each image from the mean image, after gain and offset of the exposure were removed.

    The images come from the same camera position. A difference of at most three standard deviations of the noise is set
    to zero if the value that gain and offset predict is saturated.
    """
    n, height, width, channels = images.shape
    y = np.ascontiguousarray(images.transpose(0, 3, 1, 2), np.float32).reshape(n, channels, -1)
    full = y >= 1 - LEVEL_8_BIT / 2
    saturated = full | (y <= LEVEL_8_BIT / 2)
    a, b = np.ones((n, channels, 1), np.float32), np.zeros((n, channels, 1), np.float32)
    x, dead = np.sort(y, 0)[(n - 1) // 2], LEVEL_8_BIT
    few = _telling(saturated)
    y_few = y[..., few]
    for _ in range(ROUNDS):
        expected = a * x[:, few] + b
        use = ~saturated[..., few] & (expected > dead) & (expected < 1 - dead)
        a, b = _fit(y_few, x[:, few], use)
        left = np.abs(y_few - a * x[:, few] - b)[use]
        dead = LEVEL_8_BIT + (3 * 1.4826 * float(np.median(left)) if left.size else 0.0)
        x = _seen((y - b) / a, saturated, full[0])
    expected = np.clip(a * x + b, 0, 1)
    left = y - expected
    left[((expected < dead) | (expected > 1 - dead)) & (np.abs(left) < dead)] = 0
    left -= left.mean(0)
    return np.ascontiguousarray(left.reshape(n, channels, height, width).transpose(0, 2, 3, 1))


def _telling(
    saturated: Mask,  # [n, 3, P]
) -> NDArray[np.int64]:
    """Choose the pixels for the fit of exposure: FIT_PIXELS of all, and up to FIT_PIXELS that no image saturates."""
    inside = np.flatnonzero((~saturated.any(0)).any(0))
    spaced = [every[:: max(1, -(-len(every) // FIT_PIXELS))] for every in (inside, np.arange(saturated.shape[2]))]
    return np.unique(np.concatenate(spaced))


def _fit(
    y: Array,  # [n, 3, P]
    x: Array,  # [3, P]
    use: Mask,  # [n, 3, P]
) -> tuple[Array, Array]:
    """Fit gains a and offsets b, [n, 3, 1], of y = a x + b to the pixels in `use`, for n images and 3 channels.

    A black pixel (x = y = 0) with a small weight is added, so that an image of one shade determines only a gain.
    """
    number = use.sum(-1, keepdims=True)
    enough = number >= LEAST_PIXELS
    y, x = np.pad(y, ((0, 0), (0, 0), (0, 1))), np.pad(x, ((0, 0), (0, 1)))
    weights = np.concatenate([use, BLACK * number], -1).astype(np.float32)
    weight = weights
    for _ in range(REWEIGHTINGS):
        weight = weight / np.maximum(weight.sum(-1, keepdims=True), 1e-9)
        mean = (weight * x).sum(-1, keepdims=True)
        weighted = weight * (x - mean)
        slope = (weighted * y).sum(-1, keepdims=True) / np.maximum((weighted * x).sum(-1, keepdims=True), 1e-9)
        a = np.clip(slope, *GAINS)
        b = (weight * y).sum(-1, keepdims=True) - a * mean
        weight = weights / np.maximum(np.abs(y - a * x - b), np.float32(LEVEL_8_BIT))
    return _shared(a, enough, 1), _shared(b, enough, 0)


def _shared(
    values: Array,  # [n, 3, 1]
    enough: Mask,  # [n, 3, 1]
    otherwise: float,
) -> Array:
    """Replace a gain or offset that was fitted to too few pixels by the mean over the image's other channels."""
    number = enough.sum(1, keepdims=True)
    mean = (values * enough).sum(1, keepdims=True) / np.maximum(number, 1)
    return np.where(enough, values, np.where(number > 0, mean, otherwise)).astype(np.float32)


def _seen(
    values: Array,  # [n, 3, P] (y - b) / a
    saturated: Mask,  # [n, 3, P]
    full: Mask,  # [3, P] where the first image is saturated, whether it is white and not black
) -> Array:  # [3, P]
    """Return for each pixel the median over n images of its unsaturated values.

    A pixel that is saturated in all images gets its largest value if it is white, and its smallest value if it is
    black.
    """
    ordered = np.sort(np.where(saturated, np.float32(np.inf), values), 0)
    number = (~saturated).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(number - 1, 0)[None] // 2, 0)[0]
    return np.where(number > 0, middle, np.where(full, values.max(0), values.min(0)))
