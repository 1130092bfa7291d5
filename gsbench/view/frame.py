"""Render and time one frame of the viewer: a model as the controls ask for it, or two models in one image."""

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.gates.gate import most_cost
from gsbench.gates.picture import cost_colors, effect_set_colors
from gsbench.kernels.operation import Operation, Results
from gsbench.kernels.tape import Tape
from gsbench.measure.images import STEPS, Pixels, inferno, rounding_image, to_bytes
from gsbench.measure.speed import StageClock
from gsbench.models import GaussianModel
from gsbench.models.camera_time import CameraTime
from gsbench.models.render import rasterize_slice, render_slices
from gsbench.run.load import LoadedRun
from gsbench.scenes import Camera
from gsbench.schedule import ActiveComponents
from gsbench.stability.float32_error import check_exactness, float64_camera, float64_image, float64_model
from gsbench.view.labels import measurements, short_names

SLICE, RASTER = "slice", "raster"  # compute the 3D Gaussians at a time and a viewpoint, and rasterize them
STAGES = {SLICE: ("AGR", "conditioning", "colours"), RASTER: ("projection", "binning", "blending")}
# By the name of a kernel operation: the stage that ends after it, and the stage that ends before it.
_ENDS = {"refine": "AGR", "show_colors": "colours", "project": "projection", "blend": "blending"}
_FOLLOWS = {"show_colors": "conditioning", "blend": "binning"}

DIVIDER = (255, 255, 255)  # RGB of the line between two models
IMAGE, CLASS, COST = PLAIN = ("image", "class", "cost")  # meanings of the Gaussians' colours
FLOAT32 = "float32"  # instead of Gaussians the bound on the error of float32, which takes 20 times as long as a frame
COLOURS = (*PLAIN, FLOAT32)
EVERY_DEGREE = 3  # the highest SH degree of any model


class FrameRequest(NamedTuple):
    """The settings of a requested frame."""

    time: float | None  # in [0, 1]; None if the scene is static
    center: Tensor | None = None  # [3], viewpoint for which Gaussians are computed; None: the camera's
    agr: bool = True  # whether AGR (neural refinement) is on, if the model has it
    sh_degree: int = EVERY_DEGREE  # highest SH degree of the colours
    colours: str = IMAGE  # one of PLAIN
    background: Tensor | None = None  # [3] RGB in [0, 1], of the colours IMAGE; None: that of the training


class FrameCost(NamedTuple):
    """The milliseconds that one model takes for a frame, by stage."""

    name: str  # of the model
    ms: dict[str, float]  # by stage, in their order; a part that torch computes is a single stage

    def of(self, part: str) -> float:
        """Return the milliseconds of SLICE or RASTER."""
        return sum(ms for stage, ms in self.ms.items() if stage == part or stage in STAGES[part])


class Frame(NamedTuple):
    """A rendered image, and the milliseconds of each model in it."""

    image: Pixels  # [H, W, 3] RGB
    costs: tuple[FrameCost, ...] = ()

    def ms(self, part: str) -> float:
        """Return the milliseconds of SLICE or RASTER, summed over the models."""
        return sum(cost.of(part) for cost in self.costs)


class Float32Error(NamedTuple):
    """The bound on the error of float32 in a frame: its image, and a summary in steps of 8 bits, 1/255."""

    image: Pixels  # [H, W, 3] RGB, on the scale of `gsbench.measure.images.rounding_image`
    largest: float  # bound of a pixel
    median: float  # bound of the pixels that show a Gaussian
    undecided: float  # share of the pixels in which rounding may decide what is blended, or in which order
    seconds: float  # that it took


class StageWatch(Tape):
    """Times the stages of a frame: ``with StageWatch(device) as watch: ...; watch.end(SLICE); ...; watch.end(RASTER)``.

    The watch takes the place of the tape that records kernel calls for the backward pass, so it sees when each kernel
    begins and ends. It records no call, so there are no gradients.
    """

    def __init__(self, device: str) -> None:
        super().__init__()
        self._clock = StageClock(device)
        self._clock.start()
        self._ended: set[str] = set()  # stages that a kernel has ended

    def record(
        self, operation: Operation, tensors: list[Tensor], numbers: Sequence[Any], results: Results | None
    ) -> list[Tensor]:
        """Run a kernel; if a stage of the frame ends just before or just after this kernel, store the stage's time.

        A GPU's rasterizer is a single stage: one call has computed all `results`.
        """
        if results is not None:
            return results[0]
        if operation.name in _FOLLOWS:
            self._clock.lap(_FOLLOWS[operation.name])
        outputs, _ = operation.run(tensors, numbers)
        if operation.name in _ENDS:
            self._ended.add(_ENDS[operation.name])
            self._clock.lap(_ENDS[operation.name])
        return outputs

    def end(self, part: str) -> None:
        """End SLICE or RASTER; the time since its last kernel belongs to its last stage, or to it if there is none."""
        last = STAGES[part][-1]
        self._clock.lap(last if last in self._ended else part)

    @property
    def ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage that was measured."""
        return {name: 1000 * seconds for name, seconds in self._clock.seconds.items()}


class FrameRenderer:
    """Renders the frames of one run's model, one at a time, as it switches parts of the model on and off for each."""

    def __init__(
        self,
        run: LoadedRun,
        name: str,  # which no other run has
        most_cost: float,  # ns that the most expensive Gaussian of all compared models adds to a frame: the brightest
    ) -> None:
        self.run, self.name, self.most_cost = run, name, most_cost
        self.label = (name, *measurements(run))
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

    def image(self, camera: Camera, request: FrameRequest) -> Tensor:
        """Render the image of a camera as floats, [H, W, 3], from which PSNR can be computed."""
        return self._timed_image(camera, request)[0].cpu()

    def float32_error(self, camera: Camera, request: FrameRequest) -> Float32Error:
        """Bound the error of float32 in each pixel of the image of a camera; other frames can be rendered meanwhile.

        Raises:
            InputError: there is no such bound: the model is on a GPU, the CPU kernels are not built, or the model does
                not compute in float64.
        """
        run, center, start = self.run, request.center, time.perf_counter()
        check_exactness(run.model)
        with self._exact_lock, torch.inference_mode():
            with self._lock:
                self._exact = self._exact or float64_model(run.model)
                run.model.active = self._exact.active = self._active(request)
                single = run.model.slice(CameraTime.at(camera.center if center is None else center, request.time))
            query = CameraTime.at(float64_camera(camera).center if center is None else center.double(), request.time)
            try:
                gaussians = self._exact.slice(query)
            except InputError:
                raise
            except Exception as error:  # a user's model may compute in float32 alone, and fail in any way
                raise InputError(f"the model does not compute in float64: {one_line(error)}") from None
            antialias = run.config.raster.antialias
            camera = replace(camera, near=run.near)
            reference = float64_image(gaussians, single, camera, self._background(request), antialias)
            bound, undecided = STEPS * reference.bound, float(reference.undecided.double().mean())
            return Float32Error(
                rounding_image(bound.numpy()),
                float(bound.max()),
                STEPS * reference.median_bound,
                undecided,
                time.perf_counter() - start,
            )

    def _timed_image(self, camera: Camera, request: FrameRequest) -> tuple[Tensor, dict[str, float]]:
        """Return the image of a camera, [H, W, 3], and the milliseconds of each stage."""
        run, device = self.run, self.run.config.device
        camera = replace(camera.to(device), near=run.near)
        center = camera.center if request.center is None else request.center.to(device)
        query = CameraTime.at(center, request.time)
        with self._lock, torch.inference_mode(), StageWatch(device) as watch:
            run.model.active = self._active(request)
            gaussians = run.model.slice(query)
            watch.end(SLICE)
            background, antialias = self._background(request), run.config.raster.antialias
            if request.colours in self._colors:
                gaussians = gaussians._replace(colors=self._colors[request.colours])
                output = rasterize_slice(gaussians, camera, background, run.model.backend, antialias)
            else:
                output = render_slices(run.model, gaussians, [camera], background, antialias)
            watch.end(RASTER)
            return output.image[0], watch.ms

    def _background(self, request: FrameRequest) -> Tensor:
        """Return the background colour of a frame, [3]; colours with a legend keep the background of that legend."""
        usual = self._backgrounds[request.colours]
        return usual if request.background is None or request.colours != IMAGE else request.background.to(usual)

    def _active(self, request: FrameRequest) -> ActiveComponents:
        """Return the parts of the model that are on in a frame: as trained, without those that are switched off."""
        trained = self.trained_active
        degree = min(request.sh_degree, trained.sh_degree)
        return replace(trained, refine=request.agr and trained.refine, sh_degree=degree)


def renderers_of(runs: Sequence[LoadedRun]) -> list[FrameRenderer]:
    """Return a renderer for each of several runs that are compared: distinct names, one colour scale of costs.

    Raises:
        InputError: the runs are of different scenes.
    """
    first = runs[0]
    for run in runs:
        if run.scene.fingerprint != first.scene.fingerprint:
            data = f"{first.scene.name} in {first.folder} and other data in {run.folder}"
            raise InputError(f"expected runs of one scene to look at together, got {data}")
    most = max(most_cost(run.model) for run in runs)
    return [FrameRenderer(run, name, most) for run, name in zip(runs, short_names(runs), strict=True)]


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
