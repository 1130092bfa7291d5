"""Record the renders of a model as a CUDA graph, and replay it for other cameras and times."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import resolve
from gsbench.kernels.raster import Viewport
from gsbench.models.base import GaussianModel
from gsbench.models.query import Query
from gsbench.models.render import rasterize_slice
from gsbench.raster import EPS2D, FAR, NEAR
from gsbench.raster.native import draw_within
from gsbench.scenes.scene import Camera

MARGIN = 1.25  # room for intersections, as a multiple of what the first image needs
T = TypeVar("T")


class _Recording(NamedTuple):
    """A recorded render of one image size. Its camera and time are overwritten before each replay."""

    camera: Camera
    time: Tensor | None  # []
    play: Callable[[], None]
    image: Tensor  # [H, W, 3]
    needed: Tensor  # [2] int64: intersections, and whether a value was out of range
    room: int  # for intersections


class GraphedFrames:
    """Renders a model on a GPU like `render`, but replays its kernels and waits only at the end of an image.

    The first call for an image size records a graph, which fixes the numbers of Gaussians and of pixels. `render` waits
    for the number of intersections in the middle of an image. A graph has memory for a fixed number, MARGIN times that
    of the first image. The number is checked at the end; if it is larger, the graph is recorded again.
    """

    def __init__(self, model: GaussianModel, background: Tensor, antialias: bool = False) -> None:
        """Render `model`, whose parameters may change in value but not in number, with a background colour [3].

        Raises:
            InputError: this model is not rendered by the CUDA backend.
        """
        backend = resolve(model.backend.name, model.splats["means"].device.type)
        if backend.name != "cuda":
            raise InputError(f"CUDA graph: expected raster.backend=cuda, got '{backend.name}': only a GPU records what "
                             f"it does")  # fmt: skip
        self.model = model
        self.background = background
        self.antialias = antialias
        self._recordings: dict[tuple[int, int, bool], _Recording] = {}

    @torch.no_grad()
    def __call__(self, camera: Camera, time: float | None) -> Tensor:  # [H, W, 3]
        """Render the model for a camera at a time; the next call overwrites the image.

        Raises:
            InputError: the model observes time and `time` is None, or a value is out of range.
            RuntimeError: CUDA cannot record this model.
        """
        size = camera.width, camera.height, time is None
        if size not in self._recordings:
            self._recordings[size] = self._record(camera, time)
        recording = self._recordings[size]
        recording.camera.viewmat.copy_(camera.viewmat)
        recording.camera.K.copy_(camera.K)
        if recording.time is not None and time is not None:
            recording.time.fill_(time)
        recording.play()
        *pairs, flags = recording.needed.tolist()  # waits for the image
        if flags or any(n > recording.room for n in pairs):
            del self._recordings[size]
            return self(camera, time)
        return recording.image

    def _record(self, camera: Camera, time: float | None) -> _Recording:
        seen = self.model.slice(Query.of(camera, time))
        drawn = rasterize_slice(seen, camera, self.background, self.model.backend, self.antialias)
        room = 1 + int(MARGIN * drawn.info.pairs)
        own = Camera(camera.viewmat.clone(), camera.K.clone(), camera.width, camera.height)
        own_time = None if time is None else own.K.new_full((), time)
        view = Viewport(camera.width, camera.height, NEAR, FAR, EPS2D, self.antialias)

        def frame() -> tuple[Tensor, Tensor]:
            # The first image was refused if the model has shapes.
            means, factors, opacities, colors, _ = self.model.slice(Query.of(own, own_time))
            return draw_within(means, factors, opacities, colors[None], own.viewmat[None], own.K[None],
                                self.background, view, room)  # fmt: skip

        with torch.cuda.device_of(own.K):
            play, (image, needed) = capture(frame)
        return _Recording(own, own_time, play, image[0], needed, room)


def capture(call: Callable[[], T]) -> tuple[Callable[[], None], T]:
    """Record a call on the current GPU; return the function that replays it, and the results that it overwrites."""
    call()  # the first call loads modules, which cannot be recorded
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        results = call()
    return graph.replay, results
