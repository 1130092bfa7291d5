"""N-DGS' unit directions, bounded times and joint gate: their formulas, in every model that has the option."""

import math
from typing import Any

import pytest
import torch
from small import CAMERA, assert_culled_outside_its_intervals, joint, moved, raw, seeded, started
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import REFERENCE
from gsbench.models import CameraTime, build
from gsbench.models.base import Raw
from gsbench.models.cholesky import CholeskyModel

TIME, LAMBDA = 0.45, 0.4
QUERY = CameraTime.at(CAMERA, TIME)
LAMBDAS = {"lambda_t": LAMBDA, "lambda_d": LAMBDA}
MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "ndgs": ("ndgs", LAMBDAS),
    "6dgs": ("6dgs", {"lambda_d": LAMBDA, "unit_directions": True}),
    "7dgs": ("7dgs", LAMBDAS | {"unit_directions": True, "bounded_times": True}),
    "7dgs_nodir": ("7dgs_nodir", {"lambda_t": LAMBDA, "bounded_times": True}),
}


def lively(which: str, count: int = 24, **options: Any) -> CholeskyModel:
    """A model with options of N-DGS in the midst of a training, in float64, with a mean direction of zero."""
    name, own = MODELS[which]
    model = moved(started(build(name, **own | options), count))
    assert isinstance(model, CholeskyModel)
    return model


def offset_of(values: Raw) -> Tensor:
    """d - mu_d and t - mu_t, with v / (|v| + 1e-8) and a sigmoid, [N, k]."""
    parts = []
    if "directions" in values:
        away, v = values["means"] - CAMERA, values["directions"]
        parts.append(away / torch.linalg.norm(away, dim=-1, keepdim=True))
        parts[0] = parts[0] - v / (torch.linalg.norm(v, dim=-1, keepdim=True) + 1e-8)
    if "times" in values:
        parts.append(TIME - 1 / (1 + torch.exp(-values["times"])))
    return torch.cat(parts, -1)


def by_hand(model: CholeskyModel) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 3], covariances [N, 3, 3] and opacities [N] at QUERY, with explicit inverses."""
    values, S = raw(model), joint(model)
    delta, k = offset_of(values), S.shape[-1] - 3

    def distance(block: slice) -> Tensor:
        part = delta[:, block]
        return torch.einsum("ni,nij,nj->n", part, torch.linalg.inv(S[:, 3:, 3:][:, block, block]), part)

    if type(model).__name__ == "NDGSModel":
        exponent = LAMBDA * distance(slice(0, 4))
    else:
        of_d = distance(slice(0, 3)) if "directions" in values else 0.0
        of_t = distance(slice(k - 1, k)) if "times" in values else 0.0
        exponent = 0.5 * LAMBDA * (of_d + of_t)
    gain = S[:, :3, 3:] @ torch.linalg.inv(S[:, 3:, 3:])
    means = values["means"] + (gain @ delta[..., None])[..., 0]
    return means, S[:, :3, :3] - gain @ S[:, 3:, :3], torch.sigmoid(values["opacities"]) * torch.exp(-exponent)


@pytest.mark.parametrize("order", ["conditioned_first", "paper"])
@pytest.mark.parametrize("which", MODELS)
def test_the_formulas(which: str, order: str) -> None:
    """Catches a 1/2 or two marginal blocks in the joint gate, a raw direction, a raw time, an option without effect."""
    model = lively(which, factor_order=order)
    seen, (means, covariances, opacities) = model.slice(QUERY), by_hand(model)
    torch.testing.assert_close(seen.means.detach(), means, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close((seen.factors @ seen.factors.mT).detach(), covariances, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(seen.opacities.detach(), opacities, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("which", ["ndgs", "7dgs"])
def test_gradients_of_a_slice(which: str) -> None:
    """Catches a gradient that stops at the sigmoid of a time, at a norm or at the joint gate."""
    model = lively(which, count=4)
    model.select(torch.arange(2))
    names = ("means", "times", "directions", "log_diagonal", "motion", "coupling")
    whole = raw(model)

    def slice_of(*changed: Tensor) -> tuple[Tensor, ...]:
        return tuple(model.slice_geometry(whole | dict(zip(names, changed, strict=True)), QUERY)[:3])

    assert torch.autograd.gradcheck(slice_of, [whole[name].requires_grad_() for name in names])


@pytest.mark.parametrize("which", MODELS)
def test_kernels_are_given_means_as_they_are_sliced(which: str) -> None:
    """Catches a kernel that gets raw directions or times; with a joint gate, one that is used without having it."""
    model = lively(which).float()
    query = CameraTime.at(CAMERA.float(), TIME)
    by_kernel = model.slice_geometry(raw(model), query)
    model.backend = REFERENCE
    in_torch = model.slice_geometry(raw(model), query)
    for x, y in zip(by_kernel[:3], in_torch[:3], strict=True):
        torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-5)


def test_start() -> None:
    """Catches times at infinity, times that are not clipped as the authors', and raw times that are no logits."""
    times = torch.sigmoid(started(build("ndgs", **LAMBDAS), 600).splats["times"].data)
    plain = started(build("7dgs", **LAMBDAS), 600).splats["times"].data
    torch.testing.assert_close(times, plain.clamp(1e-6, 1 - 1e-6), rtol=1e-5, atol=1e-6)
    assert 0.1 < (times < 2e-6).float().mean() + (times > 1 - 2e-6).float().mean() < 0.25


@pytest.mark.parametrize("which", ["ndgs", "7dgs_nodir"])
def test_children_move_as_their_parent(which: str) -> None:
    """Catches a child of a split in time whose time is added to the logit, and one off its parent's path at an end."""
    model = lively(which, count=40)
    model.extent = 1e-6  # every Gaussian moves far
    model.splats["log_diagonal"].data[:, model.rows["t"]] = 0.0  # and lives long
    parents = {name: value.repeat_interleave(2, 0) for name, value in raw(model).items()}
    parents["times"][::4] = 4.0  # near the end, where a later child is clipped
    children = parents | model.split(parents, seeded(3))
    before, after = torch.sigmoid(parents["times"]), torch.sigmoid(children["times"])
    assert ((after - before).abs() > 0.1).float().mean() > 0.3
    assert ((after > 0) & (after < 1)).all()
    assert (after > 1 - 2e-6).any()
    paths = [model.slice_geometry(values, QUERY).means for values in (parents, children)]
    if which == "7dgs_nodir":  # otherwise the direction to a child is another one
        torch.testing.assert_close(paths[1], paths[0])
    model.split_in_time = False
    torch.testing.assert_close(model.split(parents, seeded(3))["times"], parents["times"], rtol=0, atol=0)


def test_a_gaussian_is_dimmed_by_what_is_left() -> None:
    """Catches a gate that is divided into marginal parts: what stays of time, and of both, is by formula."""
    model = lively("ndgs")
    values, S = raw(model), joint(model)
    weights = torch.ones(1, len(model), dtype=torch.float64)
    whole, delta = by_hand(model)[2], offset_of(values)
    of_time = torch.exp(-LAMBDA * delta[:, 3].square() / S[:, 6, 6])
    of_direction = torch.exp(
        -LAMBDA * torch.linalg.vecdot(delta[:, :3], torch.linalg.solve(S[:, 3:6, 3:6], delta[:, :3]))
    )
    frozen = model.frozen(values, [QUERY], weights)
    left = {"direction": of_time, "time": of_direction, "static": torch.ones_like(of_time)}
    assert frozen.keys() == left.keys()
    for name, factor in left.items():
        opacities = torch.sigmoid(frozen[name]["opacities"])
        torch.testing.assert_close(opacities, (whole / factor).clamp(min=1e-6), rtol=1e-5, atol=1e-9)
    seen = model.slice_geometry(values | frozen["direction"], QUERY).opacities  # of one view, the mean is itself
    torch.testing.assert_close(seen[whole > 2e-6], whole[whole > 2e-6], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("which", ["ndgs", "7dgs_nodir"])
def test_outside_its_interval_a_gaussian_is_culled(which: str) -> None:
    """Catches a lifetime with the 1/2 of f_temp, or by raw times, which sorts rows into an order that saves nothing."""
    model = lively(which, count=200)
    model.splats["log_diagonal"].data[:, 0 if which == "7dgs_nodir" else 3] -= 2.0  # short in time
    times, lifetimes = model.lifetimes()
    torch.testing.assert_close(times, torch.sigmoid(model.splats["times"][:, 0]))
    torch.testing.assert_close(lifetimes, (joint(model)[:, -1, -1] / (2 if which == "ndgs" else 1) / LAMBDA).sqrt())
    assert_culled_outside_its_intervals(model, torch.linspace(0, 1, 41, dtype=torch.float64), which == "7dgs_nodir")


def test_a_joint_gate_has_one_lambda() -> None:
    """Catches a second lambda that is ignored without a word, or trained without a gradient."""
    with pytest.raises(InputError, match=r"joint_gate: expected lambda_d equal to lambda_t, got 0.2 and 0.1"):
        build("ndgs", lambda_t=0.1, lambda_d=0.2)
    model = lively("ndgs")
    assert [math.exp(x) for x in model.log_lambda.values()] == pytest.approx([LAMBDA])
    assert len(build("ndgs", lambda_t=0.1, lambda_d=0.2, joint_gate=False).log_lambda) == 2
