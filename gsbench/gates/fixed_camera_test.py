"""Test whether images that were taken from the same camera position change with time.

Differences of exposure are removed first. The model of an image of a static scene is y = clip(a x + b). The colours x
are the same for all images, and each image and channel has a gain a and an offset b. Gains and offsets are fitted by
least absolute deviations (Schlossmacher 1973), so objects that move through less than half of the image are outliers
and do not change the fit. x is the median of (y - b) / a over the images without saturated pixels, so x may exceed 1.
The residuals are noise or a change of the scene. Then there are two tests:

- Does anything change? Each block of pixels is divided into two halves by a chess-board pattern. Noise is independent
  in the two halves, so the product of their means is zero on average. For a change of the scene it is positive. The
  scene changes if this product is far above the noise in at least one block.
- Does it change slowly with time? Let M hold the block means of the images from one position, and W the slow cosines
  cos(pi k t), k = 1 .. 4, at their times t. The statistic is |W^T M|^2 / |M|^2, summed over positions. It is compared
  with its values after random permutations of the images within each position (Gretton et al. 2005). Images of the same
  time are permuted together, so that a light which flickers for all cameras does not count as slow change.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.gates.permutation_test import PERMUTATIONS, Array, compare, slow_waves
from gsbench.scenes import View

LONG_SIDE = 100  # size of the compared images; every k-th pixel is taken, since noise of neighbours may be correlated
BLOCKS = 20  # number of blocks along the longer side
FAR_ABOVE = 20.0  # a block changes if its energy is above this times that of noise
MOST_VIEWS = 240  # largest number of images of all positions; of more images, evenly spaced ones are used
LEAST_OF_A_POSITION = 3  # least number of images from a position; the statistic is the same for two images in any order
LEVEL_8_BIT = 1 / 255
ROUNDS = 3  # how often gain and offset are fitted and x is computed again
REWEIGHTINGS = 8  # iterations of the least absolute deviations
FIT_PIXELS = 500  # number of pixels that the fit uses
LEAST_PIXELS = 16  # with fewer valid pixels nothing is fitted
BLACK = 0.01  # relative weight of an added black pixel: if all other pixels are alike, only a gain is fitted
GAINS = (0.25, 4.0)  # range of the gain

Pixels = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FixedCameraResult:
    """The result of comparing the images from the same camera position with one another."""

    changed: float  # share of the blocks of pixels that change, over all positions
    p: float | None = None  # p-value of slow change with time; None: nothing changes, or no position has enough images
    z: float | None = None  # z-score of slow change with time


def compare_images(views: Sequence[View], groups: Sequence[Sequence[int]], seed: int) -> FixedCameraResult:
    """Test whether images from the same camera position differ, and whether they change slowly with time.

    Args:
        views: the views, which have times.
        groups: for each camera position the indices of its views, at least two.
        seed: the seed of the random permutations.
    """
    most = max(4, MOST_VIEWS // len(groups))  # images of a position; 4 have 24 orders to permute, 3 only 6
    block_count, changed_count = 0, 0  # over all positions
    means, times = [], []  # of each position with enough images: [n, 3 B] and [n]
    for position, group in enumerate(groups):
        chosen = _spread(sorted(group, key=lambda v: views[v].time or 0.0), most, position / len(groups))
        halves = _halves(changes_of(np.stack([_pixels(views[v]) for v in chosen])))
        changed = _changed_blocks(halves)
        block_count, changed_count = block_count + len(changed), changed_count + int(changed.sum())
        if len(chosen) >= LEAST_OF_A_POSITION:
            means.append(halves.mean(0).reshape(len(chosen), -1).astype(np.float64))
            times.append(np.array([views[v].time for v in chosen], dtype=np.float64))
    if not changed_count or not means:
        return FixedCameraResult(changed_count / block_count)
    return FixedCameraResult(changed_count / block_count, *_test_slow_change(means, times, seed))


def _spread(ordered: list[int], most: int, start: float) -> list[int]:
    """Choose at most `most` evenly spaced views of a sorted list.

    A different `start` in [0, 1) for each camera position makes the chosen times different.
    """
    if len(ordered) <= most:
        return ordered
    return [ordered[int((i + start) * len(ordered) / most)] for i in range(most)]


def _pixels(view: View) -> Pixels:
    """Return every k-th pixel of a view's image, so that its longer side has at most LONG_SIDE pixels."""
    step = -(-max(view.pixels.shape[:2]) // LONG_SIDE)  # rounded up
    pixels = view.pixels[step // 2 :: step, step // 2 :: step]
    return np.asarray((pixels if pixels.is_floating_point() else pixels.float() / 255).to("cpu", torch.float32).numpy())


def _halves(
    images: Pixels,  # [n, H, W, 3]
) -> Pixels:  # [2, n, B, 3]
    """Divide each block of pixels into two halves by a chess-board pattern, and return the mean of each half.

    Noise is independent in the two halves, so that their product has only the change of the block (`_changed_blocks`).
    Pixels at the right and at the bottom that fill no block are left out.
    """
    n, height, width, channels = images.shape
    side = min(max(2, max(height, width) // BLOCKS), height, width)  # of a block, pixels; 1 in an image of one row
    rows, columns = height // side, width // side
    board = np.add.outer(np.arange(side), np.arange(side)) % 2
    cells = images[:, : rows * side, : columns * side].reshape(n, rows, side, columns, side, channels)
    cells = cells.transpose(0, 1, 3, 5, 2, 4).reshape(n, rows * columns, channels, side * side)
    weights = np.stack([board.ravel() == half for half in (0, 1)], 1).astype(np.float32)  # [side^2, 2]
    weights /= np.maximum(weights.sum(0), 1)  # in a block of one pixel, the second half is empty
    return np.ascontiguousarray((cells @ weights).transpose(3, 0, 1, 2))


def _changed_blocks(
    halves: Pixels,  # [2, n, B, 3], of mean zero over the n images
) -> Mask:  # [B]
    """Return which blocks of pixels change over the images by more than 1/255 and by far more than their noise."""
    first, second = halves
    degrees = first.shape[2] * (len(first) - 1)  # degrees of freedom: channels times (n - 1)
    energy = (first * second).sum((0, 2)) / degrees  # [B] variance of the change
    noise = np.square(first - second).sum((0, 2)) / (2 * degrees)  # [B] variance of the noise in a half
    noise = np.maximum(noise, noise.mean())  # a single block may have a small one by chance
    return np.asarray((energy > LEVEL_8_BIT**2) & (energy > FAR_ABOVE * noise))


def _test_slow_change(means: list[Array], times: list[Array], seed: int) -> tuple[float, float]:
    """Return the p-value and z-score of the test whether block means follow slow cosines of time, cos(pi k t).

    Args:
        means: the block means M of the images from each camera position, [n, 3 B] each.
        times: the times of these images, [n] for each position.
        seed: the seed of the random permutations.
    """
    # A random key of each time sorts the images of every position, so images of one time are permuted together.
    all_times = np.unique(np.concatenate(times))
    keys = np.random.default_rng(seed).random((PERMUTATIONS, len(all_times)))
    statistics = np.zeros(1 + PERMUTATIONS)  # |W^T M|^2 / |M|^2, first in the actual order
    for matrix, t in zip(means, times, strict=True):
        energy = float(np.square(matrix).sum())
        if energy == 0:
            continue
        waves = slow_waves(t)
        ranks = np.argsort(np.argsort(keys[:, np.searchsorted(all_times, t)], 1, kind="stable"), 1)  # [P, n]
        waves = waves[np.concatenate([np.arange(len(t))[None], ranks])].transpose(0, 2, 1)  # [1 + P, WAVES, n]
        statistics += ((waves @ (matrix @ matrix.T)) * waves).sum((1, 2)) / energy
    return compare(float(statistics[0]), statistics[1:])


def changes_of(
    images: Pixels,  # [n, H, W, 3] of one camera position, in [0, 1]
) -> Pixels:  # [n, H, W, 3]
    """Return the difference of each image from the mean image, after gain and offset of the exposure were removed.

    The images come from the same camera position. A difference of at most three standard deviations of the noise is set
    to zero if the value that gain and offset predict is saturated. Names are those of the module's docstring.
    """
    n, height, width, channels = images.shape
    y = np.ascontiguousarray(images.transpose(0, 3, 1, 2), np.float32).reshape(n, channels, -1)  # [n, 3, P]
    white = y >= 1 - LEVEL_8_BIT / 2
    saturated = white | (y <= LEVEL_8_BIT / 2)
    a, b = np.ones((n, channels, 1), np.float32), np.zeros((n, channels, 1), np.float32)
    x = np.sort(y, 0)[(n - 1) // 2]  # [3, P] the median image, to begin with
    margin = LEVEL_8_BIT  # a predicted value at most this far from 0 or 1 counts as saturated
    few = _fit_pixels(saturated)
    y_few = y[..., few]
    for _ in range(ROUNDS):
        expected = a * x[:, few] + b
        use = ~saturated[..., few] & (expected > margin) & (expected < 1 - margin)
        a, b = _fit(y_few, x[:, few], use)
        deviations = np.abs(y_few - a * x[:, few] - b)[use]
        # The standard deviation of normal noise is 1.4826 times the median of its absolute values.
        margin = LEVEL_8_BIT + (3 * 1.4826 * float(np.median(deviations)) if deviations.size else 0.0)
        x = _static_image((y - b) / a, saturated, white[0])
    expected = np.clip(a * x + b, 0, 1)
    changes = y - expected
    changes[((expected < margin) | (expected > 1 - margin)) & (np.abs(changes) < margin)] = 0
    changes -= changes.mean(0)
    return np.ascontiguousarray(changes.reshape(n, channels, height, width).transpose(0, 2, 3, 1))


def _fit_pixels(
    saturated: Mask,  # [n, 3, P]
) -> NDArray[np.int64]:
    """Choose the pixels for the fit of exposure: FIT_PIXELS of all, and up to FIT_PIXELS that no image saturates.

    Those of the second kind have a channel that no image saturates. Both kinds are evenly spaced.
    """
    unsaturated = np.flatnonzero((~saturated.any(0)).any(0))
    everything = np.arange(saturated.shape[2])
    spaced = [pixels[:: max(1, -(-len(pixels) // FIT_PIXELS))] for pixels in (unsaturated, everything)]
    return np.unique(np.concatenate(spaced))


def _fit(
    y: Pixels,  # [n, 3, P]
    x: Pixels,  # [3, P]
    use: Mask,  # [n, 3, P]
) -> tuple[Pixels, Pixels]:
    """Fit gains a and offsets b, [n, 3, 1], of y = a x + b to the pixels in `use`, for n images and 3 channels.

    Least absolute deviations: each weighted least-squares fit divides the weights by |y - a x - b| of the fit before.
    A black pixel (x = y = 0) with a small weight is added, so that an image of one shade determines only a gain.
    """
    pixel_count = use.sum(-1, keepdims=True)  # [n, 3, 1]
    enough = pixel_count >= LEAST_PIXELS
    y, x = np.pad(y, ((0, 0), (0, 0), (0, 1))), np.pad(x, ((0, 0), (0, 1)))  # the black pixel is the last
    first_weights = np.concatenate([use, BLACK * pixel_count], -1).astype(np.float32)  # [n, 3, P + 1]
    weights = first_weights
    for _ in range(REWEIGHTINGS):
        weights = weights / np.maximum(weights.sum(-1, keepdims=True), 1e-9)
        mean = (weights * x).sum(-1, keepdims=True)
        weighted = weights * (x - mean)
        slope = (weighted * y).sum(-1, keepdims=True) / np.maximum((weighted * x).sum(-1, keepdims=True), 1e-9)
        a = np.clip(slope, *GAINS)
        b = (weights * y).sum(-1, keepdims=True) - a * mean
        weights = first_weights / np.maximum(np.abs(y - a * x - b), np.float32(LEVEL_8_BIT))
    return _shared(a, enough, 1), _shared(b, enough, 0)


def _shared(
    values: Pixels,  # [n, 3, 1]
    enough: Mask,  # [n, 3, 1]
    otherwise: float,
) -> Pixels:
    """Replace a gain or offset that was fitted to too few pixels by the mean over the image's other channels.

    If all channels have too few pixels, it becomes `otherwise`.
    """
    channel_count = enough.sum(1, keepdims=True)
    mean = (values * enough).sum(1, keepdims=True) / np.maximum(channel_count, 1)
    return np.where(enough, values, np.where(channel_count > 0, mean, otherwise)).astype(np.float32)


def _static_image(
    values: Pixels,  # [n, 3, P] (y - b) / a
    saturated: Mask,  # [n, 3, P]
    white: Mask,  # [3, P] which pixels of the first image are white
) -> Pixels:  # [3, P]
    """Return for each pixel the median over n images of its unsaturated values.

    A pixel that is saturated in all images gets its largest value if it is white, and its smallest value if it is
    black.
    """
    ordered = np.sort(np.where(saturated, np.float32(np.inf), values), 0)  # the unsaturated values come first
    unsaturated_count = (~saturated).sum(0)
    median = np.take_along_axis(ordered, np.maximum(unsaturated_count - 1, 0)[None] // 2, 0)[0]
    return np.where(unsaturated_count > 0, median, np.where(white, values.max(0), values.min(0)))
