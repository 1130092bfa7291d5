"""Measure what flickers: how the error of renders changes from frame to frame in pixels where the truth stands still.

With the error e_t = render - truth of frame t, means over static pixels and channels, in steps of 8 bits (1/255):

    flicker = 255 mean_t |e_t+1 - e_t|        static_drift = 255 |mean of e, last third - mean of e, first third|

Both are 0 for a constant error, which PSNR has already. `flicker_truth` is the mean of |g_t+1 - g_t| of the truth g:
sensor noise, which no model can follow. Renders are floats, as 8 bits alone change by up to 1 step a frame.

A film is three or more evaluated views of one camera in the order of their times. Its static pixels are those that are
in the region `moving` (gsbench.measure.regions) of none of its views. Tests of D-NeRF have no film: their cameras jump.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.measure.images import Pixels, strip, to_bytes
from gsbench.measure.record import Region
from gsbench.measure.regions import LEAST_VIEWS, Mask, Regions, by_camera
from gsbench.scenes import View

LEAST_HEIGHT = 120  # pixels of the picture of a row over time; each frame is as many rows as this needs
NO_FILM = f"needs a film: {LEAST_VIEWS} evaluated views of one camera, in the order of their times"
FARNEBACK = (0.5, 3, 15, 3, 5, 1.2, 0)  # scale, levels, window, iterations, neighbourhood, its sigma, flags
SKIPPED = 2  # frames at each end, for tOF
Grey = NDArray[np.uint8]  # [H, W] an image in 8 bits
NAMES = ("flicker", "static_drift", "flicker_truth")


class Film:
    """The frames of one camera, of which one at a time is added; only numbers of static pixels and one row are kept."""

    def __init__(self, frames: int, still: Mask) -> None:  # number of frames; [H, W] the static pixels
        self.frames = frames
        self.still = still
        self._still = torch.from_numpy(still)
        # The row of the picture: the one with the most movement; the middle one if that is the first, or none moves
        self._row = int((~still).sum(1).argmax()) or len(still) // 2
        self._before: tuple[Tensor, Tensor] | None = None  # error and truth of the static pixels, [P, 3]
        self._changes: list[tuple[float, float]] = []  # mean absolute changes of both
        self._drift = torch.zeros(())  # [P, 3], the mean error of the last third minus that of the first third
        self._rows: list[tuple[Tensor, Tensor]] = []  # [W, 3] of render and truth

    def add(self, render: Tensor, truth: Tensor) -> None:  # [H, W, 3], each
        """Measure the next frame."""
        render, truth = (image.detach().cpu().double().clamp(0, 1) for image in (render, truth))
        now = (render - truth)[self._still], truth[self._still]
        if self._before is not None:
            error, image = ((b - a).abs().mean() for a, b in zip(self._before, now, strict=True))
            self._changes.append((float(error), float(image)))
        i, third = len(self._rows), self.frames // 3
        sign = (i >= self.frames - third) - (i < third)  # 1 in the last third, -1 in the first, else 0
        self._drift = self._drift + sign * now[0] / third
        self._before = now
        self._rows.append((render[self._row], truth[self._row]))

    @property
    def scores(self) -> tuple[float, float, float]:
        """Return flicker, drift and the flicker of the truth, in steps of 8 bits."""
        error, image = (255 * fmean(changes) for changes in zip(*self._changes, strict=True))
        return error, 255 * float(self._drift.abs().mean()), image

    def picture(self) -> Pixels:
        """Return a picture of one row of pixels over time, which runs down: render, truth and error."""
        render, truth = (torch.stack(rows).numpy() for rows in zip(*self._rows, strict=True))
        repeats = -(-LEAST_HEIGHT // len(render))  # rounded up
        return strip([(render.repeat(repeats, 0), truth.repeat(repeats, 0))])


class FlickerScores:
    """Measures the flicker of all films of a split, while images are rendered one after the other."""

    def __init__(
        self,
        views: Sequence[View],
        moved: Mapping[str, Mask],  # the pixels that move, by the name of the view
    ) -> None:
        self.films: list[Film] = []
        self.still: list[tuple[list[View], Mask]] = []  # the views of each film, and its static pixels
        self._film_of: dict[str, Film] = {}
        self.missing_because = NO_FILM
        for film in films_of(views):
            still = ~np.logical_or.reduce([moved[view.name] for view in film])
            if not still.any():
                self.missing_because = "no pixel of the film stands still"
                continue
            self.films.append(Film(len(film), still))
            self.still.append((film, still))
            self._film_of |= dict.fromkeys((view.name for view in film), self.films[-1])

    def measured(self, images: Iterable[tuple[str, Tensor, Tensor]]) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield (name of the view, render, ground truth) again, and add each to the film of its camera."""
        for name, render, truth in images:
            if name in self._film_of:
                self._film_of[name].add(render, truth)
            yield name, render, truth

    def metrics(self) -> dict[str, float | None]:
        """Return the means over films; None without one."""
        if not self.films:
            return dict.fromkeys(NAMES)
        by_metric = zip(*(film.scores for film in self.films), strict=True)
        return dict(zip(NAMES, map(fmean, by_metric), strict=True))

    def missing(self) -> dict[str, str]:
        """Return the reasons why a metric is None."""
        return {} if self.films else dict.fromkeys(NAMES, self.missing_because)

    def of_record(self) -> dict[str, Region]:
        """Return the static pixels for the record of the run."""
        static = Regions({f"film {i}": film.still for i, film in enumerate(self.films)}, "images of one camera")
        frames = sum(film.frames for film in self.films)
        return {"static": Region(static.source, frames, static.share, static.digest)} if self.films else {}

    def pictures(self) -> dict[str, Pixels]:
        """Return the picture of the first film by its file name."""
        return {"flicker.png": self.films[0].picture()} if self.films else {}


def films_of(views: Sequence[View]) -> list[list[View]]:
    """Return the views of each camera that is a film: it has at least three, and their times rise from view to view.

    Other cameras are left out, because a film's frames are compared in the order in which they are rendered.
    """

    def is_in_order(group: list[View]) -> bool:
        times = [view.time for view in group]
        return all(a is not None and b is not None and a < b for a, b in itertools.pairwise(times))

    return [group for group in by_camera(views) if len(group) >= LEAST_VIEWS and is_in_order(group)]


def tof(renders: Sequence[Grey], truths: Sequence[Grey]) -> float | None:  # of each frame
    """Compute tOF (Chu et al. 2020, TecoGAN) of a film: how much the optical flow of renders differs from the truth's.

    It is the mean over pixels of the Euclidean length of the difference of both flows, in pixels, as in its authors'
    code (the text has the L1 norm): Farneback's flow of 8-bit grey images, cropped to multiples of 32 pixels with at
    least 16 removed, without the first two frames and the last two. None: too few frames or pixels.
    """
    shape = renders[0].shape
    height, width = (32 * ((side - 16) // 32) for side in shape)
    if min(height, width) <= 0 or len(renders) < 2 * SKIPPED + 2:
        return None
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2

    def flows(frames: Sequence[Grey]) -> Iterator[NDArray[Any]]:  # [height, width, 2] each
        cropped = [grey[top : top + height, left : left + width] for grey in frames[SKIPPED:-SKIPPED]]
        for before, after in itertools.pairwise(cropped):
            yield cv2.calcOpticalFlowFarneback(before, after, np.empty(0), *FARNEBACK)

    return fmean(flow_difference(a, b) for a, b in zip(flows(renders), flows(truths), strict=True))


def grey_of(image: Tensor) -> Grey:  # [H, W, 3]
    """Return an image in grey, for `tof`."""
    return np.asarray(cv2.cvtColor(to_bytes(image.cpu().numpy()), cv2.COLOR_RGB2GRAY), np.uint8)


def flow_difference(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:  # [H, W, 2], each
    """Return the mean length of the difference of two optical flows."""
    return float(np.linalg.norm(a.astype(np.float64) - b, axis=-1).mean())
