"""Test whether images that were taken from the same camera position change with time.

Differences of exposure are removed first (gsbench.gates.exposure). Then there are two tests:

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

from gsbench.gates.exposure import LEVEL_8_BIT, changes
from gsbench.gates.permutation_test import PERMUTATIONS, compare, slow_waves
from gsbench.scenes import View

LONG_SIDE = 100  # size of the compared images; every k-th pixel is taken, since noise of neighbours may be correlated
BLOCKS = 20  # number of blocks along the longer side
FAR_ABOVE = 20.0  # a block changes if its energy is above this times that of noise
MOST_VIEWS = 240  # largest number of images of all positions; of more images, evenly spaced ones are used
LEAST_AT_A_PLACE = 3  # least number of images from a position; the statistic is the same for two images in any order

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FixedCameraResult:
    """Hold the result of comparing the images from the same camera position with one another."""

    changed: float  # share of the blocks of pixels that change, over all positions
    p: float | None  # p-value of slow change with time; None: nothing changes, or no position has enough images
    z: float | None  # z-score of slow change with time


def compare_images(views: Sequence[View], places: Sequence[Sequence[int]], seed: int) -> FixedCameraResult:
    """Test whether images from the same camera position differ, and whether they change slowly with time.

    Args:
        views: the views, which have times.
        places: for each camera position the indices of its views, at least two.
        seed: the seed of the random permutations.
    """
    most = max(4, MOST_VIEWS // len(places))
    blocks, changed, means, times = 0, 0, [], []
    for number, place in enumerate(places):
        chosen = _spread(sorted(place, key=lambda v: views[v].time or 0.0), most, number / len(places))
        halves = _halves(changes(np.stack([_pixels(views[v]) for v in chosen])))
        is_changed = _is_changed(halves)
        blocks, changed = blocks + len(is_changed), changed + int(is_changed.sum())
        if len(chosen) >= LEAST_AT_A_PLACE:
            means.append(halves.mean(0).reshape(len(chosen), -1).astype(np.float64))
            times.append(np.array([views[v].time for v in chosen], dtype=np.float64))
    if not changed or not means:
        return FixedCameraResult(changed / blocks, None, None)
    p, z = _slow(means, times, seed)
    return FixedCameraResult(changed / blocks, p, z)


def _spread(ordered: list[int], most: int, start: float) -> list[int]:
    """Choose at most `most` evenly spaced views of a sorted list.

    A different `start` in [0, 1) for each camera position makes the chosen times different.
    """
    if len(ordered) <= most:
        return ordered
    return [ordered[int((i + start) * len(ordered) / most)] for i in range(most)]


def _pixels(view: View) -> NDArray[np.float32]:
    """Return every k-th pixel of a view's image, so that its longer side has at most LONG_SIDE pixels."""
    step = -(-max(view.pixels.shape[:2]) // LONG_SIDE)
    pixels = view.pixels[step // 2 :: step, step // 2 :: step]
    return np.asarray((pixels if pixels.is_floating_point() else pixels.float() / 255).to("cpu", torch.float32).numpy())


def _halves(
    images: NDArray[np.float32],  # [n, H, W, 3]
) -> NDArray[np.float32]:  # [2, n, B, 3]
    """Divide each block of pixels into two halves by a chess-board pattern, and return the mean of each half."""
    n, height, width, channels = images.shape
    side = min(max(2, max(height, width) // BLOCKS), height, width)
    rows, columns = height // side, width // side
    board = np.add.outer(np.arange(side), np.arange(side)) % 2
    cells = images[:, : rows * side, : columns * side].reshape(n, rows, side, columns, side, channels)
    cells = cells.transpose(0, 1, 3, 5, 2, 4).reshape(n, rows * columns, channels, side * side)
    weights = np.stack([board.ravel() == half for half in (0, 1)], 1).astype(np.float32)
    return np.ascontiguousarray((cells @ (weights / np.maximum(weights.sum(0), 1))).transpose(3, 0, 1, 2))


def _is_changed(
    halves: NDArray[np.float32],  # [2, n, B, 3], of mean zero over the n images
) -> NDArray[np.bool_]:  # [B]
    """Return which blocks of pixels change over the images by more than 1/255 and by far more than their noise.

    Args:
        halves: the means of the two halves of each block, from `_halves`.
    """
    first, second = halves
    degrees = first.shape[2] * (len(first) - 1)
    energy = (first * second).sum((0, 2)) / degrees
    noise = np.square(first - second).sum((0, 2)) / (2 * degrees)
    noise = np.maximum(noise, noise.mean())
    return np.asarray((energy > LEVEL_8_BIT**2) & (energy > FAR_ABOVE * noise))


def _slow(means: list[Array], times: list[Array], seed: int) -> tuple[float, float]:
    """Return the p-value and z-score of the test whether block means follow slow cosines of time, cos(pi k t).

    Args:
        means: the block means of the images from each camera position, [n, ..] each.
        times: the times of these images, [n] for each position.
        seed: the seed of the random permutations.
    """
    moments = np.unique(np.concatenate(times))
    keys = np.random.default_rng(seed).random((PERMUTATIONS, len(moments)))
    total = np.zeros(1 + PERMUTATIONS)
    for matrix, moment in zip(means, times, strict=True):
        energy = float(np.square(matrix).sum())
        if energy == 0:
            continue
        waves = slow_waves(moment)
        ranks = np.argsort(np.argsort(keys[:, np.searchsorted(moments, moment)], 1, kind="stable"), 1)
        waves = waves[np.concatenate([np.arange(len(moment))[None], ranks])].transpose(0, 2, 1)  # [1 + P, WAVES, n]
        total += ((waves @ (matrix @ matrix.T)) * waves).sum((1, 2)) / energy
    return compare(float(total[0]), total[1:])
