"""Serve one browser of the viewer: a thread renders what the browser requests until the browser disconnects."""

import html
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
import viser

from gsbench.errors import InputError
from gsbench.measure.images import png
from gsbench.models.factors import rotation
from gsbench.scenes import Camera, Scene
from gsbench.view.controls import SIDE, WIPE, Controls, ShownImage
from gsbench.view.frame import FLOAT32, IMAGE, Frame, FrameRenderer, beside, wiped
from gsbench.view.labels import Label, labelled
from gsbench.view.nearest import TrainingViews, compare
from gsbench.view.panel import comparison, cost_table, legend
from gsbench.view.resolution import ROUNDING_MS, Resolution
from gsbench.view.rounding import Rounding
from gsbench.view.stages import RASTER, SLICE

REST_S = 0.2  # seconds without a change after which a frame is rendered with all pixels
FRAME_S = 1 / 30  # seconds between two frames while the scene is played
ROUNDING_FRAMES = 20  # the bound on the error of float32 takes about as long as so many frames (docs/stability.md)
COMPUTED = "the bound is being computed; this is the image"
SAVE_S = 2.0  # seconds between two files that are sent
QUALITY = {True: 75, False: 95}  # JPEG quality while something moves (True) and at rest (False)


class Workers(NamedTuple):
    """Hold the two threads that render for all browsers, each in turn.

    The C library keeps the memory that a thread has freed for that thread, so that a thread a browser would hold the
    memory of many frames for good.
    """

    frames: ThreadPoolExecutor
    bounds: ThreadPoolExecutor  # on the error of float32, which take so long that frames must not wait for them

    def stop(self) -> None:
        """End both threads after what they are doing; what waits for them is cancelled."""
        for pool in self:
            pool.shutdown(wait=False, cancel_futures=True)


class Client:
    """One browser of the viewer. Each browser has its own controls; all browsers share the models."""

    def __init__(
        self,
        client: viser.ClientHandle,
        renderers: Sequence[FrameRenderer],
        scene: Scene | str,
        most_cost: float,
        start: viser.InitialCameraConfig,
        workers: Workers,
    ) -> None:
        """Show the controls in the browser and start the thread that requests frames for it.

        Args:
            client: viser's handle of the browser.
            renderers: the renderers of the models that can be shown, at least one, all of one scene.
            scene: the scene with its training views, or a text that says why there are none.
            most_cost: the nanoseconds that the most expensive Gaussian adds to a frame; it has the brightest colour.
            start: the camera to which the browser may return.
            workers: the threads that render for all browsers.
        """
        self.client = client
        self.controls = Controls(client, renderers, scene, start)
        self.controls.save.on_click(self._save)
        self._scene = renderers[0].run.scene
        self._saving = threading.Lock()
        self._workers = workers
        self._bounding: Future[tuple[Frame | None, dict[str, Rounding | str]]] | None = None  # if something rests
        self.changed = self.controls.changed
        self.left = False
        self.rests = True  # whether the last frame has all pixels (and its bounds), and nothing has changed since
        self.resolution = Resolution()
        self._rounding_resolution = Resolution(ROUNDING_MS)
        self._views = None if isinstance(scene, str) else TrainingViews(scene)
        self._most_cost = most_cost
        client.camera.on_update(self._move)
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()
        self.changed.set()

    async def _move(self, _: viser.CameraHandle) -> None:
        """Note that the camera has moved.

        The method is async, because viser would call a plain function in another thread.
        """
        self.changed.set()

    def leave(self) -> None:
        """End the thread of a browser that has disconnected."""
        self.left = True
        self.changed.set()

    def _work(self) -> None:
        """Render a frame after each change of controls or camera, until the browser disconnects.

        When the changes stop, the frame is rendered again with all pixels, and once more where the browser requests
        the bound on the error of float32. A change ends the wait for that bound.
        """
        while True:
            playing = self.controls.play.value
            changed = self.changed.wait(FRAME_S if playing else None if self.rests else REST_S)
            moving = changed or self.controls.play.value
            if moving:
                self.rests = False
                if self._bounding is not None:
                    self._bounding.cancel()  # without effect if it has started; its result is not shown
                    self._bounding = None
            self.changed.clear()
            if self.left:  # tested after `clear`, so that a later call of `leave` ends the next wait
                return
            self.controls.advance()
            try:
                if self._bounding is not None:
                    self._end_rounding()
                else:
                    self._workers.frames.submit(self._show, moving).result()
                    if not moving:
                        self._start_rounding()
                        self._workers.frames.submit(self._compare).result()
            except InputError as error:
                self.controls.costs.content = html.escape(str(error))
            except (CancelledError, RuntimeError):
                if not self.left:  # otherwise the viewer has stopped, and its workers take nothing
                    raise
            self.rests = not moving and self._bounding is None

    def _show(self, moving: bool) -> None:
        """Render a frame, and send it to the browser with its time and the legend of its colours."""
        controls = self.controls
        width, height = self._size(self.resolution, moving)
        frame = self._combined(width, height, self._rendered)
        self.resolution.took(width * height, frame.ms(SLICE), frame.ms(RASTER))
        self._rounding_resolution.took(width * height, 0.0, ROUNDING_FRAMES * frame.ms(RASTER))
        self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=QUALITY[moving])
        controls.costs.content = cost_table(frame.costs, width, height)
        self._explain({} if moving else dict.fromkeys((one.renderer.name for one in controls.shown()), COMPUTED))

    def _start_rounding(self) -> None:
        """Start to compute the bound on the error of float32 if the browser requests it; the image is shown meanwhile.

        Another thread computes it, so that the browser is served if the user goes on.
        """
        if any(colours == FLOAT32 for _, colours in self.controls.shown()):
            self._bounding = self._workers.bounds.submit(self._bounded)

    def _bounded(self) -> tuple[Frame | None, dict[str, Rounding | str]]:
        """Render a frame with the bound on the error of float32, None if no shown model has one; and what to say."""
        said: dict[str, Rounding | str] = {}

        def render(renderer: FrameRenderer, colours: str, camera: Camera) -> Frame:
            if colours == FLOAT32:
                try:
                    found = said[renderer.name] = renderer.rounding(camera, self.controls.request(colours))
                    return Frame(found.image, ())
                except InputError as error:
                    said[renderer.name] = f"no bound: {error}"
            return self._rendered(renderer, colours, camera)

        frame = self._combined(*self._size(self._rounding_resolution, True), render)
        return frame if any(isinstance(one, Rounding) for one in said.values()) else None, said

    def _end_rounding(self) -> None:
        """Show the bound on the error of float32 if it is ready."""
        if self._bounding is not None and self._bounding.done():
            frame, said = self._bounding.result()
            self._bounding = None
            if frame is not None:
                self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=QUALITY[False])
            self._explain(said)

    def _explain(self, said: Mapping[str, Rounding | str]) -> None:
        """Show the legend of the colours, with what is known of the error of float32, by the name of the model."""
        text = legend(self.controls.shown(), self._most_cost, said)
        if text != self.controls.legend.content:
            self.controls.legend.content = text

    def _rendered(self, renderer: FrameRenderer, colours: str, camera: Camera) -> Frame:
        return renderer.render(camera, self.controls.request(colours))

    def _combined(self, width: int, height: int, render: Callable[[FrameRenderer, str, Camera], Frame]) -> Frame:
        """Render the labelled image of one model, or one that combines two models, as the controls say."""
        shown, mode = self.controls.shown(), self.controls.layout
        camera = self._camera(max(1, width // 2) if mode == SIDE else width, height)
        frame, *others = [render(renderer, colours, camera) for renderer, colours in shown]
        edge = round(self.controls.wiped * width) if mode == WIPE else camera.width
        if others:
            frame = beside(frame, others[0]) if mode == SIDE else wiped(frame, others[0], edge)
        return frame._replace(image=labelled(frame.image, edge, *map(_label, shown)))

    def _compare(self) -> None:
        """Show the training view nearest to the camera, and the models' renders of it, if the browser requests this."""
        if self._views is None or not self.controls.compare.value:
            return
        nearest = self._views.nearest(self._camera(1, 1), self.controls.now)
        request = self.controls.request_of(nearest.view)
        renderers = dict.fromkeys(renderer for renderer, _ in self.controls.shown())
        compared = [compare(renderer, nearest.view, request) for renderer in renderers]
        self.controls.comparison.content = comparison(nearest, compared)

    def _size(self, resolution: Resolution, limited: bool) -> tuple[int, int]:
        """Return the width and height in pixels at which to render a frame for the browser's window."""
        camera = self.client.camera
        return resolution.size(max(1, camera.image_width), max(1, camera.image_height), limited)

    def _save(self, _: object) -> None:
        """Send what the browser shows, with all pixels, as a PNG file that it stores; one file at a time.

        A click is passed over for SAVE_S seconds after a file, so that files do not wait for a slow browser.
        """
        if not self._saving.acquire(blocking=False):
            return
        try:
            bounded = any(colours == FLOAT32 for _, colours in self.controls.shown())
            pool = self._workers.bounds if bounded else self._workers.frames
            image = pool.submit(self._saved, bounded).result()
            names = dict.fromkeys(renderer.name for renderer, _ in self.controls.shown())
            name = " ".join([self._scene.name, *names])
            self.client.send_file_download(f"{name}.png", image, save_immediately=True)
            time.sleep(SAVE_S)
        except InputError as error:
            self.controls.costs.content = html.escape(str(error))
        finally:
            self._saving.release()

    def _saved(self, bounded: bool) -> bytes:
        """Return what the browser shows, with all pixels, as a PNG file; `bounded`: with the bounds of float32."""
        frame = self._bounded()[0] if bounded else None
        return png((frame or self._combined(*self._size(self.resolution, False), self._rendered)).image)

    def _camera(self, width: int, height: int) -> Camera:
        """Return the browser's camera for an image of the given size; the browser's field of view is vertical.

        Side by side, each of two narrow images shows all that an image of the training's proportions does.
        """
        seen, fov = self.client.camera, self.client.camera.fov
        if self.controls.layout == SIDE:
            proportions = self._scene.width / self._scene.height
            fov = 2 * math.atan(max(1.0, proportions * height / width) * math.tan(fov / 2))
        return camera_at(np.asarray(seen.position), np.asarray(seen.wxyz), fov, width, height)


def _label(shown: ShownImage) -> Label:
    """Return the label of an image: its model, and its colours if they mean something else, and what was measured."""
    renderer, colours = shown
    return renderer.name + ("" if colours == IMAGE else f", {colours}"), *renderer.measured


def camera_at(position: np.ndarray, wxyz: np.ndarray, fov: float, width: int, height: int) -> Camera:
    """Return a camera for the pose and the field of view of a camera in viser.

    Args:
        position: the position of the camera [3], world units.
        wxyz: quaternion of the rotation from camera axes (OpenCV convention) to world axes.
        fov: the vertical field of view, radians.
        width: width of the image, pixels.
        height: height of the image, pixels.
    """
    R = rotation(torch.tensor(wxyz, dtype=torch.float64)[None])[0]
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = R.T, -R.T @ torch.tensor(position, dtype=torch.float64)
    focal = height / 2 / math.tan(fov / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(viewmat.float(), K, width, height)
