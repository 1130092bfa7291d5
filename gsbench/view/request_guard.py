"""Guard the port of the viewer: refuse requests from other web sites, and drop messages that its page never sends.

viser listens through the library `websockets`, and has no parameters for the options that this protection needs (viser
1.1.1: `ViserServer(host, port, label, verbose)`). `RequestGuard.active` sets these options.
"""

import asyncio
import errno
import ipaddress
import logging
import math
import socket
import sys
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http import HTTPStatus
from typing import Annotated, Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server as websockets_server
from msgspec import Meta
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from gsbench.errors import InputError, one_line

MOST_BROWSERS = 16  # connected at once
MOST_BYTES = 4096  # of a message; messages of the page have about 300
MOST_PORTS = 1000  # ports that are tried
FURTHEST = 1e9  # world units from the origin
MOST_PIXELS = 16384  # of a side of a browser's window

# viser's page draws fewer pixels for good after it was slow for some seconds, unless its address has their number.
ENTRANCE = """\
<!doctype html><meta charset="utf-8"><title>gsbench</title>
<noscript>The viewer of gsbench needs JavaScript.</noscript>
<script>
const address = new URL(location);
address.searchParams.set("fixedDpr", Math.min(devicePixelRatio, 2));
location.replace(address);
</script>
"""

Length = Annotated[float, Meta(ge=-FURTHEST, le=FURTHEST)]
Vector = tuple[Length, Length, Length]
Side = Annotated[int, Meta(ge=0, le=MOST_PIXELS)]
Answer = Response | None | Awaitable[Response | None]


class ViewerCameraMessage(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    """The pose of a browser's camera, as viser's page sends it; numbers in ranges from which an image can be made."""

    wxyz: tuple[float, float, float, float]
    position: Vector
    fov: Annotated[float, Meta(ge=0.01, le=3.1)]  # radians
    near: float
    far: float
    image_height: Side
    image_width: Side
    look_at: Vector
    up_direction: Vector


class Values(msgspec.Struct, forbid_unknown_fields=True):
    """The property of a control that a browser may change: its value."""

    value: bool | int | float | str | tuple[int, int, int]  # three: a colour


class GuiUpdateMessage(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    """The message that the user has changed a control; `gsbench.view.controls` checks the value."""

    uuid: str
    updates: Values


class SceneNodeClickMessage(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    """The message that the user has clicked on the frustum of a training camera."""

    name: str
    instance_index: int | None
    ray_origin: tuple[float, float, float]
    ray_direction: tuple[float, float, float]
    screen_pos: tuple[float, float]
    modifier: str | None
    owner: str = ""


DECODER = msgspec.msgpack.Decoder(ViewerCameraMessage | GuiUpdateMessage | SceneNodeClickMessage)


def is_known(message: object) -> bool:
    """Tell whether a message is one that the viewer's page sends, and whether its values can be used."""
    if not isinstance(message, bytes):
        return False
    try:
        decoded = DECODER.decode(message)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    match decoded:
        case ViewerCameraMessage(wxyz=wxyz):
            return 0.9 < math.hypot(*wxyz) < 1.1
        case GuiUpdateMessage(updates=Values(value=float() as value)):
            return math.isfinite(value)
    return True


class Connection(ServerConnection):
    """A browser's connection that passes only known messages; others could stop viser or fill its memory."""

    async def recv(self, decode: bool | None = None) -> Any:
        """Wait for the next message that the viewer's page may send; drop all others."""
        while not is_known(message := await super().recv(decode)):
            pass
        return message


class RequestGuard:
    """The port on which the viewer listens, and the host names by which a browser may reach it.

    Requests by other names are refused: a web site can let its own name resolve to this machine ("DNS rebinding"), and
    a browser would then let this site read what the viewer sends.
    """

    def __init__(self, host: str, port: int) -> None:
        """Find the first free port from `port` on.

        Raises:
            InputError: it is not possible to listen on this host, or no port is free.
        """
        with ThreadPoolExecutor(1) as pool:  # a notebook has an event loop in the main thread
            addresses, self.port = pool.submit(asyncio.run, _free_port(host, port)).result()
        self._hosts = {host.lower(), *addresses}
        self._is_open = any(ipaddress.ip_address(address).is_unspecified for address in addresses)
        if self._is_open:  # every machine on the network can connect, by any address of this machine
            self._hosts.add(socket.gethostname().lower())
        self._is_active = False

    @contextmanager
    def active(self) -> Iterator[None]:
        """Guard a viser server that is started inside this context.

        viser looks up the function `websockets.asyncio.server.serve` when its server starts. This context replaces that
        function by one with the check, and restores it at the end.

        Raises:
            InputError: this version of viser does not use that function, so its server would accept requests from any
                page.
        """
        original = websockets_server.serve

        def serve(*arguments: Any, process_request: Callable[..., Answer], **options: Any) -> Any:
            asyncio.get_running_loop().set_exception_handler(_print_error)
            self._is_active = True
            # `websockets` would log a traceback if a client does not speak HTTP.
            silent = logging.Logger("gsbench.view", logging.CRITICAL + 1)
            options |= {"max_size": MOST_BYTES, "create_connection": Connection, "logger": silent}

            def check(connection: ServerConnection, request: Request) -> Answer:
                return self._refusal(connection, request) or _entrance(request) or process_request(connection, request)

            return original(*arguments, process_request=check, **options)

        websockets_server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets_server.serve = original  # type: ignore[misc]
        if not self._is_active:
            raise InputError("expected a viser that the viewer can guard, such as 1.1.1, got another one: install that")

    def admits(self, headers: Headers) -> bool:
        """Tell whether a request is for this server and comes from its own page.

        The page of another site has another `Origin` header. After "DNS rebinding", the attacker's host name is in the
        `Host` header.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_this_server(hosts[0]):
            return False
        host = hosts[0].lower()
        return all(origin.lower() in (f"http://{host}", f"https://{host}") for origin in origins)

    def _is_this_server(self, host: str) -> bool:
        """Tell whether `host`, with or without a port, is a name of this server; a tunnel may change the port."""
        try:
            parts = urlsplit(f"//{host}")
            name = parts.hostname or ""
        except ValueError:
            return False
        if parts.netloc != host or "@" in host:
            return False
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name == "localhost" or name in self._hosts
        return address.is_loopback or self._is_open or name in self._hosts

    def _refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the HTTP response to a request that is refused; None if the request is admitted."""
        if not self.admits(request.headers):
            return _response(HTTPStatus.FORBIDDEN, "a viewer of gsbench answers its own page alone: see --host")
        if request.headers.get_all("Upgrade") and len(connection.server.connections) >= MOST_BROWSERS:
            text = f"{MOST_BROWSERS} browsers are connected, which is the most"
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, text)
        return None


async def _free_port(host: str, port: int) -> tuple[list[str], int]:
    """Return the addresses of a host name on this machine, and the first port that is free on all of them."""
    expected = f"--host: expected an address or a name of this machine, such as localhost, got {host[:100]!a}"
    if not host or "\0" in host:
        raise InputError(expected)
    loop = asyncio.get_running_loop()
    for candidate in range(port, min(port + MOST_PORTS, 65536)):
        try:
            server = await loop.create_server(asyncio.Protocol, host, candidate)
        except (OSError, ValueError) as error:  # ValueError: not a valid name
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                continue
            raise InputError(f"{expected}, port {candidate}: {one_line(error)}") from None
        addresses = [str(listener.getsockname()[0]) for listener in server.sockets]
        server.close()
        await server.wait_closed()
        return addresses, candidate
    raise InputError(f"--port: expected a free one among the {MOST_PORTS} from {port} on, got none")


def _entrance(request: Request) -> Response | None:
    """Return the page that leads to viser's page with as many pixels as the screen has; None for all other requests."""
    parts = urlsplit(request.path)
    if parts.path != "/" or "fixedDpr" in parse_qs(parts.query) or request.headers.get_all("Upgrade"):
        return None
    return _response(HTTPStatus.OK, ENTRANCE, "text/html")


def _response(status: HTTPStatus, text: str, kind: str = "text/plain") -> Response:
    headers = Headers({"Content-Type": f"{kind}; charset=utf-8", "Cache-Control": "no-store"})
    return Response(status, status.phrase, headers, f"{text}\n".encode())


def _print_error(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print an error in viser's thread as one line, for example if a control gets an invalid value."""
    error = context.get("exception")
    text = f"{type(error).__name__}: {one_line(error)}" if error else context["message"]
    print(f"gsbench.view: a browser's message or connection was dropped: {text}", file=sys.stderr)
