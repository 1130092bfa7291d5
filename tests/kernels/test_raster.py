"""The native rasterizer against a brute-force picture, the reference's gradients in float64, and its own promises."""

from typing import Any

import numpy as np
import pytest
import torch
from raster.cases import assert_beta_vector, camera, case, gaussians, names
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import raster
from gsbench.raster import RasterOutput, rasterize
from gsbench.stability.brute import render

DIFFERENTIABLE = ("means", "factors", "opacities", "colors", "viewmats", "background", "shapes")


def single(name: str) -> dict[str, Any]:
    arguments = case(name, torch.float32)
    arguments.setdefault("background", torch.full((arguments["colors"].shape[-1],), 0.3))
    return arguments


def differentiate(arguments: dict[str, Any], backend: str, undecided: Tensor) -> tuple[RasterOutput, dict[str, Tensor]]:
    """A picture, and the gradients of a random sum over the pixels that rounding cannot decide otherwise."""
    inputs = {k: v.clone().requires_grad_(k in DIFFERENTIABLE) if isinstance(v, Tensor) else v
              for k, v in arguments.items()}  # fmt: skip
    output = rasterize(**inputs, backend=backend)
    output.info.means2d.retain_grad()
    g = torch.Generator().manual_seed(1)
    weight = torch.randn(output.image.shape, generator=g).to(output.image) * ~undecided[..., None]
    weight_alpha = torch.randn(output.alpha.shape, generator=g).to(output.image) * ~undecided[..., None]
    ((output.image * weight).sum() + (output.alpha * weight_alpha).sum()).backward()
    gradients = {k: inputs[k].grad for k in DIFFERENTIABLE if k in inputs}
    gradients["means2d"] = output.info.means2d.grad
    return output, {k: torch.zeros(()) if v is None else v for k, v in gradients.items()}


def undecided_pixels(arguments: dict[str, Any]) -> Tensor:
    exact = {k: v.double() if isinstance(v, Tensor) else v for k, v in arguments.items()}
    return render(**exact).slack <= 1e-3


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("name", names())
def test_picture(name: str) -> None:
    """Catches any rule of the picture that differs, a bound that loses a pixel, and a wrong rounding in one ISA."""
    arguments = single(name)
    picture = render(**{k: v.double() if isinstance(v, Tensor) else v for k, v in arguments.items()})
    output = rasterize(**arguments, backend="cpu")
    decided = picture.slack > 1e-3
    np.testing.assert_allclose(output.image[decided], picture.image[decided], rtol=0, atol=1e-4)
    np.testing.assert_allclose(output.alpha[decided], picture.alpha[decided], rtol=0, atol=1e-4)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("name", names())
def test_gradients(name: str) -> None:
    """Catches a wrong gradient of any input: by size, by direction, and by which entries are zero."""
    arguments = single(name)
    undecided = undecided_pixels(arguments)
    exact = {k: v.double() if isinstance(v, Tensor) else v for k, v in arguments.items()}
    _, expected = differentiate(exact, "reference", undecided)
    _, actual = differentiate(arguments, "cpu", undecided)
    for key, truth in expected.items():
        got = actual[key].double()
        scale = truth.norm()
        assert (got - truth).norm() <= 1e-3 * scale + 1e-6, key
        if scale > 1e-6:
            assert torch.nn.functional.cosine_similarity(got.flatten(), truth.flatten(), 0) > 0.9999, key
        noise = 1e-6 * (truth.abs().max() if truth.numel() else 0) + 1e-9
        assert not ((got == 0) & (truth.abs() > noise)).any(), f"{key}: a gradient is missing"
        assert not ((truth == 0) & (got.abs() > noise)).any(), f"{key}: a gradient should be zero"


@pytest.mark.parametrize("name", names())
def test_info(name: str) -> None:
    """Catches radii, means or depths that differ from the reference's: density control lives on them."""
    arguments = single(name)
    expected, actual = (rasterize(**arguments, backend=backend).info for backend in ("reference", "cpu"))
    assert actual.radii.dtype == torch.int32
    assert (actual.radii - expected.radii).abs().le(1 + 1e-5 * expected.radii).all()
    assert ((actual.radii > 0) == (expected.radii > 0)).float().mean() > 0.95 or not len(arguments["means"])
    drawn = actual.radii > 0
    torch.testing.assert_close(actual.means2d[drawn], expected.means2d[drawn], rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(actual.depths, expected.depths, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", ["random", "three_cameras", "five_channels", "opaque_stack", "beta_of_three_cameras"])
def test_same_bits_for_any_number_of_threads(name: str) -> None:
    """Catches sums whose order depends on who comes first."""
    arguments = single(name)
    if name == "random":  # several tiles and several tasks of every loop
        g = torch.Generator().manual_seed(0)
        scene = gaussians(g, 3000, size=0.05) | camera(150, 100) | {"background": torch.ones(3)}
        arguments = {k: v.float() if isinstance(v, Tensor) else v for k, v in scene.items()}
    none = torch.zeros(len(arguments["viewmats"]), arguments["height"], arguments["width"], dtype=torch.bool)
    results = []
    for number in (1, 2, 5):
        torch.set_num_threads(number)
        output, gradients = differentiate(arguments, "cpu", none)
        results.append([output.image, output.alpha, *gradients.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_layouts_do_not_matter() -> None:
    """Catches memory read in the wrong order: transposed factors, expanded colours, strided means."""
    arguments = single("three_cameras")
    N = len(arguments["means"])
    arguments["colors"] = arguments["colors"][0]
    expected = rasterize(**arguments, backend="cpu").image
    strided = arguments | {
        "factors": arguments["factors"].mT.contiguous().mT,
        "means": torch.cat([arguments["means"], torch.ones(N, 2)], 1)[:, :3],
        "colors": arguments["colors"].expand(3, N, 3),
        "viewmats": arguments["viewmats"].mT.contiguous().mT,
    }
    assert torch.equal(rasterize(**strided, backend="cpu").image, expected)


def test_shared_colors_collect_the_gradient_of_every_camera() -> None:
    """Catches a gradient of shared colours that keeps only one camera's part."""
    arguments = single("three_cameras") | {"colors": torch.rand(30, 3)}
    none = undecided_pixels(arguments) & False
    _, shared = differentiate(arguments, "cpu", none)
    _, separate = differentiate(arguments | {"colors": arguments["colors"].repeat(3, 1, 1)}, "cpu", none)
    torch.testing.assert_close(shared["colors"], separate["colors"].sum(0))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", [0, 15, (1 << 17) - 1, 1 << 17, -1])
def test_one_bad_value_of_many_is_flagged(bad: float, place: int) -> None:
    """Catches vectors or parts of a large array that are not looked at: its first, where parts meet, its last."""
    N = 100_003
    arrays = [torch.full((N, 3), 0.5), torch.full((N, 3, 3), 0.5), torch.full((N,), 0.5), torch.full((N, 3), 0.5)]
    rest = torch.eye(4)[None], torch.eye(3)[None], torch.zeros(3)
    assert int(raster.flag_values(*arrays, *rest)) == 0
    arrays[1].view(-1)[place] = bad
    assert int(raster.flag_values(*arrays, *rest)) == 1 << 1


@pytest.mark.parametrize("bad", [0.0, -1.0, torch.nan, torch.inf])
def test_exponents_of_beta_profiles_are_positive(bad: float) -> None:
    """Catches an exponent that the kernel lets in and the reference refuses."""
    arguments = single("beta")
    arguments["shapes"][-1] = bad
    with pytest.raises(InputError, match=r"^shapes: expected (exponents above 0|finite values), got"):
        rasterize(**arguments, backend="cpu")


@pytest.mark.usefixtures("instruction_set")
def test_beta_vector() -> None:
    """Catches another formula of a Beta profile than that of Universal Beta Splatting, in value, size and gradient."""
    assert_beta_vector("cpu", torch.float32, 2e-4)


@pytest.mark.usefixtures("instruction_set")
def test_a_large_exponent_is_a_gaussian() -> None:
    """Catches digits of 1 - r^2 that are lost near 1, which an exponent of 10^5 multiplies: alphas were off by 1e-3."""
    arguments = single("random") | {"eps2d": 0.0}
    large = {"factors": arguments["factors"] * (2e5**0.5), "shapes": torch.full((60,), 1e5)}
    gaussian, beta = (rasterize(**a, backend="cpu").image for a in (arguments, arguments | large))
    decided = ~undecided_pixels(arguments) & ~undecided_pixels(arguments | large)
    assert decided.double().mean() > 0.8
    torch.testing.assert_close(beta[decided], gaussian[decided], rtol=0, atol=1e-4)


@pytest.mark.usefixtures("instruction_set")
def test_gradients_at_the_rim_are_those_of_the_held_profile() -> None:
    """Catches a gradient of an exponent below 1 that is infinite or missing at the rim: pixels are put on it."""
    distances = torch.tensor([0.9, 1 - 1e-4, 1 - 6e-7, 1 + 1e-5]).sqrt()  # r at which each image has its one pixel
    gradients = []
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float32)):
        factor = torch.diag(torch.tensor([1.0, 1, 0], dtype=dtype))[None].requires_grad_()
        shapes = torch.tensor([0.2], dtype=dtype, requires_grad=True)
        Ks = torch.tensor([[1.0, 0, 0], [0, 1, 0.5], [0, 0, 1]], dtype=dtype).repeat(4, 1, 1)
        Ks[:, 0, 2] = 0.5 + distances
        out = rasterize(torch.tensor([[0.0, 0, 1]], dtype=dtype), factor, torch.ones(1, dtype=dtype),
                        torch.ones(1, 1, dtype=dtype), torch.eye(4, dtype=dtype).repeat(4, 1, 1), Ks, 1, 1, eps2d=0.0,
                        shapes=shapes, backend=backend)  # fmt: skip
        slopes = [torch.autograd.grad(x, (factor, shapes), retain_graph=True) for x in out.alpha.flatten()]
        gradients.append((out.alpha.detach().flatten(), *map(torch.stack, zip(*slopes, strict=True))))
    for got, want in zip(*gradients, strict=True):
        assert want[2].abs().max() > 0
        assert not want[3].any()
        for one, other in zip(got, want, strict=True):  # the slope at r^2 = 1 - 1e-4 is known to 1e-3: r^2 is rounded
            assert (one - other).norm() <= 5e-3 * other.norm()


def test_what_it_cannot_do_is_said() -> None:
    """Catches a crash or a silent wrong result where the backend has limits the reference has not."""
    arguments = single("random")
    double = {k: v.double() if isinstance(v, Tensor) else v for k, v in arguments.items()}
    with pytest.raises(InputError, match="float32"):
        rasterize(**double, backend="cpu")
    with pytest.raises(InputError, match="no gradient by Ks"):
        rasterize(**arguments | {"Ks": arguments["Ks"].requires_grad_()}, backend="cpu")


def test_a_request_beyond_memory_fails_by_message() -> None:
    """Catches the process being killed: 100,000 Gaussians that each cover a 4k picture, before 2,000 cameras."""
    g = torch.Generator().manual_seed(0)
    scene = gaussians(g, 100_000, size=20.0) | camera(3840, 2160)
    arguments = {k: v.float() if isinstance(v, Tensor) else v for k, v in scene.items()}
    with pytest.raises(InputError, match=r"GiB|pairs"):
        rasterize(**arguments, backend="cpu")
    few = single("random") | {"width": 3840, "height": 2160}
    many = few | {"viewmats": few["viewmats"].repeat(2000, 1, 1), "Ks": few["Ks"].repeat(2000, 1, 1)}
    with pytest.raises(InputError, match="GiB"):
        rasterize(**many, backend="cpu")


@pytest.mark.parametrize("name", ["random", "three_cameras", "five_channels", "beta_of_three_cameras"])
def test_operations_keep_torch_s_rules(name: str) -> None:
    """Catches an operation that aliases, mutates or misdeclares its outputs, so that torch.compile would be wrong."""
    a = single(name)
    inputs = [a[k].requires_grad_() for k in ("means", "factors", "opacities", "viewmats")]
    viewport = raster.Viewport(a["width"], a["height"], 0.01, 1e10, 0.3, False)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    ops = torch.ops.gsbench
    shapes = a.get("shapes")
    given = torch.empty(0) if shapes is None else shapes.requires_grad_()
    torch.library.opcheck(ops.project, ([*inputs, a["Ks"], given], *viewport), test_utils=checks)
    splats = raster.Splats(*(x.detach() for x in raster.project(*inputs, a["Ks"], viewport, shapes)[:4]))
    bins, _ = raster.bin_tiles(splats, viewport, torch.zeros(1, dtype=torch.int64))
    colors = a["colors"] if a["colors"].dim() == 3 else a["colors"][None]
    blended = [splats.means2d.requires_grad_(), splats.roots.requires_grad_(), splats.half_sizes, colors]
    torch.library.opcheck(
        ops.blend, ([*blended, a["background"], *bins, given], a["width"], a["height"]), test_utils=checks
    )
