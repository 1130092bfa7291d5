"""The rasterizer's kernels against a brute-force picture, the reference's gradients in float64, and their promises."""

import math
from functools import cache
from typing import Any

import pytest
import torch
from numerics.brute import Picture, render
from raster.cases import CASES, assert_beta_vector, camera, case, gaussians
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import operation, raster
from gsbench.raster import RasterOutput, rasterize

DIFFERENTIABLE = ("means", "factors", "opacities", "colors", "viewmats", "background", "beta_exponents")
Arguments = dict[str, Any]


def with_background(name: str, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Arguments:
    """The arguments of a case, with a background where it has none."""
    arguments = case(name, dtype, device)
    channels = arguments["colors"].shape[-1]
    return {"background": torch.full((channels,), 0.3, dtype=dtype, device=device)} | arguments


def cast(arguments: Arguments, dtype: torch.dtype, device: str = "cpu") -> Arguments:
    return {k: v.to(device, dtype) if isinstance(v, Tensor) else v for k, v in arguments.items()}


@cache
def brute_force(name: str) -> Picture:
    """The picture of a case in float64, from its numbers in float32."""
    return render(**cast(with_background(name), torch.float64))


def decided(name: str) -> Tensor:
    """Pixels where no rounding can flip a decision of the picture's rules, [C, H, W]."""
    return brute_force(name).slack > 1e-3


def differentiate(arguments: Arguments, backend: str, where: Tensor) -> tuple[RasterOutput, dict[str, Tensor]]:
    """A picture, and the gradients of a random sum over some of its pixels, in float64 on the CPU."""
    inputs = {
        k: v.clone().requires_grad_(k in DIFFERENTIABLE) if isinstance(v, Tensor) else v for k, v in arguments.items()
    }
    output = rasterize(**inputs, backend=backend)
    output.info.means2d.retain_grad()
    g = torch.Generator().manual_seed(1)
    weights = [torch.randn(x.shape, generator=g) * where[..., None] for x in (output.image, output.alpha)]
    sum((x * w.to(x)).sum() for x, w in zip((output.image, output.alpha), weights, strict=True)).backward()
    leaves = {k: inputs[k] for k in DIFFERENTIABLE if k in inputs} | {"means2d": output.info.means2d}
    return output, {
        k: torch.zeros_like(x).cpu().double() if x.grad is None else x.grad.cpu().double() for k, x in leaves.items()
    }


@cache
def by_reference(name: str) -> tuple[RasterOutput, dict[str, Tensor]]:
    """Picture and gradients of a case by the reference in float64."""
    return differentiate(cast(with_background(name), torch.float64), "reference", decided(name))


def assert_gradients_close(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Compare by size, by direction, and by which numbers are zero."""
    for key, want in expected.items():
        got, size = actual[key], want.norm()
        assert (got - want).norm() <= 1e-3 * size + 1e-6, key
        if size > 1e-6:
            assert torch.cosine_similarity(got.flatten(), want.flatten(), 0) > 0.9999, key
        noise = 1e-6 * (want.abs().max() if want.numel() else 0) + 1e-9
        assert not ((got == 0) & (want.abs() > noise)).any(), f"{key}: a gradient is missing"
        assert not ((want == 0) & (got.abs() > noise)).any(), f"{key}: a gradient should be zero"


@pytest.mark.parametrize("name", CASES)
def test_picture(name, place):
    """Catches another rule of the picture, a tile that loses a Gaussian, and other radii, means or depths."""
    output = rasterize(**with_background(name, device=place.device), backend=place.device)
    for got, want in ((output.image, brute_force(name).image), (output.alpha, brute_force(name).alpha)):
        known = torch.as_tensor(want)[decided(name)]
        torch.testing.assert_close(got.cpu().double()[decided(name)], known, rtol=0, atol=1e-4)
    info, expected = output.info, by_reference(name)[0].info
    assert info.radii.dtype == torch.int32
    radii = info.radii.cpu()
    assert (radii - expected.radii).abs().le(1 + 1e-5 * expected.radii).all()
    assert ((radii > 0) == (expected.radii > 0)).float().mean() > 0.95 or not radii.numel()
    drawn = (radii > 0) & (expected.radii > 0)
    means2d, depths = info.means2d.detach().cpu().double(), info.depths.cpu().double()
    torch.testing.assert_close(means2d[drawn], expected.means2d.detach()[drawn], rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(depths, expected.depths.detach(), rtol=1e-5, atol=1e-5)
    assert (info.pairs == 0) == (expected.pairs == 0)


@pytest.mark.parametrize("name", CASES)
def test_gradients(name, place):
    """Catches a wrong or missing derivative of any input, and sums that miss a patch, a lane or a camera."""
    _, actual = differentiate(with_background(name, device=place.device), place.device, decided(name))
    assert_gradients_close(actual, by_reference(name)[1])


def test_many_tiles_and_rounds(place):
    """Catches what shows only with more than 32 splats a tile and several tiles: staging rounds, offsets, sort keys."""
    g = torch.Generator().manual_seed(3)
    N, width, height = (3_000, 230, 170) if place.device == "cuda" else (300, 50, 40)
    exact = gaussians(g, N, size=0.1) | camera(width, height) | {"background": torch.tensor([0.1, 0.5, 0.9])}
    exact["opacities"] = exact["opacities"] * 0.3  # deep: many splats a pixel
    exact, single = cast(exact, torch.float64), cast(exact, torch.float32, place.device)
    want, got = rasterize(**exact, backend="reference"), rasterize(**single, backend=place.device)
    error = (got.image.cpu().double() - want.image).abs().amax(-1)
    # A decision that rounding flips changes a pixel by up to 1/255: a handful of the millions there are.
    assert error.quantile(0.999) < 1e-4
    assert error.max() < 1 / 255
    _, expected = differentiate(exact, "reference", error < 1e-4)
    assert_gradients_close(differentiate(single, place.device, error < 1e-4)[1], expected)


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("name", [name for name in CASES if "their_own" in name])
def test_cameras_of_their_own_gaussians_have_the_bits_of_single_calls(name, is_reversed, place, monkeypatch):
    """Catches a camera that reads another's Gaussians or adds to their gradients, and a barrier that is missing."""
    if is_reversed:
        monkeypatch.setenv("GSBENCH_SHIM_REVERSED", "1")  # the kernels of a CPU do not read it
    arguments = with_background(name, device=place.device)
    sliced = [key for key, x in arguments.items() if isinstance(x, Tensor) and key != "background"]

    def drawn(at: slice) -> list[Tensor]:
        inputs = {key: arguments[key][at].clone().requires_grad_(key != "Ks") for key in sliced}
        output = rasterize(**arguments | inputs, backend=place.device)
        gradients = torch.autograd.grad(
            (output.image.square() + output.alpha).sum(), [inputs[key] for key in DIFFERENTIABLE if key in inputs]
        )
        return [output.image, output.alpha, output.info.half_sizes, output.info.depths, *gradients]

    single = zip(*(drawn(slice(c, c + 1)) for c in range(3)), strict=True)
    assert all(map(torch.equal, drawn(slice(None)), map(torch.cat, single)))


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", ["random", "three_cameras", "five_channels", "opaque_stack", "beta_of_three_cameras"])
def test_same_bits_for_any_number_of_threads(name):
    """Catches sums whose order depends on who comes first."""
    arguments = with_background(name)
    if name == "random":  # several tiles and several tasks of every loop
        g = torch.Generator().manual_seed(0)
        arguments = cast(
            gaussians(g, 3000, size=0.05) | camera(150, 100) | {"background": torch.ones(3)}, torch.float32
        )
    results = []
    for number in (1, 2, 5):
        torch.set_num_threads(number)
        output, gradients = differentiate(arguments, "cpu", torch.ones(()).bool())
        results.append([output.image, output.alpha, *gradients.values()])
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("position", [0, 15, (1 << 17) - 1, 1 << 17, -1])
def test_one_bad_value_of_many_is_flagged(bad, position):
    """Catches vectors or parts of a large array that are not looked at: its first, where parts meet, its last."""
    N = 100_003
    arrays = [torch.full((N, 3), 0.5), torch.full((N, 3, 3), 0.5), torch.full((N,), 0.5), torch.full((N, 3), 0.5)]
    rest = torch.eye(4)[None], torch.eye(3)[None], torch.zeros(3)
    assert int(raster.flag_values(raster.RasterInputs(*arrays, *rest))) == 0
    arrays[1].view(-1)[position] = bad
    assert int(raster.flag_values(raster.RasterInputs(*arrays, *rest))) == 1 << 1


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.nan, "means: expected finite"),
        ("factors", torch.inf, "factors: expected finite"),
        ("opacities", 1.5, "opacities: expected values in"),
        ("colors", -torch.inf, "colors: expected finite"),
        ("viewmats", torch.nan, "viewmats: expected finite"),
        ("Ks", 0.0, "Ks: expected positive"),
        ("background", torch.nan, "background: expected finite"),
        ("beta_exponents", 0.0, "beta_exponents: expected exponents above 0"),
        ("beta_exponents", -1.0, "beta_exponents: expected exponents above 0"),
        ("beta_exponents", torch.inf, "beta_exponents: expected finite"),
        ("beta_exponents", torch.nan, "beta_exponents: expected finite"),
    ],
)
def test_bad_values_are_named(name, value, message, place):
    """Catches a value that shows late, as a picture of NaN, on a GPU, or one of the last camera's Gaussians."""
    arguments = with_background("beta_of_three_cameras_of_their_own_gaussians", device=place.device)
    arguments[name].view(-1)[0 if name == "Ks" else -1] = value
    with pytest.raises(InputError, match=f"^{message}"):
        rasterize(**arguments, backend=place.device)


def test_beta_vector(place):
    """Catches another formula of a Beta profile than that of Universal Beta Splatting, in value, size and gradient."""
    assert_beta_vector(place.device, torch.float32, 2e-4)


@pytest.mark.usefixtures("instruction_set")
def test_gradients_of_many_gaussians_are_zero_where_none_is_given(monkeypatch):
    """Catches rows that stay as they were in memory, where zeros are written past the cache."""
    monkeypatch.setattr(operation, "allocate", lambda _, like, shape: like.new_full(shape, math.nan))
    N, last = 90_001, 20
    arguments = cast(gaussians(torch.Generator().manual_seed(0), N) | camera(64, 64), torch.float32)
    leaves = [arguments[name].requires_grad_() for name in ("means", "factors", "opacities")]
    rest = [arguments[name] for name in ("colors", "viewmats", "Ks")]
    inputs = raster.RasterInputs(*leaves, *rest, torch.zeros(3), None)
    splats = raster.project(inputs, raster.Viewport(64, 64, 0.01, 100.0, 0.3, False))
    (splats.means2d[0, -last:].sum() + splats.roots[0, -last:].sum()).backward()
    for x in leaves:
        assert x.grad is not None
        assert not x.grad[:-last].any()
        assert x.grad[-last:].any(0).all()


@pytest.mark.usefixtures("instruction_set")
def test_a_large_exponent_is_a_gaussian():
    """Catches digits of 1 - r^2 that are lost near 1, which an exponent of 10^5 multiplies: alphas were off by 1e-3."""
    arguments = with_background("random") | {"eps2d": 0.0}
    large = arguments | {"factors": arguments["factors"] * (2e5**0.5), "beta_exponents": torch.full((60,), 1e5)}
    gaussian, beta = (rasterize(**a, backend="cpu").image for a in (arguments, large))
    where = torch.stack([render(**cast(a, torch.float64)).slack > 1e-3 for a in (arguments, large)]).all(0)
    assert where.double().mean() > 0.8
    torch.testing.assert_close(beta[where], gaussian[where], rtol=0, atol=1e-4)


@pytest.mark.usefixtures("instruction_set")
def test_gradients_at_the_rim_are_those_of_the_held_profile():
    """Catches a gradient of an exponent below 1 that is infinite or missing at the rim: pixels are put on it."""
    distances = torch.tensor([0.9, 1 - 1e-4, 1 - 6e-7, 1 + 1e-5]).sqrt()  # r at which each image has its one pixel
    Ks = torch.tensor([[1.0, 0, 0], [0, 1, 0.5], [0, 0, 1]]).repeat(4, 1, 1)
    Ks[:, 0, 2] = 0.5 + distances
    gradients = []
    for backend in ("cpu", "reference"):
        factor = torch.diag(torch.tensor([1.0, 1, 0]))[None].requires_grad_()
        exponents = torch.tensor([0.2], requires_grad=True)
        gaussian = (torch.tensor([[0.0, 0, 1]]), factor, torch.ones(1), torch.ones(1, 1))
        view = (torch.eye(4).repeat(4, 1, 1), Ks, 1, 1)
        out = rasterize(*gaussian, *view, eps2d=0.0, beta_exponents=exponents, backend=backend)
        slopes = [torch.autograd.grad(x, (factor, exponents), retain_graph=True) for x in out.alpha.flatten()]
        gradients.append((out.alpha.detach().flatten(), *map(torch.stack, zip(*slopes, strict=True))))
    for got, want in zip(*gradients, strict=True):
        assert want[2].abs().max() > 0
        assert not want[3].any()
        for x, y in zip(got, want, strict=True):  # the slope at r^2 = 1 - 1e-4 is known to 1e-3: r^2 is rounded
            assert (x - y).norm() <= 5e-3 * y.norm()


def test_what_it_cannot_do_is_refused():
    """Catches a crash or a silent wrong result where the kernels have limits the reference has not: types, a gradient
    by intrinsics, and 100,000 Gaussians that each cover a 4k picture, or 2,000 cameras of it."""
    arguments = with_background("random")
    with pytest.raises(InputError, match="float32"):
        rasterize(**cast(arguments, torch.float64), backend="cpu")
    with pytest.raises(InputError, match="no gradient by Ks"):
        rasterize(**arguments | {"Ks": arguments["Ks"].requires_grad_()}, backend="cpu")
    covering = gaussians(torch.Generator().manual_seed(0), 100_000, size=20.0) | camera(3840, 2160)
    with pytest.raises(InputError, match=r"GiB|pairs"):
        rasterize(**cast(covering, torch.float32), backend="cpu")
    cameras = {key: arguments[key].detach().repeat(2000, 1, 1) for key in ("viewmats", "Ks")}
    with pytest.raises(InputError, match="GiB"):
        rasterize(**arguments | cameras | {"width": 3840, "height": 2160}, backend="cpu")
