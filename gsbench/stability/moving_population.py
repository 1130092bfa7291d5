"""Test slices of many random ill-conditioned dGS, dBS, UBS and FreeTimeGS Gaussians against float64.

The exact slices are those of the torch models in float64. Each audit compares them with mpmath on a few Gaussians.
"""

import time
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Generator, Tensor
from torch.nn.functional import normalize

from gsbench.models.beta import softplus_inverse
from gsbench.models.ubs import joint_factor
from gsbench.stability import moving_cases, slices
from gsbench.stability.cases import Bound, Cell
from gsbench.stability.curves import percentile
from gsbench.stability.slicing_cases import LN_10, Observed

MODELS = ("dgs", "dbs", "ubs", "freetime")
VERIFIED = 2  # Gaussians that are computed in mpmath


def judge(model: str, N: int, backends: list[str], seed: int = 0) -> tuple[list[Cell], float]:
    """Measure the errors of N random slices of a model in float32, the 99.9th percentile over the Gaussians.

    Return a result for each backend, and the largest error of the float64 slices of the first Gaussians in mpmath.
    """
    observed = draw(Generator().manual_seed(seed), model, N)
    known = truth(observed)
    return list(_cells(observed, known, backends)), verify(observed)


def _cells(observed: Observed, known: slices.SliceTruth, backends: list[str]) -> Iterator[Cell]:
    for backend in backends:
        start = time.perf_counter()
        found, raw = slices.load(observed, slices.ONE_SCHEME, backend)
        errors = slices.compare(*slices.differentiate(found, raw, observed, known.weights), known)
        ms = 1e3 * (time.perf_counter() - start)
        forward, gradient = (percentile(x.numpy()) for x in (errors.forward, errors.gradient))
        yield Cell(
            "population", "hard_slices", observed.model, slices.ONE_SCHEME, backend, forward, gradient,
            errors.bad.double().mean().item(), ms, Bound(), f"{len(known.scale)} slices",
        )  # fmt: skip


def truth(observed: Observed, weights: Tensor | None = None) -> slices.SliceTruth:
    """Compute the slices and the gradient of a loss by the torch model in float64."""
    found, raw = slices.load(observed, slices.ONE_SCHEME, "reference")
    exact = {name: value.detach().double().requires_grad_() for name, value in raw.items()}
    zero = torch.zeros(len(exact["means"]), 14 if "betas" in exact else 13, dtype=torch.float64)
    outputs, _ = slices.differentiate(found.double(), exact, observed, zero)
    own, scale = slices.weights_of(outputs, observed.raw["means"])
    weights = own if weights is None else weights
    return slices.SliceTruth(outputs, weights, scale, slices.differentiate(found, exact, observed, weights)[1])


def verify(observed: Observed) -> float:
    """Return the largest error of the float64 slices of the first Gaussians against mpmath."""
    first = replace(observed, raw={name: value[:VERIFIED] for name, value in observed.raw.items()})
    known = slices.truth(first)
    found = truth(first, known.weights)
    errors = slices.compare(found.outputs, found.gradient, known)
    return float(torch.maximum(errors.forward, errors.gradient).max())


def draw(g: Generator, model: str, N: int) -> Observed:
    """Draw N random Gaussians with sizes 10^-u, u uniform in [0, 5], about one size away from the time and direction.

    In dGS, dBS and FreeTimeGS the lives and widths of view are 10^-v, v uniform in [-1, 2].
    """
    observed = moving_cases.ordinary(g, model, N)
    raw = observed.raw

    def normal(width: int) -> Tensor:
        return torch.randn(N, width, generator=g)

    def logs(width: int, least: float, most: float) -> Tensor:
        return -LN_10 * (least + (most - least) * torch.rand(N, width, generator=g))

    if "betas" in raw:
        raw["betas"] = normal(raw["betas"].shape[1])
        raw["scales"][:, :3] = softplus_inverse(logs(3, 0, 5).exp().double()).float()
    else:
        raw["scales"] = logs(3, 0, 5)
    towards = normalize(raw["means"] - observed.center, dim=-1)
    if model == "freetime":
        raw["durations"], raw["velocities"] = logs(1, -1, 2), normal(3)
        raw["times"] = observed.time + raw["durations"].exp() * normal(1)
    elif model == "ubs":
        raw["scales"][:, 3:] = softplus_inverse(logs(4, 0, 5).exp().double()).float()
        raw["lower"] = normal(raw["lower"].shape[1])
        offset = (joint_factor(raw)[:, 3:] @ normal(7)[..., None])[..., 0]
        raw["directions"], raw["times"] = towards - offset[:, :3], observed.time - offset[:, 3:]
    else:
        raw["precision"], raw["coupling"] = normal(7), normal(12)
        places = [0, 2, 5, 6]
        raw["precision"][:, places] = -logs(4, -1, 2)
        offset = normal(4) * raw["precision"][:, places].neg().exp()
        raw["directions"] = towards - offset[:, :3]
        times = observed.time - offset[:, 3:]
        raw["times"] = times.clamp(1e-3, 1 - 1e-3).logit() if model == "dgs" else times
    return observed
