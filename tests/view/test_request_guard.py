"""The port of the viewer: who is let in, and what a browser may send without harm to it, to others or the machine."""

import asyncio
import gc
import gzip
import http.client
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from viser import _messages
from visitor import CAMERA, free_port, joined, packed, until, update
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from gsbench.errors import InputError
from gsbench.run.load import load_run
from gsbench.view import request_guard
from gsbench.view import viewer as viewer_module
from gsbench.view.request_guard import ENTRANCE, RequestGuard, is_known
from gsbench.view.viewer import Viewer

NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def viewer(folder: Path) -> Iterator[Viewer]:
    viewer = Viewer([load_run(folder)], "localhost", free_port())
    yield viewer
    viewer.stop()


def rests(viewer: Viewer) -> bool:
    """Whether a browser is there and has its picture."""
    browsers = list(viewer.browsers.values())
    return bool(browsers) and all(browser.rests and not browser.changed.is_set() for browser in browsers)


OWN_PAGES = [
    ("localhost:8080", "http://localhost:8080"),
    ("localhost:9000", "http://localhost:9000"),  # a tunnel
    ("127.0.0.1:8080", "http://127.0.0.1:8080"),
    ("[::1]:8080", "http://[::1]:8080"),
    ("LOCALHOST:8080", "http://localhost:8080"),
    ("localhost:8080", None),  # no browser
]
FOREIGN_PAGES = [
    *(("localhost:8080", f"http://{page}") for page in ("localhost:3000", "127.0.0.1:8080", "evil.example")),
    *(("localhost:8080", origin) for origin in ("http://localhost:8080.evil.example", "null", "")),
    ("evil.example:8080", "http://evil.example:8080"),  # DNS rebinding
    ("evil.example@localhost", "http://evil.example@localhost"),
    ("192.0.2.1:8080", "http://192.0.2.1:8080"),
    *((host, None) for host in ("evil.example", "localhost.evil.example", "localhost@evil.example", "[::1", "")),
]


def test_only_its_own_page_is_admitted():
    """Catches a page of another site that reads the frames, and a viewer for the network that no address reaches."""
    guard, wide = RequestGuard("localhost", free_port()), RequestGuard("0.0.0.0", free_port())
    twice = Headers(Host="localhost")
    twice["Host"] = "evil.example"
    assert not any(map(guard.admits, (Headers(), twice)))
    for pages, admitted in ((OWN_PAGES, True), (FOREIGN_PAGES, False)):
        for host, origin in pages:
            headers = Headers(Host=host, **({} if origin is None else {"Origin": origin}))
            assert guard.admits(headers) == admitted, (host, origin)
    for host in ("192.0.2.1:8080", "localhost", socket.gethostname()):
        assert wide.admits(Headers(Host=host, Origin=f"http://{host}"))
    assert not wide.admits(Headers(Host="evil.example", Origin="http://evil.example"))


def test_a_foreign_page_gets_no_frame(viewer):
    """Catches a check that is there but that nobody asks."""
    port = viewer.server.get_port()
    with pytest.raises(InvalidStatus, match="403"):
        joined(viewer, origin="http://evil.example")
    with pytest.raises(InvalidStatus, match="403"):
        connect("ws://evil.example/", sock=socket.create_connection(("127.0.0.1", port)))
    for host, status in (("evil.example", 403), (f"localhost:{port}", 200)):
        assert fetched(port, "/", host)[0] == status
    with joined(viewer, origin=f"http://localhost:{port}") as browser:
        browser.send(packed(CAMERA))
        assert browser.recv(timeout=20)


def fetched(port: int, path: str, host: str) -> tuple[int, str]:
    """The status and the text of a page."""
    page = http.client.HTTPConnection("127.0.0.1", port)
    page.request("GET", path, headers={"Host": host})
    answer = page.getresponse()
    text = answer.read()
    page.close()
    if answer.headers["Content-Encoding"] == "gzip":
        text = gzip.decompress(text)
    return answer.status, text.decode()


def test_the_page_is_opened_with_all_pixels_of_the_screen(viewer):
    """Catches a page that stays coarse where the browser was slow, and one that leads to itself."""
    port = viewer.server.get_port()
    host = f"localhost:{port}"
    for path in ("/", "/?initialCameraPosition=1,2,3"):
        assert fetched(port, path, host) == (200, f"{ENTRANCE}\n")
    assert 'searchParams.set("fixedDpr"' in ENTRANCE
    for path in ("/?fixedDpr=1", "/?initialCameraPosition=1,2,3&fixedDpr=1.5"):
        status, text = fetched(port, path, host)
        assert (status, "fixedDpr" in text, "root" in text) == (200, False, True)


BAD_CAMERAS: list[dict[str, Any]] = [
    *({"fov": fov} for fov in (0, NAN, 4, 1e-300, "x", None)),
    *({"position": position} for position in ([1], [NAN, 0, 0], [INF, 0, 0], [1e38, 0, 0])),
    *({"wxyz": quaternion} for quaternion in ([0, 0, 0, 0], [1, 0, 0], [NAN, 0, 0, 0])),
    *({"image_width": -1}, {"image_height": 10**9}, {"look_at": "abc"}),
    *({"more": 1}, {"type": "Nothing"}, {"type": ["x"]}),
]
OTHERS: list[object] = [
    "text",
    b"",
    b"\xc1",
    b"\x91" * 3000,
    packed({"type": "ShareUrlRequest"}),
    packed({"type": "ShareUrlDisconnect"}),
    packed({"type": "GuiFormDirtyMessage", "uuid": "x"}),
    packed({"type": "RunJavascriptMessage", "source": "x"}),
    *(
        packed({"type": "GuiUpdateMessage", "uuid": "x", "updates": updates})
        for updates in ({"update_cb": 1}, [], *({"value": value} for value in (NAN, [1], [1, 2, 3, 4], [1, 2, NAN])))
    ),
]


def test_what_the_page_never_sends_is_not_known():
    """Catches a camera that stops its thread, a tunnel to the internet, and a control that is changed in its code."""
    for changed in BAD_CAMERAS:
        assert not is_known(packed(CAMERA, **changed)), changed
    assert not any(map(is_known, OTHERS))
    ray = {"ray_origin": [0, 0, 1.5], "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5]}
    click = {"type": "SceneNodeClickMessage", "name": "/training/1", "instance_index": None, "modifier": None}
    assert is_known(packed(click | ray, owner=""))
    for value in (True, 3, 0.5, "wipe", [255, 0, 0]):
        assert is_known(packed({"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": value}}))
    assert is_known(packed(CAMERA))


def test_viser_is_the_one_that_is_guarded():
    """Catches a viser that has changed what its page sends, or that listens in another way, past the guard."""
    with pytest.raises(InputError, match="viser"), RequestGuard("localhost", free_port()).active():
        pass
    for name in ("ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage"):
        fields = set(getattr(_messages, name).__dataclass_fields__) - {"_cached_redundancy_key"}
        assert set(getattr(request_guard, name).__struct_fields__) == fields


def test_a_browser_that_sends_nonsense_still_has_its_picture(viewer, capfd):
    """Catches a thread or a connection that ends by one message, and a stack trace for it."""
    with joined(viewer) as browser:
        browser.send(packed(CAMERA))
        until(lambda: rests(viewer))
        (shown,) = viewer.browsers.values()
        for changed in BAD_CAMERAS:
            browser.send(packed(CAMERA, **changed))
        for message in OTHERS:
            browser.send(message)  # type: ignore[arg-type]
        for control in (
            shown.controls.time,
            shown.controls.mode,
            shown.controls.degree,
            shown.controls.wipe,
            shown.controls.play,
            shown.controls.background,
            *shown.controls._choices[0],
        ):
            for value in ("x" * 100, "1e9", "1" * 100, -(2**60), INF, [0, 300, -1], [2**60, 0, 0], False):
                browser.send(update(control, value))
        browser.send(packed(CAMERA, position=[0, 0, -5], image_width=32))
        until(lambda: viewer.server.get_clients()[shown.client.client_id].camera.image_width == 32)
        time.sleep(0.5)
        until(lambda: rests(viewer))
    assert "Traceback" not in capfd.readouterr().err


def test_large_or_many_messages_are_not_kept(viewer):
    """Catches memory that grows by whatever a browser sends, for as long as the viewer runs."""
    with joined(viewer) as browser:
        browser.send(packed({"type": "GuiFormDirtyMessage", "uuid": "x" * 2**20}))
        with pytest.raises(ConnectionClosed, match="1009"):
            list(iter(lambda: browser.recv(timeout=10), None))
    with joined(viewer) as browser:
        for i in range(100):
            browser.send(packed({"type": "GuiFormDirtyMessage", "uuid": f"{i}"}))
        browser.send(packed(CAMERA))
        until(lambda: rests(viewer))
    assert not [thing for thing in gc.get_objects() if type(thing) is _messages.GuiFormDirtyMessage]


def test_browsers_are_counted(viewer, monkeypatch):
    """Catches threads without number."""
    until(lambda: not viewer.browsers)
    monkeypatch.setattr(request_guard, "MOST_BROWSERS", 2)
    with joined(viewer), joined(viewer), pytest.raises(InvalidStatus, match="503"):
        joined(viewer)


def test_browsers_that_do_not_read_hold_a_frame_each(viewer, monkeypatch):
    """Catches memory that grows with the browsers: frames that wait, and a thread that renders for each of them."""
    until(lambda: not viewer.browsers)
    threads, noise = [], np.random.default_rng(0).integers(0, 255, (600, 900, 3), np.uint8)

    def labelled(*_: object) -> np.ndarray:
        threads.append(threading.get_ident())
        return noise

    monkeypatch.setattr(viewer_module, "labelled", labelled)
    with ExitStack() as stack:
        browsers = []
        for _ in range(8):
            quiet = socket.create_connection(("localhost", viewer.server.get_port()))
            quiet.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            browsers.append(stack.enter_context(joined(viewer, sock=quiet, max_queue=1, close_timeout=0)))
        for i in range(15):
            rendered = len(threads) + len(browsers)
            for browser in browsers:
                browser.send(packed(CAMERA, position=[0, 0, -4 - 0.1 * i]))
            until(lambda rendered=rendered: len(threads) >= rendered)
        until(lambda: rests(viewer))
        gc.collect()
        images = [thing.rgb_data for thing in gc.get_objects() if type(thing) is _messages.BackgroundImageMessage]
        waiting = [len(image) for image in images if image is not None]
        sent = [
            thing.transport.get_write_buffer_size()
            for thing in gc.get_objects()
            if type(thing) is request_guard.Connection
        ]
        frame = max(waiting)
        assert frame > 100_000
        assert len(waiting) <= 2 * 8  # one that waits and one on its way to the socket
        assert sum(sent) < 8 * 2 * frame
        assert len(set(threads)) == 1
        for browser in browsers:
            browser.socket.shutdown(socket.SHUT_RDWR)


def test_aborted_connections_leave_no_browser(viewer):
    """Catches a browser that is cut off and for which frames are still rendered, and one for which a thread is kept."""
    with joined(viewer) as browser:
        browser.send(packed(CAMERA))
        until(lambda: rests(viewer))
    until(lambda: not viewer.browsers)
    before = threading.active_count()
    for pause in (0, 0, 0.02, 0.1, 0.3):
        browsers = [joined(viewer) for _ in range(4)]
        for browser in browsers:
            browser.send(packed(CAMERA))
        time.sleep(pause)
        for browser in browsers:
            browser.socket.shutdown(socket.SHUT_RDWR)
    until(lambda: not viewer.browsers and threading.active_count() <= before)


def test_a_port_that_is_taken_is_passed_over():
    """Catches a viewer that fails because another one runs, and one that a notebook, which has a loop, cannot open."""

    async def cell() -> int:
        return RequestGuard("localhost", free_port()).port

    assert asyncio.run(cell()) > 0
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert port < RequestGuard("127.0.0.1", port).port < port + 50
    with pytest.raises(InputError, match="--port"), socket.create_server(("127.0.0.1", 65535)):
        RequestGuard("127.0.0.1", 65535)
