"""Undo the distortion of a camera's lens with OpenCV, so that its image is that of a pinhole camera."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.scenes.images import Pixels

_HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel centres are at +0.5 here, and at integers in OpenCV
_LEAST_RATIO = 1.1  # below it, an image whose sides are not exactly in one ratio to the camera's may have been cropped
_OUTSIDE = 2.0  # pixels that OpenCV's rectangle without blank pixels may exceed the image, as it samples the border


@dataclass(frozen=True)
class Lens:
    """Hold the intrinsics of a camera, in pixels of the full image, and the distortion of its lens."""

    width: int
    height: int
    K: NDArray[np.float64]  # [3, 3] pixel centres at +0.5
    distortion: tuple[float, float, float, float]  # k1, k2 (radial), p1, p2 (tangential), as in OpenCV

    @property
    def key(self) -> tuple[object, ...]:
        """What is equal for equal lenses."""
        return (self.width, self.height, *self.K.ravel().tolist(), *self.distortion)

    def resized(self, width: int, height: int) -> "Lens | None":
        """Return the lens of an image of width x height pixels, which was resized from the camera's by one ratio.

        The sides of the image may be rounded. None: its sides have two ratios to the camera's, so that it was cropped
        or is of another camera.
        """
        if (width, height) == (self.width, self.height):
            return self
        ratio = max(self.width / width, width / self.width)
        is_exact = width * self.height == height * self.width
        off = min(abs(self.height * width / self.width - height), abs(self.width * height / self.height - width))
        if not is_exact and not (ratio > _LEAST_RATIO and off < 1):
            return None
        scale = np.diag([width / self.width, height / self.height, 1])
        return replace(self, width=width, height=height, K=scale @ self.K)

    def pinhole(self) -> NDArray[np.float64]:  # [3, 3]
        """Return the intrinsics of the undistorted image, which has the same size; without distortion K itself.

        The image shows the largest rectangle that has no blank pixels (`cv2.getOptimalNewCameraMatrix` with alpha = 0).
        """
        if not any(self.distortion):
            return self.K
        size = self.width, self.height
        return cv2.getOptimalNewCameraMatrix(self.K - _HALF, np.array(self.distortion), size, 0)[0] + _HALF

    def undistort(
        self,
        pixels: Pixels,  # [H, W] or [H, W, 3]
        where: str,  # the image's path, for the message
        interpolation: int = cv2.INTER_LINEAR,
    ) -> Pixels:
        """Return the image that the camera `pinhole()` sees; without distortion the image itself.

        Raises:
            InputError: the distortion has no inverse over the image.
        """
        if not any(self.distortion):
            return pixels
        size = self.width, self.height
        try:
            K = self.pinhole() - _HALF
            x, y = cv2.initUndistortRectifyMap(
                self.K - _HALF, np.array(self.distortion), np.eye(3), K, size, cv2.CV_32FC1
            )
            inside = [(at >= -_OUTSIDE) & (at <= n - 1 + _OUTSIDE) for at, n in zip((x, y), size, strict=True)]
            if K[0, 0] > 0 and K[1, 1] > 0 and all(part.all() for part in inside):
                return cv2.remap(pixels, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]
        except cv2.error:
            pass
        raise InputError(f"{where}: OpenCV cannot undo the distortion k1 k2 p1 p2 = {self.distortion}: undo it by "
                         "`colmap image_undistorter`")  # fmt: skip
