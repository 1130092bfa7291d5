"""Move a camera around a model, render it along that path, and write the frames as a video or as PNG files."""

import math
import os
import secrets
import sys
from collections.abc import Generator, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import torch
from torch import Tensor
from tqdm import tqdm

from gsbench.errors import InputError
from gsbench.measure.atomic import name_file
from gsbench.measure.images import Pixels, to_bytes, write_png
from gsbench.models import cameras
from gsbench.models.cameras import ELEVATION
from gsbench.models.render import render
from gsbench.run.load import LoadedRun
from gsbench.scenes import Camera

HIGHEST = math.radians(60)  # elevation at the end of a spiral
TURNS = 2  # of a spiral
FAR_AWAY = 1e4  # in scene extents; view directions then differ by at most about 1e-4 radians
SUFFIXES = ".mp4", ".webm", ".mkv", ".avi"  # of the files into which OpenCV's wheel writes CODEC
FIRST_BYTES = 4096  # that a video needs at least
CODEC = "vp09"  # VP9, which browsers play; the encoder comes with OpenCV's wheel, unlike one for H.264

Shot = tuple[Camera, float | None]  # a frame of a video: its camera and its time


def around(
    run: LoadedRun,
    azimuth: float,  # about the up direction of the scene, radians
    elevation: float,  # above the horizon, radians
) -> Camera:
    """Return a camera that looks at the middle of a model from one scene extent, about as far as training cameras."""
    size = run.scene.width, run.scene.height
    return cameras.around(run.model, run.scene.extent, *size, azimuth, elevation, run.scene.up)


def orbit(run: LoadedRun, frames: int) -> list[Camera]:
    """Return cameras on one full circle around a model; the last camera does not repeat the first."""
    return [around(run, 2 * math.pi * i / frames, ELEVATION) for i in range(frames)]


def spiral(run: LoadedRun, frames: int) -> list[Camera]:
    """Return cameras on a spiral that goes twice around a model and rises from the horizon."""
    return [around(run, 2 * math.pi * TURNS * part, HIGHEST * part) for part in times(frames)]


def times(frames: int) -> list[float]:
    """Return the times of a video's frames: 0 to 1 in equal steps."""
    return [i / max(1, frames - 1) for i in range(frames)]


def far_along(run: LoadedRun, direction: Tensor) -> Tensor:
    """Return a viewpoint [3] that is so far away that all Gaussians are seen along the same `direction` [3]."""
    return cameras.middle(run.model) - FAR_AWAY * run.scene.extent * torch.nn.functional.normalize(direction, dim=0)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with another image size and the same horizontal field of view.

    Pixels stay as wide as high: with another aspect ratio, the image shows less or more above and below.
    """
    scale = width / camera.width
    K = camera.K.clone()
    K[:2] *= scale
    K[1, 2] += (height - scale * camera.height) / 2
    return replace(camera, K=K, width=width, height=height)


def frames(run: LoadedRun, shots: list[Shot], supersample: int = 1) -> Generator[Pixels, None, None]:
    """Yield the rendered image of each shot, [H, W, 3] RGB; a progress bar is shown on stderr.

    Each pixel is the mean of supersample x supersample rendered ones.
    """
    background = torch.tensor(run.scene.background).to(run.config.device)
    with torch.inference_mode(), tqdm(shots, desc=run.scene.name, unit="frame") as bar:
        for camera, time in bar:
            width, height, n = camera.width, camera.height, supersample
            fine = replace(resized(camera, n * width, n * height), near=run.near).to(run.config.device)
            image = render(run.model, fine, time, background, run.config.raster.antialias)
            yield to_bytes(image.reshape(height, n, width, n, 3).mean((1, 3)).cpu().numpy())


def write_video(images: Iterable[Pixels], path: Path, fps: float) -> None:
    """Write images of one size as a video; if this fails, an existing file at `path` is unchanged.

    OpenCV does not report that a disk is full, so that the frames of the file are counted at the end.

    Raises:
        InputError: OpenCV cannot write this kind of file, or not all frames are in it.
        OSError: the disk is read-only or full.
    """
    part = path.with_name(f".{secrets.token_hex(4)}.part{path.suffix}")
    writer, count = None, 0
    try:
        part.write_bytes(bytes(FIRST_BYTES))  # unlike OpenCV, it reports why the disk takes no file
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
            if (readable := _frame_count(part)) != count:
                raise InputError(
                    f"{path}: expected a video of {count} frames, {readable} can be read: is the disk full?"
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
    """Write images as 0000.png, 0001.png and so on into a folder, which is created if its parent exists.

    If the folder has a next image, of a longer clip, this is printed.
    """
    folder.mkdir(exist_ok=True)
    written = 0
    for image in images:
        write_png(image, folder / f"{written:04d}.png")
        written += 1
    if (following := folder / f"{written:04d}.png").exists():
        print(f"{following}: it was there before, and is not of these {written} images: delete it", file=sys.stderr)


def check_file(option: str, path: Path, *suffixes: str) -> None:
    """Raise InputError unless an option names a file with one of the suffixes, in a folder that exists."""
    check_parent(path)
    if path.is_dir():
        raise InputError(f"{option}: expected a file name, {str(path)!a:.200} is a folder: name another")
    if path.suffix.lower() not in suffixes:
        raise InputError(
            f"{option}: expected a file name that ends in {' or '.join(suffixes)}, got {str(path)!a:.200}",
            docs="viewing.md#export",
        )


def check_folder(option: str, folder: Path) -> None:
    """Raise InputError unless an option names a folder, perhaps a new one, in a folder that exists."""
    check_parent(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{option}: expected a folder, {folder} is a file: name another")


def check_parent(path: Path) -> None:
    """Raise InputError unless `path` is a valid file name and its parent folder exists."""
    if not path.name or "\0" in str(path):
        raise InputError(f"expected the name of a file or a folder to write, got {str(path)!a:.200}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: expected a folder {path.parent} to write into, there is none: make it first")
