"""Keep Gaussians at a minimum scale: a small part of a pixel of the training camera that resolves them best."""

import torch
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.scenes import Camera
from gsbench.train.checkpoint import tensor

# The rasterizer adds 0.3 px^2 to every projected covariance (eps2d); a standard deviation of 0.05 px changes that by
# less than 1 %. A thinner Gaussian has the same image, so its size would follow a random walk. Mip-Splatting (Yu et al.
# 2024, section 4.1) bounds sizes by the same sampling rate.
LEAST_PIXELS = 0.05


class MinimumScale:
    """The minimum scale of each Gaussian: LEAST_PIXELS pixels in the training camera that sees the Gaussian largest."""

    def __init__(self, model: GaussianModel, cameras: list[Camera]) -> None:
        """Measure the minimum scales of `model`, which is initialised and on its device, for the training `cameras`."""
        self.model = model
        self.centers = torch.stack([camera.center for camera in cameras])  # [C, 3]
        self.focal = torch.stack([camera.K[[0, 1], [0, 1]].amax() for camera in cameras])  # [C] pixels
        self.update()

    @torch.no_grad()
    def update(self) -> None:
        """Measure the minimum scales again, after Gaussians were moved, added or removed."""
        means = self.model.splats["means"]
        pixel = means.new_full((len(means),), torch.inf)  # [N] width of a pixel at the Gaussian's distance, world units
        for center, focal in zip(self.centers, self.focal, strict=True):
            pixel = torch.minimum(pixel, (means - center).norm(dim=-1) / focal)
        self.least = LEAST_PIXELS * pixel

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Keep the minimum scales of the given rows until they are measured again."""
        self.least = self.least[rows]

    @torch.no_grad()
    def hold(self) -> None:
        """Raise sizes that are below the minimum scales."""
        self.model.hold_sizes(self.least)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the minimum scales, for the checkpoint."""
        return {"least": self.least}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from the `state_dict` of a checkpoint; raises InputError if it is not of this many Gaussians."""
        means = self.model.splats["means"]
        self.least = tensor(state, "least", means.shape[:1], means.dtype)
