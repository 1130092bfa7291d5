"""Reduce the resolution of training views, for the early steps of a training, which need no fine detail."""

import torch
import torch.nn.functional as F

from gsbench.scenes import Camera, View


class Pyramid:
    """Provide the training views at several resolutions; a reduced view is cached."""

    def __init__(self, views: list[View]) -> None:
        """Store the training views at full resolution."""
        self.views = views
        self._reduced: dict[tuple[int, int], View] = {}

    def view(self, index: int, factor: int) -> View:
        """Return training view number `index` with an image that is `factor` times smaller in width and height."""
        if factor == 1:
            return self.views[index]
        key = (index, factor)
        if key not in self._reduced:
            self._reduced[key] = reduced(self.views[index], factor)
        return self._reduced[key]

    def keep_only(self, factor: int) -> None:
        """Delete the cached reduced images, except those reduced by `factor`."""
        self._reduced = {key: view for key, view in self._reduced.items() if key[1] == factor}


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
    return View(view.name, Camera(camera.viewmat, K, width, height), view.time, mean)
