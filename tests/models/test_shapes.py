"""The optional shapes of a slice, on their way from a model to the image and back."""

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import AUTO, REFERENCE, Backend
from gsbench.kernels.tape import Tape
from gsbench.models import CameraTime
from gsbench.models.base import GaussianModel, Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Conditioned, joined_exponents, tensors_of
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.render import rasterize_slice, render
from gsbench.scenes.scene import Camera, Points
from gsbench.view.slice_ply import trained_of

N = 6
SEEN = Camera(torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
HERE = CameraTime.of(SEEN, None)


class Shaped(GatedModel):
    """Balls of one radius, each with its own b."""

    geometry = ("shape",)
    observes = ("direction",)  # so that rows without effects are sliced by `static`

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        return {"shape": torch.arange(float(len(distances)))[:, None]}

    def condition(self, raw: Raw, query: Any) -> Conditioned:
        shapes, rows = raw["shape"][:, 0].exp(), len(raw["shape"])
        return Conditioned(raw["means"], 0.1 * torch.eye(3).expand(rows, 3, 3), torch.ones(rows), shapes)

    def static(self, raw: Raw) -> Conditioned:
        return self.condition(raw, None)

    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        return {}

    def spatial_scales(self) -> Tensor:
        return torch.full((len(self), 1), 0.1)

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        return raw


def made(kind: type[GaussianModel], **options: Any) -> GaussianModel:
    model, points = kind(**options), torch.rand(N, 3, generator=torch.Generator().manual_seed(0))
    points[:, 2] += 2
    model.initialise(Points(points, points), 1.0, torch.Generator().manual_seed(0))
    return model


def test_a_model_s_shapes_reach_the_image() -> None:
    """Catches shapes that are dropped on the way, so that a Beta kernel is drawn as a Gaussian without a word."""
    model = made(Shaped)
    seen = model.slice(HERE)
    torch.testing.assert_close(seen.beta_exponents, torch.arange(float(N)).exp())
    drawn = [
        rasterize_slice(x, SEEN, torch.zeros(3), REFERENCE).image[0] for x in (seen, seen._replace(beta_exponents=None))
    ]
    image = render(model, SEEN, None, torch.zeros(3))
    torch.testing.assert_close(image, drawn[0], rtol=0, atol=1e-4)
    assert (image - drawn[1]).abs().max() > 0.1


@pytest.mark.parametrize("backend", [AUTO, REFERENCE], ids=lambda backend: backend.name)
def test_shapes_are_trained(backend: Backend) -> None:
    """Catches a gradient of shapes that a recorded backward pass loses on its way to the parameter."""
    model = made(Shaped, backend=backend)
    parameter, sums = model.splats["shape"], {}
    with Tape() as tape:
        loss = render(model, SEEN, None, torch.zeros(3)).square().sum()
    tape.backward(loss, torch.ones(()), [parameter], sums)
    (expected,) = torch.autograd.grad(render(model, SEEN, None, torch.zeros(3)).square().sum(), parameter)
    assert expected.any()
    torch.testing.assert_close(sums[id(parameter)], expected)


def test_rows_of_two_kinds_keep_their_shapes() -> None:
    """Catches shapes lost, or in another order, where some rows change with the query and the others do not."""
    model = made(Shaped)
    whole = model.slice(HERE)
    model.effect_sets = EffectSets(0, 2, torch.full((N,), 15, dtype=torch.int32))
    assert all(torch.equal(x, y) for x, y in zip(tensors_of(model.slice(HERE)), tensors_of(whole), strict=True))


def test_shapes_of_some_rows_are_refused() -> None:
    """Catches a model that forgets the shapes of its static rows, all of whose shapes would then be dropped."""
    assert joined_exponents(None, None) is None
    with pytest.raises(InputError, match="let `condition` and `static` of the model agree"):
        joined_exponents(torch.ones(2), None)


def test_a_slice_without_shapes_is_as_before() -> None:
    """Catches an empty tensor of shapes where there are none: an image would be refused."""
    for backend in ({}, {"backend": REFERENCE}):
        model = made(Gaussians3DModel, **backend)
        assert model.slice(HERE).beta_exponents is None
        assert render(model, SEEN, None, torch.zeros(3)).any()


def test_a_ply_leaves_the_shapes_out() -> None:
    """Catches shapes that are taken for colours, and a model whose shapes are lost without being told."""
    model = made(Shaped)
    trained = trained_of(model, HERE)
    assert len(trained) == N
    assert trained.from_profiles
    assert not trained_of(made(Gaussians3DModel), HERE).from_profiles
