"""Find the pixels in which a scene moves, and those of its objects, so that PSNR can be measured there alone.

Both are found in the ground truth, by integers only, so every machine finds the same pixels:

- `moving`: needs at least three evaluated views with the same camera. Each image is averaged over 3 x 3 pixels. A pixel
  moves if a channel differs from its median over these views by more than 16 of 255. Then a 3 x 3 opening drops single
  pixels, and a dilation by a (2 r + 1)^2 square, r = height / 270 rounded, adds the border.
- `object`: pixels with an object number in the scene's masks; without masks, pixels with an alpha of at least 0.5.
"""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gsbench.measure.quality import capped_psnr, quantise
from gsbench.measure.record import Region, ViewScore
from gsbench.scenes import View

LEAST_VIEWS = 3  # with one camera; the median of two images is one of them
THRESHOLD = 16  # of 255, by which a moving pixel differs from the median
PIXELS_OF_A_RADIUS = 270  # rows of the image for each pixel by which the region is dilated
LEAST_PIXELS = 64  # views with a smaller region are not measured
SAME = 1e-6  # largest difference of equal cameras
STRIP = 128  # rows whose median is computed at once, to save memory

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Regions:
    """The region of each view that has one of at least LEAST_PIXELS pixels, or the reason why there is none."""

    masks: dict[str, Mask]  # [H, W] by the name of the view
    source: str  # what the region was found in; empty if there is none
    missing: str = ""
    of_any_size: dict[str, Mask] = field(default_factory=dict)  # also those of fewer pixels

    @property
    def share(self) -> float:
        """Return the mean share of the pixels that are in the region, over the views that have one."""
        return float(np.mean([mask.mean() for mask in self.masks.values()])) if self.masks else 0.0

    @property
    def digest(self) -> str:
        """Return the SHA-256 of all masks and of the names of their views."""
        sha = hashlib.sha256()
        for name, mask in sorted(self.masks.items()):
            sha.update(f"{name}\n{mask.shape}\n".encode() + np.packbits(mask).tobytes())
        return sha.hexdigest()


def find_regions(views: Sequence[View]) -> dict[str, Regions]:
    """Return the regions `moving` and `object` of the evaluated views."""
    return {"moving": moving(views), "object": of_objects(views)}


def moving(views: Sequence[View]) -> Regions:
    """Find the moving pixels of views that share a camera; see the first lines of this module."""
    groups = [group for group in by_camera(views) if len(group) >= LEAST_VIEWS]
    if not groups:
        return Regions({}, "", f"needs {LEAST_VIEWS} evaluated views with the same camera")
    masks = {}
    for group in groups:
        camera = group[0].camera
        sums = np.empty((len(group), camera.height, camera.width, 3), np.uint16)  # of 3 x 3 pixels
        for i, view in enumerate(group):  # not a list to stack, which would take the memory twice
            sums[i] = _sums(view)
        median = np.empty_like(sums[0])
        for row in range(0, sums.shape[1], STRIP):
            strip = np.sort(sums[:, row : row + STRIP], axis=0)
            median[row : row + STRIP] = strip[(len(group) - 1) // 2]  # the lower one of an even number
        radius = round(sums.shape[1] / PIXELS_OF_A_RADIUS)
        for view, image_sums in zip(group, sums, strict=True):
            # Sums of 9 pixels are compared. The differences have no name, so that their memory is freed at once.
            moved = (np.abs(image_sums.astype(np.int32) - median) > 9 * THRESHOLD).any(-1).astype(np.uint8)
            moved = cv2.morphologyEx(moved, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
            masks[view.name] = cv2.dilate(moved, np.ones((2 * radius + 1,) * 2, np.uint8)).astype(bool)
    return _large(masks, "images of one camera")


def of_objects(views: Sequence[View]) -> Regions:
    """Find the pixels of objects by the scene's masks, else by alpha; see the first lines of this module."""
    if all(view.regions is not None for view in views):
        return _large({view.name: _array(view.regions) > 0 for view in views}, "masks")
    if all(view.alpha is not None for view in views):
        return _large({view.name: _array(view.alpha) >= 128 for view in views}, "alpha")
    return Regions({}, "", "needs masks, or images with alpha")


def region_psnr(
    render: Tensor,  # [H, W, 3]
    truth: Tensor,  # [H, W, 3]
    mask: Mask,
) -> float:
    """Compute PSNR over the pixels of a region: -10 log10 of the mean squared error of pixels x 3 channels, dB.

    It is capped as that of a whole view (gsbench.measure.exact_views).
    """
    inside = torch.from_numpy(mask).to(render.device)
    return capped_psnr(render[inside][None], truth[inside][None])  # as an image of one row


class RegionScores:
    """Measures PSNR over the moving pixels and over those of objects, while images are rendered one after the other."""

    def __init__(self, views: Sequence[View], quantised: bool) -> None:
        """Find the regions of the evaluated views; `quantised`: renders are rounded to 8 bits first."""
        self.regions = find_regions(views)
        self.quantised = quantised
        self.scores: dict[str, dict[str, float]] = {name: {} for name in self.regions}  # dB by region, then by view

    def measured(self, images: Iterable[tuple[str, Tensor, Tensor]]) -> Iterator[tuple[str, Tensor, Tensor]]:
        """Yield (name of the view, render, ground truth) again, and measure each over the regions of its view."""
        for name, render, truth in images:
            shown = quantise(render) if self.quantised else render
            for region, scores in self.scores.items():
                mask = self.regions[region].masks.get(name)
                if mask is not None:
                    scores[name] = region_psnr(shown, truth, mask)
            yield name, render, truth

    def metrics(self) -> dict[str, float | None]:
        """Return `psnr_moving` and `psnr_object`, means over the views that have such a region; None without one."""
        return {f"psnr_{name}": fmean(present.values()) if present else None for name, present in self.scores.items()}

    def with_scores(self, per_view: Sequence[ViewScore]) -> list[ViewScore]:
        """Return the scores of single views with those over their regions added."""
        moving, objects = self.scores["moving"], self.scores["object"]
        return [
            replace(view, psnr_moving=moving.get(view.name), psnr_object=objects.get(view.name)) for view in per_view
        ]

    def missing(self) -> dict[str, str]:
        """Return the reasons why a metric is None."""
        return {f"psnr_{name}": regions.missing for name, regions in self.regions.items() if regions.missing}

    def of_record(self) -> dict[str, Region]:
        """Return the regions for the record of the run."""
        return {
            name: Region(each.source, len(each.masks), each.share, each.digest)
            for name, each in self.regions.items()
            if each.masks
        }


def _large(masks: dict[str, Mask], source: str) -> Regions:
    """Keep the masks of at least LEAST_PIXELS pixels."""
    kept = {name: mask for name, mask in masks.items() if mask.sum() >= LEAST_PIXELS}
    missing = "" if kept else f"no view has a region of {LEAST_PIXELS} pixels"
    return Regions(kept, source if kept else "", missing, masks)


def by_camera(views: Sequence[View]) -> list[list[View]]:
    """Group the views by cameras that are equal to SAME, and by image sizes."""
    cameras = [view.camera for view in views]
    keys = np.array(
        [[each.width, each.height, *each.viewmat.flatten().tolist(), *each.K.flatten().tolist()] for each in cameras]
    )
    return [[views[i] for i in group] for group in grouped(keys, range(len(views)), SAME, np.inf)]


def grouped(vectors: npt.NDArray[np.float64], indices: Sequence[int], most: float, order: float) -> list[list[int]]:
    """Group some of the vectors [V, n] so that each differs from the first of its group by a norm of at most `most`."""
    groups, left = [], np.array(indices, dtype=np.int64)  # those in no group yet
    while len(left):
        near = np.linalg.norm(vectors[left] - vectors[left[0]], order, axis=1) <= most
        groups.append(left[near].tolist())
        left = left[~near]
    return groups


def _sums(view: View) -> npt.NDArray[np.uint16]:
    """Return the sums of an image of 8 bits over 3 x 3 pixels, [H, W, 3]; a pixel at the border is repeated."""
    image = (view.image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge").astype(np.uint16)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    sums: npt.NDArray[np.uint16] = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return sums


def _array(values: Tensor | None) -> npt.NDArray[np.uint8]:
    assert values is not None
    array: npt.NDArray[np.uint8] = values.cpu().numpy()
    return array
