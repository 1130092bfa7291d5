"""A browser without a page: it speaks with the viewer as viser's page does, and keeps the pictures that it gets."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import viser
from websockets.sync.client import ClientConnection, connect

from gsbench.view.viewer import Browser, Viewer

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0, 0, -4],
    "fov": 0.7,
    "near": 0.1,
    "far": 100,
    "image_height": 64,
    "image_width": 64,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])


def packed(message: dict[str, Any], **changed: Any) -> bytes:
    return msgspec.msgpack.encode(message | changed)


def update(control: Any, value: object) -> bytes:
    """The message that the user has changed a control."""
    return packed({"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}})


def joined(viewer: Viewer, **more: Any) -> ClientConnection:
    """Connect as viser's page does."""
    port = viewer.server.get_port()
    return connect(f"ws://localhost:{port}/", subprotocols=[f"viser-v{viser.__version__}"], max_size=None, **more)


def until(holds: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


class Visitor:
    """One browser of the viewer, whose user changes controls; `pictures` are the images that it has shown."""

    def __init__(self, connection: ClientConnection, browser: Browser) -> None:
        self.connection, self.browser, self.controls = connection, browser, browser.controls
        self.pictures: list[np.ndarray] = []
        show = browser._set_image

        def keep(frame: Any, quality: int) -> None:
            self.pictures.append(frame.image)
            show(frame, quality)

        browser._set_image = keep  # type: ignore[method-assign]

    def control(self, label: str) -> Any:
        handles = self.browser.client.gui._gui_input_handle_from_uuid.values()
        return next(handle for handle in handles if handle.label == label)

    def send(self, message: bytes) -> np.ndarray:
        """Send a message that changes the picture; return the next one that rests."""
        count, browser = len(self.pictures), self.browser
        self.connection.send(message)
        until(lambda: len(self.pictures) > count and browser.rests and not browser.changed.is_set())
        return self.pictures[-1]

    def set(self, label: str, value: object) -> np.ndarray:
        """Change a control, or press a button; return the picture."""
        return self.send(update(self.control(label), value))

    def look(self, **changed: Any) -> np.ndarray:
        """Move the camera, or change the size of the window; return the picture."""
        return self.send(packed(CAMERA, **changed))


@contextmanager
def visit(viewer: Viewer) -> Iterator[Visitor]:
    """A browser that joins, has its picture, and leaves."""
    before = set(viewer.browsers)
    with joined(viewer, close_timeout=0) as connection:  # nobody reads the answer
        connection.send(packed(CAMERA))
        until(lambda: set(viewer.browsers) - before)
        (number,) = set(viewer.browsers) - before
        visitor = Visitor(connection, viewer.browsers[number])
        visitor.look(image_width=66)
        visitor.look()
        yield visitor
