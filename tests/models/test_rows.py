"""Rows of Gaussians: kept, cloned and split by density control, written to and read from a state."""

import math
from typing import Any

import pytest
import torch
from small import CAMERA, EXTENT, MODELS, VARIANTS, fresh, joint, lively, raw, seeded
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.base import CHILDREN
from gsbench.schedule import ActiveComponents

TRIANGULAR = [v for v in VARIANTS if v.startswith(("6dgs", "7dgs")) and "row_scaled" not in v]
IN_TIME = [v for v in TRIANGULAR if v.startswith("7dgs")]
SHRINK = 1.6  # of the children of a split, in 3DGS' gaussian_model.py


def quiet(variant: str, **options: Any) -> GaussianModel:
    """A lively model whose AGR does not act: rows are what is looked at."""
    model = lively(variant, **options)
    model.set_active(ActiveComponents(3, False, False))
    return model


def split_all(model: GaussianModel, seed: int = 0) -> Tensor:
    """Replace every Gaussian by its children; the parent of each."""
    parents = torch.arange(len(model)).repeat_interleave(CHILDREN)
    model.select(parents)
    model.split_rows(torch.arange(len(model)), seeded(seed))
    return parents


def sliced_covariance(model: GaussianModel) -> Tensor:
    """Covariances [N, 3, 3] of a slice; they do not depend on where the model is observed."""
    factors = model.slice(CameraTime.at(CAMERA, 0.5)).factors.detach()
    return factors @ factors.mT


def gain(model: GaussianModel) -> Tensor:
    """K = S_pq S_qq^-1 of a triangular model, q = (d, t)."""
    S = joint(model)
    return S[:, :3, 3:] @ torch.linalg.inv(S[:, 3:, 3:])


@pytest.mark.parametrize("variant", VARIANTS)
def test_select(variant: str) -> None:
    """Catches a parameter whose rows are not moved with the others, or that is replaced and lost to the optimizer."""
    model = quiet(variant)
    before, objects = raw(model), dict(model.splats.items())
    for p in model.splats.values():
        p.grad = torch.ones_like(p)
    rows = torch.tensor([5, 2, 2, 0])
    model.select(rows)
    assert len(model) == 4
    for name, parameter in model.splats.items():
        assert torch.equal(parameter, before[name][rows])
        assert parameter is objects[name]
        assert parameter.grad is None
    model.select(torch.zeros(0, dtype=torch.long))
    assert len(model) == 0
    assert model.slice(CameraTime.at(CAMERA, 0.5)).means.shape == (0, 3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_split_touches_only_its_rows(variant: str) -> None:
    """Catches a split that moves other Gaussians, changes what children inherit, or gives twins the same place."""
    model = quiet(variant)
    model.select(torch.tensor([0, 1, 2, 3, 3, 4, 4]))
    before = raw(model)
    model.split_rows(torch.tensor([3, 4, 5, 6]), seeded(0))
    after = raw(model)
    for name, value in after.items():
        assert torch.equal(value[:3], before[name][:3])
        if name not in {*model.centers, *model.geometry, "means"}:
            assert torch.equal(value, before[name])
    assert not torch.equal(after["means"][3], after["means"][4])
    assert all(value.isfinite().all() for value in after.values())
    again = quiet(variant)
    again.select(torch.tensor([0, 1, 2, 3, 3, 4, 4]))
    again.split_rows(torch.tensor([3, 4, 5, 6]), seeded(0))
    assert all(torch.equal(a, b) for a, b in zip(raw(again).values(), after.values(), strict=True))


@pytest.mark.parametrize("variant", [v for v in VARIANTS if "row_scaled" not in v])
def test_children_of_a_split_in_space(variant: str) -> None:
    """Catches children of another size or motion: covariance of the slice / 1.6^2, K and the blocks of q unchanged."""
    model = quiet(variant)
    model.extent = math.inf  # nothing is long enough to be split in time
    before, covariance = raw(model), sliced_covariance(model)
    slopes, S_qq = (gain(model), joint(model)[:, 3:, 3:]) if variant in TRIANGULAR else (None, None)
    scales = model.scales()
    parents = split_all(model)
    torch.testing.assert_close(sliced_covariance(model), covariance[parents] / SHRINK**2)
    torch.testing.assert_close(model.scales(), scales[parents] / SHRINK)
    if slopes is not None:
        torch.testing.assert_close(gain(model), slopes[parents], rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(joint(model)[:, 3:, 3:], S_qq[parents])
        for name in {*model.centers} - {"means"}:
            assert torch.equal(model.splats[name], before[name][parents])


@pytest.mark.parametrize("variant", [v for v in VARIANTS if "row_scaled" not in v])
def test_children_lie_where_the_parent_is_dense(variant: str) -> None:
    """Catches offsets of another size or orientation: over many draws, their covariance is that of the parent."""
    model = quiet(variant, count=4)
    model.extent = math.inf
    centers, expected = ["means"], sliced_covariance(model)[0]
    if variant.startswith("4dgs"):  # drawn from space and time together
        F = model.factors(raw(model))[0]
        centers, expected = ["means", "times"], F @ F.T
    where = torch.cat([raw(model)[name][0] for name in centers])
    model.select(torch.zeros(20_000, dtype=torch.long))
    model.split_rows(torch.arange(20_000), seeded(1))
    offsets = torch.cat([raw(model)[name] for name in centers], -1) - where
    assert (offsets.mean(0).abs() < 5 * expected.diagonal().sqrt() / math.sqrt(20_000)).all()
    torch.testing.assert_close(offsets.mT @ offsets / 20_000, expected, rtol=0, atol=0.05 * expected.trace().item())


@pytest.mark.parametrize("variant", IN_TIME)
def test_children_of_a_split_in_time(variant: str) -> None:
    """Catches children off the parent's path or with another slope.

    S_t shrinks by 1.6^2, K and the slice's covariance stay, and at any time and from anywhere each child's slice lies
    where the parent's does: it moves along mu_cond(t) as its parent did.
    """
    model = quiet(variant)
    model.extent = 1e-9  # everything that moves and is long is split in time
    model.splats["log_diagonal"].data[:, model.rows["t"]] += 2
    assert model.long_in_time().all()
    covariance, slopes, S_t = sliced_covariance(model), gain(model), joint(model)[:, -1, -1]
    before = raw(model)
    paths = {t: model.slice(CameraTime.at(4 * CAMERA, t)).means.detach() for t in (0.0, 0.4, 1.3)}
    parents = split_all(model)
    torch.testing.assert_close(joint(model)[:, -1, -1], S_t[parents] / SHRINK**2)
    torch.testing.assert_close(gain(model), slopes[parents], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(sliced_covariance(model), covariance[parents])
    moved = model.splats["times"].data - before["times"][parents]
    assert moved.abs().min() > 0
    # The direction of view to a child differs from that to its parent; seen from where it is the same, so is the path.
    offset = model.splats["means"].data - before["means"][parents]
    for t, path in paths.items():
        for i in range(4):
            child = model.slice(CameraTime.at(4 * CAMERA + offset[i], t)).means[i]
            torch.testing.assert_close(child, path[parents[i]], rtol=1e-6, atol=1e-8)


def test_long_in_time() -> None:
    """Catches thresholds other than |S_pt| > 0.05 extent and sqrt(S_t) > 0.25, and a criterion where there is no t."""
    model = fresh("7dgs")
    assert not model.long_in_time().any()  # nothing moves at first
    rows = model.rows
    time = rows["t"][0]
    motion, log_diagonal = model.splats["motion"].data, model.splats["log_diagonal"].data
    for sigma, S_pt, expected in [(0.26, 0.11, True), (0.24, 0.11, False), (0.26, 0.09, False)]:
        log_diagonal[:, time] = math.log(sigma)
        motion[:, 3] = S_pt / sigma  # of the first of p, after those with d
        assert (model.long_in_time() == expected).all()
    assert EXTENT == 2.0
    for name in ("3dgs", "4dgs", "6dgs"):
        assert not lively(name).long_in_time().any()


@pytest.mark.parametrize("variant", VARIANTS)
def test_reset_of_opacities(variant: str) -> None:
    """Catches a reset that raises what was lower already, or sets another value than asked for."""
    model = quiet(variant)
    before = torch.sigmoid(model.splats["opacities"].data)
    ceiling = before.median().item()
    model.reset_opacities(ceiling)
    torch.testing.assert_close(torch.sigmoid(model.splats["opacities"].data), before.clamp(max=ceiling))


# ---- states


@pytest.mark.parametrize("variant", VARIANTS)
def test_state_of_something_else(variant: str) -> None:
    """Catches a state of another model or option that loads, and fails or draws nonsense later."""
    model = fresh(variant)
    foreign = [fresh(name).state_dict() for name in MODELS if name not in variant]
    foreign += [fresh(variant, sh_degree=2).state_dict(), fresh(variant, agr=not model.agr).state_dict()]
    if variant.startswith("4dgs"):
        foreign.append(fresh(variant, time_degree=1).state_dict())
    before = raw(model)
    for wrong in foreign:
        with pytest.raises(InputError, match="checkpoint") as error:
            model.load_state(wrong)
        assert "\n" not in str(error.value)
    assert all(torch.equal(a, b) for a, b in zip(raw(model).values(), before.values(), strict=True))
