"""Hold Gaussians to what the training cameras can see: no size falls below a small part of a pixel."""

import torch
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.scenes import Camera

# The rasterizer adds 0.3 px^2 to every projected covariance (eps2d), so that a standard deviation of 0.05 px changes it
# by less than 1 %; what is thinner still has the same image, and only random-walks (Mip-Splatting, Yu et al. 2024,
# section 4.1, bounds sizes by the same sampling rate, from above in frequency).
LEAST_PIXELS = 0.05


class Floor:
    """The least size of each Gaussian in space: LEAST_PIXELS where the training camera that sees it largest stands."""

    def __init__(self, model: GaussianModel, cameras: list[Camera]) -> None:
        """Hold `model`, initialised and on its device, to what `cameras` can see."""
        self.model = model
        self.centers = torch.stack([camera.center for camera in cameras])  # [C, 3]
        self.focal = torch.stack([camera.K[[0, 1], [0, 1]].amax() for camera in cameras])  # [C] pixels
        self.update()

    @torch.no_grad()
    def update(self) -> None:
        """Measure anew, after Gaussians were moved, added or removed."""
        means = self.model.splats["means"]
        pixel = means.new_full((len(means),), torch.inf)  # [N] its width at the Gaussian's distance, world units
        for center, focal in zip(self.centers, self.focal, strict=True):
            pixel = torch.minimum(pixel, (means - center).norm(dim=-1) / focal)
        self.least = LEAST_PIXELS * pixel

    @torch.no_grad()
    def hold(self) -> None:
        """Raise the sizes that a step took below the floor."""
        self.model.hold_sizes(self.least)

    def state_dict(self) -> Tensor:
        """What was measured last."""
        return self.least

    def load_state_dict(self, state: Tensor) -> None:
        """Go on from `state_dict`."""
        self.least = state
