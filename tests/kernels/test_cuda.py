"""The CUDA kernels against the reference, on a GPU or by the shim: pictures, gradients, the loss, bad input."""

import re
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import pytest
import torch
from raster.cases import assert_beta_vector, camera, case, gaussians, names
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.adam import adam
from gsbench.kernels.loss import l1_ssim
from gsbench.kernels.raster import backward_by_splat
from gsbench.raster import rasterize
from gsbench.scenes.scene import to_floats
from gsbench.stability.brute import render
from gsbench.train.losses import photometric
from gsbench.train.optim import adam_reference

DIFFERENTIABLE = ("means", "factors", "opacities", "colors", "viewmats", "background", "shapes")


def decided(arguments: dict[str, Any]) -> Tensor:
    """Pixels where no rounding can flip a decision of the picture's rules, [C, H, W]."""
    exact = {k: v.double() if isinstance(v, Tensor) else v for k, v in arguments.items()}
    return render(**exact).slack > 1e-3


@pytest.mark.parametrize("name", names())
def test_picture_is_the_reference(name: str, cuda_device: str) -> None:
    """Catches any wrong rule of the picture, a bound, tile or patch that loses a Gaussian, and a wrong order."""
    expected = rasterize(**case(name), backend="reference")
    output = rasterize(**case(name, torch.float32, cuda_device), backend=cuda_device)
    sure = decided(case(name))
    assert sure.double().mean() > 0.8
    for got, want in ((output.image, expected.image), (output.alpha, expected.alpha)):
        torch.testing.assert_close(got.cpu().double()[sure], want[sure], rtol=0, atol=1e-4)
    assert output.info.radii.dtype == torch.int32
    assert ((output.info.radii.cpu() - expected.info.radii).abs() <= 1).all()
    torch.testing.assert_close(output.info.depths.cpu().double(), expected.info.depths, rtol=1e-5, atol=1e-5)
    assert (output.info.pairs == 0) == (expected.info.pairs == 0)


def test_beta_vector(cuda_device: str) -> None:
    """Catches another formula of a Beta profile than that of Universal Beta Splatting, in value, size and gradient."""
    assert_beta_vector(cuda_device, torch.float32, 2e-4)


def gradients(arguments: dict[str, Any], backend: str, weight: Tensor) -> dict[str, Tensor]:
    """Of a loss that feels every channel and the cover of the pixels with a weight, by every input."""
    inputs = {k: arguments[k].clone().requires_grad_() for k in DIFFERENTIABLE if k in arguments}
    output = rasterize(**arguments | inputs, backend=backend)
    output.info.means2d.retain_grad()
    weight = weight.to(output.image)[..., None]
    waves = torch.arange(output.image.numel()).mul(0.05).sin().view_as(output.image).to(output.image)
    (weight * (waves * output.image.square() + 0.3 * output.alpha.square())).sum().backward()
    grads = {k: v.grad for k, v in inputs.items()} | {"means2d": output.info.means2d.grad}
    assert all(g is not None and g.isfinite().all() for g in grads.values())
    return {k: g.cpu().double() for k, g in grads.items()}


def assert_gradients_close(got: dict[str, Tensor], want: dict[str, Tensor]) -> None:
    """To 1e-3 by norm, and in direction."""
    for name, expected in want.items():
        size = expected.norm()
        assert (got[name] - expected).norm() <= 1e-3 * size + 1e-7, name
        if size > 1e-6:
            assert torch.cosine_similarity(got[name].flatten(), expected.flatten(), dim=0) > 0.9999, name


@pytest.fixture(params=[False, True], ids=["by_pixel", "by_splat"])
def by_splat(request: pytest.FixtureRequest) -> Iterator[None]:
    """Runs the test with each of backward's kernels."""
    with backward_by_splat() if request.param else nullcontext():
        yield


@pytest.mark.usefixtures("by_splat")
@pytest.mark.parametrize("name", names())
def test_gradients_are_those_of_the_reference(name: str, cuda_device: str) -> None:
    """Catches a wrong or missing derivative of any input, and sums that miss a patch, a lane or a camera."""
    exact, single = case(name), case(name, torch.float32, cuda_device)
    sure = decided(exact)
    assert_gradients_close(gradients(single, cuda_device, sure), gradients(exact, "reference", sure))


@pytest.mark.usefixtures("by_splat")
def test_many_tiles_and_rounds(cuda_device: str) -> None:
    """Catches what shows only with more than 32 splats a tile and several tiles: staging rounds, offsets, sort keys."""
    g = torch.Generator().manual_seed(3)
    N, width, height = (3_000, 230, 170) if cuda_device == "cuda" else (300, 50, 40)
    exact = gaussians(g, N, size=0.1) | camera(width, height) | {"background": torch.tensor([0.1, 0.5, 0.9])}
    exact["opacities"] = exact["opacities"] * 0.3  # deep: many splats a pixel
    exact = {k: v.double() if isinstance(v, Tensor) else v for k, v in exact.items()}
    single = {k: v.to(cuda_device, torch.float32) if isinstance(v, Tensor) else v for k, v in exact.items()}
    want, got = rasterize(**exact, backend="reference"), rasterize(**single, backend=cuda_device)
    error = (got.image.cpu().double() - want.image).abs().amax(-1)
    # A decision that rounding flips changes a pixel by up to 1/255: a handful of the millions made.
    assert error.quantile(0.999) < 1e-4
    assert error.max() < 1 / 255
    weight = (error < 1e-4).double()
    assert_gradients_close(gradients(single, cuda_device, weight), gradients(exact, "reference", weight))


@pytest.mark.usefixtures("by_splat")
@pytest.mark.parametrize("name", ["random", "opaque_stack", "three_cameras", "five_channels", "beta"])
def test_order_of_threads_does_not_matter(name: str, cuda_device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a missing barrier: by the shim, a thread would read what another has not written yet, or has over."""
    if cuda_device != "cpu":
        pytest.skip("the order of threads can be chosen on the shim only; on a GPU, racecheck looks for races")
    arguments, found = case(name, torch.float32), []
    image, target = torch.rand(40, 20, 3).requires_grad_(), torch.rand(40, 20, 3)
    for reversed_ in (False, True):
        if reversed_:
            monkeypatch.setenv("GSBENCH_SHIM_REVERSED", "1")
        output = rasterize(**arguments, backend=cuda_device)
        every = torch.ones(output.alpha.shape[:-1])
        grads = gradients(arguments, cuda_device, every)
        loss = l1_ssim(image, target, 0.2)
        (g_image,) = torch.autograd.grad(loss, image)
        found.append([output.image, output.alpha, loss, g_image, *grads.values()])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("means", torch.nan, "means: expected finite"), ("factors", torch.inf, "factors: expected finite"),
     ("opacities", 1.5, "opacities: expected values in"), ("colors", -torch.inf, "colors: expected finite"),
     ("viewmats", torch.nan, "viewmats: expected finite"), ("Ks", 0.0, "Ks: expected positive"),
     ("background", torch.nan, "background: expected finite"), ("shapes", 0.0, "shapes: expected exponents above 0"),
     ("shapes", torch.inf, "shapes: expected finite")],
)  # fmt: skip
def test_bad_values_are_named(name: str, value: float, said: str, cuda_device: str) -> None:
    """Catches a value that is found late, as a picture of NaN, because the door does not wait for the device."""
    arguments = case("beta_of_three_cameras", torch.float32, cuda_device)
    arguments[name].view(-1)[0] = value
    with pytest.raises(InputError, match=said):
        rasterize(**arguments, backend=cuda_device)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (16, 16), (37, 50), (5, 70)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_loss_is_the_reference(height: int, width: int, weight: float, cuda_device: str) -> None:
    """Catches a wrong window, border, weight or derivative, at sizes that are no multiple of a tile."""
    g = torch.Generator().manual_seed(height)
    target = torch.rand(height, width, 3, generator=g)
    image = (target + 0.2 * torch.randn(height, width, 3, generator=g)).double().requires_grad_()
    expected = photometric(image, target.double(), weight)
    expected.backward()
    single = image.detach().float().to(cuda_device).requires_grad_()
    loss = l1_ssim(single, target.to(cuda_device), weight)
    loss.backward()
    assert abs(loss.item() - expected.item()) < 1e-5
    assert_gradients_close({"image": single.grad.cpu().double()}, {"image": image.grad})
    with torch.no_grad():
        assert l1_ssim(single, target.to(cuda_device), weight).item() == loss.item()


def test_bytes_of_a_target_have_the_bits_of_floats(cuda_device: str) -> None:
    """Catches a byte divided with another rounding, in the value or in the gradient alone."""
    random = torch.Generator().manual_seed(0)
    in_bytes = torch.randint(256, (37, 50, 3), generator=random, dtype=torch.uint8).to(cuda_device)
    image = torch.rand(37, 50, 3, generator=random).to(cuda_device).requires_grad_()
    losses = [l1_ssim(image, target, 0.2) for target in (in_bytes, to_floats(in_bytes))]
    assert losses[0].item() == losses[1].item()
    assert torch.equal(*(torch.autograd.grad(loss, image)[0] for loss in losses))


@pytest.mark.parametrize("shape", [(1,), (700, 1, 3), (300, 28)])
@pytest.mark.parametrize("step", [1.0, 30_000.0])
def test_adam_updates_what_was_drawn(shape: tuple[int, ...], step: float, cuda_device: str) -> None:
    """Catches a wrong row of a wide parameter, a bias correction lost to cancellation, and rows that should rest."""
    random = torch.Generator().manual_seed(0)
    g, p, m = (torch.randn(shape, generator=random) for _ in range(3))
    v, drawn = torch.rand(shape, generator=random), torch.rand(shape[0], generator=random) < 0.7
    expected = p.double(), m.double(), v.double()
    adam_reference(expected[0], g.double(), expected[1], expected[2], drawn, 0.01, [0.9, 0.999], 1e-15,
                   torch.tensor(step))  # fmt: skip
    actual = [x.clone().to(cuda_device) for x in (p, g, m, v, drawn, torch.tensor(step))]
    adam(*actual[:5], 0.01, [0.9, 0.999], 1e-15, actual[5])
    for index, want in zip((0, 2, 3), expected, strict=True):
        torch.testing.assert_close(actual[index].cpu().double(), want, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(actual[index].cpu()[~drawn], (p, g, m, v)[index][~drawn], rtol=0, atol=0)


def test_out_of_memory_names_the_buffer_and_the_process_lives_on(
    cuda_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches torch's own words, which say neither what the memory was for nor what to lower, and a broken state."""
    arguments, new_empty = case("random", torch.float32, cuda_device), Tensor.new_empty
    every = torch.ones(1, arguments["height"], arguments["width"])
    asked = 0

    def run(refused: int) -> dict[str, Tensor]:
        nonlocal asked
        asked = 0

        def limited(like: Tensor, *args: Any, **kwargs: Any) -> Tensor:
            nonlocal asked
            if args == (0,):  # stands for an input that is left out, and needs no memory
                return new_empty(like, *args, **kwargs)
            asked += 1
            if asked == refused:
                raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")
            return new_empty(like, *args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(Tensor, "new_empty", limited)
            return gradients(arguments, cuda_device, every)

    run(refused=0)  # what happens once a process is done with
    expected, buffers = run(refused=0), set()
    for k in range(1, asked + 1):
        with pytest.raises(torch.OutOfMemoryError) as error:
            run(refused=k)
        said = re.fullmatch("(.+) need [0-9.]+ MiB on .+: lower the image's size.+", str(error.value))
        assert said, str(error.value)
        buffers.add(said[1])
    assert buffers >= {"projected Gaussians", "lists of each tile's Gaussians", "images", "gradients",
                       "scratch space of gradients"}  # fmt: skip
    assert_gradients_close(run(refused=0), expected)
