"""Test by random permutations of time whether data follow slow cosines of time, cos(pi k t)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

WAVES = 4  # cos(pi k t), k = 1 .. WAVES
PERMUTATIONS = 999
TIE = 1e-9  # relative tolerance: a permutation that happens to be the actual order may differ by rounding

Array = NDArray[np.float64]


class ResidualsTest(NamedTuple):
    """The result of the test whether residuals follow slow cosines of time."""

    p: float
    z: float
    free: float  # share of the variance of the cosines that the camera does not explain


def follow_time(
    products: Array,  # [V, V] scalar products of the views' gradients
    times: Array,  # [V] in [0, 1]
    camera: Array,  # [V, B] functions of the camera, with a constant
    seed: int,
    groups: Sequence[Sequence[int]] | None = None,
) -> ResidualsTest:
    """Test whether the gradients of V views follow slow cosines of time (Freedman and Lane 1983).

    Let P project onto what the cosines have beyond the camera, and R onto what the camera does not explain. The
    statistic is |P R G|^2 / |R G|^2 for the gradients G, of which only G G^T = `products` is needed.

    Args:
        products: the scalar products of the gradients of all pairs of views.
        times: the times of the views.
        camera: their influence on gradients and cosines is removed by linear regression.
        seed: the seed of the random permutations.
        groups: views within which times are permuted; by default all views are one group.
    """
    waves = slow_waves(times)
    of_camera = _range(camera)
    unexplained = waves - of_camera @ (of_camera.T @ waves)
    free = float(np.square(unexplained).sum() / max(np.square(waves).sum(), 1e-300))
    slow = _range(unexplained)  # [V, S]
    residual = np.eye(len(times)) - of_camera @ of_camera.T  # [V, V] R
    gram = residual @ products @ residual  # R G (R G)^T
    total = float(np.trace(gram))  # |R G|^2
    random = np.random.default_rng(seed)

    def share(rows: NDArray[np.int64]) -> float:
        """Return the share of the gradients that cosines of time, permuted by `rows`, explain beyond the camera.

        Instead of the residuals R G, the cosines and the camera are permuted. What the permuted camera explains is
        subtracted from |R G|^2; without a permutation it is zero.
        """
        permuted = np.concatenate([slow, of_camera], 1)[rows]
        energies = np.einsum("vk,vk->k", permuted, gram @ permuted)  # |u^T R G|^2 for each column u
        left = total - energies[slow.shape[1] :].sum()
        return float(energies[: slow.shape[1]].sum() / left) if left > 0 else 0.0

    actual = share(np.arange(len(times)))
    order, null = np.arange(len(times)), np.empty(PERMUTATIONS)
    for i in range(PERMUTATIONS):
        for group in groups or [range(len(times))]:  # no groups: None or an empty list
            order[list(group)] = random.permutation(list(group))
        null[i] = share(order)
    return ResidualsTest(*compare(actual, null), free)


def slow_waves(
    times: Array,  # [V] in [0, 1]
) -> Array:  # [V, WAVES]
    """Return the cosines cos(pi k t), k = 1 .. WAVES, of times t, less the mean of each."""
    waves = np.cos(math.pi * np.outer(times, np.arange(1, WAVES + 1)))
    return np.asarray(waves - waves.mean(0))


def compare(
    actual: float,
    null: Array,  # [PERMUTATIONS] the values after random permutations of time
) -> tuple[float, float]:
    """Return the p-value and the z-score of a permutation test.

    The p-value is (1 + number of permutations whose statistic reaches that of the actual order) / (1 + number of
    permutations).
    """
    p = (1 + int((null >= actual - TIE * abs(actual)).sum())) / (1 + len(null))
    spread = float(null.std())
    return p, (actual - float(null.mean())) / spread if spread > TIE * abs(actual) else 0.0


def _range(columns: Array) -> Array:
    """Return an orthonormal basis [V, R] of the column space of a matrix [V, B]."""
    left, singular_values, _ = np.linalg.svd(columns, full_matrices=False)
    # What is smaller than 1e-6 of the largest counts as zero.
    return np.asarray(left[:, singular_values > 1e-6 * max(singular_values.max(initial=0.0), 1e-300)])
