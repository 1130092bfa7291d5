"""Keep the scale of each Gaussian above 0.05 pixels in the training camera in which it appears largest."""

import torch
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.scenes import Camera
from gsbench.train.checkpoint import tensor

# The rasterizer adds 0.3 px^2 to every projected covariance (eps2d). A standard deviation of 0.05 px changes this by
# less than 1 %, so the image of a smaller Gaussian is the same and its scale would do a random walk. Mip-Splatting (Yu
# et al. 2024, section 4.1) also limits scales by the sampling rate of the cameras.
LEAST_PIXELS = 0.05


class MinimumScale:
    """Keep each Gaussian's scale above a minimum: LEAST_PIXELS pixels in the camera in which it appears largest."""

    def __init__(self, model: GaussianModel, cameras: list[Camera]) -> None:
        """Compute the minimum scales of the Gaussians of an initialised model for the training cameras."""
        self.model = model
        self.centers = torch.stack([camera.center for camera in cameras])  # [C, 3]
        self.focal = torch.stack([camera.K[[0, 1], [0, 1]].amax() for camera in cameras])  # [C] pixels
        self.update()

    @torch.no_grad()
    def update(self) -> None:
        """Compute the minimum scales of all Gaussians again, after Gaussians were moved, added or removed."""
        means = self.model.splats["means"]
        pixel = means.new_full((len(means),), torch.inf)  # [N] width of a pixel at the Gaussian's distance, world units
        for center, focal in zip(self.centers, self.focal, strict=True):
            pixel = torch.minimum(pixel, (means - center).norm(dim=-1) / focal)
        self.least = LEAST_PIXELS * pixel

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Reorder the minimum scales after Gaussians were added or removed; `update` computes them again."""
        self.least = self.least[rows]

    @torch.no_grad()
    def hold(self) -> None:
        """Raise the scales of Gaussians that are below their minimum scale to this minimum."""
        self.model.hold_sizes(self.least)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the minimum scales of all Gaussians, for the checkpoint."""
        return {"least": self.least}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the minimum scales from a checkpoint; raises InputError if the number of Gaussians differs."""
        means = self.model.splats["means"]
        self.least = tensor(state, "least", means.shape[:1], means.dtype)
