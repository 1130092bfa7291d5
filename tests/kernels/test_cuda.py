"""What only the CUDA kernels can do wrong: order of threads, rows that rest, memory that runs out."""

import re
from contextlib import nullcontext
from typing import Any

import pytest
import torch
from raster.cases import case
from test_raster import assert_gradients_close, differentiate
from torch import Tensor

from gsbench.kernels.loss import l1_ssim
from gsbench.kernels.raster import add_density, backward_by_splat

EVERY_PIXEL = torch.ones(()).bool()


@pytest.mark.parametrize("kernel", [nullcontext, backward_by_splat])
@pytest.mark.parametrize("name", ["random", "opaque_stack", "three_cameras", "five_channels", "beta"])
def test_order_of_threads_does_not_matter(
    name: str, kernel: Any, cuda_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a missing barrier: by the shim, a thread would read what another has not written yet, or has over."""
    if cuda_device != "cpu":
        pytest.skip("the order of threads can be chosen on the shim only; on a GPU, racecheck looks for races")
    results = []
    image, target = torch.rand(40, 20, 3).requires_grad_(), torch.rand(40, 20, 3)
    for is_reversed in (False, True):
        if is_reversed:
            monkeypatch.setenv("GSBENCH_SHIM_REVERSED", "1")
        with kernel():
            output, gradients = differentiate(case(name, torch.float32), cuda_device, EVERY_PIXEL)
        loss = l1_ssim(image, target, 0.2)
        results.append([output.image, output.alpha, loss, *torch.autograd.grad(loss, image), *gradients.values()])
    for x, y in zip(*results, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-5)


def test_out_of_memory_names_the_buffer_and_the_process_lives_on(
    cuda_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert buffers >= {
        "projected Gaussians",
        "lists of each tile's Gaussians",
        "images",
        "gradients",
        "scratch space of gradients",
    }
    assert_gradients_close(run(refused=0), expected)


@pytest.mark.parametrize(("C", "N"), [(1, 0), (1, 257), (3, 1000)])
def test_what_density_control_adds_up(C: int, N: int, cuda_device: str) -> None:
    """Catches a scale at the other axis, a camera left out, a count that starts anew, and Gaussians after the last
    whole block; torch adds up the same on the CPU (`GradientRule.accumulate`)."""
    random = torch.Generator().manual_seed(0)
    drawn, g = torch.rand(C, N, generator=random) < 0.4, torch.randn(C, N, 2, generator=random)
    gradient, visible = torch.rand(N, generator=random), torch.full((N,), 7.0)
    unseen = torch.arange(N, dtype=torch.int32)
    wanted = torch.hypot(g[..., 0] * 50.0, g[..., 1] * 20.0).sum(0) + gradient
    for has_unseen in (True, False):
        state = [x.to(cuda_device, copy=True) for x in (gradient, visible, unseen)]
        add_density(
            drawn.to(cuda_device), g.to(cuda_device), (50.0, 20.0), *state[:2], state[2] if has_unseen else None
        )
        torch.testing.assert_close(state[0].cpu(), wanted, rtol=1e-6, atol=0)
        assert torch.equal(state[1].cpu(), visible + drawn.sum(0))
        assert torch.equal(state[2].cpu(), (unseen + C).masked_fill(drawn.any(0), 0) if has_unseen else unseen)
