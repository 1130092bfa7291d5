"""The optional exponents of Beta profiles, on their way from a model to the image and back."""

from collections.abc import Sequence

import pytest
import torch
from small import started
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import AUTO, REFERENCE
from gsbench.kernels.tape import Tape
from gsbench.models import CameraTime
from gsbench.models.base import Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Conditioned, joined_exponents, tensors_of
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.render import rasterize_slice, render
from gsbench.scenes.scene import Camera, Points
from gsbench.view.slice_ply import trained_of

N, BLACK = 6, torch.zeros(3)
VIEW = torch.eye(4)
VIEW[2, 3] = 2.0
CAMERA = Camera(VIEW, torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
HERE = CameraTime.of(CAMERA, None)


class Profiles(GatedModel):
    """Balls of one radius, each with its own b."""

    geometry = ("exponent",)
    observes = ("direction",)  # so that rows without effects are sliced by `static`

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        return {"exponent": torch.arange(float(len(distances)))[:, None]}

    def condition(self, raw: Raw, query: CameraTime | None) -> Conditioned:
        exponents, rows = raw["exponent"][:, 0].exp(), len(raw["exponent"])
        return Conditioned(raw["means"], 0.1 * torch.eye(3).expand(rows, 3, 3), torch.ones(rows), exponents)

    def static(self, raw: Raw) -> Conditioned:
        return self.condition(raw, None)

    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        return {}

    def spatial_scales(self) -> Tensor:
        return torch.full((len(self), 1), 0.1)

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        return raw


@pytest.mark.parametrize("backend", [AUTO, REFERENCE], ids=lambda backend: backend.name)
def test_exponents_reach_the_image_and_are_trained(backend):
    """Catches exponents that are dropped on the way, so that a Beta profile is drawn as a Gaussian without a word, a
    gradient that a recorded backward pass loses, and an empty tensor of exponents where there are none."""
    model = started(Profiles(backend=backend), N)
    model.splats["opacities"].data.fill_(1.0)
    batch = model.slice(HERE)
    torch.testing.assert_close(batch.beta_exponents, torch.arange(float(N)).exp())
    drawn = [
        rasterize_slice(x, CAMERA, BLACK, REFERENCE).image[0] for x in (batch, batch._replace(beta_exponents=None))
    ]
    image = render(model, CAMERA, None, BLACK)
    torch.testing.assert_close(image, drawn[0], rtol=0, atol=1e-4)
    assert (image - drawn[1]).abs().max() > 0.1
    parameter, sums = model.splats["exponent"], {}
    with Tape() as tape:
        loss = render(model, CAMERA, None, BLACK).square().sum()
    tape.backward(loss, torch.ones(()), [parameter], sums)
    (expected,) = torch.autograd.grad(render(model, CAMERA, None, BLACK).square().sum(), parameter)
    assert expected.any()
    torch.testing.assert_close(sums[id(parameter)], expected)
    plain = started(Gaussians3DModel(backend=backend), N)
    assert plain.slice(HERE).beta_exponents is None
    assert render(plain, CAMERA, None, BLACK).any()


def test_rows_of_two_kinds_keep_their_exponents():
    """Catches exponents lost, or in another order, where some rows change with the query and the others do not; and a
    model that forgets those of its static rows, which would drop all."""
    model = started(Profiles(), N)
    whole = model.slice(HERE)
    model.effect_sets = EffectSets(0, 2, torch.full((N,), 15, dtype=torch.int32))
    assert all(torch.equal(x, y) for x, y in zip(tensors_of(model.slice(HERE)), tensors_of(whole), strict=True))
    assert joined_exponents(None, None) is None
    with pytest.raises(InputError, match="let `condition` and `static` of the model agree"):
        joined_exponents(torch.ones(2), None)


def test_a_ply_leaves_the_exponents_out():
    """Catches exponents that are taken for colours, and a model whose exponents are lost without a word."""
    trained = trained_of(started(Profiles(), N), HERE)
    assert len(trained) == N
    assert trained.from_profiles
    assert not trained_of(started(Gaussians3DModel(), N), HERE).from_profiles
