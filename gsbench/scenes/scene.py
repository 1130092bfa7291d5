"""Define cameras, views (a camera, a time and an image) and scenes (views by split, background, extent)."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

    viewmat: Tensor  # [4, 4] world to camera, rigid
    K: Tensor  # [3, 3] intrinsics in pixels
    width: int
    height: int

    @property
    def center(self) -> Tensor:
        """Return the camera's position in the world, [3]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def to(self, device: str) -> "Camera":
        """Return the same camera with its tensors on `device`."""
        return Camera(self.viewmat.to(device), self.K.to(device), self.width, self.height)


@dataclass(frozen=True)
class View:
    """An image with the camera and the time at which it was taken."""

    name: str  # in the data set, such as "train/r_000"
    camera: Camera
    time: float | None  # in [0, 1]; None where the data set has no time
    pixels: Tensor  # [H, W, 3] of floats in [0, 1] or of 8 bits; or [H, W, 4] of 8 bits: straight alpha ..
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # .. which is composited over this when it is looked at
    composited_alpha: Tensor | None = None  # [H, W] 8 bits, of pixels that were composited when they were loaded
    regions: Tensor | None = None  # [H, W] 8 bits: the number of the object seen in each pixel, 0 = none; None: unknown

    @property
    def alpha(self) -> Tensor | None:
        """The alpha of the image as stored, [H, W] of 8 bits; None where the image has none."""
        return self.pixels[..., 3] if self.pixels.shape[-1] == 4 else self.composited_alpha

    @property
    def image(self) -> Tensor:
        """Return the image, [H, W, 3] of floats in [0, 1]; an image of 8 bits is converted at each access.

        The result has the bits of an image that was composited when it was loaded.
        """
        if self.pixels.is_floating_point():
            return self.pixels
        # Divided by a tensor: by a number, a GPU would multiply by its reciprocal, which rounds in another way.
        values = self.pixels.float().div_(torch.full((), 255.0, device=self.pixels.device))
        if values.shape[-1] == 3:
            return values
        alpha = values[..., 3:]
        image = values[..., :3] * alpha
        if any(self.background):  # zeros would change nothing
            image.add_(values.new_tensor(self.background) * (1 - alpha)).clamp_(0, 1)
        return image

    def to(self, device: str) -> "View":
        """Return the same view with its tensors on `device`."""
        alpha, regions = (x if x is None else x.to(device) for x in (self.composited_alpha, self.regions))
        camera, pixels = self.camera.to(device), self.pixels.to(device)
        return replace(self, camera=camera, pixels=pixels, composited_alpha=alpha, regions=regions)


@dataclass(frozen=True)
class Points:
    """Initial points, given by the data set or drawn at random."""

    means: Tensor  # [P, 3]
    colors: Tensor  # [P, 3] in [0, 1]


@dataclass(frozen=True)
class Scene:
    """Everything a model is fitted to and measured on."""

    name: str
    train: list[View]
    val: list[View]
    test: list[View]
    background: tuple[float, float, float]  # the colour every image was composited over
    extent: float  # 1.1 x the radius of the training cameras around their mean (3DGS, getNerfppNorm)
    points: Points | None  # None: the data set gives none
    fingerprint: str  # SHA-256 of the files, so that a record identifies its data

    @property
    def has_time(self) -> bool:
        """Tell whether every training view has a time."""
        return all(view.time is not None for view in self.train)

    def to(self, device: str) -> "Scene":
        """Return the same scene with its views on `device`."""
        train, val, test = ([view.to(device) for view in views] for views in (self.train, self.val, self.test))
        return replace(self, train=train, val=val, test=test)


def scene_extent(
    viewmats: Tensor,  # [C, 4, 4] the training cameras
) -> float:
    """Return 1.1 x the largest distance of a camera from the cameras' mean, in world units; 0 if all are at one place.

    Source: 3DGS, `getNerfppNorm` in scene/dataset_readers.py. Learning rates of positions and the size at which a
    Gaussian splits are multiples of it.
    """
    rotations, translations = viewmats[:, :3, :3].double(), viewmats[:, :3, 3].double()
    centers = -torch.einsum("cji,cj->ci", rotations, translations)
    return 1.1 * float((centers - centers.mean(dim=0)).norm(dim=1).max())
