"""The oracle itself: what it says of things known otherwise, and that its digits suffice."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from mpmath import mp

from gsbench.models.appearance import sh_basis
from gsbench.models.factors import KINDS
from gsbench.stability import moving_population, oracle, population, slicing_cases
from gsbench.stability.cases import CASES, of_area
from gsbench.stability.slices import SliceTruth, exact


def row(observed: slicing_cases.Observed, i: int) -> list[float]:
    return torch.cat([value[i].flatten() for value in observed.raw.values()]).tolist()


def test_independent_position() -> None:
    """Catches a covariance that is not S_pp where p does not correlate, and an opacity factor that is not marginal."""
    observed = CASES["ordinary_gaussians"](model="7dgs")
    for kind in KINDS:
        observed.raw[kind].zero_()
    got = [float(x) for x in oracle.evaluate(exact(observed), row(observed, 0))]
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
def test_digits_suffice(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a precision too low for the hardest case: half as many digits again change nothing in float64."""
    observed = CASES["diagonals_over_eight_decades"](model=model)
    function, x = exact(observed), row(observed, 1)
    values, slopes = oracle.evaluate(function, x), oracle.gradient(function, x, [1.0] * 13)
    monkeypatch.setattr(oracle, "DIGITS", 180)
    for found, better in ((values, oracle.evaluate(function, x)), (slopes, oracle.gradient(function, x, [1.0] * 13))):
        np.testing.assert_allclose([float(v) for v in found], [float(v) for v in better], rtol=1e-14, atol=1e-300)


def test_harmonics() -> None:
    """Catches a sign or factor of a Y_lm: the models' table of constants is the general formula."""
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    with mp.workdps(30):
        expected = [float(oracle._harmonic(degree, order, *map(mp.mpf, direction.tolist())))
                    for degree in range(4) for order in range(-degree, degree + 1)]  # fmt: skip
    np.testing.assert_allclose(sh_basis(direction[None], 3)[0], expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("order", ["paper", "conditioned_first"])
def test_the_reference_of_the_million(order: str) -> None:
    """Catches a wrong covariance or gradient in float64, which a million slices are held to: mpmath agrees to 1e-6."""
    hard = population.draw(torch.Generator().manual_seed(7), 6, order)
    assert population.verify(hard, order, 6) < 1e-6


@pytest.mark.parametrize("part", ["outputs", "gradient"])
def test_the_reference_of_moving_slices(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a check of the float64 slices against mpmath that looks at their values or at their gradients alone."""
    observed = moving_population.draw(torch.Generator().manual_seed(7), "freetime", 4)
    assert moving_population.verify(observed) < 1e-6
    truth = moving_population.truth

    def wrong(*arguments: Any) -> SliceTruth:
        right = truth(*arguments)
        return replace(right, **{part: getattr(right, part) + 1e-2 * getattr(right, part).abs().amax()})

    monkeypatch.setattr(moving_population, "truth", wrong)
    assert moving_population.verify(observed) > 1e-4


def test_a_seed_of_the_drift_is_one_of_the_points_too() -> None:
    """Catches three seeds that all start from the same points."""
    trainings = [CASES["single_against_double"](model="7dgs", run_seed=seed) for seed in (0, 1)]
    assert [one.config.seed for one in trainings] == [0, 1]
    first, second = (one.scene.points for one in trainings)
    assert first is not None
    assert second is not None
    assert not torch.equal(first.means, second.means)


def test_every_case_says_what_it_stresses() -> None:
    """Catches a case without its line, and one in an area that no judge looks at."""
    for found in CASES.values():
        assert len(found.stresses) > 40, found.name
    assert sum(len(of_area(area)) for area in ("slicing", "colour", "projection", "blending", "training", "drift")) == (
        len(CASES)
    )
