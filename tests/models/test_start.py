"""A model that starts from trained Gaussians looks like them, whatever it is."""

from typing import Any

import pytest
import torch
from models.small import CAMERA, MODELS, VARIANTS, seeded
from torch import Tensor

from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.base import Raw
from gsbench.models.factors import quaternions_in_space, rotation, rotation4d
from gsbench.models.gaussian_batch import Conditioned
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.scene import Points
from gsbench.schedule import ActiveComponents

N = 12


def trained(degree: int = 3) -> TrainedGaussians:
    """Gaussians of every shape."""
    g = seeded(3)
    K = (degree + 1) ** 2
    draws = [torch.randn(shape, generator=g) for shape in ((N, 3), (N, 3), (N, 4), (N,), (N, 3), (N, K - 1, 3))]
    return TrainedGaussians(*draws)


def started(variant: str, given: TrainedGaussians, **options: Any) -> GaussianModel:
    name, own = VARIANTS[variant]
    model = build(name, **own | options)
    model.start_from(given, 2.0, seeded(0))
    model.set_active(ActiveComponents(model.sh_degree, False, False))
    return model.requires_grad_(False)


def covariance(given: TrainedGaussians) -> Tensor:
    F = rotation(given.quats) * given.log_scales.exp()[:, None, :]
    return F @ F.mT


# A row-scaled triangle cannot express every shape: CholeskyLayout.parameters.
@pytest.mark.parametrize("variant", [name for name in VARIANTS if not name.endswith("row_scaled")])
def test_the_shape_in_space_is_theirs(variant: str) -> None:
    """Catches axes in another order, a mirrored quaternion, and time or direction that leak into space."""
    given = trained()
    model = started(variant, given)
    if "times" in model.splats:
        model.splats["times"][:] = 0.3
    seen = model.condition(dict(model.splats.items()), CameraTime.at(CAMERA.float(), 0.3))
    torch.testing.assert_close(seen.means, given.means, atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.factors @ seen.factors.mT, covariance(given), atol=2e-4, rtol=2e-4)
    torch.testing.assert_close(model.splats["opacities"].data, given.logits)


def test_3dgs_is_theirs_to_the_bit() -> None:
    """Catches a detour over covariances that loses digits."""
    given = trained()
    model = started("3dgs", given)
    assert torch.equal(model.splats["scales"], given.log_scales)
    assert torch.equal(model.splats["quats"], given.quats)
    assert torch.equal(model.splats["shN"], given.rest)
    assert torch.equal(model.splats["sh0"][:, 0], given.dc)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("theirs", "own"), [(0, 3), (1, 2), (3, 1), (4, 3), (3, 0)])
def test_harmonics_of_another_degree(name: str, theirs: int, own: int) -> None:
    """Catches harmonics that move to another degree or wave, and colours that differ where both have them."""
    given = trained(theirs)
    shared = (min(theirs, own) + 1) ** 2 - 1
    cut = TrainedGaussians(given.means, given.log_scales, given.quats, given.logits, given.dc, given.rest[:, :shared])
    query = CameraTime.at(CAMERA.float(), 0.3)
    model, still = started(name, given, sh_degree=own), started("3dgs", cut, sh_degree=own)
    opaque = torch.ones(N)
    colors = [one.shade(dict(one.splats.items()), given.means, opaque, query) for one in (model, still)]
    torch.testing.assert_close(*colors)
    assert colors[0].std() > 0.1


def test_a_flat_gaussian_has_a_triangle() -> None:
    """Catches a logarithm of zero: 2D Gaussians that were written as 3D ones have a scale of 1e-20 or so."""
    given = trained()
    given.log_scales[:, 1] = -46
    for name in ("6dgs", "7dgs"):
        assert all(parameter.isfinite().all() for parameter in started(name, given).splats.values())


def test_quaternions_in_space() -> None:
    """Catches a 4D rotation that turns time."""
    quats = torch.nn.functional.normalize(trained().quats.double(), dim=1)
    expected = torch.eye(4, dtype=torch.float64).repeat(N, 1, 1)
    expected[:, :3, :3] = rotation(quats)
    torch.testing.assert_close(rotation4d(*quaternions_in_space(quats)), expected)


def test_a_model_that_is_not_known_starts_with_spheres() -> None:
    """Catches a new model that cannot start from a PLY."""

    class Balls(GaussianModel):
        """Balls, as docs/adding_a_model.md has them."""

        geometry = ("radii",)

        def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
            return {"radii": distances.log()[:, None]}

        def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
            raise NotImplementedError

        def spatial_scales(self) -> Tensor:
            raise NotImplementedError

        def split(self, raw: Raw, generator: torch.Generator) -> Raw:
            raise NotImplementedError

    model, given = Balls(), trained()
    model.start_from(given, 2.0, seeded(0))
    torch.testing.assert_close(model.splats["radii"][:, 0].data, given.log_scales.mean(1))
