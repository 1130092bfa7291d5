"""Read the images of a scene, undo the distortion of lenses and reduce the images: shots become views.

In messages `where` is the path of an image and the file that names it.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.scenes import files, images
from gsbench.scenes.images import Pixels, Rendition, Size
from gsbench.scenes.scene import Camera, View

_HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel centres are at +0.5 here, and at integers in OpenCV
_LEAST_RATIO = 1.1  # below it, an image whose sides are not exactly in one ratio to the camera's may have been cropped
_OUTSIDE = 2.0  # pixels that OpenCV's rectangle without blank pixels may exceed the image, as it samples the border
_WIDEST = 0.1  # focal length by the image's side, a field of view of 157 degrees, which no lens without distortion has
SMALLEST = 1e-6  # pixels; smaller focal lengths become zero in single precision
_RIGID_TOLERANCE = 1e-4  # D-NeRF writes single precision: its trex is orthonormal to 2.2e-6
PINHOLE = (0.0, 0.0, 0.0, 0.0)  # the distortion of a lens that has none
MASKS = "masks"  # the folder with the object number of each pixel, in PNG files


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

    @property
    def is_odd(self) -> bool:
        """Whether K is rare for images of this size, as if it were in other units, such as parts of the width or mm."""
        size = np.array([self.width, self.height])
        middle, focal = self.K[:2, 2], self.K.diagonal()[:2]
        return bool((middle < 1).any() or (middle > size - 1).any() or (focal < _WIDEST * size).any())

    def resized(self, width: int, height: int) -> "Lens | None":
        """Return the lens of an image of width x height pixels, which was resized from the camera's by one ratio.

        The sides of the image may be rounded. None: its sides have two ratios to the camera's, so that it was cropped
        or is of another camera.
        """
        if (width, height) == (self.width, self.height):
            return self
        ratio = max(self.width / width, width / self.width)
        is_exact = width * self.height == height * self.width
        # Pixels by which a side differs from that of one ratio; either side may have been rounded.
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
        where: str,
        interpolation: int = cv2.INTER_LINEAR,
    ) -> Pixels:
        """Return the image that the camera `pinhole()` sees; without distortion the image itself."""
        if not any(self.distortion):
            return pixels
        size = self.width, self.height
        try:
            K = self.pinhole() - _HALF
            x, y = cv2.initUndistortRectifyMap(
                self.K - _HALF, np.array(self.distortion), np.eye(3), K, size, cv2.CV_32FC1
            )
            # Strong distortion gives OpenCV a mirrored camera, or pixels that the image does not have.
            inside = [(at >= -_OUTSIDE) & (at <= n - 1 + _OUTSIDE) for at, n in zip((x, y), size, strict=True)]
            if K[0, 0] > 0 and K[1, 1] > 0 and all(part.all() for part in inside):
                return cv2.remap(pixels, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]
        except cv2.error:
            pass  # is the same error
        raise InputError(
            f"{where}: OpenCV cannot undo the distortion k1 k2 p1 p2 = {self.distortion}: undo it by "
            "`colmap image_undistorter`"
        )


@dataclass(frozen=True)
class Shot:
    """Hold the checked description of an image; the image itself is not read yet."""

    path: Path
    mask: Path | None  # file of the object number of each pixel
    name: str  # of the view: relative to the folder of the scene or of the images, without suffix
    where: str  # the path and the file that names it, for messages
    time: float | None
    viewmat: Tensor  # [4, 4] float64
    lens: Lens  # its size is that of the image, or another by one ratio

    def path_in(self, root: Path) -> str:
        """Return the path relative to the scene's folder."""
        return self.path.relative_to(root).as_posix()


@dataclass(frozen=True)
class Shots:
    """Hold shots, their views in the same order, the SHA-256 of their image files, and what was decided about sizes."""

    shots: Sequence[Shot]
    views: list[View]
    digests: list[str]
    notes: list[str]

    def by_path(self, root: Path) -> dict[str, str]:
        """Return the SHA-256 of each image file by its path relative to the scene's folder."""
        return dict(zip([shot.path_in(root) for shot in self.shots], self.digests, strict=True))


def check_rigid(
    pose: NDArray[np.float64],  # [4, 4]
    where: str,
    what: str,  # such as camera-to-world
) -> None:
    """Raise InputError unless a pose is a rotation and a translation."""
    if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=_RIGID_TOLERANCE):
        raise InputError(f"{where}: expected the last row 0 0 0 1, got {pose[3].tolist()}")
    rotation = pose[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    determinant = np.linalg.det(rotation)
    if error > _RIGID_TOLERANCE or determinant < 0:
        raise InputError(
            f"{where}: expected a rigid {what} matrix (R^T R = I to {_RIGID_TOLERANCE}, det R = +1), got an "
            f"error of {error:.2g} and a determinant of {determinant:.6g}: take out scale, shear and mirroring, or "
            "write more digits"
        )


def size_of(path: Path, where: str) -> Size:
    """Return the width and height of an image file in pixels; raise InputError if it is not a whole PNG or JPEG."""
    return images.photo_size(images.read_image(path, where), where)


def read(
    shots: Sequence[Shot],  # at least one
    rendition: Rendition,
    *,
    in_8_bits: bool | None = None,  # whether pixels stay in 8 bits (not if reduced); None: those of a large scene do
    decode: Callable[[Shot, bytes], Pixels] = lambda shot, data: images.decode_photo(data, shot.where),
) -> Shots:
    """Read all images by several threads; K is scaled as the image is, by the ratio of the sizes along each axis.

    Raises:
        InputError: an image is damaged, or has another size than the first one.
    """
    first, downscale = shots[0], rendition.downscale
    data = images.read_image(first.path, first.where)
    size = images.photo_size(data, first.where)
    reduced = images.reduced_size(size, downscale, first.where)
    if in_8_bits is None:
        in_8_bits = rendition.resize is None and images.stays_in_8_bits(data, size, len(shots), downscale)

    def read_one(shot: Shot) -> tuple[View, str, bool, bool]:  # view, SHA-256, has an orientation, is opaque
        data = images.read_image(shot.path, shot.where)
        decoded = decode(shot, data)
        lens = _lens_of_image((decoded.shape[1], decoded.shape[0]), size, shot)
        if decoded.shape[2] == 4 and any(lens.distortion):
            raise InputError(
                f"{shot.where}: expected an image without alpha, as its camera has distortion: undo it by "
                "`colmap image_undistorter`"
            )
        pixels = lens.undistort(decoded, shot.where)
        is_stored = in_8_bits and pixels.dtype == np.uint8
        image = torch.from_numpy(pixels) if is_stored else images.composite(pixels, rendition, reduced)
        K = np.diag([reduced[0] / size[0], reduced[1] / size[1], 1]) @ lens.pinhole()
        camera = Camera(shot.viewmat, torch.from_numpy(K.astype(np.float32)), image.shape[1], image.shape[0])
        alpha = None if is_stored else images.alpha_of(decoded, reduced)
        regions = None if shot.mask is None else _read_mask(shot, shot.mask, lens, reduced)
        view = View(shot.name, camera, shot.time, image, rendition.background, alpha, regions)
        return view, files.digest(data), images.is_turned(data), decoded.shape[2] == 3

    # RGBA, or three floats and alpha; and a mask
    pixel_bytes = (4 if in_8_bits else 3 * 4 + 1) + any(shot.mask is not None for shot in shots)
    threads = images.count_readers(size, len(shots), downscale, first.where, pixel_bytes)
    with images.quiet_opencv(), ThreadPoolExecutor(threads) as pool:
        views, digests, turned, opaque = zip(*pool.map(read_one, shots), strict=True)
    notes = _notes(shots, size, reduced, downscale)
    if any(turned):
        notes.append(
            f"{sum(turned)} of {len(shots)} images have an EXIF orientation, which is not applied: if the "
            f"program that wrote the poses applied it, turn the pixels and remove the tag"
        )
    if any(opaque) and not all(opaque):
        notes.append(
            f"{sum(opaque)} of {len(shots)} images have no alpha and keep their own background, the others get "
            f"{rendition.background}"
        )
    return Shots(shots, list(views), list(digests), notes)


def _lens_of_image(size: Size, expected: Size, shot: Shot) -> Lens:
    """Return the lens in pixels of the image; raise InputError if its size is not its camera's or the first image's."""
    lens = shot.lens.resized(*size)
    if lens is None:
        stated, actual = f"{shot.lens.width}x{shot.lens.height}", f"{size[0]}x{size[1]}"
        raise InputError(
            f"{shot.where}: expected {stated} as its camera, or both sides resized by one ratio, "
            f"got {actual}: use the images that its camera is of, not turned, and scene.downscale",
            docs="data.md#cameras-and-images",
        )
    if size != expected:
        raise InputError(
            f"{shot.where}: expected {expected[0]}x{expected[1]} as the first image, got "
            f"{size[0]}x{size[1]}: use images of one size",
            docs="data.md#what-is-read",
        )
    return lens


def _notes(shots: Sequence[Shot], size: Size, reduced: Size, downscale: int) -> list[str]:
    """Return sentences on images that are resized, and on sizes that `downscale` does not divide."""
    notes = []
    other_sizes = sorted({(shot.lens.width, shot.lens.height) for shot in shots} - {size})
    if other_sizes:
        stated = f"{other_sizes[0][0]}x{other_sizes[0][1]}"
        notes.append(
            f"images of {size[0]}x{size[1]} are resized from those of their camera, {stated}, "
            "whose intrinsics are scaled with them"
        )
    odd = [shot for shot in shots if shot.lens.is_odd]
    if odd:
        lens = odd[0].lens
        notes.append(
            f"{len(odd)} of {len(shots)} images are of a camera whose principal point is outside of the image or whose "
            f"field of view is near 180 degrees, such as {odd[0].name}: focal lengths {lens.K[0, 0]:.6g} and "
            f"{lens.K[1, 1]:.6g}, principal point {lens.K[0, 2]:.6g} and {lens.K[1, 2]:.6g} for "
            f"{lens.width}x{lens.height}: are they in pixels of this image?"
        )
    if (reduced[0] * downscale, reduced[1] * downscale) != size:
        notes.append(
            f"images of {size[0]}x{size[1]} are reduced to {reduced[0]}x{reduced[1]}, as {downscale} does not "
            "divide their size"
        )
    return notes


def _read_mask(shot: Shot, path: Path, lens: Lens, size: Size) -> Tensor:  # [H, W] 8 bits
    """Read, undistort and reduce the mask of an image: a PNG with the number of the object in each pixel."""
    where = f"{path} (the mask of {shot.name}{shot.path.suffix}; without its folder a scene has no regions)"
    numbers = images.decode_regions(images.read_image(path, where), (lens.width, lens.height), where)
    return images.subsample(lens.undistort(numbers, where, cv2.INTER_NEAREST), size)
