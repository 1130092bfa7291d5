"""Render an image of a model, once or as a CUDA graph that is replayed for other cameras and times."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import Backend, resolve
from gsbench.kernels.raster import RasterInputs, Viewport, enqueue, room_for
from gsbench.models.base import GaussianModel
from gsbench.models.camera_time import CameraTime
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.raster import EPS2D, FAR, RasterOutput, rasterize
from gsbench.scenes.scene import Camera


def rasterize_slice(
    gaussians: Gaussians3D, camera: Camera, background: Tensor, backend: Backend, antialias: bool = False
) -> RasterOutput:
    """Rasterize the 3D Gaussians of a model (with colours) for one camera, as `gsbench.raster.rasterize`.

    The background [3] is that of the first three channels; behind further ones there is 0.
    """
    return rasterize_slices(gaussians, [camera], background, backend, antialias)


def rasterize_slices(
    gaussians: Gaussians3D,  # [N, ..] for all cameras, or [C, N, ..]
    cameras: Sequence[Camera],  # of equal size and near plane
    background: Tensor,
    backend: Backend,
    antialias: bool = False,
) -> RasterOutput:
    """Rasterize slices of a model in one call, each for its camera, otherwise as `rasterize_slice`."""
    camera = cameras[0]
    return rasterize(
        *gaussians[:4],  # means, factors, opacities and colours
        in_one([x.viewmat for x in cameras]),
        in_one([x.K for x in cameras]),
        camera.width,
        camera.height,
        background=_behind(gaussians, background),
        near=camera.near,
        backend=backend,
        antialias=antialias,
        beta_exponents=gaussians.beta_exponents,
    )


def in_one(tensors: list[Tensor]) -> Tensor:
    """Stack the tensors of several views, without a copy if there is only one."""
    return tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)


def _behind(gaussians: Gaussians3D, background: Tensor) -> Tensor:
    """Return what is behind all channels of 3D Gaussians: the background [3], then zeros."""
    further = gaussians.colors.shape[-1] - len(background)
    return F.pad(background, (0, further)) if further else background


def render_slices(
    model: GaussianModel,  # that does not decode, if there are several cameras
    gaussians: Gaussians3D,  # [N, ..] for all cameras, or [C, N, ..]
    cameras: Sequence[Camera],  # of equal size and near plane
    background: Tensor,
    antialias: bool = False,
) -> RasterOutput:
    """Render slices of a model in one call, each for its camera, and let the model decode what was blended."""
    output = rasterize_slices(gaussians, cameras, background, model.backend, antialias)
    return replace(output, image=model.decode(output.image, cameras[0]))


def render(
    model: GaussianModel, camera: Camera, time: float | None, background: Tensor, antialias: bool = False
) -> Tensor:
    """Render the image [H, W, 3] of a model for a camera and a time in [0, 1], with its backend."""
    gaussians = model.slice(CameraTime.of(camera, time))
    return render_slices(model, gaussians, [camera], background, antialias).image[0]


T = TypeVar("T")


class _Recording(NamedTuple):
    """Hold a CUDA graph that renders images of one size. The camera and time are overwritten before each replay."""

    camera: Camera
    time: Tensor | None  # []
    play: Callable[[], None]
    image: Tensor  # [H, W, 3]
    needed: Tensor  # [2] int64: intersections, and whether a value was out of range
    room: int  # the number of intersections that fit into the graph's memory


class GraphedFrames:
    """Render images of a model on a GPU by replaying a CUDA graph.

    The first call for an image size records the graph. The graph has memory for more tile intersections than
    the first image has (`room_for`), so rendering needs no synchronisation before the end of an image. If an image
    has more than fit, the graph is recorded again. The number of Gaussians must not change.
    """

    def __init__(self, model: GaussianModel, background: Tensor, antialias: bool = False) -> None:
        """Prepare to render a model on a GPU; raises InputError if it does not use the CUDA backend."""
        backend = resolve(model.backend.name, model.splats["means"].device.type)
        if backend.name != "cuda":
            raise InputError(
                f"CUDA graph: expected raster.backend=cuda, got '{backend.name}': only a GPU records what it does"
            )
        self.model = model
        self.background = background
        self.antialias = antialias
        self._recordings: dict[tuple[int, int, bool], _Recording] = {}

    @torch.no_grad()
    def __call__(self, camera: Camera, time: float | None) -> Tensor:  # [H, W, 3]
        """Return the image of the model for a camera and a time. The next call overwrites this image.

        Raises:
            InputError: the model depends on time and `time` is None, or a value is out of range.
            RuntimeError: CUDA cannot record this model.
        """
        key = camera.width, camera.height, time is None
        if key not in self._recordings:
            self._recordings[key] = self._record(camera, time)
        recording = self._recordings[key]
        recording.camera.overwrite(camera)
        if recording.time is not None and time is not None:
            recording.time.fill_(time)
        recording.play()
        pairs, flags = recording.needed.tolist()  # waits for the image
        if flags or pairs > recording.room:  # record again: for more pairs, or to raise the error of a wrong value
            del self._recordings[key]
            return self(camera, time)
        return recording.image

    def _record(self, camera: Camera, time: float | None) -> _Recording:
        """Record a graph with room for more intersections than this image has, which is checked as it is drawn once."""
        gaussians = self.model.slice(CameraTime.of(camera, time))
        drawn = rasterize_slice(gaussians, camera, self.background, self.model.backend, self.antialias)
        room = room_for(drawn.info.pairs)
        recorded = camera.clone()
        moment = None if time is None else recorded.K.new_full((), time)
        view = Viewport(camera.width, camera.height, camera.near, FAR, EPS2D, self.antialias)

        def frame() -> tuple[Tensor, Tensor]:
            gaussians = self.model.slice(CameraTime.of(recorded, moment))
            means, factors, opacities, colors, beta_exponents = gaussians
            camera_tensors = recorded.viewmat[None], recorded.K[None], _behind(gaussians, self.background)
            inputs = RasterInputs(means, factors, opacities, colors[None], *camera_tensors, beta_exponents)
            drawing = enqueue(inputs, view, room)
            return self.model.decode(drawing.image, recorded), drawing.needed

        with torch.cuda.device_of(recorded.K):
            play, (image, needed) = capture(frame)
        return _Recording(recorded, moment, play, image[0], needed, room)


def capture(call: Callable[[], T]) -> tuple[Callable[[], None], T]:
    """Record a call as a CUDA graph. Return a function that replays it, and the result, which a replay overwrites."""
    call()  # the first call loads modules, which cannot be recorded
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        results = call()
    return graph.replay, results
