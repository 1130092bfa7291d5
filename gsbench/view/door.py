"""Guard the port of the viewer: refuse requests from other web sites, and drop messages that its page never sends.

viser listens through the library `websockets`, but has no parameters for the options that this protection needs.
`Door.guard` sets these options.
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
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from gsbench.errors import InputError, one_line

MOST_BROWSERS = 16  # connected at once; each has a thread that renders for it
MOST_BYTES = 4096  # of a message; messages of the page have about 300
MOST_PORTS = 1000  # ports that are tried
FURTHEST = 1e9  # world units from the origin
MOST_PIXELS = 16384  # of a side of a browser's window
FIELDS_OF_VIEW = 0.01, 3.1  # radians

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

Three = tuple[float, float, float]
Answer = Response | None | Awaitable[Response | None]


class ViewerCameraMessage(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    """The message with the pose of a browser's camera, as viser's page sends it."""

    wxyz: tuple[float, float, float, float]
    position: Three
    fov: float
    near: float
    far: float
    image_height: int
    image_width: int
    look_at: Three
    up_direction: Three

    def is_usable(self) -> bool:
        """Tell whether an image can be rendered from this camera pose."""
        lengths = (*self.position, *self.look_at, *self.up_direction)
        return (
            all(abs(length) <= FURTHEST for length in lengths)  # false for NaN
            and 0.9 < math.hypot(*self.wxyz) < 1.1
            and FIELDS_OF_VIEW[0] <= self.fov <= FIELDS_OF_VIEW[1]
            and all(0 <= pixels <= MOST_PIXELS for pixels in (self.image_width, self.image_height))
        )


class Values(msgspec.Struct, forbid_unknown_fields=True):
    """The property of a control that a browser may change: its value."""

    value: bool | int | float | str | tuple[int, int, int]  # three: a colour


class GuiUpdateMessage(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    """The message that the user has changed a control; `gsbench.view.controls` checks the value."""

    uuid: str
    updates: Values

    def is_usable(self) -> bool:
        """Tell whether the value is text, a colour or a finite number."""
        value = self.updates.value
        return isinstance(value, str) or all(map(math.isfinite, value if isinstance(value, tuple) else (value,)))


class SceneNodeClickMessage(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    """The message that the user has clicked on the frustum of a training camera."""

    name: str
    instance_index: int | None
    ray_origin: Three
    ray_direction: Three
    screen_pos: tuple[float, float]
    modifier: str | None
    owner: str = ""

    def is_usable(self) -> bool:
        """Return True, because the values of this message are not used."""
        return True


KNOWN = msgspec.msgpack.Decoder(ViewerCameraMessage | GuiUpdateMessage | SceneNodeClickMessage)


def is_known(message: object) -> bool:
    """Tell whether a message is one that the viewer's page sends, and whether its values can be used."""
    if not isinstance(message, bytes):
        return False
    try:
        return KNOWN.decode(message).is_usable()
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False


class Connection(ServerConnection):
    """A browser's connection that passes only known messages; others could stop viser or fill its memory."""

    async def recv(self, decode: bool | None = None) -> Any:
        """Wait for the next message that the viewer's page may send; drop all others."""
        while not is_known(message := await super().recv(decode)):
            pass
        return message


class Door:
    """The port on which the viewer listens, and the host names by which a browser may reach it."""

    def __init__(self, host: str, port: int) -> None:
        """Find a free port for the viewer.

        Args:
            host: the address or the name to listen on.
            port: the first port to try.

        Raises:
            InputError: it is not possible to listen on this host, or no port is free.
        """
        with ThreadPoolExecutor(1) as pool:  # a notebook has an event loop in the main thread
            addresses, self.port = pool.submit(asyncio.run, _free(host, port)).result()
        self._hosts = {host.lower(), *addresses}
        self._is_open = any(ipaddress.ip_address(address).is_unspecified for address in addresses)
        if self._is_open:  # every machine on the network can connect, by any address of this machine
            self._hosts.add(socket.gethostname().lower())
        self._guards = False

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Guard a viser server that is started inside this context.

        viser has no option for a check of requests. It looks up the function `websockets.asyncio.server.serve` when its
        server starts. This context replaces that function by one with the check, and restores it at the end. gsbench
        changes one other library: submitit, in `gsbench/sweep/container.py`.

        Raises:
            InputError: this version of viser does not use that function, so its server would accept requests from any
                page.
        """
        original = websockets_server.serve

        def serve(*arguments: Any, process_request: Callable[..., Answer], **options: Any) -> Any:
            asyncio.get_running_loop().set_exception_handler(_say)
            self._guards = True
            options |= {"max_size": MOST_BYTES, "create_connection": Connection, "logger": _silent()}

            def check(connection: ServerConnection, request: Request) -> Answer:
                return self._refusal(connection, request) or _entrance(request) or process_request(connection, request)

            return original(*arguments, process_request=check, **options)

        websockets_server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets_server.serve = original  # type: ignore[misc]
        if not self._guards:
            raise InputError("expected a viser that the viewer can guard, such as 1.1.1, got another one: install that")

    def admits(self, headers: Headers) -> bool:
        """Tell whether a request is for this server and comes from its own page.

        The page of another site has another `Origin` header. In an attack by "DNS rebinding", the attacker's host name
        resolves to this machine's address; such a request has that name in its `Host` header.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return False
        own = hosts[0].lower()
        return all(origin.lower() in (f"http://{own}", f"https://{own}") for origin in origins)

    def _is_ours(self, host: str) -> bool:
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
            return _answer(HTTPStatus.FORBIDDEN, "a viewer of gsbench answers its own page alone: see --host")
        if request.headers.get_all("Upgrade") and len(connection.server.connections) >= MOST_BROWSERS:
            return _answer(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_BROWSERS} browsers are connected, which is the most")
        return None


async def _free(host: str, port: int) -> tuple[list[str], int]:
    """Return the addresses of a host name on this machine, and the first port that is free on all of them."""
    asked = f"--host: expected an address or a name of this machine, such as localhost, got {host[:100]!a}"
    if not host or "\0" in host:
        raise InputError(asked)
    loop = asyncio.get_running_loop()
    for tried in range(port, min(port + MOST_PORTS, 65536)):
        try:
            server = await loop.create_server(asyncio.Protocol, host, tried)
        except (OSError, ValueError) as error:  # ValueError: not a valid name
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                continue
            raise InputError(f"{asked}, port {tried}: {one_line(error)}") from None
        addresses = [str(one.getsockname()[0]) for one in server.sockets]
        server.close()
        await server.wait_closed()
        return addresses, tried
    raise InputError(f"--port: expected a free one among the {MOST_PORTS} from {port} on, got none")


def _entrance(request: Request) -> Response | None:
    """Return the page that leads to viser's page with as many pixels as the screen has; None for all other requests."""
    parts = urlsplit(request.path)
    if parts.path != "/" or "fixedDpr" in parse_qs(parts.query) or request.headers.get_all("Upgrade"):
        return None
    return _answer(HTTPStatus.OK, ENTRANCE, "text/html")


def _answer(status: HTTPStatus, text: str, kind: str = "text/plain") -> Response:
    """Return an HTTP response with some text."""
    headers = Headers({"Content-Type": f"{kind}; charset=utf-8", "Cache-Control": "no-store"})
    return Response(status, status.phrase, headers, f"{text}\n".encode())


def _silent() -> logging.Logger:
    """Return a silent logger for `websockets`, which otherwise prints a traceback if a client does not speak HTTP."""
    logger = logging.getLogger("gsbench.view.door")
    logger.propagate = False
    logger.addHandler(logging.NullHandler())
    return logger


def _say(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print an error in viser's thread as one line, for example if a control gets an invalid value."""
    error = context.get("exception")
    said = f"{type(error).__name__}: {one_line(error)}" if error else context["message"]
    print(f"gsbench.view: a browser's message or connection was dropped: {said}", file=sys.stderr)
