"""Random hard cases from the slice through rasterizer and loss to every gradient: no number may not be finite."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsbench.kernels.backends import BACKENDS
from gsbench.models import GaussianModel, Query
from gsbench.raster import rasterize
from gsbench.stability import (
    colors,  # noqa: F401  # its cases enter the list
    moving_population,
    picture_cases,  # noqa: F401
    pictures,
    slices,
    slicing_cases,
)
from gsbench.stability.audit import present
from gsbench.stability.cases import CASES, of_area
from gsbench.stability.slicing_cases import COUNT, Observed
from gsbench.train.losses import photometric

WIDTH, HEIGHT = 16, 12
SLICES = [(case.name, model) for case in of_area("slicing") for model in case.subjects]
PICTURES = [case.name for case in of_area("projection") + of_area("blending") if case.name != "faint_crowd"]
severities, seeds = st.floats(0, 1), st.integers(0, 2**31)
backends = st.sampled_from(present())
raw_values = st.floats(-100, 100, width=32)


def appearance(model: str, seed: int) -> dict[str, Tensor]:
    """Coefficients of colours, of the model's shape."""
    g = torch.Generator().manual_seed(seed)
    if model == "4dgs":
        return {"sh0": torch.randn(COUNT, 1, 1, 3, generator=g), "shN": torch.randn(COUNT, 47, 3, generator=g)}
    return {"sh0": torch.randn(COUNT, 1, 3, generator=g), "shN": torch.randn(COUNT, 15, 3, generator=g)}


def whole_path(model: GaussianModel, raw: dict[str, Tensor], center: Tensor, time: float, backend: str) -> None:
    """Slice, draw, compare with a photograph, and differentiate; everything must be finite."""
    inputs = {name: value.clone().requires_grad_() for name, value in raw.items()}
    moment = torch.tensor(time)
    means, factors, opacities, shapes = model.slice_geometry(inputs, Query(center, moment))
    shown = model.shade(inputs, means, opacities, Query(center, moment))
    viewmat = torch.eye(4)
    viewmat[:3, 3] = -center
    K = torch.tensor([[20.0, 0, WIDTH / 2], [0, 20.0, HEIGHT / 2], [0, 0, 1]])
    image = rasterize(
        means, factors, opacities, shown, viewmat[None], K[None], WIDTH, HEIGHT, backend=backend, shapes=shapes
    ).image[0]
    target = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    loss = photometric(image, target, 0.2, BACKENDS[backend])
    assert loss.isfinite()
    gradients = torch.autograd.grad(loss, list(inputs.values()), materialize_grads=True)
    for name, gradient in zip(inputs, gradients, strict=True):
        assert gradient.isfinite().all(), name


def check_case(which: tuple[str, str], severity: float, seed: int, backend: str) -> None:
    name, model_name = which
    observed: Observed = CASES[name](severity, seed, model=model_name)
    model, raw = slices.load(observed, "square_root", backend)
    raw = {name: value.detach() for name, value in raw.items()} | appearance(model_name, seed)
    whole_path(model, raw, observed.center, observed.time, backend)


def check_any_numbers(model_name: str, values: list[float], seed: int, backend: str) -> None:
    """Raw parameters replaced at random by numbers that no recipe would give."""
    case = "ordinary_gaussians" if model_name in slicing_cases.ALL else "ordinary_moving_gaussians"
    observed: Observed = CASES[case](1.0, seed, model=model_name)
    model, raw = slices.load(observed, "square_root", backend)
    raw = {name: value.detach() for name, value in raw.items()}
    g = torch.Generator().manual_seed(seed)
    for value in values:
        name = sorted(raw)[int(torch.randint(len(raw), (), generator=g))]
        flat = raw[name].view(-1)
        flat[int(torch.randint(len(flat), (), generator=g))] = value
    whole_path(model, raw | appearance(model_name, seed), observed.center, observed.time, backend)


def check_picture(name: str, severity: float, seed: int, backend: str) -> None:
    for arguments in CASES[name](severity, seed):
        inputs: dict[str, Any] = {k: arguments[k].clone().requires_grad_() for k in
                                  pictures.inputs_of(arguments)}  # fmt: skip
        out = rasterize(**(arguments | inputs), backend=backend)
        assert out.image.isfinite().all()
        gradients = torch.autograd.grad((out.image.square().sum() + out.alpha.sum()), list(inputs.values()),
                                        materialize_grads=True)  # fmt: skip
        assert all(g.isfinite().all() for g in gradients)


def searched(examples: int) -> tuple[Any, Any, Any]:
    """The three searches, of so many examples in all."""
    hard = settings(max_examples=examples // 2, deadline=None)(
        given(st.sampled_from(SLICES), severities, seeds, backends)(check_case)
    )
    wild = settings(max_examples=examples // 4, deadline=None)(
        given(
            st.sampled_from([*slicing_cases.ALL, *moving_population.MODELS]),
            st.lists(raw_values, max_size=12),
            seeds,
            backends,
        )(check_any_numbers)
    )
    drawn = settings(max_examples=examples // 4, deadline=None)(
        given(st.sampled_from(PICTURES), severities, seeds, backends)(check_picture)
    )
    return hard, wild, drawn


@pytest.mark.parametrize("search", searched(240), ids=["hard", "wild", "drawn"])
def test_no_number_is_not_finite(search: Any) -> None:
    """Catches 0 x inf, an overflow or a division by zero anywhere between raw parameters and their gradients."""
    search()


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("search", searched(10_000), ids=["hard", "wild", "drawn"])
def test_no_number_of_10000_is_not_finite(search: Any) -> None:
    """The same, 10,000 times."""
    search()
