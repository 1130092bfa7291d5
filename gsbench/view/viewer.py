"""Serve the viewer to several browsers, each with its own controls."""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import viser

from gsbench.effects.gate import most_cost
from gsbench.errors import InputError
from gsbench.models import cameras
from gsbench.run.load import LoadedRun, scene_of
from gsbench.scenes import Scene
from gsbench.view import paths
from gsbench.view.client import Client, Workers
from gsbench.view.door import Door
from gsbench.view.frame import FrameRenderer
from gsbench.view.labels import short_names


class Viewer:
    """A web server that shows the models of one scene in browsers."""

    def __init__(self, runs: Sequence[LoadedRun], host: str, port: int, data_root: str | None = None) -> None:
        """Start the web server.

        Args:
            runs: the runs whose models are shown, at least one, all of one scene.
            host: the address to listen on.
            port: the port to listen on; if it is in use, the next free one is taken.
            data_root: the folder of the data set, if it has moved.

        Raises:
            InputError: the runs are of different scenes, or it is not possible to listen on this host.
        """
        door, first = Door(host, port), runs[0]
        for run in runs:
            if run.scene.fingerprint != first.scene.fingerprint:
                raise InputError(f"expected runs of one scene to look at together, got {first.scene.name} in "
                                 f"{first.folder} and other data in {run.folder}")  # fmt: skip
        self._most_cost = max(most_cost(run.model) for run in runs)
        self.renderers = [
            FrameRenderer(run, name, self._most_cost) for run, name in zip(runs, short_names(runs), strict=True)
        ]
        self.scene = scene_or_reason(first, data_root)
        self.clients: dict[int, Client] = {}
        self._porter = ThreadPoolExecutor(1)  # connects and disconnects browsers in turn; viser would use 32 threads
        self._workers = Workers(ThreadPoolExecutor(1), ThreadPoolExecutor(1))
        with door.guard():
            self.server = viser.ViserServer(host, door.port, label=f"gsbench: {first.scene.name}", verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()  # beside the images instead of on top of them
        self._stand(first)
        self.server.on_client_disconnect(self._in_turn(self._forget))
        self.server.on_client_connect(self._in_turn(self._welcome))

    def stop(self) -> None:
        """Stop the web server, and the threads that render for the browsers."""
        for client in list(self.clients.values()):
            client.leave()
        self.server.stop()
        self._porter.shutdown(wait=False)
        self._workers.stop()

    def _stand(self, run: LoadedRun) -> None:
        """Place the first camera of every browser at the start of an orbit around the model."""
        camera = paths.around(run, 0.0, cameras.ELEVATION)
        up = np.array(run.scene.up)
        self.server.scene.set_up_direction(up)
        start = self.server.initial_camera
        start.position = camera.center.double().numpy()
        start.look_at = cameras.middle(run.model).double().numpy()
        start.up = up
        start.fov = 2 * float(np.arctan(camera.height / 2 / float(camera.K[1, 1])))

    def _in_turn(self, callback: Callable[[viser.ClientHandle], None]) -> Callable[[viser.ClientHandle], Any]:
        """Wrap a callback so that callbacks run one after another.

        Otherwise a browser could be removed before its controls exist.
        """

        async def waits(client: viser.ClientHandle) -> None:
            await asyncio.get_running_loop().run_in_executor(self._porter, callback, client)

        return waits

    def _welcome(self, client: viser.ClientHandle) -> None:
        self.clients[client.client_id] = Client(
            client, self.renderers, self.scene, self._most_cost, self.server.initial_camera, self._workers
        )

    def _forget(self, client: viser.ClientHandle) -> None:
        gone = self.clients.pop(client.client_id, None)
        if gone is not None:
            gone.leave()


def scene_or_reason(run: LoadedRun, data_root: str | None) -> Scene | str:
    """Return the scene of a run, or the reason why its data cannot be loaded; its model can be shown in both cases."""
    try:
        return scene_of(run, data_root)
    except InputError as error:
        return str(error)
