"""Give each training camera an affine map of its colours, which no evaluated view has (`train.camera_colors`).

    render shown to the loss = render (I + M_c) + b_c,    loss + 1e-3 sum of M_c^2 and b_c^2 over all cameras c

Cameras of an array differ in exposure and white balance, and Gaussians would learn these as if they depended on the
view. M and b start at 0, and learn from step 3,000 of the recipe on (FreeTimeGS++). Images are measured without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from gsbench.config_key import joins, key
from gsbench.train.hooks import Hook, ImageMap, LossTerm, TrainedGroup, Training

if TYPE_CHECKING:
    from torch import Tensor

    from gsbench.scenes import View

START = 3_000  # step of the recipe
RATE = 1e-3
WEIGHT = 1e-3  # of the sum of squares


@joins("train")
@dataclass
class CameraColorsKey:
    """The key of this hook."""

    camera_colors: bool = key(False, "an affine map of colours for each training camera", absent=False)


class CameraColors(Hook):
    """Train the maps of all cameras, and apply them to the renders that the loss compares."""

    name = "camera_colors"

    def __init__(self, training: Training) -> None:
        from torch import nn

        from gsbench.measure.regions import by_camera

        super().__init__(training)
        is_on = cast(CameraColorsKey, training.config.train).camera_colors
        cameras = by_camera(training.scene.train) if is_on else []
        # the number of each view's camera, by the view's name
        self.camera_of = {view.name: i for i, camera in enumerate(cameras) for view in camera}
        # [C, 4, 3]: the rows of M, and b below them
        self.maps = nn.Parameter(training.renderer.background.new_zeros(len(cameras), 4, 3))

    def groups(self) -> dict[str, TrainedGroup]:
        from gsbench.config import LearningRate

        return {self.name: ([self.maps], LearningRate(RATE))} if len(self.maps) else {}

    def image_maps(self, step: int, views: Sequence[View]) -> Sequence[ImageMap]:
        if not self._acts(step):
            return ()
        return (lambda image, index: in_colors_of(image, self.maps[self.camera_of[views[index].name]]),)

    def loss_terms(self, step: int, views: Sequence[View]) -> Sequence[LossTerm]:
        return ((WEIGHT, lambda _, __: self.maps.square().sum()),) if self._acts(step) else ()

    def _acts(self, step: int) -> bool:
        return len(self.maps) > 0 and self.training.schedule.within(step, START, None)

    def state_dict(self) -> dict[str, Any]:
        return {"maps": self.maps.data} if len(self.maps) else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        from gsbench.train.checkpoint import tensor

        if len(self.maps):
            self.maps.data = tensor(state, "maps", self.maps.shape, self.maps.dtype)

    def results(self) -> dict[str, Any]:
        if not len(self.maps):
            return {}
        return {self.name: {"cameras": len(self.maps), "largest_change": float(self.maps.data.abs().max())}}


def in_colors_of(
    image: Tensor,  # [.., H, W, 3]
    of_camera: Tensor,  # [4, 3]
) -> Tensor:  # [.., H, W, 3]
    """Return an image in the colours of a camera.

    Each row of pixels has a copy of the map, so that the map's gradient is added along rows and then over rows, which
    gives the same bits for any number of threads.
    """
    by_row = of_camera.repeat(image.shape[-3], 1, 1)[:, None]  # [H, 1, 4, 3]
    change = by_row[:, :, 3]
    for channel in range(3):
        change = change + image[..., channel, None] * by_row[:, :, channel]
    return image + change
