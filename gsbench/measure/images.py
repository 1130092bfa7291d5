"""Make 8-bit images, error maps and comparison images (render | ground truth | error), and write PNG files."""

import base64
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from gsbench.measure.atomic import write_atomically

ERROR_SCALE = 0.2  # the error that has the brightest colour, equal for all images, so that they can be compared
STEPS = 255  # of 8 bits between black and white
ROUNDING_SCALE = 1e-6, 1.0  # steps of 8 bits, 1/255: the ends of the log scale for errors of float32
LEAST_WIDTH = 240  # pixels per column; a smaller image is enlarged by an integer factor, without smoothing
HEADER = 44  # pixels
GAP = 4  # pixels; grey, because the background is often white
GREY = 200

Pixels = npt.NDArray[np.uint8]


def strip(rows: list[tuple[npt.ArrayLike, npt.ArrayLike]]) -> Pixels:
    """Make a comparison image of renders and ground truths, uint8 [H', W', 3] RGB.

    Each (render, truth) pair, two images [H, W, 3] in [0, 1], is one row; there is at least one, and all have one size.
    The third column shows the absolute error (mean over RGB), from black for no error to bright yellow for 0.2 or more.
    A header names the columns and shows this scale.
    """
    pairs = [(np.asarray(render, np.float32), np.asarray(truth, np.float32)) for render, truth in rows]
    width = pairs[0][0].shape[1]
    factor = enlargement(width)
    picture = [_header(width * factor)]
    gap = np.full((GAP, picture[0].shape[1], 3), GREY, np.uint8)
    for render, truth in pairs:
        picture += [in_a_row([to_bytes(render), to_bytes(truth), error_image(render, truth)], factor), gap]
    return np.concatenate(picture[:-1])


def enlargement(width: int) -> int:
    """Return the factor by which `strip` enlarges images of a width in pixels."""
    return -(-LEAST_WIDTH // width)  # rounded up


def error_image(render: npt.NDArray[np.float32], truth: npt.NDArray[np.float32]) -> Pixels:  # [H, W, 3], each
    """Return an image of the absolute error (mean over RGB).

    Black is no error, bright yellow an error of 0.2 or more, and magenta marks NaN.
    """
    error = np.abs(np.clip(render, 0, 1) - np.clip(truth, 0, 1)).mean(-1)
    shown = inferno(np.nan_to_num(error) / ERROR_SCALE)
    shown[np.isnan(error)] = (255, 0, 255)
    return shown


def to_bytes(image: npt.NDArray[np.float32]) -> Pixels:  # [H, W, 3]
    """Convert an image from [0, 1] (clamped) to 8 bits; pixels that are NaN become magenta."""
    shown = (np.clip(np.nan_to_num(image), 0, 1) * 255).round().astype(np.uint8)
    shown[np.isnan(image).any(-1)] = (255, 0, 255)
    return shown


def inferno(values: npt.NDArray[np.floating]) -> Pixels:  # [H, W]
    """Convert values in [0, 1] (clamped) to the colours [H, W, 3] of OpenCV's colour map "inferno", RGB."""
    levels = (np.clip(values, 0, 1) * 255).round().astype(np.uint8)
    return np.asarray(cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB), np.uint8)


def rounding_image(values: npt.NDArray[np.float64]) -> Pixels:  # [H, W]
    """Return an image of errors of float32, or of bounds on them, in steps of 8 bits, on the log scale of all images.

    Black is an error of 1e-6 steps or less, bright yellow a whole step or more.
    """
    least, most = np.log(ROUNDING_SCALE)
    return inferno((np.log(np.maximum(values, ROUNDING_SCALE[0])) - least) / (most - least))


def write_png(image: Pixels, path: Path) -> None:  # [H, W, 3] RGB
    """Write `image` to `path` as PNG, atomically."""
    write_atomically(path, png(image))


def png(image: Pixels) -> bytes:  # [H, W, 3] RGB
    """Return an image as the bytes of a PNG file."""
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def data_url(image: Pixels) -> str:  # [H, W, 3] RGB
    """Return an image as PNG in a `data:` URL, which HTML can hold."""
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"


def reduced(image: Pixels, most: int, *, by_longer_side: bool = False) -> Pixels:  # [H, W, 3]
    """Reduce an image to `most` pixels of width, or of its longer side; a smaller image stays as it is."""
    height, width = image.shape[:2]
    factor = most / (max(height, width) if by_longer_side else width)
    if factor >= 1:
        return image
    size = max(1, round(factor * width)), max(1, round(factor * height))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def in_a_row(images: list[Pixels], factor: int) -> Pixels:
    """Enlarge images of one size by an integer factor, and put them side by side with gaps between them."""
    large = [image.repeat(factor, 0).repeat(factor, 1) for image in images]
    gap = np.full((large[0].shape[0], GAP, 3), GREY, np.uint8)
    return np.concatenate([part for image in large for part in (gap, image)][1:], 1)


def _header(width: int) -> Pixels:
    """Return the header of a comparison image: the titles of three columns of `width` pixels, and the error scale.

    Titles are above the scale, at rows 26 to 38, which leaves 16 pixels for its label on the left and 64 on the right.
    """
    header = np.full((HEADER, 3 * width + 2 * GAP, 3), 255, np.uint8)
    titles = ("render", "ground truth", "absolute error, mean of RGB")
    for column, title in enumerate(titles):
        write_text(header, title, column * (width + GAP) + 6, 16)
    left, right = 2 * (width + GAP) + 6, 3 * width + 2 * GAP - 64
    header[26:38, left + 16 : right] = inferno(np.linspace(0, 1, right - left - 16)[None].repeat(12, 0))
    write_text(header, "0", left, 37)
    write_text(header, f">= {ERROR_SCALE}", right + 6, 37)
    return header


def write_text(image: Pixels, text: str, x: int, y: int) -> None:
    """Write a line of text into an image; (x, y) is its lower left corner."""
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
