"""Show the training cameras as frusta with their images, in one browser of the viewer."""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt
import viser
from scipy.spatial.transform import Rotation

from gsbench.measure.images import to_bytes
from gsbench.measure.quality import evenly
from gsbench.scenes import Scene, View

MOST = 100  # frusta; if there are more training views, evenly spaced ones are shown
THUMBNAIL = 96  # pixels of the longer side
SIZE = 0.06  # of a frustum, in scene extents

GoTo = Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64], float | None], None]


class Frusta:
    """The frusta of a scene's training cameras in one browser; they are made when they are first shown."""

    def __init__(self, client: viser.ClientHandle, scene: Scene, go_to: GoTo) -> None:
        """Store the scene; the frusta are made when they are first shown.

        Args:
            client: viser's handle of the browser.
            scene: the scene whose training views are shown.
            go_to: the function to call with the position, quaternion and time of a frustum that the user clicks on.
        """
        self.client, self.scene, self.go_to = client, scene, go_to
        self.handles: list[viser.CameraFrustumHandle] = []

    def show(self, visible: bool) -> None:
        """Show or hide the frusta of all training cameras."""
        if visible and not self.handles:
            views = evenly(self.scene.train, min(MOST, len(self.scene.train)))
            self.handles = [self._add(i, view) for i, view in enumerate(views)]
        for handle in self.handles:
            handle.visible = visible

    def _add(self, number: int, view: View) -> viser.CameraFrustumHandle:
        """Add the frustum of a training view to the viewer."""
        camera = view.to("cpu").camera
        xyzw = Rotation.from_matrix(camera.viewmat[:3, :3].T.double().numpy()).as_quat()
        wxyz, position = np.roll(xyzw, 1), camera.center.double().numpy()
        handle = self.client.scene.add_camera_frustum(
            f"/training/{number}",
            fov=2 * float(np.arctan(camera.height / 2 / float(camera.K[1, 1]))),
            aspect=camera.width / camera.height,
            scale=SIZE * self.scene.extent,
            color=(200, 120, 40),
            image=thumbnail(view),
            wxyz=wxyz,
            position=position,
        )
        handle.on_click(lambda _: self.go_to(position, wxyz, view.time))
        return handle


def thumbnail(view: View) -> npt.NDArray[np.uint8]:
    """Return the image of a view as uint8 [H, W, 3] RGB, reduced to THUMBNAIL pixels on its longer side."""
    image = to_bytes(view.image.cpu().numpy())
    factor = THUMBNAIL / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(1, round(factor * image.shape[1])), max(1, round(factor * image.shape[0]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
