"""Find the training view nearest to a camera, and compare views of the data with the models' renders of them."""

import math
from typing import NamedTuple

import torch

from gsbench.measure.images import Pixels, error_image, reduced, to_bytes
from gsbench.measure.quality import capped_psnr, quantise
from gsbench.scenes import Camera, Scene, View
from gsbench.view.frame import FrameRenderer, FrameRequest

SAME = 1e-3  # in extents plus radians; closer views count as the same viewpoint
MOST_WIDTH = 480  # pixels, to which the images of a comparison are reduced


class Nearest(NamedTuple):
    """The training view nearest to a camera, with its distance and its angle from the camera."""

    view: View
    distance: float  # in the user's units
    degrees: float  # angle between the view directions


class ViewComparison(NamedTuple):
    """The image of a training view, a model's render of it, the error image and the PSNR."""

    name: str  # of the model
    truth: Pixels  # [H, W, 3] RGB, as the others
    render: Pixels
    error: Pixels  # in the colours of `gsbench.measure.images.error_image`
    psnr: float  # dB, of all pixels


def nearest_view(scene: Scene, camera: Camera, time: float | None) -> Nearest:
    """Return the training view with the smallest sum of distance (in scene extents) and angle (in radians).

    If several views are about equally near, the view nearest in time is returned. No image is read.
    """
    placed = [view.camera.to("cpu") for view in scene.train]
    distances = (torch.stack([other.center for other in placed]) - camera.center).norm(dim=-1)
    forwards = torch.stack([other.viewmat[2, :3] for other in placed])
    angles = torch.arccos((forwards @ camera.viewmat[2, :3]).clamp(-1, 1))
    far = distances / max(scene.extent, 1e-12) + angles  # in extents plus radians
    away = (torch.tensor([view.time or 0.0 for view in scene.train]) - (time or 0.0)).abs()
    best = int(torch.where(far <= far.min() + SAME, away, math.inf).argmin())
    return Nearest(scene.train[best], float(distances[best]) * scene.placement.unit, math.degrees(angles[best]))


def compare(renderer: FrameRenderer, view: View, request: FrameRequest) -> ViewComparison:
    """Render a model from the camera of a view, and compute the error as in the run's evaluation."""
    view = view.to("cpu")
    image = renderer.image(view.camera, request)
    shown = quantise(image) if renderer.run.config.protocol.quantise else image
    return ViewComparison(
        renderer.name,
        reduced(to_bytes(view.image.cpu().numpy()), MOST_WIDTH),
        reduced(to_bytes(shown.cpu().numpy()), MOST_WIDTH),
        reduced(error_image(shown.numpy(), view.image.numpy()), MOST_WIDTH),
        capped_psnr(shown, view.image),
    )
