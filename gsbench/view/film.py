"""Render a model along a path of cameras, and write the frames as a video or as PNG files."""

import os
import secrets
from collections.abc import Generator, Iterable
from contextlib import suppress
from pathlib import Path

import cv2
import torch
from tqdm import tqdm

from gsbench.errors import InputError
from gsbench.measure.atomic import name_file
from gsbench.measure.images import Pixels, to_bytes, write_png
from gsbench.models.render import render
from gsbench.run.load import LoadedRun
from gsbench.view.paths import Shot, resized

SUFFIXES = ".mp4", ".webm", ".mkv", ".avi"  # of the files into which OpenCV's wheel writes CODEC
FIRST_BYTES = 4096  # that a video needs at least
CODEC = "vp09"  # VP9, which browsers play; the encoder comes with OpenCV's wheel, unlike one for H.264


def frames(run: LoadedRun, shots: list[Shot], supersample: int = 1) -> Generator[Pixels, None, None]:
    """Yield rendered images, one for each shot (a camera and a time), as uint8 [H, W, 3] RGB.

    Each pixel is the mean of supersample x supersample rendered ones. A progress bar is shown on stderr.
    """
    background = torch.tensor(run.scene.background).to(run.config.device)
    with torch.inference_mode(), tqdm(shots, desc=run.scene.name, unit="frame") as bar:
        for camera, time in bar:
            width, height, n = camera.width, camera.height, supersample
            fine = resized(camera, n * width, n * height).to(run.config.device)
            image = render(run.model, fine, time, background, run.config.raster.antialias)
            yield to_bytes(image.reshape(height, n, width, n, 3).mean((1, 3)).cpu().numpy())


def write_video(images: Iterable[Pixels], path: Path, fps: float) -> None:
    """Write images of one size as a video; if this fails, an existing file at `path` is unchanged.

    OpenCV does not tell that a disk is full, so that the frames of the file are counted at the end.

    Raises:
        InputError: the folder does not exist, OpenCV cannot write this kind of file, or not all frames are in it.
        OSError: the disk is read-only or full.
    """
    check_parent(path)
    part = path.with_name(f".{secrets.token_hex(4)}.part{path.suffix}")
    writer, size, count = None, (0, 0), 0
    try:
        part.write_bytes(bytes(FIRST_BYTES))  # unlike OpenCV, it tells why the disk takes no file
        for image in images:
            if writer is None:
                size = image.shape[1], image.shape[0]
                writer = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*CODEC), fps, size)
                if not writer.isOpened():
                    raise InputError(f"{path}: expected a file that OpenCV can encode, such as out.mp4")
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            count += 1
        if writer is not None:
            writer.release()
            if (written := _frame_count(part)) != count:
                raise InputError(
                    f"{path}: expected a video of {count} frames, {written} can be read: is the disk full?"
                )
            os.replace(part, path)
    except OSError as error:
        name_file(error, path)
        raise
    finally:
        with suppress(OSError):  # of a read-only disk
            part.unlink()


def _frame_count(path: Path) -> int:
    """Return how many frames of a video can be read."""
    video, count = cv2.VideoCapture(str(path)), 0
    while video.grab():
        count += 1
    video.release()
    return count


def write_images(images: Iterable[Pixels], folder: Path) -> None:
    """Write images as 0000.png, 0001.png and so on into a folder, which is made if its parent exists.

    Raises:
        InputError: the parent folder does not exist.
    """
    check_parent(folder)
    folder.mkdir(exist_ok=True)
    for i, image in enumerate(images):
        write_png(image, folder / f"{i:04d}.png")


def check_file(option: str, path: Path, *suffixes: str) -> None:
    """Raise InputError unless the file of an option ends in one of the suffixes and can be written into its folder."""
    check_parent(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{option}: expected a file name that ends in {' or '.join(suffixes)}, got {str(path)!a:.200}",
                         docs="viewing.md#export")  # fmt: skip


def check_parent(path: Path) -> None:
    """Raise InputError unless `path` is a valid file name and its parent folder exists."""
    if not path.name or "\0" in str(path):
        raise InputError(f"expected the name of a file or a folder to write, got {str(path)!a:.200}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: expected a folder {path.parent} to write into, there is none: make it first")
