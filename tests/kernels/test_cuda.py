"""What only the CUDA kernels can do wrong: order of threads, rows that rest, memory that runs out."""

import re
from typing import Any

import pytest
import torch
from raster.cases import case
from test_raster import assert_gradients_close, differentiate
from torch import Tensor

from gsbench.kernels import raster
from gsbench.kernels.library import CudaLibrary
from gsbench.kernels.loss import l1_ssim
from gsbench.kernels.raster import add_density, room_for
from gsbench.kernels.recording import Recording
from gsbench.kernels.tape import Tape
from gsbench.raster import rasterize

EVERY_PIXEL = torch.ones(()).bool()


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the kernels that Python calls from here on, again in a repetition too."""
    names, run = [], CudaLibrary._run

    def noted(library: CudaLibrary, device: torch.device, name: str, *values: Any) -> None:
        names.append(name)
        run(library, device, name, *values)

    monkeypatch.setattr(CudaLibrary, "_run", noted)
    return names


@pytest.mark.parametrize("name", ["three_cameras", "no_gaussian", "beta"])
def test_a_forward_pass_is_one_call(name, cuda_device, called):
    """Catches kernels that Python calls one by one, each with memory of its own, or again for the backward pass."""
    arguments = case(name, torch.float32, cuda_device)
    differentiate(arguments, cuda_device, EVERY_PIXEL)  # which learns how many intersections there are
    called.clear()
    differentiate(arguments, cuda_device, EVERY_PIXEL)
    assert called == ["draw", "blend_backward", "project_backward"]
    arguments["means"].requires_grad_()
    for way in (torch.no_grad, Tape):
        called.clear()
        with way():
            image = rasterize(**arguments, backend=cuda_device).image
        assert called == ["draw"]
        assert image.requires_grad == (way is Tape)


def test_too_little_memory_is_enlarged(cuda_device, called):
    """Catches intersections that are left out of an image, a call that is made twice each time, memory that stays as
    large as an image needed long ago, and a repetition that makes calls with too little memory again."""
    arguments = case("random", torch.float32, cuda_device)
    expected, gradients = differentiate(arguments, cuda_device, EVERY_PIXEL)
    (sizes,) = [key for key in raster._rooms if key[1:] == (60, arguments["width"], arguments["height"])]
    for room, calls in ((1, 2), (10**6, 1), (expected.info.pairs, 1), (2 * expected.info.pairs, 1)):
        raster._rooms[sizes] = room
        called.clear()
        output, actual = differentiate(arguments, cuda_device, EVERY_PIXEL)
        assert called == ["draw"] * calls + ["blend_backward", "project_backward"]
        assert output.info.pairs == expected.info.pairs
        assert torch.equal(output.image, expected.image)
        assert_gradients_close(actual, gradients)
        fits = expected.info.pairs <= room <= 2 * expected.info.pairs
        assert raster._rooms[sizes] == (room if fits else room_for(expected.info.pairs))
    raster._rooms[sizes] = 1
    with Recording() as recording, torch.no_grad():
        image = rasterize(**arguments, backend=cuda_device).image
    called.clear()
    image.zero_()
    recording.repeat()
    assert called == ["draw"]
    assert torch.equal(image, expected.image)


@pytest.mark.slow
def test_more_tiles_than_16_bits_can_number(cuda_device):
    """Catches tiles whose numbers are cut off, or taken for the number that stands for none."""
    C = 2**16 + 1  # images of one tile
    means = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [0.0, 0.0, -1.0]])  # the last one is behind the camera
    factors, opacities, colors = 0.1 * torch.eye(3).repeat(3, 1, 1), torch.tensor([0.9, 0.5, 0.5]), torch.eye(3)
    views = torch.eye(4), torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    arguments = [x.to(cuda_device) for x in (means, factors, opacities, colors)]
    single, many = (
        rasterize(*arguments, *[x.to(cuda_device).repeat(count, 1, 1) for x in views], 1, 1, backend=cuda_device)
        for count in (1, C)
    )
    assert single.image.any()
    assert (many.image == single.image).all()
    assert many.info.pairs == C * single.info.pairs


@pytest.mark.parametrize("name", ["random", "opaque_stack", "three_cameras", "five_channels", "beta"])
def test_order_of_threads_does_not_matter(name, cuda_device, monkeypatch):
    """Catches a missing barrier: by the shim, a thread would read what another has not written yet, or has over."""
    if cuda_device != "cpu":
        pytest.skip("the order of threads can be chosen on the shim only; on a GPU, racecheck looks for races")
    results = []
    image, target = torch.rand(40, 20, 3).requires_grad_(), torch.rand(40, 20, 3)
    for is_reversed in (False, True):
        if is_reversed:
            monkeypatch.setenv("GSBENCH_SHIM_REVERSED", "1")
        output, gradients = differentiate(case(name, torch.float32), cuda_device, EVERY_PIXEL)
        loss = l1_ssim(image, target, 0.2)
        results.append([output.image, output.alpha, loss, *torch.autograd.grad(loss, image), *gradients.values()])
    for x, y in zip(*results, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-5)


def test_out_of_memory_names_the_buffer_and_the_process_lives_on(cuda_device, monkeypatch):
    """Catches torch's own words, which say neither what the memory was for nor what to lower, and a broken state."""
    arguments, new_empty = case("random", torch.float32, cuda_device), Tensor.new_empty
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
            return differentiate(arguments, cuda_device, EVERY_PIXEL)[1]

    run(refused=0)  # what happens once a process is done with
    expected, buffers = run(refused=0), set()
    for k in range(1, asked + 1):
        with pytest.raises(torch.OutOfMemoryError) as error:
            run(refused=k)
        message = re.fullmatch("(.+) need [0-9.]+ MiB on .+: lower the image's size.+", str(error.value))
        assert message, str(error.value)
        buffers.add(message[1])
    of_images = {"projected Gaussians", "lists of each tile's Gaussians", "images"}
    assert buffers >= of_images | {"gradients", "scratch space of gradients"}
    assert_gradients_close(run(refused=0), expected)


@pytest.mark.parametrize(("C", "N"), [(1, 0), (1, 257), (3, 1000)])
def test_what_density_control_adds_up(C, N, cuda_device):
    """Catches a scale at the other axis, a camera left out, a count that starts anew, Gaussians after the last whole
    block, and sums of a step that is to be skipped; torch adds up the same on the CPU (`GradientRule.accumulate`)."""
    random = torch.Generator().manual_seed(0)
    drawn, g = torch.rand(C, N, generator=random) < 0.4, torch.randn(C, N, 2, generator=random)
    gradient, visible = torch.rand(N, generator=random), torch.full((N,), 7.0)
    unseen = torch.arange(N, dtype=torch.int32)
    wanted = torch.hypot(g[..., 0] * 50.0, g[..., 1] * 20.0).sum(0) + gradient
    for has_unseen in (True, False):
        state = [x.to(cuda_device, copy=True) for x in (gradient, visible, unseen)]
        summed = *state[:2], state[2] if has_unseen else None
        add_density(
            drawn.to(cuda_device), g.to(cuda_device), (50.0, 20.0), *summed, torch.zeros((), device=cuda_device)
        )
        torch.testing.assert_close(state[0].cpu(), wanted, rtol=1e-6, atol=0)
        assert torch.equal(state[1].cpu(), visible + drawn.sum(0))
        assert torch.equal(state[2].cpu(), (unseen + C).masked_fill(drawn.any(0), 0) if has_unseen else unseen)
        before = [x.clone() for x in state]
        add_density(drawn.to(cuda_device), g.to(cuda_device), (50.0, 20.0), *summed, torch.ones((), device=cuda_device))
        assert all(map(torch.equal, state, before))
