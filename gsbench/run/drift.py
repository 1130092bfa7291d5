"""Measure how far the Gaussians move that are seen where the truth stands still: their drift in 3D.

A film (gsbench.measure.flicker) has static pixels S. In a pixel x of frame t, Gaussian i has the blend weight w_i,t(x):
its alpha times the transmittance in front of it. With its mean p_i(t), as it is sliced for the camera of the film,

    drift_3d = sum_t [ sum_S sum_i w_i,t(x) |p_i(t+1) - p_i(t)| ] / [ sum_S sum_i w_i,t(x) ],

the path over the film of what is seen in S, in the user's unit of length; `drift_3d_px` is that of the projected means,
in pixels. A pixel is linear in the colours, so a rendering with path lengths in place of colours has these sums. Images
do not show this: Gaussians of one colour may slide along a wall.
"""

import itertools
from collections.abc import Mapping, Sequence
from statistics import fmean

import torch
from torch import Tensor

from gsbench.measure.regions import Mask
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import rasterize_slice
from gsbench.raster import NEAR
from gsbench.scenes import Camera, View

NAMES = ("drift_3d", "drift_3d_px")
Still = tuple[Sequence[View], Mask]  # a film, and its static pixels [H, W]


@torch.no_grad()
def of_films(model: GaussianModel, films: Sequence[Still], antialias: bool, unit: float) -> Mapping[str, float | None]:
    """Return the means of both measures over films; None without one.

    Args:
        model: the trained model.
        films: the films, each with its static pixels.
        antialias: as in `gsbench.raster.rasterize`.
        unit: the unit of the model's coordinates in the user's (`Placement.unit`).
    """
    if not films:
        return dict.fromkeys(NAMES)
    paths = [_path(model, film, torch.from_numpy(still), antialias).tolist() for film, still in films]
    means = fmean(unit * length for length, _ in paths), fmean(pixels for _, pixels in paths)
    return dict(zip(NAMES, means, strict=True))


def _path(model: GaussianModel, film: Sequence[View], still: Tensor, antialias: bool) -> Tensor:
    """Return the path over a film in the model's unit and in pixels, [2] float64."""
    camera = film[0].camera
    black = torch.zeros_like(camera.K[0])
    path = torch.zeros(2, dtype=torch.float64)
    slices = (model.slice(CameraTime.of(camera, view.time)) for view in film)
    for now, after in itertools.pairwise(slices):  # of frames t and t + 1
        moved = (after.means - now.means).norm(dim=-1)
        shifted = (_pixels(camera, after.means) - _pixels(camera, now.means)).norm(dim=-1)
        lengths = torch.stack([moved, shifted, torch.ones_like(moved)], 1)  # [N, 3] in place of colours
        image = rasterize_slice(now._replace(colors=lengths), camera, black, model.backend, antialias).image[0]
        weighted = image.cpu()[still].double().sum(0)  # [3] sums over S: weights times both lengths, and weights alone
        path += weighted[:2] / weighted[2].clamp_min(torch.finfo(weighted.dtype).tiny)  # no weight: no path
    return path


def _pixels(camera: Camera, means: Tensor) -> Tensor:  # [N, 3] -> [N, 2]
    """Project means; those that the rasterizer culls as too near stay finite."""
    in_camera = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    projected = in_camera @ camera.K.T
    return projected[:, :2] / in_camera[:, 2:].clamp_min(NEAR)
