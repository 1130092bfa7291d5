"""Render and time one frame of the viewer: one model as the browser requests it, or two models in one image."""

import threading
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from gsbench.effects.picture import cost_colors, effect_set_colors
from gsbench.measure.images import Pixels, inferno, to_bytes
from gsbench.models import GaussianModel
from gsbench.models.query import Query
from gsbench.models.render import rasterize_slice
from gsbench.models.twins import doubled, exact_model
from gsbench.run.load import LoadedRun
from gsbench.scenes import Camera
from gsbench.schedule import ActiveComponents
from gsbench.view.labels import measured
from gsbench.view.rounding import Rounding, check_exactness, rounding
from gsbench.view.stages import RASTER, SLICE, StageWatch, part_of

DIVIDER = (255, 255, 255)  # RGB of the line between two models
IMAGE, CLASS, COST = PLAIN = ("image", "class", "cost")  # meanings of the Gaussians' colours
FLOAT32 = "float32"  # instead of Gaussians the bound on the error of float32, which takes 20 times as long as a frame
COLOURS = (*PLAIN, FLOAT32)
EVERY_DEGREE = 3  # the highest SH degree of any model


class FrameRequest(NamedTuple):
    """The settings of a requested frame: time, viewpoint of the Gaussians, AGR (a network) or not, SH, colours."""

    time: float | None  # in [0, 1]; None if the scene is static
    center: torch.Tensor | None = None  # [3], viewpoint for which Gaussians are computed; None: the camera's
    agr: bool = True  # whether AGR (neural refinement) is on, if the model has it
    sh_degree: int = EVERY_DEGREE  # highest SH degree of the colours
    colours: str = IMAGE  # one of PLAIN
    background: torch.Tensor | None = None  # [3] RGB in [0, 1], of the colours IMAGE; None: that of the training


class FrameCost(NamedTuple):
    """The milliseconds that one model takes for a frame, by stage."""

    name: str  # of the model
    ms: dict[str, float]  # by stage, in their order

    def of(self, part: str) -> float:
        """Return the milliseconds of one part of a frame: to compute conditional 3D Gaussians, or to rasterize them."""
        return sum(ms for stage, ms in self.ms.items() if part_of(stage) == part)


class Frame(NamedTuple):
    """A rendered image, and the milliseconds that each model in it took."""

    image: Pixels  # [H, W, 3] RGB
    costs: tuple[FrameCost, ...]  # of each model in it

    def ms(self, part: str) -> float:
        """Return the milliseconds of one part of a frame, summed over its models; see `FrameCost.of`."""
        return sum(cost.of(part) for cost in self.costs)


class FrameRenderer:
    """Renders the frames of one run's model, one frame at a time.

    The renderer switches parts of the model, such as AGR (a network), on and off for each frame. Therefore it cannot
    render two frames at once.
    """

    def __init__(self, run: LoadedRun, name: str, most_cost: float) -> None:
        """Prepare to render the model of a run; nothing is rendered yet.

        Args:
            run: the run with the model to render.
            name: the name of the run, which no other one has.
            most_cost: the nanoseconds that the most expensive Gaussian adds to a frame; it has the brightest colour.
                The value is the same for all models that are compared.
        """
        self.run = run
        self.name = name
        self.measured = measured(run)
        self.trained_active = run.model.active
        self.has_agr = run.model.refinement is not None
        self.counts = run.model.count_by_effects()  # number of Gaussians by the set of their effects
        background = torch.tensor(run.scene.background).to(run.config.device)
        self._backgrounds = {IMAGE: background, CLASS: torch.ones_like(background), COST: torch.zeros_like(background)}
        self._colors = {CLASS: effect_set_colors(run.model), COST: cost_colors(run.model, most_cost)}
        self._lock = threading.Lock()  # of the model
        self._exact: GaussianModel | None = None  # its copy in float64, made when it is first needed
        self._exact_lock = threading.Lock()

    def render(self, camera: Camera, request: FrameRequest) -> Frame:
        """Render the image of a camera, and return it with its milliseconds.

        Raises:
            InputError: the camera is not valid.
        """
        image, ms = self._timed_image(camera, request)
        shown = inferno(image[..., 0].cpu().numpy()) if request.colours == COST else to_bytes(image.cpu().numpy())
        return Frame(shown, (FrameCost(self.name, ms),))

    def image(self, camera: Camera, request: FrameRequest) -> torch.Tensor:
        """Render the image of a camera as floats, [H, W, 3], from which PSNR can be computed."""
        return self._timed_image(camera, request)[0].cpu()

    def rounding(self, camera: Camera, request: FrameRequest) -> Rounding:
        """Bound the error of float32 in each pixel of the image of a camera; other frames can be rendered meanwhile.

        Raises:
            InputError: there is no such bound: the model is on a GPU, the CPU kernels are not built, or the model does
                not compute in float64.
        """
        run, center = self.run, request.center
        check_exactness(run.model)
        with self._exact_lock:
            with self._lock, torch.inference_mode():
                self._exact = self._exact or exact_model(run.model)
                run.model.active = self._exact.active = self._active(request)
                single = run.model.slice(Query.at(camera.center if center is None else center, request.time))
            query = Query.at(doubled(camera).center if center is None else center.double(), request.time)
            return rounding(self._exact, single, query, camera, self._background(request), run.config.raster.antialias)

    def _timed_image(self, camera: Camera, request: FrameRequest) -> tuple[torch.Tensor, dict[str, float]]:
        """Render the image of a camera, and return it with the milliseconds of each stage."""
        run, device = self.run, self.run.config.device
        camera = camera.to(device)
        center = camera.center if request.center is None else request.center.to(device)
        query = Query.at(center, request.time)
        with self._lock, torch.inference_mode(), StageWatch(device) as watch:
            run.model.active = self._active(request)
            gaussians = run.model.slice(query)
            watch.end(SLICE)
            if request.colours in self._colors:
                gaussians = gaussians._replace(colors=self._colors[request.colours])
            background = self._background(request)
            image = rasterize_slice(gaussians, camera, background, run.model.backend, run.config.raster.antialias).image
            watch.end(RASTER)
            return image[0], watch.ms

    def _background(self, request: FrameRequest) -> torch.Tensor:
        """Return the background colour of a requested frame, [3]; a legend explains the colours on that of its own."""
        usual = self._backgrounds[request.colours]
        return usual if request.background is None or request.colours != IMAGE else request.background.to(usual)

    def _active(self, request: FrameRequest) -> ActiveComponents:
        """Return the active parts of the model, such as AGR (a network), without those that the user switches off."""
        trained = self.trained_active
        degree = min(request.sh_degree, trained.sh_degree)
        return replace(trained, refine=request.agr and trained.refine, sh_degree=degree)


def beside(left: Frame, right: Frame) -> Frame:
    """Put two frames side by side, with a line between them."""
    image = np.concatenate([left.image, right.image], axis=1)
    image[:, left.image.shape[1] - 1] = DIVIDER
    return Frame(image, left.costs + right.costs)


def wiped(left: Frame, right: Frame, edge: int) -> Frame:
    """Combine two frames of the same size: `left` up to the column `edge`, and `right` beyond it."""
    image = right.image.copy()
    image[:, :edge] = left.image[:, :edge]
    if 0 < edge < image.shape[1]:
        image[:, edge] = DIVIDER
    return Frame(image, left.costs + right.costs)
