"""Serve the viewer: one thread renders for all browsers, each of which has its own controls."""

import html
import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import viser

from gsbench.errors import InputError, one_line
from gsbench.measure.images import png
from gsbench.models import cameras
from gsbench.run.load import LoadedRun, scene_of
from gsbench.scenes import Camera, Scene
from gsbench.view import video
from gsbench.view.controls import SIDE, WIPE, Controls, ShownImage, ViserPose
from gsbench.view.frame import (
    FLOAT32,
    IMAGE,
    RASTER,
    SLICE,
    Float32Error,
    Frame,
    FrameRenderer,
    beside,
    renderers_of,
    wiped,
)
from gsbench.view.labels import Label, labelled
from gsbench.view.panel import comparison, cost_table, legend
from gsbench.view.request_guard import RequestGuard
from gsbench.view.training_views import compare, nearest_view

REST_S = 0.2  # seconds without a change after which a frame is rendered with all pixels
FRAME_S = 1 / 30  # seconds between two frames while the scene is played
SAVE_S = 2.0  # seconds between two files that are sent, so that they do not wait for a slow browser
JPEG_MOVING, JPEG_AT_REST = 75, 95  # quality
MOVING_MS = 40.0  # time limit of a frame while something moves
FLOAT32_MS = 3000.0  # about what the bound on the error of float32 may take
FLOAT32_FRAMES = 20  # that bound takes about as long as so many frames (9 to 20 were measured)
LEAST_PIXELS = 96 * 96
MOST_PIXELS = 3840 * 2160  # of a frame at rest; a larger window shows it enlarged

Notes = dict[str, Float32Error | str]  # by model: the bound on the error of float32, or why there is none


class Resolution:
    """Chooses the resolution of one browser's frames from the milliseconds of the previous frame."""

    def __init__(self, limit_ms: float) -> None:
        """Assume for the first frame that LEAST_PIXELS take as long as a limited frame may take."""
        self._limit_ms = limit_ms
        self._ms_per_pixel, self._slice_ms = limit_ms / LEAST_PIXELS, 0.0

    def took(self, pixels: int, slice_ms: float, raster_ms: float) -> None:
        """Keep the milliseconds of the last frame; those for computing 3D Gaussians do not depend on resolution."""
        self._ms_per_pixel, self._slice_ms = raster_ms / max(1, pixels), slice_ms

    def size(self, width: int, height: int, *, limited: bool) -> tuple[int, int]:
        """Return the width and height at which to render for a window; `limited`: within the time limit."""
        pixels = float(min(width * height, MOST_PIXELS))
        if limited:
            affordable = (self._limit_ms - self._slice_ms) / max(self._ms_per_pixel, 1e-9)
            pixels = min(pixels, max(LEAST_PIXELS, affordable))
        scale = math.sqrt(pixels / (width * height))
        return max(1, round(scale * width)), max(1, round(scale * height))


class Browser:
    """One browser: a frame of few pixels after each change, one of all pixels at rest, then the bound of float32."""

    def __init__(self, client: viser.ClientHandle, viewer: "Viewer") -> None:
        """Show the controls; `viewer` has the models that all browsers share."""
        self.client, self._viewer = client, viewer
        self.changed = threading.Event()
        self.rests = True  # whether the last frame has all pixels (and its bounds), and nothing has changed since
        self._rests_at = 0.0  # the time at which a frame with all pixels is due
        self._saves = False  # whether the image is to be sent as a file
        self._saved_at = -math.inf
        self._bound: Future[tuple[Frame, Notes]] | None = None  # on the error of float32, being computed
        self._resolution, self._float32_resolution = Resolution(MOVING_MS), Resolution(FLOAT32_MS)
        start = viewer.server.initial_camera
        self.controls = Controls(client, viewer.renderers, viewer.scene, start, self.change, self._save)
        client.camera.on_update(self._move)
        self.change()

    def change(self) -> None:
        """Ask for a new frame."""
        self.changed.set()
        self._viewer.wake.set()

    async def _move(self, _: viser.CameraHandle) -> None:  # async: viser would call a plain function in another thread
        self.change()

    def _save(self) -> None:
        """Render with all pixels and send the image as a file, unless one was sent just now."""
        if time.monotonic() - self._saved_at > SAVE_S:
            self._saved_at, self._saves = time.monotonic(), True
            self.change()

    def serve(self) -> float:
        """Render the frame that the browser needs now; return the seconds until it needs another without a change."""
        is_playing = self.controls.play.value
        try:
            if self.changed.is_set() or is_playing:
                self.changed.clear()
                self._render_moving()
                return FRAME_S if is_playing else REST_S
            if self.rests:
                return math.inf
            if (left := self._rests_at - time.monotonic()) > 0:
                return left
            if self._bound is None:
                self._render_at_rest()
            elif self._bound.done():
                self._show_bound(*self._bound.result())
                self.rests = True
        except Exception as error:  # of a user's model too; other browsers must still be served
            self.controls.costs.content = html.escape(one_line(error))
            self.rests = True
        return math.inf  # the end of the bound wakes the viewer

    def _render_moving(self) -> None:
        """Render a frame within the time limit, or a whole one for a file; drop a bound that is being computed."""
        if self._bound is not None:
            self._bound.cancel()
            self._bound = None
        self.controls.advance()
        self.rests, self._rests_at = False, time.monotonic() + REST_S
        has_bound = self.controls.shows_float32
        frame = self._show(limited=not self._saves or has_bound)
        if not has_bound:
            self._send(frame)

    def _render_at_rest(self) -> None:
        """Render all pixels and the nearest training view, and start to compute the bound of float32 if it is shown."""
        frame = self._show(limited=False)
        if self.controls.shows_float32:
            self._bound = self._viewer.bounds.submit(self._bounded, frame)
            self._bound.add_done_callback(lambda _: self._viewer.wake.set())
        scene = self._viewer.scene
        if not isinstance(scene, str) and self.controls.compare.value:
            nearest = nearest_view(scene, self._camera(1, 1), self.controls.now)
            request = self.controls.request_of(nearest.view)
            renderers = dict.fromkeys(renderer for renderer, _ in self.controls.shown())
            compared = [compare(renderer, nearest.view, request) for renderer in renderers]
            self.controls.comparison.content = comparison(nearest, compared)
        self.rests = self._bound is None

    def _show(self, *, limited: bool) -> Frame:
        """Render a frame, and show it with its milliseconds and the legend of its colours."""
        width, height = self._size(self._resolution, limited=limited)
        frame = self._combined(width, height, self._rendered)
        self._resolution.took(width * height, frame.ms(SLICE), frame.ms(RASTER))
        self._float32_resolution.took(width * height, 0.0, FLOAT32_FRAMES * frame.ms(RASTER))
        self._set_image(frame, JPEG_MOVING if limited else JPEG_AT_REST)
        self.controls.costs.content = cost_table(frame.costs, width, height)
        self._set_legend({})
        return frame

    def _bounded(self, usual: Frame) -> tuple[Frame, Notes]:
        """Render again with the bound on the error of float32, in fewer pixels if that takes long.

        If no model has the bound, return `usual`, the frame of all pixels that is shown already.
        """
        notes: Notes = {}

        def render(renderer: FrameRenderer, colours: str, camera: Camera) -> Frame:
            if colours == FLOAT32:
                try:
                    bound = notes[renderer.name] = renderer.float32_error(camera, self.controls.request(colours))
                    return Frame(bound.image)
                except InputError as error:
                    notes[renderer.name] = f"no bound: {error}"
            return self._rendered(renderer, colours, camera)

        frame = self._combined(*self._size(self._float32_resolution, limited=True), render)
        return frame if any(isinstance(note, Float32Error) for note in notes.values()) else usual, notes

    def _show_bound(self, frame: Frame, notes: Notes) -> None:
        self._set_image(frame, JPEG_AT_REST)
        self._set_legend(notes)
        self._send(frame)

    def _send(self, frame: Frame) -> None:
        """Send a frame as a PNG file that the browser stores, if the user asked for it."""
        if self._saves:
            self._saves = False
            names = dict.fromkeys(renderer.name for renderer, _ in self.controls.shown())
            name = " ".join([self._viewer.renderers[0].run.scene.name, *names])
            self.client.send_file_download(f"{name}.png", png(frame.image), save_immediately=True)

    def _set_image(self, frame: Frame, quality: int) -> None:
        self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=quality)

    def _set_legend(self, notes: Notes) -> None:
        text = legend(self.controls.shown(), self._viewer.renderers[0].most_cost, notes)
        if text != self.controls.legend.content:
            self.controls.legend.content = text

    def _rendered(self, renderer: FrameRenderer, colours: str, camera: Camera) -> Frame:
        return renderer.render(camera, self.controls.request(colours))

    def _combined(self, width: int, height: int, render: Callable[[FrameRenderer, str, Camera], Frame]) -> Frame:
        """Render the labelled image of one model, or one that combines two models, as the controls say."""
        shown, layout = self.controls.shown(), self.controls.layout
        camera = self._camera(max(1, width // 2) if layout == SIDE else width, height)
        frame, *others = [render(renderer, colours, camera) for renderer, colours in shown]
        edge = round(self.controls.wiped * width) if layout == WIPE else camera.width
        if others:
            frame = beside(frame, others[0]) if layout == SIDE else wiped(frame, others[0], edge)
        return frame._replace(image=labelled(frame.image, edge, *map(_label, shown)))

    def _size(self, resolution: Resolution, *, limited: bool) -> tuple[int, int]:
        camera = self.client.camera
        return resolution.size(max(1, camera.image_width), max(1, camera.image_height), limited=limited)

    def _camera(self, width: int, height: int) -> Camera:
        """Return the browser's camera for an image of the given size.

        Side by side, each of two narrow images shows all that an image of the training's proportions does.
        """
        camera, scene = self.client.camera, self._viewer.renderers[0].run.scene
        fov = camera.fov
        if self.controls.layout == SIDE:
            fov = 2 * math.atan(max(1.0, scene.width / scene.height * height / width) * math.tan(fov / 2))
        return ViserPose(camera.position, camera.wxyz, fov).camera(width, height)


class Viewer:
    """A web server that shows the models of one scene in browsers.

    One thread renders for all browsers in turn: the C library keeps the memory that a thread has freed for that thread,
    so a thread a browser would hold the memory of many frames for good.
    """

    def __init__(
        self,
        runs: Sequence[LoadedRun],  # at least one, all of one scene
        host: str,
        port: int,  # if it is in use, the next free one is taken
        data_root: str | None = None,  # of the data set, if it has moved
    ) -> None:
        """Start the web server.

        Raises:
            InputError: the runs are of different scenes, or it is not possible to listen on this host.
        """
        self.renderers, first = renderers_of(runs), runs[0]
        guard = RequestGuard(host, port)
        self.scene: Scene | str  # or the reason why its data cannot be loaded; its model can be shown without them
        try:
            self.scene = scene_of(first, data_root)
        except InputError as error:
            self.scene = str(error)
        self.browsers: dict[int, Browser] = {}
        self.wake = threading.Event()  # a browser needs a frame
        self.bounds = ThreadPoolExecutor(1)  # on the error of float32, which take so long that frames must not wait
        self._stops = False
        with guard.active():  # a server that is made here keeps refusing requests of other pages
            self.server = viser.ViserServer(host, guard.port, label=f"gsbench: {first.scene.name}", verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()  # beside the images instead of on top of them
        start, up = self.server.initial_camera, np.array(first.scene.up)
        self.server.scene.set_up_direction(up)
        start.position, _, start.fov = ViserPose.of(video.around(first, 0.0, cameras.ELEVATION))
        start.look_at, start.up = cameras.middle(first.model).double().numpy(), up
        self.server.on_client_disconnect(self._leave)
        self.server.on_client_connect(self._join)
        self.thread = threading.Thread(target=self._render_all, daemon=True)
        self.thread.start()

    def stop(self) -> None:
        """Stop the web server and the threads that render."""
        self._stops = True
        self.wake.set()
        self.server.stop()
        self.bounds.shutdown(wait=False, cancel_futures=True)

    def _render_all(self) -> None:
        while not self._stops:
            waits = [browser.serve() for browser in list(self.browsers.values())]
            least = min(waits, default=math.inf)
            self.wake.wait(None if least == math.inf else least)
            self.wake.clear()  # before the next look at what has changed

    # Async, so that viser calls both in its event loop: a browser is not removed before its controls exist.

    async def _join(self, client: viser.ClientHandle) -> None:
        self.browsers[client.client_id] = Browser(client, self)

    async def _leave(self, client: viser.ClientHandle) -> None:
        self.browsers.pop(client.client_id, None)


def _label(shown: ShownImage) -> Label:
    """Return the label of an image: its model, and its colours if they mean something else, and what was measured."""
    name, *rows = shown.renderer.label
    return name + ("" if shown.colours == IMAGE else f", {shown.colours}"), *rows
