"""Spacetime Gaussians, lite and full: their equations by vectors of an independent numpy program, and new times."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from interrupted import assert_resumes
from small import CAMERA, DIGITS, covariances, fresh, layer_of_the_vectors, lively, pinhole, raw, row, seeded
from tiny_training import trainer
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import REFERENCE
from gsbench.models import CameraTime
from gsbench.models.factors import rotation
from gsbench.models.render import rasterize_slice, render, render_slices
from gsbench.models.spacetime import pixel_rays
from gsbench.scenes import Camera
from gsbench.scenes.points import SH_C0
from gsbench.stability.float32_error import psnr_float32
from gsbench.train.density.blend_weights import WeighedImage

QUERY = CameraTime.at(CAMERA, 0.62)


def gaussian(name: str = "stg", **raw: Tensor) -> Any:
    """The Gaussian of the vector; keyword arguments replace its raw parameters."""
    model = lively(name, 4, sh_degree=0)
    model.select(torch.arange(1))
    parameters = {
        "means": row(0.3, -0.7, 1.1),
        "times": row(0.4),
        "durations": row(-1.0),
        "opacities": row(0.5)[0],
        "path": row(0.2, -0.1, 0.05, 0.4, 0.3, -0.2, -0.6, 0.1, 0.8),
        "quats": row(1, 0.1, 0, -0.2),
        "turns": row(0.3, -0.4, 0.5, 0.1),
    } | raw
    for name, value in parameters.items():
        model.splats[name].data = value
    return model


def test_the_vector():
    """Catches a half in the exponent, coefficients by axis or in reversed order, and a turn before the mean time."""
    model = gaussian()
    sliced = model.slice(QUERY)
    torch.testing.assert_close(sliced.opacities, row(0.43530545)[0], **DIGITS)
    torch.testing.assert_close(sliced.means, row(0.35697120, -0.70641520, 1.10983840), **DIGITS)
    R = rotation(row(0.98121447, 0.01104557, 0.10125102, -0.16384257))
    S = model.splats["scales"].detach().exp()
    torch.testing.assert_close(covariances(sliced), R * S.square()[:, None] @ R.mT, rtol=0, atol=2e-8)


def test_a_mean_time_learns_from_the_opacity_alone():
    """Catches a gradient of mu through path or turn, which the authors' code has not, and a lost one of the opacity."""
    model = gaussian()
    sliced = model.slice(QUERY)
    assert torch.autograd.grad(
        sliced.means.sum() + sliced.factors.sum(), model.splats["times"], retain_graph=True, allow_unused=True
    ) == (None,)
    (gradient,) = torch.autograd.grad(sliced.opacities.sum(), model.splats["times"])
    before, after = (gaussian(times=row(0.4 + step)).slice(QUERY).opacities for step in (-1e-6, 1e-6))
    torch.testing.assert_close(gradient[0], (after - before).detach() / 2e-6, rtol=1e-8, atol=0)


def test_the_start():
    """Catches times outside [0, 1], a duration that is taken for a logarithm, and Gaussians that move or turn."""
    model = fresh("stg", 4000, duration=math.exp(-2))
    values = raw(model)
    assert 0 <= values["times"].min() < 0.01
    assert 0.99 < values["times"].max() <= 1
    torch.testing.assert_close(values["durations"], torch.full((4000, 1), -2.0))
    assert not values["path"].any()
    assert not values["turns"].any()


def test_a_frozen_gaussian_has_the_mean_quaternion():
    """Catches a frozen Gaussian that keeps the quaternion of its mean time."""
    model, queries = gaussian(), [CameraTime.at(CAMERA, time) for time in (0.2, 0.7)]
    weights = torch.tensor([[0.25], [0.75]])
    frozen = model.frozen(raw(model), queries, weights)["static"]
    torch.testing.assert_close(frozen["quats"], row(1, 0.1, 0, -0.2) + (0.575 - 0.4) * row(0.3, -0.4, 0.5, 0.1))


@pytest.mark.parametrize("kind", ["clone", "split"])
def test_clones_and_children_have_new_times(kind):
    """Catches a copy with its parent's time, an original that loses its time, and draws from elsewhere."""
    fitted = trainer("stg", f"train.densify.clone_below={1e3 if kind == 'clone' else 1e-9}")
    rule, model = fitted.density.rule, fitted.model
    before = raw(model)
    rule.gradient.fill_(1.0)
    rule.times_visible.fill_(1.0)
    rule.densify(seeded(0), False, 2 * len(model))
    after, N = raw(model), len(before["times"])
    copies = after["times"][N if kind == "clone" else 0 :]
    assert len(after["times"]) == 2 * N
    assert len({*copies.flatten().tolist()} - {*before["times"].flatten().tolist()}) == len(copies)
    assert 0 <= copies.min() < 0.2
    assert 0.8 < copies.max() <= 1
    if kind == "clone":
        assert all(torch.equal(after[name][:N], x) for name, x in before.items())
        assert all(torch.equal(after[name][N:], x) for name, x in before.items() if name != "times")


BASE, VIEW, TIME = row(0.1, 0.2, 0.3), row(0.4, 0.5, 0.6), row(-0.3, 0.2, 0.7)
NINE = row(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, -0.066, 0.044, 0.154)


def seen_along(x: float, y: float, z: float) -> Camera:
    """A camera of one pixel at (.1, -.2, .3), which looks along z and whose pixel lies in a direction."""
    viewmat, K = torch.eye(4).double(), torch.eye(3).double()
    viewmat[:3, 3] = row(-0.1, 0.2, -0.3)[0]
    K[:2, 2] = 0.5 - row(x, y)[0] / z
    return Camera(viewmat, K, 1, 1)


def test_the_features_of_the_vector():
    """Catches features of time that are not multiplied by t - mu, and base features that are clipped as colours are."""
    features = {"view_features": VIEW, "time_features": TIME}
    for base in (BASE, -BASE):
        model = gaussian("stg_full", sh0=(base[:, None] - 0.5) / SH_C0, **features)
        blended = torch.cat([base, NINE[:, 3:]], 1)
        torch.testing.assert_close(model.slice(QUERY).colors, blended, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("saturate", "pixel"), [(True, (0.72183223, 0.75329802, 0.78038574)), (False, (0.95356830, 1.0, 1.0))]
)
def test_the_decoded_vector(saturate, pixel):
    """Catches inputs in another order, rays of the camera's own space or of another length, and a bias."""
    model: Any = lively("stg_full", saturate=saturate)
    for number, layer in enumerate(model.decoder):
        layer.weight.data, _ = layer_of_the_vectors(number, *layer.weight.shape)
    image = model.decode(NINE[None, None], seen_along(0.3, 0.1, 0.95))
    torch.testing.assert_close(image[0, 0], row(*pixel), **DIGITS)


def test_a_ray_meets_what_its_pixel_shows():
    """Catches pixels counted by columns or from their corners, and a rotation to the camera instead of from it."""
    camera = replace(pinhole(6, 4), viewmat=torch.eye(4).double())
    camera.viewmat[:3, :3], camera.viewmat[:3, 3] = rotation(row(0.8, 0.3, -0.2, 0.5))[0], row(1, 2, 3)[0]
    camera = replace(camera)  # at the centre that follows
    center, sight = pixel_rays(camera).split(3, -1)
    projected = (center + 7 * sight) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    shown = (projected @ camera.K.T)[..., :2] / projected[..., 2:]
    x, y = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(4) + 0.5, indexing="xy")
    torch.testing.assert_close(shown, torch.stack([x, y], -1).double())
    torch.testing.assert_close(sight.norm(dim=-1), torch.ones(4, 6).double())


@pytest.mark.parametrize("saturate", [True, False])
def test_the_decoder_has_the_gradients_of_its_values(saturate):
    """Catches a gradient that a kernel, the clip or the sigmoid loses, by features and by both layers."""
    model: Any = lively("stg_full", saturate=saturate)
    weights, (width, height) = [layer.weight for layer in model.decoder], (3, 2)
    blended = torch.rand(1, height, width, 9, generator=seeded(2)).double().requires_grad_()

    def image(*_: Tensor) -> Any:
        return model.decode(blended, pinhole(width, height))

    assert torch.autograd.gradcheck(image, [blended, *weights])


def test_an_image_by_kernels_is_that_of_torch():
    """Catches channels that a kernel mixes up, a background behind features, and a decoder without portable layers."""
    model, camera = lively("stg_full", 24), pinhole(20, 16)
    single = lively("stg_full", 24).float()
    background = row(0.3, 0.6, 0.1)[0]
    image = render(model, camera, 0.45, background).detach()
    at = Camera(camera.viewmat.float(), camera.K.float(), 20, 16)
    torch.testing.assert_close(render(single, at, 0.45, background.float()).double(), image, rtol=0, atol=2e-5)
    sliced = model.slice(CameraTime.of(camera, 0.45))
    triples = [
        rasterize_slice(sliced._replace(colors=part), camera, behind, REFERENCE).image
        for part, behind in zip(sliced.colors.split(3, 1), (background, *torch.zeros(2, 3).double()), strict=True)
    ]
    torch.testing.assert_close(model.decode(torch.cat(triples, -1), camera)[0].detach(), image)


def test_a_training_of_the_full_model():
    """Catches a decoder that does not learn or that a checkpoint lacks, and scores of images that are not decoded."""
    fitted, _ = assert_resumes(lambda: trainer("stg_full", "model.options.saturate=false"), 30)
    model: Any = fitted.model
    begun: Any = trainer("stg_full").model
    for trained, initial in zip(model.decoder, begun.decoder, strict=True):
        assert not torch.equal(trained.weight, initial.weight)
    assert model.splats["time_features"].any()
    view, black = fitted.scene.train[0], torch.zeros(3)
    weighed = WeighedImage(model, view, black, antialias=False)
    assert torch.equal(weighed.image, render(model, view.camera, view.time, black).detach())
    weights = weighed.weights(torch.ones(weighed.image.shape[:2]))
    alpha = render_slices(model, model.slice(CameraTime.of(view.camera, view.time)), [view.camera], black).alpha
    torch.testing.assert_close(weights.sum(), alpha.sum().detach())
    value, why = psnr_float32(model, [view], black, antialias=False)
    assert value is None
    assert "SpacetimeFeatureModel decodes" in why


@pytest.mark.parametrize("key", ["gate=both", "static_above=0.5"])
def test_it_is_not_simplified(key):
    """Catches errors of simplified Gaussians that are predicted without the decoder."""
    with pytest.raises(InputError, match="SpacetimeFeatureModel decodes what is blended"):
        trainer("stg_full", f"effects.{key}")
