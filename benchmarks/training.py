"""Make the training steps that are timed: gradients and Adam, as the trainer calls them."""

from collections.abc import Callable

import torch

from benchmarks.scene import TIME, camera
from gsbench.kernels.adam import adam_all
from gsbench.measure.speed import StageClock
from gsbench.models import GaussianModel
from gsbench.scenes import Camera, View
from gsbench.train.optim import BETAS, EPS
from gsbench.train.step import Step

RATE = 1e-9  # moves nothing


def one_view(width: int, height: int) -> View:
    """Return a view of the benchmark's scene, with a random image."""
    viewmats, Ks = camera(width, height)
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    return View("0", Camera(viewmats[0], Ks[0], width, height), TIME, target)


def training_step(fitted: GaussianModel, width: int, height: int, views: int) -> Callable[[], None]:
    """Return a call that computes the gradients of a batch on the model's device, and updates the model by Adam."""
    device = fitted.splats["means"].device.type
    batch = [one_view(width, height).to(device)] * views
    gradients = Step(fitted, torch.zeros(3, device=device), 0.2, False, StageClock(device))
    update = adam_of(fitted)

    def call() -> None:
        gradients(batch)
        update()
        for parameter in fitted.parameters():
            parameter.grad = None

    return call


def adam_of(fitted: GaussianModel) -> Callable[[], None]:
    """Return a call that updates all parameters with a gradient: by the kernel if it serves them, else by torch.

    `gsbench.train.optim.Optimizer` chooses the same way.
    """
    parameters = [p for p in fitted.parameters() if p.requires_grad]
    if not fitted.backend.serves(parameters[0]):
        return torch.optim.Adam(parameters, lr=RATE, betas=BETAS, eps=EPS, fused=True).step
    states = [(p, torch.zeros_like(p), torch.zeros_like(p), p.new_zeros(())) for p in parameters]
    rate = parameters[0].new_tensor(RATE)

    def call() -> None:
        learning = [state for state in states if state[0].grad is not None]
        gradients = [p.grad for p, *_ in learning]
        updated, means, squares, steps = ([state[i] for state in learning] for i in range(4))
        adam_all(updated, gradients, means, squares, steps, [rate] * len(learning), BETAS, EPS)

    return call
