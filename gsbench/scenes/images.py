"""Read PNG and JPEG images and videos: check the file, decode it, composite it over the background, reduce its size.

A file that is damaged or of another kind raises `InputError`; `where` is its path, and the file that names it.
"""

import io
import os
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.process.memory import available, require
from gsbench.reading import read_file

# FFmpeg prints nothing, as an error of ours says what is wrong; OpenCV reads this at the first video of a process.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
Pixels = NDArray[np.uint8] | NDArray[np.uint16]
Size = tuple[int, int]  # width and height, pixels
Color = tuple[float, float, float]  # RGB in [0, 1]


@dataclass(frozen=True)
class Rendition:
    """Hold how the images of a scene are composited and reduced; see `gsbench.scenes.load`."""

    downscale: int
    background: Color
    resize: str | None = None  # one of gsbench.scenes.RESIZES


class DamagedError(InputError):
    """The bytes of a file are not those of a whole image."""


class Kind(NamedTuple):
    """Describe the colour types and bit depths of PNG files that are accepted."""

    depths: dict[int, tuple[int, ...]]  # accepted bits per channel, by the colour type of PNG
    words: str  # description for error messages


COLORS = Kind({2: (8, 16), 6: (8, 16), 3: (1, 2, 4, 8)}, "8- or 16-bit RGB or RGBA")  # 3: a palette of RGB
NUMBERS = Kind({0: (8,)}, "8-bit grey, the number of the object in each pixel")
_DEPTH_AT = 24  # index of the byte of a PNG that has the bits per channel; its colour type follows
DECODING = 64  # bytes per pixel while an image is decoded and composited; measured: 48 for 8 bits, 52 for 16
# The images of a scene are stored as floats if all together need at most this many bytes, else in 8 bits. To convert an
# image of 800 x 800 from 8 bits takes 6 ms on one thread. With 160 x 160 it would take 0.2 ms of a step of 6 ms.
_MOST_FLOATS = 1 << 29  # bytes
_MAX_FILE = 1 << 30  # bytes; the largest accepted image has 2^29 bytes before compression
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_ORIENTATION = 274  # number of the tag of EXIF
_MAX_PIXELS = 2**26  # a PNG of a few kilobytes can claim gigabytes of pixels; no data set has more than 8192 x 8192


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence the log messages of OpenCV on stderr within a `with` block; errors are raised as InputError instead."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)


@contextmanager
def open_video(path: Path) -> Iterator[cv2.VideoCapture]:
    """Open a video within a `with` block; OpenCV prints nothing."""
    with quiet_opencv():
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        try:
            yield video
        finally:
            video.release()


def video_frames(path: Path, moments: list[float] | None = None) -> Generator[Pixels, None, None]:  # [H, W, 3]
    """Yield the frames of a video, as far as OpenCV can read it; append their milliseconds to `moments`."""
    with open_video(path) as video:
        while video.grab():
            is_read, frame = video.retrieve()
            if is_read:
                if moments is not None:
                    moments.append(video.get(cv2.CAP_PROP_POS_MSEC))
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)  # type: ignore[misc]  # OpenCV's stubs: any dtype


def read_image(path: Path, where: str) -> bytes:
    """Return the bytes of an image file; raise InputError if the file is missing, too large or not a regular file."""
    return read_file(path, where, _MAX_FILE)


def photo_size(data: bytes, where: str) -> Size:
    """Return the width and height of a PNG, checked as by `png_size`, or of a JPEG, of which the header is checked."""
    if data.startswith(_SIGNATURE):
        return png_size(data, where)
    if not data.startswith(_JPEG):
        raise DamagedError(
            f"{where}: expected a PNG or a JPEG, the file begins with {data[:8]!r}: convert it, or copy it again"
        )
    with _opened(data, where) as image:
        if image.mode != "RGB":
            raise InputError(f"{where}: expected a JPEG of RGB, got one of {image.mode}: convert it")
        return _check_size(image.size, where)


def is_turned(data: bytes) -> bool:  # of an image that was checked
    """Return whether an image has an EXIF orientation by which other programs turn or mirror it."""
    with suppress(InputError), _opened(data, "EXIF") as image:  # nothing is read of a damaged part
        # The method of a PNG would decode the pixels, to find what stands behind them.
        return Image.Image.getexif(image).get(_ORIENTATION) in range(2, 9)  # 1: stored as it is shown; 0: unknown
    return False


def png_size(data: bytes, where: str, kind: Kind = COLORS) -> Size:
    """Return the width and height of a PNG after checking the length and checksum of all chunks, without decoding."""
    if not data.startswith(_SIGNATURE):
        raise DamagedError(f"{where}: expected a PNG, the file begins with {data[:8]!r}")
    with _opened(data, where) as image:
        size = image.size
        image.verify()
    depth, color = data[_DEPTH_AT : _DEPTH_AT + 2]
    if depth not in kind.depths.get(color, ()):
        raise InputError(f"{where}: expected {kind.words}, got PNG's colour type {color} of {depth} bits: convert it")
    return _check_size(size, where)


def reduced_size(size: Size, downscale: int, where: str) -> Size:
    """Return the width and height of an image that is reduced `downscale` times, each rounded, halves up."""
    width, height = ((2 * side + downscale) // (2 * downscale) for side in size)
    if not width or not height:
        raise InputError(
            f"{where}: expected a downscale that leaves pixels, got downscale={downscale} for {size[0]}x{size[1]}"
        )
    return width, height


def stays_in_8_bits(
    data: bytes,  # of the first image of a scene, which was checked
    size: Size,
    count: int,
    downscale: int,
) -> bool:
    """Return whether the images of a scene are stored in 8 bits to save memory, and composited at each access.

    This is so for a large scene of 8-bit images that are not reduced.
    """
    is_8_bits = data.startswith(_JPEG) or data[_DEPTH_AT] == 8
    float_bytes = 3 * 4 * count * size[0] * size[1]
    return downscale == 1 and is_8_bits and float_bytes > _MOST_FLOATS


def count_readers(
    size: Size,  # of an image before the reduction
    count: int,  # of images
    downscale: int,
    where: str,
    pixel_bytes: int = 12,  # bytes a pixel of the reduced image
) -> int:
    """Return how many threads can decode at the same time in the memory that all reduced images leave free."""
    pixels = size[0] * size[1]
    kept_bytes, decoding_bytes = count * pixel_bytes * pixels // downscale**2, DECODING * pixels
    what = f"{where}: {count} images of {size[0]}x{size[1]}, reduced {downscale} times,"
    require(kept_bytes + decoding_bytes, what, "use a larger scene.downscale or fewer images")
    free = available()
    threads = os.cpu_count() or 1
    return threads if free is None else max(1, min(threads, (free - kept_bytes) // decoding_bytes))


def decode_photo(data: bytes, where: str) -> Pixels:  # [H, W, 3|4] RGB or RGBA, as stored: straight alpha
    """Decode an 8- or 16-bit PNG, or a JPEG; an EXIF orientation is ignored, as COLMAP ignores it.

    The file is checked first, because OpenCV may fill the missing rows of a truncated PNG with black.
    """
    photo_size(data, where)
    if data.startswith(_JPEG):
        with _opened(data, where) as image:  # Pillow, because OpenCV fills the missing rows of a JPEG with grey
            return np.array(image)
    pixels = _decode(data, where)
    if pixels.ndim != 3 or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{where}: expected 8- or 16-bit RGB or RGBA, got {pixels.dtype} of shape {pixels.shape}")
    to_rgb = cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(pixels, to_rgb)  # type: ignore[return-value]  # OpenCV's stubs do not keep the dtype


def decode_regions(data: bytes, size: Size, where: str) -> NDArray[np.uint8]:  # [H, W]
    """Decode a mask, an 8-bit grey PNG with the number of the object in each pixel."""
    width, height = png_size(data, where, NUMBERS)
    if (width, height) != size:
        raise InputError(f"{where}: expected {size[0]}x{size[1]} as the image of this mask, got {width}x{height}")
    return _decode(data, where)


def subsample(numbers: Pixels, size: Size) -> Tensor:  # [H, W] the number of the object in each pixel -> [h, w] 8 bits
    """Reduce a mask: each pixel has the number at its centre."""
    rows, columns = (
        (2 * np.arange(after) + 1) * before // (2 * after)  # (i + 1/2) before / after, rounded down
        for before, after in zip(numbers.shape, size[::-1], strict=True)
    )
    return torch.from_numpy(numbers[rows[:, None], columns])


def alpha_of(pixels: Pixels, size: Size) -> Tensor | None:  # [H, W, 3|4] as stored -> [h, w] 8 bits
    """Return the alpha channel of an image, reduced by averaging; None for an image without alpha."""
    if pixels.shape[2] == 3:
        return None
    alpha: NDArray[Any] = pixels[..., 3].astype(np.float32) * np.float32(255 / np.iinfo(pixels.dtype).max)
    if size != alpha.shape[::-1]:
        alpha = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.rint(alpha).astype(np.uint8))


def composite(
    pixels: Pixels | NDArray[np.float32],  # [H, W, 3|4] RGB or RGBA, straight alpha; floats are in [0, 1]
    rendition: Rendition,
    size: Size,  # after the reduction
) -> Tensor:  # [h, w, 3] float32 in [0, 1]
    """Composite an image with straight alpha over a background colour, then reduce it: a pixel is the mean of its area.

    The order matters: if colours and alpha were averaged separately, the arbitrary colours of transparent pixels would
    show at silhouettes. With `resize="pillow"` the composite is truncated to 8 bits and reduced by Pillow's bicubic
    filter, as in the code of 3DGS and of methods derived from it.
    """
    background = rendition.background
    if rendition.resize == "pillow":
        unreduced = Image.fromarray(_composite_8_bits(pixels, background))
        reduced = unreduced.resize(size, Image.Resampling.BICUBIC)
        return torch.from_numpy(np.array(reduced)).float() / 255
    values = pixels.astype(np.float32) / np.float32(_white(pixels))
    image: NDArray[Any] = values[..., :3]
    if pixels.shape[2] == 4:
        alpha = values[..., 3:]
        image = image * alpha + np.asarray(background, np.float32) * (1 - alpha)
    if size != (image.shape[1], image.shape[0]):  # with an integer factor INTER_AREA is the mean of each block
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.clip(image, 0, 1))  # float rounding may leave [0, 1] by an ulp


def reduce_8_bits(
    pixels: Pixels,  # [H, W, 3] of 8 bits
    rendition: Rendition,
    size: Size,  # after the reduction
) -> Pixels:  # [h, w, 3] of 8 bits
    """Reduce an opaque image as `composite` does, and round it to 8 bits."""
    if rendition.resize == "pillow":
        return np.array(Image.fromarray(pixels).resize(size, Image.Resampling.BICUBIC))
    if size == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def _white(pixels: NDArray[Any]) -> float:
    """Return the value of white in an image: 1 for floats."""
    return np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0


def _composite_8_bits(
    pixels: Pixels | NDArray[np.float32],  # [H, W, 3|4] RGB or RGBA, straight alpha
    background: Color,
) -> NDArray[np.uint8]:  # [H, W, 3]
    """Composite an image in double precision and truncate it to 8 bits; one channel at a time, to save memory."""
    most = _white(pixels)
    alpha = pixels[..., 3] / most if pixels.shape[2] == 4 else np.float64(1)
    composited = np.empty((*pixels.shape[:2], 3), np.uint8)
    for channel, color in enumerate(background):
        composited[..., channel] = (pixels[..., channel] / most * alpha + color * (1 - alpha)) * 255
    return composited


@contextmanager
def _opened(data: bytes, where: str) -> Iterator[Image.Image]:
    """Open a PNG or a JPEG within a `with` block; what Pillow raises there is raised as DamagedError."""
    form = "JPEG" if data.startswith(_JPEG) else "PNG"
    try:
        with Image.open(io.BytesIO(data), formats=(form,)) as image:
            yield image
    except (InputError, MemoryError):
        raise
    except Exception as error:  # Pillow raises many types of exceptions for damaged files
        why = "its header" if isinstance(error, UnidentifiedImageError) else one_line(error)[:80]
        raise DamagedError(f"{where}: damaged {form} ({why}): copy it again") from None


def _decode(data: bytes, where: str) -> NDArray[Any]:
    """Decode a checked PNG with OpenCV; raise InputError if OpenCV fails."""
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError(f"{where}: OpenCV has none for its pixels") from None
        raise DamagedError(f"{where}: OpenCV cannot decode this PNG: copy or render it again") from error
    if pixels is None:
        raise DamagedError(f"{where}: OpenCV cannot decode this PNG: copy or render it again")
    return pixels


def _check_size(size: Size, where: str) -> Size:
    """Return the size of an image; raise InputError if it has too many pixels."""
    if size[0] * size[1] > _MAX_PIXELS:
        raise InputError(f"{where}: expected at most {_MAX_PIXELS} pixels, its size is {size[0]}x{size[1]}: resize it")
    return size
