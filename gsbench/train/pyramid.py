"""Keep training views at smaller resolutions: a step early in a training needs no fine detail."""

import torch
import torch.nn.functional as F

from gsbench.scenes import Camera, View


class Pyramid:
    """The training views at every resolution that was requested; each is reduced once and kept."""

    def __init__(self, views: list[View]) -> None:
        """Start with the views as they are."""
        self.views = views
        self._reduced: dict[tuple[int, int], View] = {}

    def view(self, index: int, factor: int) -> View:
        """Return a view whose image is `factor` times smaller in width and height; 1 returns the view itself."""
        if factor == 1:
            return self.views[index]
        key = (index, factor)
        if key not in self._reduced:
            self._reduced[key] = reduced(self.views[index], factor)
        return self._reduced[key]

    def keep_only(self, factor: int) -> None:
        """Forget the views of other factors."""
        self._reduced = {key: view for key, view in self._reduced.items() if key[1] == factor}


@torch.no_grad()
def reduced(view: View, factor: int) -> View:
    """Average every factor x factor block of a view's image; incomplete blocks at the right and below are dropped.

    Pixel centres are at +0.5, so the first two rows of the intrinsics K are divided by the factor.
    """
    camera = view.camera
    width, height = camera.width // factor, camera.height // factor
    image = view.image[: height * factor, : width * factor]
    mean = F.avg_pool2d(image.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0).contiguous()
    K = camera.K.clone()
    K[:2] /= factor
    return View(view.name, Camera(camera.viewmat, K, width, height), view.time, mean)
