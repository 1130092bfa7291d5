"""Keep each Gaussian's scale above 0.05 pixels, and its lifetime above half the gap between training times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gsbench.train.hooks import Hook, Training

if TYPE_CHECKING:
    from torch import Tensor

# The rasterizer adds 0.3 px^2 to every projected covariance (eps2d). A standard deviation of 0.05 px changes this by
# less than 1 %, so the image of a smaller Gaussian is the same and its scale would do a random walk. Mip-Splatting (Yu
# et al. 2024, section 4.1) also limits scales by the sampling rate of the cameras.
LEAST_PIXELS = 0.05
# A Gaussian at the time of a view then keeps 61 % of its opacity until halfway to the next time. A much shorter one
# shows at one time only: it fits the views of this time, and leaves a hole at times between (docs/tuning.md).
LEAST_GAPS = 0.5


class MinimumScale(Hook):
    """Keep each Gaussian's scale above LEAST_PIXELS pixels in the training camera in which it appears largest."""

    name = "minimum_scale"

    def __init__(self, training: Training) -> None:
        import torch

        super().__init__(training)
        cameras = [view.camera for view in training.scene.train]
        self.centers = torch.stack([camera.center for camera in cameras])  # [C, 3]
        self.focal = torch.stack([camera.K[[0, 1], [0, 1]].amax() for camera in cameras])  # [C] pixels
        self.update()

    def update(self) -> None:
        """Compute the minimum scales of all Gaussians, world units."""
        means = self.training.model.splats["means"].detach()
        pixel = means.new_full((len(means),), float("inf"))  # [N] width of a pixel at the Gaussian's distance
        for center, focal in zip(self.centers, self.focal, strict=True):
            pixel = pixel.minimum((means - center).norm(dim=-1) / focal)
        self.least = LEAST_PIXELS * pixel

    def acts(self, step: int) -> bool:
        """Return whether minimum scales are computed after a step, or hold for the first time."""
        every = self.training.schedule.densify_every
        return (step + 1) % every == 0 or step % every == 0

    def after_update(self, step: int) -> None:
        self.training.model.hold_sizes(self.least)

    def after_density(self, step: int) -> None:
        """Compute the minimum scales anew as often as Gaussians are densified, since they move."""
        if (step + 1) % self.training.schedule.densify_every == 0:
            with self.training.stages("density"):
                self.update()

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        self.least = self.least[rows]
        if fresh.any():
            self.update()

    def state_dict(self) -> dict[str, Any]:
        return {"least": self.least}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        from gsbench.train.checkpoint import tensor

        means = self.training.model.splats["means"]
        self.least = tensor(state, "least", means.shape[:1], means.dtype)


class MinimumLifetime(Hook):
    """Keep each Gaussian's standard deviation in time above LEAST_GAPS of the median gap between training times."""

    name = "minimum_lifetime"

    def __init__(self, training: Training) -> None:
        """Compute the minimum; there is none if the model has no time, or the views fewer than two times."""
        import torch

        super().__init__(training)
        views = training.scene.train
        times = torch.tensor(sorted({view.time for view in views if view.time is not None}), dtype=torch.float64)
        has_gaps = "time" in training.model.observes and len(times) > 1
        self.least = LEAST_GAPS * float(times.diff().median()) if has_gaps else None

    def acts(self, step: int) -> bool:
        """Return False: the minimum is always the same, so lifetimes that were held once stay as they are."""
        return False

    def after_update(self, step: int) -> None:
        if self.least is not None:
            self.training.model.hold_lifetimes(self.least)
