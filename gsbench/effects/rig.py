"""Test whether the images of one camera place change with time, without a fitted model.

Two questions are asked of all places together, after each image's exposure is taken out (gsbench.effects.exposure).

- Does anything change? Noise is white over pixels, a change is not. The pixels of a block form two halves like the
  squares of a chess board. The product of the means of the halves is zero on average for noise of any size, and the
  energy of a change otherwise. One block in which it is far above the noise is enough.
- Does it change slowly? The share of the energy of each place's block means that follows slow waves of time,
  |W^T M|^2 / |M|^2, is summed over places. It is compared with that of images permuted within their places (a kernel
  test of independence, Gretton et al. 2005, with permutations within strata), so differences between places do not
  count. Each moment has a random number, and a place's images are permuted in the order of these numbers. So the images
  of one moment stay together, and the level holds for a light that flickers for all cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.effects.exposure import LEVEL_8_BIT, changes
from gsbench.effects.waves import PERMUTATIONS, compare, slow_waves
from gsbench.scenes import View

LONG_SIDE = 100  # pixels of the images that are compared; every k-th is taken, as neighbours' noise may be alike
BLOCKS = 20  # along the longer side
FAR_ABOVE = 20.0  # times the energy of noise
MOST_VIEWS = 240  # of all places together; more are taken evenly spaced from each
LEAST_AT_A_PLACE = 3  # two images have no order: a film and its reverse are one to slow waves

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlaceComparison:
    """The result of comparing the images of each camera place with one another."""

    changed: float  # share of the blocks, over all places
    p: float | None  # of slow waves; None: nothing changes, or no place has images enough
    z: float | None


def compare_places(views: Sequence[View], places: Sequence[Sequence[int]], seed: int) -> PlaceComparison:
    """Compare the images of each camera place with one another, to find changes with time.

    Args:
        views: with times.
        places: for each camera place the indices of its views, at least two.
        seed: seed of the random permutations.
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
        return PlaceComparison(changed / blocks, None, None)
    p, z = _slow(means, times, seed)
    return PlaceComparison(changed / blocks, p, z)


def _spread(ordered: list[int], most: int, start: float) -> list[int]:
    """Choose at most `most` views, evenly spaced.

    `start` in [0, 1) shifts them, so that camera places differ in time.
    """
    if len(ordered) <= most:
        return ordered
    return [ordered[int((i + start) * len(ordered) / most)] for i in range(most)]


def _pixels(view: View) -> NDArray[np.float32]:
    """Return every k-th pixel of a view's image, at most LONG_SIDE along its longer side."""
    step = -(-max(view.pixels.shape[:2]) // LONG_SIDE)
    pixels = view.pixels[step // 2 :: step, step // 2 :: step]
    return np.asarray((pixels if pixels.is_floating_point() else pixels.float() / 255).to("cpu", torch.float32).numpy())


def _halves(
    images: NDArray[np.float32],  # [n, H, W, 3]
) -> NDArray[np.float32]:  # [2, n, B, 3]
    """Average the two halves of the pixels of each block, which are like the squares of a chess board."""
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
    """Tell which blocks change by more than a level of 8 bits, and by far more than the noise of their pixels."""
    first, second = halves
    degrees = first.shape[2] * (len(first) - 1)
    energy = (first * second).sum((0, 2)) / degrees
    noise = np.square(first - second).sum((0, 2)) / (2 * degrees)
    noise = np.maximum(noise, noise.mean())
    return np.asarray((energy > LEVEL_8_BIT**2) & (energy > FAR_ABOVE * noise))


def _slow(means: list[Array], times: list[Array], seed: int) -> tuple[float, float]:
    """Return p-value and z-score of the share of energy that follows slow waves of time, summed over camera places."""
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
