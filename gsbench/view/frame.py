"""Render one frame of the viewer: slice and rasterize a model, time both, and put two models into one image."""

import threading
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from gsbench.measure.speed import synchroniser
from gsbench.models.query import Query
from gsbench.models.render import rasterize_slice
from gsbench.run.load import LoadedRun
from gsbench.scenes import Camera
from gsbench.view.film import pixels

Pixels = npt.NDArray[np.uint8]
DIVIDER = (255, 255, 255)  # RGB of the line between two models


class Asked(NamedTuple):
    """What a model is asked for, besides the camera that sees it."""

    time: float | None  # in [0, 1]; None where the scene has none
    center: torch.Tensor | None = None  # [3] where the slice is seen from; None: from the camera
    agr: bool = True  # whether AGR acts, in a model that has it


class Frame(NamedTuple):
    """A rendered image and what it cost."""

    image: Pixels  # [H, W, 3] RGB
    slice_ms: float  # conditioning, colours and AGR
    raster_ms: float


class Painter:
    """Renders the frames of one run. Its model is switched for each frame, so it does one at a time for all clients."""

    def __init__(self, run: LoadedRun) -> None:
        """Take a run; nothing is rendered yet."""
        self.run = run
        self.name = f"{run.folder.parent.name} {run.folder.name}"  # such as "7dgs seed0"
        self.trained_phase = run.model.phase
        self.has_agr = run.model.refinement is not None
        self._background = torch.tensor(run.scene.background).to(run.config.device)
        self._synchronise = synchroniser(run.config.device)
        self._lock = threading.Lock()

    def paint(self, camera: Camera, asked: Asked) -> Frame:
        """Render what a camera sees; raises InputError where it cannot be one."""
        camera = camera.to(self.run.config.device)
        center = camera.center if asked.center is None else asked.center.to(self.run.config.device)
        with self._lock, torch.inference_mode():
            self.run.model.phase = replace(self.trained_phase, refine=asked.agr and self.trained_phase.refine)
            started = self._now()
            gaussians = self.run.model.slice(Query.at(center, asked.time))
            sliced = self._now()
            backend, antialias = self.run.model.backend, self.run.config.raster.antialias
            image = rasterize_slice(gaussians, camera, self._background, backend, antialias).image[0]
            drawn = self._now()
        return Frame(pixels(image), 1000 * (sliced - started), 1000 * (drawn - sliced))

    def _now(self) -> float:
        """Return the time in seconds at which everything that was asked of the device is done."""
        self._synchronise()
        return time.perf_counter()


def beside(left: Frame, right: Frame) -> Frame:
    """Put two frames side by side, with a line between them."""
    image = np.concatenate([left.image, right.image], axis=1)
    image[:, left.image.shape[1] - 1] = DIVIDER
    return Frame(image, left.slice_ms + right.slice_ms, left.raster_ms + right.raster_ms)


def wiped(left: Frame, right: Frame, part: float) -> Frame:
    """Show the left `part` in [0, 1] of one frame and the rest of another one of the same size."""
    image, edge = right.image.copy(), round(part * right.image.shape[1])
    image[:, :edge] = left.image[:, :edge]
    if 0 < edge < image.shape[1]:
        image[:, edge] = DIVIDER
    return Frame(image, left.slice_ms + right.slice_ms, left.raster_ms + right.raster_ms)
