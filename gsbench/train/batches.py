"""Choose the training views of each step, by random permutations, and reduce their images in early steps."""

import functools
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F

from gsbench.scenes import View


class Batches:
    """The batches of training views of a run. They depend only on the seed and the step."""

    def __init__(self, views: Sequence[View], batch_size: int, seed: int) -> None:
        """Start from the training views at full resolution."""
        self.views = views
        self.batch_size = batch_size
        self.seed = seed
        self._factor = 1
        self._reduced: dict[int, View] = {}  # by index

    def at(self, step: int, factor: int) -> list[View]:
        """Return the views of a step with images that are `factor` times smaller in width and height."""
        chosen = batch(step, len(self.views), self.batch_size, self.seed)
        if factor != self._factor:
            self._factor, self._reduced = factor, {}
        if factor == 1:
            return [self.views[i] for i in chosen]
        for i in chosen:
            if i not in self._reduced:
                self._reduced[i] = reduced(self.views[i], factor)
        return [self._reduced[i] for i in chosen]


def batch(step: int, views: int, batch_size: int, seed: int) -> list[int]:
    """Return the indices of the training views of a step, counted from 0; each epoch is a permutation of all views."""
    chosen = []
    for position in range(step * batch_size, (step + 1) * batch_size):
        epoch, place = divmod(position, views)
        chosen.append(_order(views, seed, epoch)[place])
    return chosen


@functools.lru_cache(maxsize=2)  # a batch may end one epoch and begin the next
def _order(views: int, seed: int, epoch: int) -> list[int]:
    return torch.randperm(views, generator=generator(seed, epoch)).tolist()


def generator(seed: int, *purpose: int) -> torch.Generator:
    """Return a random generator whose seed is a hash of the run's seed and more numbers, such as the step.

    Taken are (): the first Gaussians; (epoch): the order of views; (step): density control; and (step, 1): its noise.
    """
    mixed = 0
    for number in (seed, *purpose):  # a step of Knuth's linear congruential generator MMIX for each number
        mixed = (mixed * 6364136223846793005 + number + 1442695040888963407) % (1 << 63)
    return torch.Generator().manual_seed(mixed)


@torch.no_grad()
def reduced(view: View, factor: int) -> View:
    """Return a view whose image is `factor` times smaller: each pixel is the mean of factor x factor pixels.

    Incomplete blocks at the right and the bottom are dropped. The first two rows of the intrinsics K are divided by the
    factor, because pixel centres are at +0.5.
    """
    camera = view.camera
    width, height = camera.width // factor, camera.height // factor
    image = view.image[: height * factor, : width * factor]
    mean = F.avg_pool2d(image.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0).contiguous()
    K = camera.K.clone()
    K[:2] /= factor
    return View(view.name, replace(camera, K=K, width=width, height=height), view.time, mean)
