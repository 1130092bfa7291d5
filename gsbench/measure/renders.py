"""Read the images or the video that another program rendered, and match them to the evaluated views.

All files are checked before the first one is measured; then one image at a time is in memory.
"""

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.measure.record import Renders
from gsbench.scenes import View
from gsbench.scenes.files import fingerprint, without_suffix
from gsbench.scenes.images import Pixels, Rendition, composite, decode_photo, photo_size, read_image, video_frames

SUFFIXES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".npy": "floats"}
HOW_TO = "report.md#renders-of-other-programs"
# The first bytes of MP4 (after four), Matroska, WebM and AVI. A playlist, which FFmpeg reads too, names other files.
VIDEO_STARTS = (b"....ftyp", b"\x1aE\xdf\xa3", b"RIFF")
PNG_DEPTH_AT = 24  # index of the byte of a PNG that has the bits per channel
MOST_MEAN = 1.0  # of an image of floats; in [0, 255] it is larger. Single values may be above 1
LEAST = -0.5  # of an image of floats; in [-1, 1] dark pixels are below it. Sharpened edges may be a little below 0
NAMED = 3  # files that a message names

Image = Pixels | NDArray[np.float32]  # [H, W, 3|4] RGB or RGBA, straight alpha


@dataclass(frozen=True)
class CheckedRenders:
    """The renders of all evaluated views: their facts, and the function that reads them in the order of the views."""

    facts: Renders
    images: Callable[[], Iterator[Tensor]]  # [H, W, 3] each, composited over the background
    files: tuple[str, ...]  # the name of the file of each view; of a video the number of its frame
    others: tuple[str, ...] = ()  # files of the folder that are not read


def check_renders(
    path: Path,
    views: Sequence[View],
    background: tuple[float, float, float],
    *,
    reduces: bool = False,
) -> CheckedRenders:
    """Match the images of a folder (PNG, JPEG or .npy), or the frames of a video, to views.

    Files are matched by name, such as r_003.png to the view test/r_003. If no file has the name of a view, they are
    matched by order, in which frame_2 comes before frame_10, as frames of a video are.

    Args:
        path: the folder or the video.
        views: the evaluated views.
        background: the colour over which images with alpha are composited.
        reduces: whether larger images are reduced to the size of the views: a pixel is the mean of its area.

    Raises:
        InputError: there are too few or too many images, two of one name, damaged ones, or ones of another size.
    """
    if path.is_dir():
        return _of_folder(path, views, background, reduces)
    if not path.is_file():
        raise InputError(f"{path}: expected a folder of images or a video, there is none: name another", docs=HOW_TO)
    return _of_video(path, views, background, reduces)


def _of_folder(
    folder: Path, views: Sequence[View], background: tuple[float, float, float], reduces: bool
) -> CheckedRenders:
    """Check the images of a folder, and match them to views; arguments are as in `check_renders`."""
    listed = sorted((folder / name for name in os.listdir(folder)), key=_order)
    images = [path for path in listed if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    files, matched = _matched(folder, images, views)
    kinds, sizes, digests = set(), set(), {}
    for file, view in zip(files, views, strict=True):
        kind, size, digests[file.name] = _checked(file)
        kinds.add(kind)
        sizes.add(_fitting(size, view, str(file), reduces))
    if len(kinds) > 1:
        raise InputError(f"{folder}: expected images of one kind, got {' and '.join(sorted(kinds))}: keep one kind")
    facts = Renders(kinds.pop(), matched, _resized(sizes, views), fingerprint(digests))
    images_of_views = partial(_composited, partial(map, _read, files), views, background)  # reads files when called
    others = tuple(path.name for path in listed if path not in files)
    return CheckedRenders(facts, images_of_views, tuple(file.name for file in files), others)


def _of_video(
    path: Path, views: Sequence[View], background: tuple[float, float, float], reduces: bool
) -> CheckedRenders:
    """Check the frames of a video, which are matched to views by order; arguments are as in `check_renders`."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(0)
        start = file.read(8)
    if not any(re.match(pattern, start, re.DOTALL) for pattern in VIDEO_STARTS):
        raise InputError(f"{path}: expected a folder of images, or a video (mp4, webm, mkv, avi), got another file")
    with closing(video_frames(path)) as frames:
        sizes = [(frame.shape[1], frame.shape[0]) for frame in islice(frames, len(views) + 1)]  # + 1: to notice more
    if len(sizes) != len(views):
        count = f"{len(sizes)} that OpenCV can read" if len(sizes) < len(views) else "more"
        raise InputError(f"{path}: expected {len(views)} frames, one for each evaluated view, got {count}", docs=HOW_TO)
    sizes = [_fitting(size, view, str(path), reduces) for size, view in zip(sizes, views, strict=True)]
    facts = Renders("video", "order", _resized(set(sizes), views), digest)
    numbers = tuple(f"frame {i}" for i in range(len(views)))
    return CheckedRenders(facts, partial(_composited, partial(video_frames, path), views, background), numbers)


def _matched(
    folder: Path, images: Sequence[Path], views: Sequence[View]
) -> tuple[list[Path], Literal["names", "order"]]:
    """Return the image of each view, and whether images were matched by names or by order."""
    by_name: dict[str, Path] = {}
    for path in images:
        name = without_suffix(path.stem if path.suffix.lower() == ".npy" else path.name)
        if name in by_name:
            raise InputError(f"{folder}: expected one image of a name, got {by_name[name].name} and {path.name}")
        by_name[name] = path
    names = [without_suffix(PurePosixPath(view.name).name) for view in views]
    if len(set(names)) < len(names):  # views of several folders, such as cam01/0003, whose image is cam01_0003
        names = [without_suffix(view.name).replace("/", "_") for view in views]
    missing = [name for name in names if name not in by_name]
    if len(missing) < len(views):  # some images have the names of views, so all must
        more = sorted(by_name.keys() - set(names))
        if missing or more:
            wrong = f"none of {_some(missing)}" if missing else f"one of no view: {_some(more)}"
            raise InputError(f"{folder}: expected an image of each evaluated view by name, got {wrong}", docs=HOW_TO)
        return [by_name[name] for name in names], "names"
    if len(images) != len(views):
        raise InputError(
            f"{folder}: expected {len(views)} images ({', '.join(SUFFIXES)}), one for each evaluated view, such as "
            f"{names[0]}.png, got {len(images)}",
            docs=HOW_TO,
        )
    _check_order(folder, images, names)
    return list(images), "order"


def _check_order(folder: Path, images: Sequence[Path], names: Sequence[str]) -> None:
    """Raise InputError if an image has, among other words, the name of another view than that of its place."""
    for path, expected in zip(images, names, strict=True):
        words = [name for name in names if re.search(rf"(?<![^\W_]){re.escape(name)}(?![^\W_])", path.stem)]
        if words and expected not in words:
            raise InputError(
                f"{folder}: expected images in the order of the views, as none has the name of a view, got {path.name} "
                f"in the place of {expected}: name each as its view, such as {names[0]}{path.suffix}",
                docs=HOW_TO,
            )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


def _order(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them: frame_2 before frame_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _checked(path: Path) -> tuple[str, tuple[int, int], str]:
    """Return the kind, the size (width, height) and the SHA-256 of a file that is an image."""
    if path.suffix.lower() == ".npy":
        height, width, _ = _array(path).shape
        with path.open("rb") as file:
            return SUFFIXES[".npy"], (width, height), hashlib.file_digest(file, "sha256").hexdigest()
    data = read_image(path, str(path))
    size = photo_size(data, str(path))
    kind = f"{data[PNG_DEPTH_AT]}-bit PNG" if data[1:4] == b"PNG" else "JPEG"
    return kind, size, hashlib.sha256(data).hexdigest()


def _read(path: Path) -> Image:
    """Read an image; raise InputError if floats are not finite, or clearly not in [0, 1]."""
    if path.suffix.lower() != ".npy":
        return decode_photo(read_image(path, str(path)), str(path))
    image: NDArray[np.float32] = np.array(_array(path), np.float32)
    mean, least = image[..., :3].mean(), image[..., :3].min()
    if not (np.isfinite(image).all() and mean <= MOST_MEAN and least >= LEAST):
        raise InputError(
            f"{path}: expected values in [0, 1], their mean is {mean:.3g}, their least {least:.3g}: scale them"
        )
    return image


def _array(path: Path) -> NDArray[Any]:  # [H, W, 3|4]
    """Open an array of floats without reading its values."""
    if not path.is_file():
        raise InputError(f"{path}: expected a file: put the array there")
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise InputError(f"{path}: expected an array of numpy: {one_line(error)[:120]}") from None
    if array.ndim != 3 or array.shape[2] not in (3, 4) or 0 in array.shape or array.dtype.kind != "f":
        raise InputError(f"{path}: expected floats [H, W, 3] or [H, W, 4], got {array.dtype} {list(array.shape)}")
    return array


def _fitting(size: tuple[int, int], view: View, where: str, reduces: bool) -> tuple[int, int]:
    """Return the size of an image; raise InputError if it is not, and cannot be reduced to, that of its view."""
    (width, height), camera = size, view.camera
    is_larger = width >= camera.width and height >= camera.height
    # The ratio of the sides is equal, up to one pixel in a side of the view.
    is_similar = abs(width * camera.height - height * camera.width) <= max(size)
    if size != (camera.width, camera.height) and not (reduces and is_larger and is_similar):
        todo = "render it so" + (", or add --reduce" if is_larger and is_similar else "")
        raise InputError(
            f"{where}: expected {camera.width}x{camera.height}, the size of the view {view.name}, "
            f"got {width}x{height}: {todo}",
            docs=HOW_TO,
        )
    return size


def _resized(sizes: set[tuple[int, int]], views: Sequence[View]) -> str | None:
    """Return the sizes of images as text if they are not those of their views."""
    if sizes == {(view.camera.width, view.camera.height) for view in views}:
        return None
    return ", ".join(f"{width}x{height}" for width, height in sorted(sizes)[:NAMED])


def _composited(
    images: Callable[[], Iterator[Image]], views: Sequence[View], background: tuple[float, float, float]
) -> Iterator[Tensor]:
    """Yield each image over the background, in the size and on the device of its view."""
    for image, view in zip(images(), views, strict=True):
        size = view.camera.width, view.camera.height
        yield composite(image, Rendition(1, background), size).to(view.camera.K.device)
