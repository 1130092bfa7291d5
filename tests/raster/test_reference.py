"""The reference rasterizer against a brute-force picture, finite differences, and what must hold for any scene."""

from typing import Any

import numpy as np
import pytest
import torch
from cases import CASES, assert_beta_vector, camera, case, gaussians
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics.brute import Picture, render
from torch import Tensor

from gsbench.raster import RasterOutput, rasterize, reference

DIFFERENTIABLE = ("means", "factors", "opacities", "colors", "viewmats", "background", "beta_exponents")


def draw(arguments: dict[str, Any]) -> RasterOutput:
    return rasterize(**arguments, backend="reference")


def brute_force(arguments: dict[str, Any], **more: Any) -> Picture:
    exact = {k: v.detach().double() if isinstance(v, Tensor) else v for k, v in arguments.items()}
    return render(**exact, **more)


@pytest.mark.parametrize("name", CASES)
def test_picture_is_the_brute_force_one(name):
    """Catches any wrong rule of the picture, a tile, bound or padding that loses or invents a Gaussian; radii that miss
    a pixel drawn or hide a Gaussian from density control, and depths of another camera."""
    arguments = case(name)
    output, picture = draw(arguments), brute_force(arguments)
    np.testing.assert_allclose(output.image.numpy(), picture.image, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(output.alpha.numpy(), picture.alpha, rtol=1e-9, atol=1e-9)
    info, C, N = output.info, len(arguments["viewmats"]), arguments["means"].shape[-2]
    assert info.radii.shape == (C, N)
    assert info.radii.dtype == torch.int32
    assert info.means2d.shape == (C, N, 2)
    R, t = arguments["viewmats"][:, :3, :3], arguments["viewmats"][:, :3, 3]
    torch.testing.assert_close(info.depths, (arguments["means"] @ R.mT + t[:, None])[..., 2])
    c, i, row, column = picture.touched.nonzero(as_tuple=True)
    pixels = torch.stack([column, row], -1) + 0.5
    assert ((pixels - info.means2d[c, i]).abs().amax(-1) <= info.radii[c, i]).all()
    drawn = (info.radii > 0).sum()
    assert (info.pairs == 0) == (drawn == 0)
    assert info.pairs >= drawn


def test_tiles_are_blended_together_as_far_as_memory_allows(monkeypatch):
    """Catches tiles that are blended one at a time, and a tile above the limit that is never blended."""
    arguments, pieces, blend = case("random"), [], reference._blend_tiles
    monkeypatch.setattr(reference, "_blend_tiles", lambda *tiles: pieces.append(tiles) or blend(*tiles))
    together = draw(arguments).image
    assert len(pieces) == len(arguments["viewmats"])
    monkeypatch.setattr(reference, "CHUNK", 1)
    assert torch.equal(draw(arguments).image, together)
    assert len(pieces) > 2 * len(arguments["viewmats"])


@pytest.mark.parametrize("name", CASES)
def test_picture_in_single_precision(name):
    """Catches cancellation: float32 keeps 1e-4 wherever no rounding can flip a decision of the picture's rules; NaN by
    way of what is not drawn (behind the camera, singular, transparent), and a picture without an autograd graph."""
    arguments = case(name, torch.float32)
    picture = brute_force(arguments)
    arguments = {k: v.requires_grad_() if k in DIFFERENTIABLE else v for k, v in arguments.items()}
    output = draw(arguments)
    assert output.image.dtype == output.alpha.dtype == torch.float32
    decided = picture.slack > 1e-3
    assert decided.double().mean() > 0.8
    np.testing.assert_allclose(output.image.detach()[decided], picture.image[decided], rtol=0, atol=1e-4)
    output.info.means2d.retain_grad()
    (output.image.square().sum() + output.alpha.sum()).backward()
    for tensor in (*(arguments[k] for k in DIFFERENTIABLE if k in arguments), output.info.means2d):
        assert tensor.grad.isfinite().all()
    hidden = (output.info.radii if arguments["means"].dim() == 3 else output.info.radii.amax(0)) == 0
    assert not arguments["means"].grad[hidden].any()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.none() | st.floats(-3, 6), st.floats(-3, 4), st.floats(0, 1))
def test_any_scene_is_drawn_as_by_brute_force(seed, exponent, log_size, opacity):
    """Catches what no case shows: a camera that is not the inverse of its pose, a use of F other than by F F^T, a sort
    by index, a background that is not dimmed; in float32 NaN and more light than there is, at any size."""
    g = torch.Generator().manual_seed(seed)
    Q, s = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))[0], torch.randn(3, 1, generator=g)
    scene = (
        gaussians(g, 12, size=0.3 * 10**log_size) | camera(16, 12) | {"opacities": torch.full((12,), opacity).double()}
    )
    scene["viewmats"][0, :3] = torch.cat([Q * torch.linalg.det(Q).sign(), s + torch.tensor([[0], [0], [2]])], 1)
    scene |= {} if exponent is None else {"beta_exponents": torch.full((12,), 10**exponent, dtype=torch.float64)}
    scene["background"] = torch.tensor([0.3, 0.5, 0.9], dtype=torch.float64)
    output, picture = draw(scene), brute_force(scene)
    decided = picture.slack > 1e-6
    torch.testing.assert_close(output.image[decided], picture.image[decided], rtol=1e-9, atol=1e-9)
    single = draw({k: v.float() if isinstance(v, Tensor) else v for k, v in scene.items()})
    assert single.image.isfinite().all()
    assert (single.alpha >= 0).all()
    assert (single.alpha <= 1 - 0.99e-4).all()  # blending ends at a transmittance of 1e-4
    assert (single.image <= 1).all()  # as colours are
    assert (single.info.radii >= 0).all()


def smooth(name: str) -> dict[str, Any]:
    """Six Gaussians of a case, whose picture has no decision so close that a finite difference would flip it."""
    arguments = case(name)
    few = torch.linspace(0, len(arguments["means"]) - 1, 6).long()
    arguments |= {k: arguments[k][few] for k in ("means", "factors", "opacities", "beta_exponents") if k in arguments}
    arguments["colors"] = arguments["colors"][..., few, :]
    D = arguments["colors"].shape[-1]
    arguments.setdefault("background", torch.linspace(0.2, 0.9, D, dtype=torch.float64))
    assert brute_force(arguments).slack.min() > 1e-4
    assert draw(arguments).info.pairs > 0
    return arguments


GRADIENT_CASES = (
    *("random", "off_screen", "larger_than_picture", "near_plane", "flat", "three_cameras", "antialiased"),
    *("oblong_pixels", "principal_point_outside", "one_channel", "five_channels"),
    *("beta", "beta_antialiased", "beta_of_three_cameras"),
)


@pytest.mark.parametrize("name", GRADIENT_CASES)
def test_gradients_of_every_input(name):
    """Catches a wrong or missing derivative of any input, cameras and background included (central differences)."""
    arguments = smooth(name)
    # Of Ks the four numbers: the others are fixed, and refused when central differences move them.
    Ks = arguments.pop("Ks")
    intrinsics = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], -1)
    names = [k for k in DIFFERENTIABLE if k in arguments]
    inputs = tuple(x.requires_grad_() for x in (*map(arguments.pop, names), intrinsics))
    weight = torch.randn(2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(*tensors: Tensor) -> Tensor:
        fx, fy, cx, cy = tensors[-1].unbind(-1)
        o, i = torch.zeros_like(fx), torch.ones_like(fx)
        Ks = torch.stack([fx, o, cx, o, fy, cy, o, o, i], -1).unflatten(-1, (3, 3))
        output = draw(arguments | dict(zip(names, tensors[:-1], strict=True)) | {"Ks": Ks})
        waves = torch.arange(output.image.numel(), dtype=torch.float64).mul(0.05).sin().view_as(output.image)
        return weight[0] * (waves * output.image.square()).sum() + weight[1] * output.alpha.square().sum()

    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("name", ["random", "off_screen", "three_cameras"])
def test_gradient_of_2d_means(name):
    """Catches `info.means2d` off the path of the loss: its gradient, which drives densification, would be None."""
    arguments = smooth(name)
    arguments["means"].requires_grad_()
    output = draw(arguments)
    output.info.means2d.retain_grad()
    waves = torch.arange(output.image.numel(), dtype=torch.float64).mul(0.05).sin().view_as(output.image)
    (waves * output.image).sum().backward()

    def loss(offsets: np.ndarray) -> float:
        return float((waves * brute_force(arguments, offsets2d=torch.from_numpy(offsets)).image).sum())

    expected, h = np.zeros(output.info.means2d.shape), 1e-6
    for index in np.ndindex(expected.shape):
        offsets = np.zeros_like(expected)
        offsets[index] = h
        expected[index] = (loss(offsets) - loss(-offsets)) / (2 * h)
    np.testing.assert_allclose(output.info.means2d.grad.numpy(), expected, rtol=1e-5, atol=1e-8)
    assert np.abs(expected).max() > 1e-2


def test_a_point_without_filter():
    """Catches 0/0 where nothing is added to a covariance of zero: not drawn, and no NaN in any gradient."""
    arguments = case("random") | {"eps2d": 0.0}
    arguments["factors"][::2] = 0
    arguments["factors"].requires_grad_()
    output = draw(arguments)
    output.image.sum().backward()
    assert output.image.isfinite().all()
    assert arguments["factors"].grad.isfinite().all()
    assert not output.info.radii[:, ::2].any()
    assert output.info.radii[:, 1::2].any()


def test_beta_vector():
    """Catches another formula of a Beta profile than that of Universal Beta Splatting, in value, size and gradient."""
    assert_beta_vector("reference", torch.float64, 1e-4)


@pytest.mark.parametrize("shape", [1e-6, 0.3, 1.0])
def test_gradients_at_the_rim_are_held(shape):
    """Catches an infinite gradient, or a missing one, where 1 - r^2 is below 1e-6 and the exponent below 1."""
    rim = torch.tensor([0.99, 1 - 1e-6, 1 - 1e-9, 1 - 1e-16, 1.0, 1.1, 1e300], dtype=torch.float64, requires_grad=True)
    exponents = torch.full((7,), shape, dtype=torch.float64, requires_grad=True)
    profile = reference._beta(rim, exponents)
    profile.sum().backward()
    held = (1 - rim.detach()).clamp(min=1e-6)
    inside = rim.detach() < 1
    torch.testing.assert_close(profile.detach(), held**shape * inside)
    torch.testing.assert_close(rim.grad, -shape * held ** (shape - 1) * inside)
    torch.testing.assert_close(exponents.grad, held**shape * held.log() * inside)


@pytest.mark.usefixtures("threads")
def test_same_bits_twice():
    """Catches sums whose order depends on the threads, in the picture and in every gradient. Large enough that torch
    runs its scatters in parallel: with 2 threads `table[index]` failed this."""
    a = gaussians(torch.Generator().manual_seed(0), 1500, size=0.05) | camera(64, 64)
    a, runs = {k: v.float() if isinstance(v, Tensor) else v for k, v in a.items()}, []
    torch.set_num_threads(2)
    for _ in range(3):
        inputs = {k: a[k].detach().requires_grad_() for k in DIFFERENTIABLE if k in a}
        output = draw(a | inputs)
        output.image.square().sum().backward()
        runs.append([output.image.detach(), *(x.grad for x in inputs.values())])
    assert all(torch.equal(x, y) for run in runs[1:] for x, y in zip(runs[0], run, strict=True))
