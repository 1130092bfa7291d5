"""Random hard cases from the slice through rasterizer and loss to every gradient: no number may not be finite."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsbench.kernels.backends import BACKENDS
from gsbench.models import CameraTime, GaussianModel
from gsbench.raster import rasterize
from gsbench.train.losses import photometric
from numerics import pictures, population, slices
from numerics.audit import CASES
from numerics.cases import of_area, present
from numerics.slices import COUNT, JOINT, Observed

WIDTH, HEIGHT = 16, 12
SLICES = [(case.name, model) for case in of_area("slicing") for model in case.subjects]
PICTURES = [case.name for case in of_area("projection") + of_area("blending") if case.name != "faint_crowd"]
severities, seeds = st.floats(0, 1), st.integers(0, 2**31)
backends = st.sampled_from(present())
raw_values = st.floats(-100, 100, width=32)


def appearance(model: str, seed: int) -> dict[str, Tensor]:
    """Coefficients of colours, of the model's shape."""
    g, waves = torch.Generator().manual_seed(seed), 3 if model == "4dgs" else 1
    sh0 = torch.randn(COUNT, 1, 1, 3, generator=g) if model == "4dgs" else torch.randn(COUNT, 1, 3, generator=g)
    return {"sh0": sh0, "shN": torch.randn(COUNT, 16 * waves - 1, 3, generator=g)}


def whole_path(model: GaussianModel, raw: dict[str, Tensor], observed: Observed, backend: str, seed: int) -> None:
    """Slice, draw, compare with a photograph, and differentiate; everything must be finite."""
    raw = raw | appearance(observed.model, seed)
    inputs = {name: value.detach().clone().requires_grad_() for name, value in raw.items()}
    query = CameraTime(observed.center, torch.tensor(observed.time))
    means, factors, opacities, shapes = model.slice_geometry(inputs, query)
    shown = model.shade(inputs, means, opacities, query)
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -observed.center
    K = torch.tensor([[20.0, 0, WIDTH / 2], [0, 20.0, HEIGHT / 2], [0, 0, 1]])
    image = rasterize(
        means, factors, opacities, shown, viewmat[None], K[None], WIDTH, HEIGHT, backend=backend, beta_exponents=shapes
    ).image[0]
    target = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    loss = photometric(image, target, 0.2, BACKENDS[backend])
    assert loss.isfinite()
    gradients = torch.autograd.grad(loss, list(inputs.values()), materialize_grads=True)
    for name, gradient in zip(inputs, gradients, strict=True):
        assert gradient.isfinite().all(), name


def check_case(which: tuple[str, str], severity: float, seed: int, backend: str) -> None:
    name, model = which
    observed: Observed = CASES[name](severity, seed, model=model)
    whole_path(*slices.load(observed, "square_root", backend), observed, backend, seed)


def check_any_numbers(model: str, values: list[float], seed: int, backend: str) -> None:
    """Raw parameters replaced at random by numbers that no recipe would give."""
    observed: Observed = CASES["ordinary_gaussians"](1.0, seed, model=model)
    g = torch.Generator().manual_seed(seed)
    for value in values:
        name = sorted(observed.raw)[int(torch.randint(len(observed.raw), (), generator=g))]
        flat = observed.raw[name].view(-1)
        flat[int(torch.randint(len(flat), (), generator=g))] = value
    whole_path(*slices.load(observed, "square_root", backend), observed, backend, seed)


def check_picture(name: str, severity: float, seed: int, backend: str) -> None:
    for arguments in CASES[name](severity, seed):
        inputs = {k: arguments[k].clone().requires_grad_() for k in pictures.inputs_of(arguments)}
        out = rasterize(**(arguments | inputs), backend=backend)
        assert out.image.isfinite().all()
        loss = out.image.square().sum() + out.alpha.sum()
        gradients = torch.autograd.grad(loss, list(inputs.values()), materialize_grads=True)
        assert all(g.isfinite().all() for g in gradients)


def searched(examples: int) -> tuple[Any, Any, Any]:
    """The three searches, of so many examples in all."""
    models = st.sampled_from([*JOINT, *population.MOVING])
    searches = (
        (2, given(st.sampled_from(SLICES), severities, seeds, backends)(check_case)),
        (4, given(models, st.lists(raw_values, max_size=12), seeds, backends)(check_any_numbers)),
        (4, given(st.sampled_from(PICTURES), severities, seeds, backends)(check_picture)),
    )
    hard, wild, drawn = (settings(max_examples=examples // part, deadline=None)(check) for part, check in searches)
    return hard, wild, drawn


@pytest.mark.parametrize("search", searched(240), ids=["hard", "wild", "drawn"])
def test_no_number_is_not_finite(search):
    """Catches 0 x inf, an overflow or a division by zero anywhere between raw parameters and their gradients."""
    search()


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("search", searched(10_000), ids=["hard", "wild", "drawn"])
def test_no_number_of_10000_is_not_finite(search):
    """The same, 10,000 times."""
    search()
