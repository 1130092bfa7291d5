"""Show the controls in one browser of the viewer, and turn their values into requests for frames."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import viser

from gsbench.scenes import Scene, View
from gsbench.view.frame import CLASS, COLOURS, IMAGE, PLAIN, FrameRenderer, FrameRequest
from gsbench.view.frusta import Frusta

PLAYED_S = 4.0  # seconds in which the time goes from 0 to 1
ONE, SIDE, WIPE = "one image", "side by side", "wipe"
Rgb = tuple[int, int, int]  # 0 to 255
NEAREST = "nearest training view"
NARROW = 576  # pixels; in a narrower window viser shows the panel on the image, as on a phone
PANEL = {"x": 15.0, "y": -15.0, "width": 400.0}  # position in pixels from the left and the bottom


class ShownImage(NamedTuple):
    """An image on the screen: the model that it shows, and what its colours mean."""

    renderer: FrameRenderer  # of the model
    colours: str  # one of COLOURS


class Controls:
    """The controls of one browser; the event `changed` is set whenever the user changes one."""

    def __init__(
        self,
        client: viser.ClientHandle,
        renderers: Sequence[FrameRenderer],
        scene: Scene | str,
        start: viser.InitialCameraConfig,
    ) -> None:
        """Show the controls in the browser.

        Args:
            client: viser's handle of the browser.
            renderers: the renderers of the models that can be shown, at least one, all of one scene.
            scene: the scene with its training views, or a text that says why there are none.
            start: the camera to which `reset` returns.
        """
        self.client = client
        self._start = start
        self._initial: list[tuple[viser.GuiInputHandle[Any], Any]] = []  # the controls, and their values at the start
        self.changed = threading.Event()
        self._renderers = {renderer.name: renderer for renderer in renderers}
        self._has_time = renderers[0].run.scene.has_time
        self._trained_background = _rgb(renderers[0].run.scene.background)
        self._frozen: torch.Tensor | None = None  # viewpoint for which Gaussians are computed; None: the camera
        self._held: float | None = None  # time for which Gaussians are computed; None: the slider's
        self._played_at = time.monotonic()
        with self._folded("milliseconds"):
            self.costs = client.gui.add_html("")
        self._add_time()
        with self._folded("controls"):
            self._add_effects()
            self._add_images()
            self._add_views(scene)
            self._add_buttons()

    def _folded(self, name: str) -> AbstractContextManager[object]:
        """Return a folder, closed at first, for a narrow window, where the panel lies on the image; otherwise none."""
        narrow = self.client.camera.image_width < NARROW
        return self.client.gui.add_folder(name, expand_by_default=False) if narrow else nullcontext()

    def _add_time(self) -> None:
        """Add a slider for the time, and a check box that plays the scene."""
        gui = self.client.gui
        self.time = gui.add_slider("time", 0.0, 1.0, 0.005, 0.0, disabled=not self._has_time)
        self.play = gui.add_checkbox("play", False, disabled=not self._has_time)
        self._watch(self.time, self._change)
        self._watch(self.play, self._start_clock)

    def _add_effects(self) -> None:
        """Add controls that switch off what models depend on: time, view direction and AGR (a network)."""
        gui, renderers = self.client.gui, self._renderers.values()
        degree = max(renderer.trained_active.sh_degree for renderer in renderers)
        with gui.add_folder("effects"):
            self.agr = gui.add_checkbox("AGR", True, disabled=not any(renderer.has_agr for renderer in renderers))
            hold = gui.add_checkbox("freeze time", False, disabled=not self._has_time, hint="slices stay those of now")
            freeze = gui.add_checkbox("freeze direction", False, hint="slices stay those seen from here")
            self.degree = gui.add_slider("harmonics", 0, max(degree, 1), 1, degree, disabled=degree == 0,
                                         hint="degree of the colours; 0: the same from everywhere")  # fmt: skip
        self._watch(self.agr, self._change)
        self._watch(self.degree, self._change)
        self._watch(hold, lambda _: self._hold(hold.value))
        self._watch(freeze, lambda _: self._freeze(freeze.value))

    def _add_images(self) -> None:
        """Add controls that select the models, what the colours of their Gaussians mean, and the background."""
        gui, names = self.client.gui, list(self._renderers)
        several = len(names) > 1
        self.mode = gui.add_dropdown("show", (ONE, SIDE, WIPE), initial_value=SIDE if several else ONE)
        first = gui.add_dropdown("model", names, visible=several)
        colours = gui.add_dropdown("colours", COLOURS, hint="of the Gaussians; float32: the bound on the error")
        second = gui.add_dropdown("second model", names, initial_value=names[min(1, len(names) - 1)], visible=several)
        others = gui.add_dropdown("second colours", COLOURS, initial_value=IMAGE if several else CLASS, visible=several)
        self.wipe = gui.add_slider("wipe at", 0.0, 1.0, 0.01, 0.5, visible=False)
        self.background = gui.add_rgb("background", self._trained_background, hint="of the colours 'image'")
        self.legend = gui.add_html("")
        self._choices = (first, colours), (second, others)

        def show(_: object) -> None:
            second.visible = several and self.mode.value != ONE
            others.visible, self.wipe.visible = self.mode.value != ONE, self.mode.value == WIPE
            self.changed.set()

        self._watch(self.mode, show)
        for control in (first, colours, second, others, self.wipe, self.background):
            self._watch(control, self._change)

    def _add_views(self, scene: Scene | str) -> None:
        """Add controls that show the training views; they are disabled if the data set is not available."""
        gui, why = self.client.gui, scene if isinstance(scene, str) else None
        frusta = gui.add_checkbox("training cameras", False, disabled=why is not None,
                                  hint=why or "click on one to stand there; not side by side")  # fmt: skip
        self.compare = gui.add_checkbox(NEAREST, False, disabled=why is not None,
                                        hint=why or "its image, the model's, and the error")  # fmt: skip
        if isinstance(scene, str):
            return
        handles = Frusta(self.client, scene, self._go_to)

        def show_frusta(_: object) -> None:
            """Show the frusta unless two images are side by side, whose cameras are not that of the browser's scene."""
            frusta.disabled = self.layout == SIDE
            handles.show(frusta.value and self.layout != SIDE)

        show_frusta(None)
        self.mode.on_update(show_frusta)
        self._watch(frusta, show_frusta)
        panel = gui.add_panel(visible=False)
        with panel.add_tab(NEAREST):
            self.comparison = gui.add_html("")
        panel.float(**PANEL)

        def show(_: object) -> None:
            panel.visible = self.compare.value
            self.changed.set()

        self._watch(self.compare, show)

    def _add_buttons(self) -> None:
        """Add a button that brings everything back to the start, and one that stores the image as a file."""
        self.client.gui.add_button("reset", hint="the camera and all controls").on_click(self._reset)
        self.save = self.client.gui.add_button("save image", hint="as it is shown, with all pixels")

    def _watch(self, control: viser.GuiInputHandle[Any], callback: Callable[[object], None]) -> None:
        """Call `callback` whenever the user changes a control, and note the value to which `reset` returns."""
        control.on_update(callback)
        self._initial.append((control, control.value))

    # ---- what happens in the browser

    def _change(self, _: object) -> None:
        self.changed.set()

    def _hold(self, on: bool) -> None:
        """Keep showing the Gaussians of the present time, or let the time slider change them again."""
        self._held = self.now if on else None
        self.changed.set()

    def _freeze(self, on: bool) -> None:
        """Keep showing the Gaussians computed for the present viewpoint, or let them follow the camera again."""
        position = torch.tensor(np.asarray(self.client.camera.position), dtype=torch.float32)
        self._frozen = position if on else None
        self.changed.set()

    def _reset(self, _: object) -> None:
        """Return to the camera and the controls of the start; the clip stops before its time is set."""
        for control, value in reversed(self._initial):
            control.value = value
        camera = self.client.camera
        with self.client.atomic():
            camera.position, camera.look_at, camera.fov = self._start.position, self._start.look_at, self._start.fov
            if self._start.up is not None:
                camera.up_direction = self._start.up
        self.changed.set()

    def _start_clock(self, _: object) -> None:
        self._played_at = time.monotonic()
        self.changed.set()

    def _go_to(self, position: npt.NDArray[np.float64], wxyz: npt.NDArray[np.float64], time: float | None) -> None:
        """Move the browser's camera and time to those of a training view."""
        with self.client.atomic():
            self.client.camera.position, self.client.camera.wxyz = position, wxyz
        if time is not None:
            self.time.value = time  # type: ignore[misc]  # viser declares it read-only to mypy
        self.changed.set()

    def advance(self) -> None:
        """Move the time slider forward while the scene is played."""
        now = time.monotonic()
        if self.play.value:
            on = (now - self._played_at) / PLAYED_S
            self.time.value = (self.now + on) % 1.0  # type: ignore[misc]  # as above
        self._played_at = now

    # ---- the requests; a browser may send any value

    @property
    def now(self) -> float:
        """Return the time of the slider, in [0, 1]."""
        return _within(self.time.value, 0.0, 1.0)

    @property
    def wiped(self) -> float:
        """Return the fraction of the image width, in [0, 1], at which a wipe between two images has its edge."""
        return _within(self.wipe.value, 0.0, 1.0)

    @property
    def layout(self) -> str:
        """Return the layout of the images: one image, two side by side, or a wipe between two."""
        return self.mode.value if self.mode.value in (SIDE, WIPE) else ONE

    def shown(self) -> list[ShownImage]:
        """Return the one or two images that the browser shows."""
        choices = self._choices[:1] if self.layout == ONE else self._choices
        first = next(iter(self._renderers.values()))
        return [
            ShownImage(self._renderers.get(model.value, first), colours.value if colours.value in COLOURS else IMAGE)
            for model, colours in choices
        ]

    def request(self, colours: str) -> FrameRequest:
        """Return the request for a frame at the present time, with the settings of the controls and with `colours`.

        For `float32` the image is requested, whose error it is about.
        """
        request = self._request_at(self.now, colours if colours in PLAIN else IMAGE)
        background = _checked(self.background.value)
        if background in (None, self._trained_background):
            return request
        return request._replace(background=torch.tensor(background) / 255)

    def request_of(self, view: View) -> FrameRequest:
        """Return the request for a frame at the time of a training view, with the settings of the controls.

        Its background is that of the training, as that of the training view.
        """
        return self._request_at(view.time, IMAGE)

    def _request_at(self, time: float | None, colours: str) -> FrameRequest:
        if not self._has_time:
            time = None
        elif self._held is not None:
            time = self._held
        return FrameRequest(time, self._frozen, self.agr.value, max(0, self.degree.value), colours)


def _rgb(color: Sequence[float]) -> Rgb:
    """Return a colour [3] in [0, 1] as 8 bits."""
    red, green, blue = (round(255 * value) for value in color)
    return red, green, blue


def _checked(color: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return a colour of a browser, or None if it is not one."""
    return color if len(color) == 3 and all(0 <= value <= 255 for value in color) else None


def _within(value: float, low: float, high: float) -> float:
    """Clamp a value to [low, high]; NaN becomes low."""
    return low if math.isnan(value) else min(max(value, low), high)
