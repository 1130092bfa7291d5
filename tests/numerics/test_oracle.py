"""The oracle: what it computes of things known otherwise, and that its digits suffice."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from mpmath import mp

from gsbench.models.appearance import sh_basis
from gsbench.models.factors import KINDS
from numerics import oracle, population
from numerics.audit import CASES
from numerics.slices import Observed, SliceTruth, exact_slice


def row(observed: Observed, i: int) -> list[float]:
    return torch.cat([value[i].flatten() for value in observed.raw.values()]).tolist()


def test_independent_position():
    """Catches a covariance that is not S_pp where p does not correlate, and an opacity factor that is not marginal."""
    observed = CASES["ordinary_gaussians"](model="7dgs")
    for kind in KINDS:
        observed.raw[kind].zero_()
    got = [float(x) for x in oracle.evaluate(exact_slice(observed), row(observed, 0))]
    sizes = observed.raw["log_diagonal"][0].double().exp()
    np.testing.assert_allclose(got[:3], observed.raw["means"][0].double(), rtol=1e-15)
    np.testing.assert_allclose(np.reshape(got[3:12], (3, 3)), torch.diag(sizes[4:] ** 2), rtol=1e-15)
    offset = observed.raw["means"][0].double() - observed.center.double()
    delta_d = offset / offset.norm() - observed.raw["directions"][0].double()
    delta_t = float(torch.tensor(observed.time)) - observed.raw["times"][0].double()
    squares = (delta_d / sizes[:3]).square().sum() + (delta_t / sizes[3]).square().sum()
    opacity_factor = torch.exp(-0.5 * math.exp(np.float32(math.log(0.35))) * squares)
    np.testing.assert_allclose(
        got[12], opacity_factor * torch.sigmoid(observed.raw["opacities"][0].double()), rtol=1e-14
    )


@pytest.mark.parametrize("model", ["4dgs", "7dgs"])
def test_digits_suffice(model, monkeypatch):
    """Catches a precision too low for the hardest case: half as many digits again change nothing in float64."""
    observed = CASES["diagonals_over_eight_decades"](model=model)
    function, x = exact_slice(observed), row(observed, 1)
    values, slopes = oracle.evaluate(function, x), oracle.gradient(function, x, [1.0] * 13)
    monkeypatch.setattr(oracle, "DIGITS", 180)
    for coarse, better in ((values, oracle.evaluate(function, x)), (slopes, oracle.gradient(function, x, [1.0] * 13))):
        np.testing.assert_allclose([float(v) for v in coarse], [float(v) for v in better], rtol=1e-14, atol=1e-300)


def test_harmonics():
    """Catches a sign or factor of a Y_lm: the models' table of constants is the general formula."""
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    with mp.workdps(30):
        expected = [
            float(oracle.harmonic(degree, order, *map(mp.mpf, direction.tolist())))
            for degree in range(4)
            for order in range(-degree, degree + 1)
        ]
    np.testing.assert_allclose(sh_basis(direction[None], 3)[0], expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("order", ["paper", "conditioned_first"])
def test_the_reference_of_the_million(order):
    """Catches a wrong covariance or gradient in float64, which a million slices are held to: mpmath agrees to 1e-6."""
    assert population.verify(population.draw_factors(torch.Generator().manual_seed(7), order, 6)) < 1e-6


@pytest.mark.parametrize("part", ["outputs", "gradient"])
def test_the_reference_of_moving_slices(part, monkeypatch):
    """Catches a check of the float64 slices against mpmath that looks at their values or at their gradients alone."""
    observed = population.draw_moving(torch.Generator().manual_seed(7), "freetime", 4)
    assert population.verify(observed) < 1e-6
    truth = population.truth

    def wrong(*arguments: Any) -> SliceTruth:
        right = truth(*arguments)
        return right._replace(**{part: getattr(right, part) + 1e-2 * getattr(right, part).abs().amax()})

    monkeypatch.setattr(population, "truth", wrong)
    assert population.verify(observed) > 1e-4
