"""Test view- and time-dependent colours (spherical harmonics, Fourier series) on hard inputs, against mpmath."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
from mpmath import mpf
from torch import Generator, Tensor

from gsbench.kernels.backends import BACKENDS
from gsbench.models import CameraTime, build
from numerics import oracle
from numerics.cases import COPIES, Case, Cell, case, device_of, fastest, worst

COUNT = 3  # Gaussians in a case
WAVES = {"3dgs": 1, "4dgs": 3}


@dataclass
class ColorInputs:
    """Gaussians of one model, and the camera centre and time for which their colours are computed."""

    model: str
    means: Tensor  # [COUNT, 3]
    times: Tensor  # [COUNT, 1]
    sh: Tensor  # [COUNT, waves x 16, 3]
    center: Tensor
    time: float = 0.4


def ordinary(g: Generator, model: str) -> ColorInputs:
    """Draw random Gaussians whose colour coefficients are as large as in trained models."""
    sh = 0.3 * torch.randn(COUNT, 16 * WAVES[model], 3, generator=g)
    means, times = torch.randn(COUNT, 3, generator=g), torch.rand(COUNT, 1, generator=g)
    return ColorInputs(model, means, times, sh, torch.tensor([0.3, -0.2, -4.0]))


@case("colour", "3dgs", "4dgs")
def ordinary_colors(g: Generator, severity: float, model: str) -> ColorInputs:
    """Test ordinary colours, in which nothing is numerically hard, as the baseline of the hard cases."""
    return ordinary(g, model)


@case("colour", "3dgs", "4dgs")
def seen_from_within(g: Generator, severity: float, model: str) -> ColorInputs:
    """Put the camera on a mean or up to 10^-6 away: a view direction of 0/0 must become 0, with gradient 0."""
    inputs = ordinary(g, model)
    aside = torch.tensor([0.0, 1e-12, 1e-6])[:, None] + 1 - severity
    inputs.center, inputs.means = torch.zeros(3), aside * torch.tensor([[1.0, -2.0, 0.5]])
    return inputs


@case("colour", "3dgs", "4dgs")
def loud_harmonics(g: Generator, severity: float, model: str) -> ColorInputs:
    """Use SH coefficients of about 10^4, so that large harmonics up to degree 3 cancel."""
    inputs = ordinary(g, model)
    inputs.sh *= 10 ** (4 * severity)
    return inputs


@case("colour", "4dgs", forward=1e-3, gradient=1e-2)
def far_in_time(g: Generator, severity: float, model: str) -> ColorInputs:
    """Test Fourier colours 1000 periods from a Gaussian's mean time mu_t. Float32 stores such a mu_t to 6e-5, which is
    an error of 8e-4 in the phase of the second frequency."""
    inputs = ordinary(g, model)
    inputs.times += 1000 * severity
    return inputs


def judge(case: Case, backends: list[str]) -> Iterator[Cell]:
    """Yield the errors of colours and their gradients for each model and backend, compared with exact values."""
    for model in case.subjects:
        inputs = case(model=model)
        g = torch.Generator().manual_seed(1)
        weight = torch.randn(COUNT, 3, generator=g, dtype=torch.float64)
        along = torch.randn(inputs.sh[0].numel(), generator=g, dtype=torch.float64)
        color, slope = truth(inputs, weight, along)
        for backend in backends:
            got, gradient = differentiate(inputs, backend, weight, 1)
            gradient = torch.cat([gradient[:, :4], gradient[:, 4:] @ along[:, None]], 1)
            bad = ~(got.isfinite().all(1) & gradient.isfinite().all(1))
            ms = fastest(partial(differentiate, inputs, backend, weight, COPIES))
            forward = worst((got - color).abs() / color.max().clamp(min=1))
            backward = worst((gradient - slope).norm(dim=1) / slope.norm(dim=1))
            bad_share = float(bad.double().mean())
            yield Cell(case.area, case.name, model, "-", backend, forward, backward, bad_share, ms, case.bound)


def truth(inputs: ColorInputs, weight: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Compute exact colours [COUNT, 3] and gradients [COUNT, 5] in mpmath. The five derivatives are with respect to the
    mean (3), to mu_t, and to a step along the direction `along` in the space of coefficients."""
    layout = {"means": 3, "times": 1, "sh": len(along)}
    time = float(torch.tensor(inputs.time))
    colors, slopes = [], []
    for i, w in enumerate(weight.tolist()):
        sh = [mpf(x) for x in inputs.sh[i].flatten().tolist()]

        def exact(x: oracle.Vector, sh: oracle.Vector = sh) -> oracle.Vector:
            moved = [a + x[4] * mpf(b) for a, b in zip(sh, along.tolist(), strict=True)]
            return oracle.colors([*x[:4], *moved], layout, inputs.center.tolist(), WAVES[inputs.model], time)

        at = [*inputs.means[i].tolist(), *inputs.times[i].tolist(), 0.0]
        colors.append([float(v) for v in oracle.evaluate(exact, at)])
        slopes.append([float(v) for v in oracle.gradient(exact, at, w)])
    return torch.tensor(colors, dtype=torch.float64), torch.tensor(slopes, dtype=torch.float64)


def differentiate(inputs: ColorInputs, backend: str, weight: Tensor, copies: int) -> tuple[Tensor, Tensor]:
    """Compute colours [N, 3] in float32, and their gradients [N, 4 + coefficients]. The gradients are with respect to
    the mean (3), to the mean time mu_t (1) and to the colour coefficients."""
    model, device = build(inputs.model, backend=BACKENDS[backend]), device_of(backend)
    rows = torch.arange(COUNT).repeat(copies)
    leaves = [value[rows].requires_grad_() for value in (inputs.means, inputs.times, inputs.sh)]
    means, times, sh = (value.to(device) for value in leaves)
    sh0 = sh[:, None, :1] if inputs.model == "4dgs" else sh[:, :1]
    raw = {"means": means, "times": times, "sh0": sh0, "shN": sh[:, 1:]}
    query = CameraTime(inputs.center.to(device), torch.tensor(inputs.time, device=device))
    color = model.shade(raw, means, torch.ones_like(means[:, 0]), query).cpu()
    gradients = torch.autograd.grad(color.double(), leaves, weight.repeat(copies, 1), materialize_grads=True)
    return color.detach().double(), torch.cat([g.flatten(1).double() for g in gradients], 1)
