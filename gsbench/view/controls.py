"""Show the controls in one browser of the viewer, and turn their values into requests for frames."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
import viser
from numpy.typing import NDArray
from viser import transforms

from gsbench.measure.images import reduced, to_bytes
from gsbench.measure.quality import evenly
from gsbench.scenes import Camera, Scene, View
from gsbench.view.frame import CLASS, COLOURS, FLOAT32, IMAGE, PLAIN, FrameRenderer, FrameRequest

PLAYED_S = 4.0  # seconds in which the time goes from 0 to 1
ONE, SIDE, WIPE = "one image", "side by side", "wipe"
NEAREST = "nearest training view"
NARROW = 576  # pixels; in a narrower window viser shows the panel on the image, as on a phone
PANEL = {"x": 15.0, "y": -15.0, "width": 400.0}  # position in pixels from the left and the bottom
MOST_FRUSTA = 100  # if there are more training views, evenly spaced ones are shown
THUMBNAIL = 96  # pixels of the longer side of a frustum's image
FRUSTUM = 0.06  # size of a frustum, in scene extents

Handle = TypeVar("Handle", bound=viser.GuiInputHandle[Any])
Rgb = tuple[int, int, int]  # 0 to 255


class ShownImage(NamedTuple):
    """An image on the screen: the model that it shows, and what its colours mean."""

    renderer: FrameRenderer  # of the model
    colours: str  # one of COLOURS


class ViserPose(NamedTuple):
    """The pose and the field of view of a camera in viser."""

    position: NDArray[np.floating]  # [3] world units
    wxyz: NDArray[np.floating]  # [4] quaternion of the rotation from camera axes (OpenCV's) to world axes
    fov: float  # vertical field of view, radians

    @classmethod
    def of(cls, camera: Camera) -> "ViserPose":
        """Return the pose of a camera, and the field of view that its focal length gives."""
        to_world = transforms.SO3.from_matrix(camera.viewmat[:3, :3].T.double().numpy())
        fov = 2 * math.atan(camera.height / 2 / float(camera.K[1, 1]))
        return cls(camera.center.double().numpy(), to_world.wxyz, fov)

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera for an image of the given size, pixels."""
        rotation = transforms.SO3(self.wxyz / np.linalg.norm(self.wxyz))
        to_world = transforms.SE3.from_rotation_and_translation(rotation, self.position)
        focal = height / 2 / math.tan(self.fov / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(torch.from_numpy(to_world.inverse().as_matrix()).float(), K, width, height)


class Controls:
    """The controls of one browser; a change of any calls `on_change`."""

    def __init__(
        self,
        client: viser.ClientHandle,
        renderers: Sequence[FrameRenderer],  # of one scene, at least one
        scene: Scene | str,  # with its training views, or why there are none
        start: viser.InitialCameraConfig,  # to which `reset` returns
        on_change: Callable[[], None],
        on_save: Callable[[], None],
    ) -> None:
        self.client = client
        self._start, self._on_change = start, on_change
        self._initial: list[tuple[viser.GuiInputHandle[Any], Any]] = []  # the controls, and their values at the start
        self._renderers = {renderer.name: renderer for renderer in renderers}
        self._has_time = renderers[0].run.scene.has_time
        self._trained_background = _rgb(renderers[0].run.scene.background)
        self._frozen: torch.Tensor | None = None  # viewpoint for which Gaussians are computed; None: the camera
        self._held: float | None = None  # time for which Gaussians are computed; None: the slider's
        self._played_at = time.monotonic()
        gui = client.gui
        with self._folded("milliseconds"):
            self.costs = gui.add_html("")
        self.time = self._watch(gui.add_slider("time", 0.0, 1.0, 0.005, 0.0, disabled=not self._has_time))
        self.play = self._watch(gui.add_checkbox("play", False, disabled=not self._has_time), self._start_clock)
        with self._folded("controls"):
            self._add_effects()
            self._add_images()
            self._add_views(scene)
            gui.add_button("reset", hint="the camera and all controls").on_click(lambda _: self._reset())
            gui.add_button("save image", hint="as it is shown, with all pixels").on_click(lambda _: on_save())

    def _folded(self, name: str) -> AbstractContextManager[object]:
        """Return a folder, closed at first, for a narrow window, where the panel lies on the image; otherwise none."""
        narrow = self.client.camera.image_width < NARROW
        return self.client.gui.add_folder(name, expand_by_default=False) if narrow else nullcontext()

    def _watch(self, control: Handle, then: Callable[[], None] | None = None) -> Handle:
        """Call `then` when a control changes, and `on_change` if the user changed it; keep its value for `reset`."""

        def react(event: viser.GuiEvent[Any]) -> None:
            if then is not None:
                then()
            if event.client is not None:
                self._on_change()

        control.on_update(react)
        self._initial.append((control, control.value))
        return control

    def _add_effects(self) -> None:
        """Add controls that switch off what models depend on: time, view direction and AGR (a network)."""
        gui, watch, renderers = self.client.gui, self._watch, self._renderers.values()
        degree = max(renderer.trained_active.sh_degree for renderer in renderers)
        has_agr = any(renderer.has_agr for renderer in renderers)
        with gui.add_folder("effects"):
            self.agr = watch(gui.add_checkbox("AGR", True, disabled=not has_agr))
            hold = gui.add_checkbox("freeze time", False, disabled=not self._has_time, hint="slices stay those of now")
            freeze = gui.add_checkbox("freeze direction", False, hint="slices stay those seen from here")
            self.degree = watch(
                gui.add_slider(
                    "harmonics",
                    0,
                    max(degree, 1),
                    1,
                    degree,
                    disabled=degree == 0,
                    hint="degree of the colours; 0: the same from everywhere",
                )
            )

        def hold_time() -> None:
            self._held = self.now if hold.value else None

        def freeze_direction() -> None:
            position = torch.tensor(self.client.camera.position, dtype=torch.float32)
            self._frozen = position if freeze.value else None

        watch(hold, hold_time)
        watch(freeze, freeze_direction)

    def _add_images(self) -> None:
        """Add controls that select the models, what the colours of their Gaussians mean, and the background."""
        gui, watch, names = self.client.gui, self._watch, list(self._renderers)
        several = len(names) > 1
        self.mode = gui.add_dropdown("show", (ONE, SIDE, WIPE), initial_value=SIDE if several else ONE)
        first = watch(gui.add_dropdown("model", names, visible=several))
        colours = watch(gui.add_dropdown("colours", COLOURS, hint="of Gaussians; float32: the bound on the error"))
        second = watch(
            gui.add_dropdown("second model", names, initial_value=names[1 if several else 0], visible=several)
        )
        second_colours = watch(
            gui.add_dropdown("second colours", COLOURS, initial_value=IMAGE if several else CLASS, visible=several)
        )
        self.wipe = watch(gui.add_slider("wipe at", 0.0, 1.0, 0.01, 0.5, visible=False))
        self.background = watch(gui.add_rgb("background", self._trained_background, hint="of the colours 'image'"))
        self.legend = gui.add_html("")
        self._choices = (first, colours), (second, second_colours)

        def show_choices() -> None:
            second.visible = several and self.mode.value != ONE
            second_colours.visible, self.wipe.visible = self.mode.value != ONE, self.mode.value == WIPE

        watch(self.mode, show_choices)

    def _add_views(self, scene: Scene | str) -> None:
        """Add controls that show the training views; they are disabled if the data set is not available."""
        gui, why = self.client.gui, scene if isinstance(scene, str) else None
        cameras = gui.add_checkbox(
            "training cameras",
            False,
            disabled=why is not None,
            hint=why or "click on one to stand there; not side by side",
        )
        self.compare = gui.add_checkbox(
            NEAREST, False, disabled=why is not None, hint=why or "its image, the model's, and the error"
        )
        if isinstance(scene, str):
            return
        frusta: list[viser.CameraFrustumHandle] = []

        def show_frusta(_: object = None) -> None:
            """Show the frusta unless two images are side by side, whose cameras are not that of the browser's scene."""
            cameras.disabled = self.layout == SIDE
            visible = cameras.value and not cameras.disabled
            if visible and not frusta:
                views = evenly(scene.train, min(MOST_FRUSTA, len(scene.train)))
                frusta.extend(self._add_frustum(i, view, FRUSTUM * scene.extent) for i, view in enumerate(views))
            for frustum in frusta:
                frustum.visible = visible

        def show_panel() -> None:
            panel.visible = self.compare.value

        show_frusta()
        self.mode.on_update(show_frusta)
        self._watch(cameras, show_frusta)
        panel = gui.add_panel(visible=False)
        with panel.add_tab(NEAREST):
            self.comparison = gui.add_html("")
        panel.float(**PANEL)
        self._watch(self.compare, show_panel)

    def _add_frustum(self, index: int, view: View, size: float) -> viser.CameraFrustumHandle:
        """Add the frustum of a training view with its image; a click on it moves camera and time there."""
        view = view.to("cpu")
        pose = ViserPose.of(view.camera)
        frustum = self.client.scene.add_camera_frustum(
            f"/training/{index}",
            fov=pose.fov,
            aspect=view.camera.width / view.camera.height,
            scale=size,
            color=(200, 120, 40),
            image=reduced(to_bytes(view.image.numpy()), THUMBNAIL, by_longer_side=True),
            wxyz=pose.wxyz,
            position=pose.position,
        )

        def go_there(_: object) -> None:
            with self.client.atomic():
                self.client.camera.position, self.client.camera.wxyz = pose.position, pose.wxyz
            if view.time is not None:
                self._set_time(view.time)
            self._on_change()

        frustum.on_click(go_there)
        return frustum

    def _reset(self) -> None:
        """Return to the camera and the controls of the start; the clip stops before its time is set."""
        for control, value in reversed(self._initial):
            control.value = value
        camera = self.client.camera
        with self.client.atomic():
            camera.position, camera.look_at, camera.fov = self._start.position, self._start.look_at, self._start.fov
            if self._start.up is not None:
                camera.up_direction = self._start.up
        self._on_change()

    def _set_time(self, value: float) -> None:
        self.time.value = value  # type: ignore[misc]  # viser declares it read-only to mypy

    def _start_clock(self) -> None:
        self._played_at = time.monotonic()

    def advance(self) -> None:
        """Move the time slider forward while the scene is played."""
        before = self._played_at
        self._start_clock()
        if self.play.value:
            self._set_time((self.now + (self._played_at - before) / PLAYED_S) % 1.0)

    # ---- the requests; a browser may send any value

    @property
    def now(self) -> float:
        """Return the time of the slider, in [0, 1]."""
        return _share(self.time.value)

    @property
    def wiped(self) -> float:
        """Return the fraction of the image width, in [0, 1], at which a wipe between two images has its edge."""
        return _share(self.wipe.value)

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

    @property
    def shows_float32(self) -> bool:
        """Whether an image is the bound on the error of float32."""
        return any(colours == FLOAT32 for _, colours in self.shown())

    def request(self, colours: str) -> FrameRequest:
        """Return the request for a frame with the present settings; for `float32` of the image whose error it is."""
        request = self._request_at(self.now, colours if colours in PLAIN else IMAGE)
        background = self.background.value
        if background == self._trained_background or not _is_rgb(background):
            return request
        return request._replace(background=torch.tensor(background) / 255)

    def request_of(self, view: View) -> FrameRequest:
        """Return the request for a frame at the time of a training view, on the background of the training."""
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


def _is_rgb(color: tuple[int, ...]) -> bool:
    return len(color) == 3 and all(0 <= value <= 255 for value in color)


def _share(value: float) -> float:
    """Clamp a value to [0, 1]; NaN becomes 0."""
    return 0.0 if math.isnan(value) else min(max(value, 0.0), 1.0)
