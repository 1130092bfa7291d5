"""The kernels of 3D Gaussians that move and fade (dGS, dBS, FreeTimeGS) against the models written in torch."""

from typing import Any

import pytest
import torch
from test_prefixes import CENTER, SHARES, TIME, assert_static_rows, gradients
from test_slices import assert_same
from torch import Tensor

from gsbench.models import Query, build
from gsbench.models.effect_sets import EffectSets
from gsbench.models.moving3d import MovingGaussians3D
from gsbench.models.sliced import tensors_of
from gsbench.scenes.scene import Points

N = 45
NAMES = ("dgs", "dbs", "dbs_static", "freetime")
SPREADS = {"betas": 0.7, "coupling": 0.5, "velocities": 0.5, "skew": 0.3, "directions": 0.7, "opacities": 2.0}


def moving(name: str, dtype: torch.dtype, count: int = N) -> tuple[MovingGaussians3D, dict[str, Tensor]]:
    """A model and raw parameters of so many Gaussians, with numbers beyond the limits of sizes and of exponents."""
    g = torch.Generator().manual_seed(6)
    model = build(name)
    assert isinstance(model, MovingGaussians3D)
    model.initialise(Points(torch.randn(count, 3, generator=g), torch.rand(count, 3, generator=g)), 1.0, g)
    used = "means", *model.geometry, *model.centers, "opacities"
    raw = {key: model.splats[key].detach() for key in dict.fromkeys(used)}
    raw = {key: x + SPREADS.get(key, 0.3) * torch.randn(x.shape, generator=g) for key, x in raw.items()}
    raw["scales"] = torch.randn(count, 3, generator=g) - 1
    if count == N:
        raw["scales"][3, 0] = -17.0  # beyond where sizes stop
        for key, column in (("precision", 0), ("durations", 0), ("betas", 1)):
            if key in raw:
                raw[key][5:7, column] = -17.0
        if "betas" in raw:
            raw["betas"][7, 2] = 0.0  # where the weight of a shift stops
            raw["precision"][8:10, 5] = 2.0  # so narrow that the factor of the opacity stops
    return model.to(dtype), {key: x.to(dtype).requires_grad_() for key, x in raw.items()}


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("name", NAMES)
def test_slice(name: str) -> None:
    """Catches a wrong motion, factor, opacity or exponent, and a wrong derivative, in every instruction set."""
    exact, raw = moving(name, torch.float64)
    seen = exact.condition(raw, Query(CENTER.double(), TIME.double()))
    opacities = torch.sigmoid(raw["opacities"]) * seen.opacity_factor
    expected = tensors_of([seen.means, seen.factors, opacities, seen.shapes])
    model, single = moving(name, torch.float32)
    model.condition = None  # nothing is left to torch
    actual = tensors_of(model.slice_geometry(single, Query(CENTER, TIME)))
    assert_same(actual, expected)
    assert_same(gradients(actual, list(single.values())), gradients(expected, list(raw.values())))


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("share", SHARES)
def test_static_rows(name: str, share: float) -> None:
    """Catches a static row that moves, fades, or has a gradient by a parameter of its motion."""
    assert_static_rows(*moving(name, torch.float64), *moving(name, torch.float32), share)


@pytest.mark.usefixtures("instruction_set")
def test_sizes_of_beta_profiles_keep_their_digits() -> None:
    """Catches a softplus that loses the digits of small sizes, or that does not stop, with its derivative."""
    x = torch.tensor([-30.0, -15.0, -9.0, -4.0, -0.1, 0.0, 0.1, 4.0, 30.0, 1e7])
    found = []
    for dtype in (torch.float64, torch.float32):
        model, raw = moving("dbs", dtype, len(x))
        with torch.no_grad():
            raw["scales"].copy_(x[:, None].expand(-1, 3))
            raw["skew"].zero_()
        model.effect_sets = EffectSets(0, 0, None)
        factors = model.slice_geometry(raw, Query(CENTER.to(dtype), TIME.to(dtype))).factors
        (slopes,) = torch.autograd.grad(factors.sum(), raw["scales"])
        found.append((factors.diagonal(dim1=1, dim2=2).double(), slopes.double()))
    for got, want in zip(found[1], found[0], strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", NAMES)
def test_threads_change_no_bit(name: str) -> None:
    """Catches rows that two threads share, or that none computes."""
    model, raw = moving(name, torch.float32, 1100)
    model.effect_sets = EffectSets(0, 550, None)
    found: list[list[Any]] = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        seen = tensors_of(model.slice_geometry(raw, Query(CENTER, TIME)))
        found.append([*seen, *gradients(seen, list(raw.values()))])
    assert all(torch.equal(x, y) for other in found[1:] for x, y in zip(found[0], other, strict=True))
