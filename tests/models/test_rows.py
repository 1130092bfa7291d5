"""Rows of Gaussians: how they start in time and direction, and how density control keeps, splits and resets them."""

import math
from typing import Any

import pytest
import torch
from small import CAMERA, EVERY, EXTENT, VARIANTS, covariances, fresh, joint, lively, raw, same, seeded
from test_equations import conditioned
from torch import Tensor

from gsbench.models import CameraTime, GaussianModel
from gsbench.models.base import CHILDREN
from gsbench.models.factors import KINDS
from gsbench.schedule import ActiveComponents

SPLIT = [v for v in VARIANTS if "row_scaled" not in v]  # which cannot express every child
CHOLESKY = [v for v in SPLIT if v.startswith(("6dgs", "7dgs"))]
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
    return covariances(model.slice(CameraTime.at(CAMERA, 0.5)))


def gain(model: GaussianModel) -> Tensor:
    """K = S_pq S_qq^-1 of a Cholesky model, q = (d, t)."""
    S = joint(model)
    return S[:, :3, 3:] @ torch.linalg.inv(S[:, 3:, 3:])


@pytest.mark.parametrize("variant", ["4dgs", "7dgs", "7dgs_paper", "7dgs_nodir", "ndgs"])
def test_start_in_time(variant):
    """Catches times outside [-0.1, 1.1], or not uniform, a time scale other than sqrt(T/5) or sqrt(T/10), and times of
    N-DGS that are not clipped as the authors', at infinity, or no logits."""
    model = fresh(variant, 4000)
    times = model.splats["times"].data
    if variant == "ndgs":
        plain = fresh("7dgs", 4000).splats["times"].data
        torch.testing.assert_close(torch.sigmoid(times), plain.clamp(1e-6, 1 - 1e-6), rtol=1e-5, atol=1e-6)
        times = plain
    assert -0.1 <= times.min() < -0.09
    assert 1.09 < times.max() <= 1.1
    assert abs(times.mean() - 0.5) < 0.02
    S_t = model.factors(raw(model))[:, -1].square().sum(-1)
    torch.testing.assert_close(S_t, torch.full((4000,), 0.2 if variant == "4dgs" else 0.1))


@pytest.mark.parametrize("variant", ["6dgs", "7dgs", "7dgs_paper"])
def test_start_in_direction(variant):
    """Catches directions that are not uniform on the sphere and a direction scale other than 1."""
    model = fresh(variant, 4000)
    d = model.splats["directions"].data
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(4000))
    assert d.mean(0).abs().max() < 0.03
    torch.testing.assert_close((d.mT @ d) / 4000, torch.eye(3) / 3, rtol=0, atol=0.02)
    torch.testing.assert_close(model.factors(raw(model))[:, 3:6].square().sum(-1), torch.ones(4000, 3))
    assert not any(raw(model)[kind].any() for kind in KINDS)


@pytest.mark.parametrize("variant", EVERY)
def test_rows_are_selected_split_and_reset(variant):
    """Catches a parameter whose rows are not moved with the others, or that is replaced and lost to the optimizer; a
    split that moves other Gaussians, changes what children inherit, gives twins the same place, or draws
    from elsewhere; a reset that raises what was lower already."""
    model, rows = quiet(variant), torch.tensor([0, 1, 2, 3, 3, 4, 4])
    before, objects = raw(model), dict(model.splats.items())
    for p in model.splats.values():
        p.grad = torch.ones_like(p)
    model.select(rows)
    assert same(raw(model), {name: x[rows] for name, x in before.items()})
    assert all(x is objects[name] and x.grad is None for name, x in model.splats.items())
    model.split_rows(torch.tensor([3, 4, 5, 6]), seeded(0))
    for name, value in raw(model).items():
        assert torch.equal(value[:3], before[name][:3])
        assert value.isfinite().all()
        if name not in {*model.centers, *model.geometry, "means"}:
            assert torch.equal(value, before[name][rows])
    assert not torch.equal(model.splats["means"][3], model.splats["means"][4])
    again = quiet(variant)
    again.select(rows)
    again.split_rows(torch.tensor([3, 4, 5, 6]), seeded(0))
    assert same(raw(again), raw(model))
    opacities = torch.sigmoid(model.splats["opacities"].data)
    model.reset_opacities(opacities.median().item())
    torch.testing.assert_close(torch.sigmoid(model.splats["opacities"].data), opacities.clamp(max=opacities.median()))


@pytest.mark.parametrize("variant", SPLIT)
def test_children_of_a_split_in_space(variant):
    """Catches children of another size or motion: covariance of the slice / 1.6^2, K and the blocks of q unchanged."""
    model = quiet(variant)
    model.extent = math.inf  # nothing is long enough to be split in time
    before, covariance = raw(model), sliced_covariance(model)
    slopes, S_qq = (gain(model), joint(model)[:, 3:, 3:]) if variant in CHOLESKY else (None, None)
    scales = model.scales()
    parents = split_all(model)
    torch.testing.assert_close(sliced_covariance(model), covariance[parents] / SHRINK**2)
    torch.testing.assert_close(model.scales(), scales[parents] / SHRINK)
    if slopes is not None:
        torch.testing.assert_close(gain(model), slopes[parents], rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(joint(model)[:, 3:, 3:], S_qq[parents])
        for name in {*model.centers} - {"means"}:
            assert torch.equal(model.splats[name], before[name][parents])


@pytest.mark.parametrize("variant", SPLIT)
def test_children_lie_where_the_parent_is_dense(variant):
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


@pytest.mark.parametrize("variant", [v for v in CHOLESKY if v.startswith("7dgs")])
def test_children_of_a_split_in_time(variant):
    """Catches children off the parent's path or with another slope. S_t shrinks by 1.6^2, K and the slice's covariance
    stay, and at any time and from anywhere each child's slice lies where the parent's does: it moves along mu_cond(t)
    as its parent did."""
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
    assert (model.splats["times"].data - before["times"][parents]).abs().min() > 0
    # The direction of view to a child differs from that to its parent; seen from where it is the same, so is the path.
    offset = model.splats["means"].data - before["means"][parents]
    for t, path in paths.items():
        for i in range(4):
            child = model.slice(CameraTime.at(4 * CAMERA + offset[i], t)).means[i]
            torch.testing.assert_close(child, path[parents[i]], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("case", ["ndgs", "7dgs_nodir, bounded"])
def test_children_of_bounded_times(case):
    """Catches a child of a split in time whose time is added to the logit, and one off its parent's path at an end."""
    model, query = conditioned(case, 40), CameraTime.at(CAMERA, 0.45)
    model.extent = 1e-6  # every Gaussian moves far
    model.splats["log_diagonal"].data[:, model.rows["t"]] = 0.0  # and lives long
    parents = {name: value.repeat_interleave(2, 0) for name, value in raw(model).items()}
    parents["times"][::4] = 4.0  # near the end, where a later child is clipped
    children = parents | model.split(parents, seeded(3))
    before, after = torch.sigmoid(parents["times"]), torch.sigmoid(children["times"])
    assert ((after - before).abs() > 0.1).float().mean() > 0.3
    assert ((after > 0) & (after < 1)).all()
    assert (after > 1 - 2e-6).any()
    if case != "ndgs":  # whose direction to a child is another one
        paths = [model.slice_geometry(values, query).means for values in (parents, children)]
        torch.testing.assert_close(paths[1], paths[0])
    model.split_in_time = False
    torch.testing.assert_close(model.split(parents, seeded(3))["times"], parents["times"], rtol=0, atol=0)


def test_long_in_time():
    """Catches thresholds other than |S_pt| > 0.05 extent and sqrt(S_t) > 0.25, and a criterion where there is no t."""
    model = fresh("7dgs")
    assert not model.long_in_time().any()  # nothing moves at first
    time = model.rows["t"][0]
    motion, log_diagonal = model.splats["motion"].data, model.splats["log_diagonal"].data
    for sigma, S_pt, expected in [(0.26, 0.11, True), (0.24, 0.11, False), (0.26, 0.09, False)]:
        log_diagonal[:, time] = math.log(sigma)
        motion[:, 3] = S_pt / sigma  # of the first of p, after those with d
        assert (model.long_in_time() == expected).all()
    assert EXTENT == 2.0
    for name in ("3dgs", "4dgs", "6dgs"):
        assert not lively(name).long_in_time().any()
