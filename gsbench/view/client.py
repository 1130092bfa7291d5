"""Serve one browser of the viewer: its controls, and the thread that renders for it until it leaves."""

import math
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import viser

from gsbench.errors import InputError
from gsbench.models.factors import rotation
from gsbench.scenes import Camera, Scene
from gsbench.view.frame import Asked, Frame, Painter, beside, wiped
from gsbench.view.frusta import Frusta
from gsbench.view.resolution import Resolution

REST_S = 0.2  # without a change, after which a frame is rendered again with all pixels
PLAYED_S = 4.0  # a clip takes that long
FRAME_S = 1 / 30  # least time between two frames while a clip is played
ONE, SIDE, WIPE = "one model", "side by side", "wipe"
QUALITY = {True: 75, False: 95}  # of the JPEG while something moves, and at rest


class Client:
    """One browser. Everything that it chooses is its own; the models are shared."""

    def __init__(self, client: viser.ClientHandle, painters: Sequence[Painter], scene: Scene | str) -> None:
        """Show the controls and begin to render.

        Args:
            client: the browser, as viser has it.
            painters: of the models that can be shown, one or more of one scene.
            scene: with the training views; or why there are none.
        """
        self.client = client
        self.painters = {painter.name: painter for painter in painters}
        self.changed = threading.Event()
        self.left = False
        self.rests = True  # whether the last frame has all pixels, and nothing has changed since
        self.resolution = Resolution()
        self._frozen: torch.Tensor | None = None  # the place that slices are seen from
        self._held: float | None = None  # the time that slices are of
        self._played_at = time.monotonic()
        self._add_controls(scene)
        client.camera.on_update(lambda _: self.changed.set())
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()
        self.changed.set()

    def leave(self) -> None:
        """End the thread of a browser that is gone."""
        self.left = True
        self.changed.set()

    # ---- controls

    def _add_controls(self, scene: Scene | str) -> None:
        """Add the controls to the browser's panel."""
        gui, names = self.client.gui, list(self.painters)
        has_time = self.painters[names[0]].run.scene.has_time
        self.status = gui.add_markdown("")
        self.time = gui.add_slider("time", 0.0, 1.0, 0.005, 0.0, disabled=not has_time)
        self.play = gui.add_checkbox("play", False, disabled=not has_time)
        hold = gui.add_checkbox("freeze time", False, disabled=not has_time, hint="slices stay those of this time")
        freeze = gui.add_checkbox("freeze direction", False, hint="slices stay those seen from here; move to see them")
        self.agr = gui.add_checkbox("AGR", True, disabled=not any(p.has_agr for p in self.painters.values()))
        several = len(names) > 1
        self.mode = gui.add_dropdown("show", [ONE, SIDE, WIPE] if several else [ONE], visible=several)
        self.first = gui.add_dropdown("model", names, visible=several)
        self.second = gui.add_dropdown("and", names, initial_value=names[-1], visible=several)
        self.wipe = gui.add_slider("wipe at", 0.0, 1.0, 0.01, 0.5, visible=several)
        if isinstance(scene, str):
            gui.add_checkbox("training cameras", False, disabled=True, hint=scene)
        else:
            self.frusta = Frusta(self.client, scene, self._go_to)
            shown = gui.add_checkbox("training cameras", False, hint="click on one to stand there")
            shown.on_update(lambda _: self.frusta.show(shown.value))
        freeze.on_update(lambda _: self._freeze(freeze.value))
        hold.on_update(lambda _: self._hold(hold.value))
        self.play.on_update(lambda _: self._start_clock())
        watched: list[Any] = [self.time, self.agr, self.mode, self.first, self.second, self.wipe]
        for control in watched:
            control.on_update(lambda _: self.changed.set())

    def _freeze(self, on: bool) -> None:
        """Keep the place from which slices are seen, or let it be the camera's again."""
        position = torch.tensor(np.asarray(self.client.camera.position), dtype=torch.float32)
        self._frozen = position if on else None
        self.changed.set()

    def _hold(self, on: bool) -> None:
        """Keep the time that slices are of, or let it be the slider's again."""
        self._held = self.time.value if on else None
        self.changed.set()

    def _start_clock(self) -> None:
        self._played_at = time.monotonic()
        self.changed.set()

    def _go_to(self, position: np.ndarray, wxyz: np.ndarray, time: float | None) -> None:
        """Stand where a training camera stood, at its time."""
        with self.client.atomic():
            self.client.camera.position, self.client.camera.wxyz = position, wxyz
        if time is not None:
            self.time.value = time  # type: ignore[misc]  # viser declares it read-only to mypy
        self.changed.set()

    # ---- rendering

    def _work(self) -> None:
        """Render whenever something changes, and once more when it no longer does, until the browser leaves."""
        while True:
            changed = self.changed.wait(FRAME_S if self.play.value else None if self.rests else REST_S)
            if self.left:
                return
            moving = changed or self.play.value
            if moving:
                self.rests = False
            self.changed.clear()
            self._advance()
            try:
                self._show(moving)
            except InputError as error:
                self.status.content = str(error)
            self.rests = not moving

    def _advance(self) -> None:
        """Move the slider on while a clip is played."""
        now = time.monotonic()
        if self.play.value:
            on = (now - self._played_at) / PLAYED_S
            self.time.value = (self.time.value + on) % 1.0  # type: ignore[misc]  # as above
        self._played_at = now

    def _show(self, moving: bool) -> None:
        """Render a frame and send it to the browser, with what it cost."""
        camera = self.client.camera
        width, height = self.resolution.size(max(1, camera.image_width), max(1, camera.image_height), moving)
        frame = self._frame(width, height)
        self.resolution.took(width * height, frame.slice_ms, frame.raster_ms)
        self.client.scene.set_background_image(frame.image, format="jpeg", jpeg_quality=QUALITY[moving])
        fps = 1000 / (frame.slice_ms + frame.raster_ms)
        self.status.content = (f"slice {frame.slice_ms:.1f} ms, raster {frame.raster_ms:.1f} ms: {fps:.0f} FPS "
                               f"at {width} x {height}")  # fmt: skip

    def _frame(self, width: int, height: int) -> Frame:
        """Render one model or two as the controls say."""
        first, second, mode = self.painters[self.first.value], self.painters[self.second.value], self.mode.value
        if mode == SIDE:
            half = self._camera(max(1, width // 2), height)
            return beside(first.paint(half, self._asked(first)), second.paint(half, self._asked(second)))
        camera = self._camera(width, height)
        if mode == WIPE:
            left, right = first.paint(camera, self._asked(first)), second.paint(camera, self._asked(second))
            return wiped(left, right, self.wipe.value)
        return first.paint(camera, self._asked(first))

    def _asked(self, painter: Painter) -> Asked:
        """Return the query that the controls stand for."""
        shown = self.time.value if self._held is None else self._held
        return Asked(shown if painter.run.scene.has_time else None, self._frozen, self.agr.value)

    def _camera(self, width: int, height: int) -> Camera:
        """Return the browser's camera for an image of that size; its field of view is the vertical one."""
        seen = self.client.camera
        return camera_at(np.asarray(seen.position), np.asarray(seen.wxyz), seen.fov, width, height)


def camera_at(position: np.ndarray, wxyz: np.ndarray, fov: float, width: int, height: int) -> Camera:
    """Return the camera of a pose as viser has it.

    Args:
        position: [3], world units.
        wxyz: quaternion of the rotation from the camera, in OpenCV axes, to the world.
        fov: vertical, radians.
        width: pixels.
        height: pixels.
    """
    R = rotation(torch.tensor(wxyz, dtype=torch.float64)[None])[0]
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = R.T, -R.T @ torch.tensor(position, dtype=torch.float64)
    focal = height / 2 / math.tan(fov / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(viewmat.float(), K, width, height)
