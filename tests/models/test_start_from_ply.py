"""A model that starts from trained Gaussians looks like them, whatever it is."""

from typing import Any

import pytest
import torch
from small import CAMERA, EVERY, MODELS, VARIANTS, Balls, covariances, seeded
from torch import Tensor

from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.factors import rotation
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.schedule import ActiveComponents

N = 12
QUERY = CameraTime.at(CAMERA.float(), 0.3)


def trained(degree: int = 3) -> TrainedGaussians:
    g, K = seeded(3), (degree + 1) ** 2
    shapes = ((N, 3), (N, 3), (N, 4), (N,), (N, 3), (N, K - 1, 3))
    return TrainedGaussians(*(torch.randn(shape, generator=g) for shape in shapes))


def started_from(gaussians: TrainedGaussians, variant: str, **options: Any) -> GaussianModel:
    name, of_variant = EVERY[variant]
    model = build(name, **of_variant | options)
    model.start_from(gaussians, 2.0, seeded(0))
    model.set_active(ActiveComponents(model.sh_degree, False, False))
    return model.requires_grad_(False)


def covariance(gaussians: TrainedGaussians) -> Tensor:
    F = rotation(gaussians.quats) * gaussians.log_scales.exp()[:, None, :]
    return F @ F.mT


# A row-scaled triangle cannot express every shape: CholeskyLayout.parameters.
@pytest.mark.parametrize("variant", [name for name in VARIANTS if not name.endswith("row_scaled")])
def test_the_shape_in_space_is_that_of_the_ply(variant):
    """Catches axes in another order, a mirrored quaternion, time or direction that leak into space, and in 3DGS a
    detour over covariances that loses digits."""
    gaussians = trained()
    model = started_from(gaussians, variant)
    if "times" in model.splats:
        model.splats["times"][:] = 0.3
    sliced = model.condition(dict(model.splats.items()), QUERY)
    torch.testing.assert_close(sliced.means, gaussians.means, atol=1e-4, rtol=0)
    torch.testing.assert_close(covariances(sliced), covariance(gaussians), atol=2e-4, rtol=2e-4)
    torch.testing.assert_close(model.splats["opacities"].data, gaussians.logits)
    if variant == "3dgs":
        for name, x in (("scales", gaussians.log_scales), ("quats", gaussians.quats), ("shN", gaussians.rest)):
            assert torch.equal(model.splats[name], x)
        assert torch.equal(model.splats["sh0"][:, 0], gaussians.dc)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("in_ply", "in_model"), [(0, 3), (1, 2), (3, 1), (4, 3), (3, 0)])
def test_harmonics_of_another_degree(name, in_ply, in_model):
    """Catches harmonics that move to another degree or wave, and colours that differ where both have them."""
    gaussians, opaque = trained(in_ply), torch.ones(N)
    shared = (min(in_ply, in_model) + 1) ** 2 - 1
    cut = TrainedGaussians(*list(vars(gaussians).values())[:5], gaussians.rest[:, :shared])
    colors = [
        model.shade(dict(model.splats.items()), gaussians.means, opaque, QUERY)
        for model in (started_from(gaussians, name, sh_degree=in_model), started_from(cut, "3dgs", sh_degree=in_model))
    ]
    torch.testing.assert_close(*colors)
    assert colors[0].std() > 0.1


def test_a_flat_gaussian_has_a_triangle():
    """Catches a logarithm of zero: 2D Gaussians that were written as 3D ones have a scale of 1e-20 or so."""
    gaussians = trained()
    gaussians.log_scales[:, 1] = -46
    for name in ("6dgs", "7dgs"):
        assert all(parameter.isfinite().all() for parameter in started_from(gaussians, name).splats.values())


def test_a_model_that_is_not_known_starts_with_spheres():
    """Catches a new model that cannot start from a PLY."""
    model, gaussians = Balls(), trained()
    model.start_from(gaussians, 2.0, seeded(0))
    torch.testing.assert_close(model.splats["radii"][:, 0].data, gaussians.log_scales.mean(1))
