# SPDX-License-Identifier: Apache-2.0
"""The console's one port: who may come in, the page in the browser, and the session's own pages.

The page is viser's, whole in one file. Every answer forbids the browser to load from elsewhere.
"""

from __future__ import annotations

import errno
import hashlib
import hmac
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from io import StringIO
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from armscan.errors import DeviceError, OptionError

try:
    import viser
    import websockets.asyncio.server as sockets
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response
except ImportError as error:  # pragma: no cover - told in one sentence
    raise OptionError(
        f"the console needs a package that is not installed ({error.name})",
        remedy="pip install 'armscan[console]'",
    ) from error

LOOPBACK = "127.0.0.1"
PORT = 8270
"""Tried first; another free one is taken where it is not."""
COOKIE, PAGES = "armscan_console", "/pages/"
POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Scripts of the page are packed inside it and unpacked there; nothing comes from another host."""
_patching = threading.Lock()


@dataclass(frozen=True, slots=True)
class Door:
    """Decides which requests come in: those of this computer's loopback address, or with the token.

    ``folder_of_pages`` gives the folder whose HTML pages are served.
    """

    token: str
    folder_of_pages: Callable[[], Path]

    @property
    def cookie(self) -> str:
        """Name of the cookie: browsers keep one for all ports, and two consoles may stand at one
        computer.
        """
        return f"{COOKIE}_{hashlib.sha256(self.token.encode()).hexdigest()[:8]}"

    def refusal(self, peer: str, request: Request) -> str:
        """Why a request is not let in; empty if it is."""
        host = request.headers.get("Host", "")
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            # a page of another host in the operator's browser would press the buttons
            return "another page asked for the console"
        name = urlsplit(f"//{host}").hostname or ""
        if is_loopback(peer) and is_loopback(name):
            return ""
        brought = (*self._tokens(request),)
        if any(hmac.compare_digest(one.encode(), self.token.encode()) for one in brought):
            return ""
        return "the console asks for its token: use the whole address that it printed"

    def _tokens(self, request: Request) -> Iterator[str]:
        yield from parse_qs(urlsplit(request.path).query).get("token", [])
        cookie: SimpleCookie = SimpleCookie()
        for text in request.headers.get_all("Cookie"):
            try:
                cookie.load(text)
            except CookieError:
                continue
        if self.cookie in cookie:
            yield cookie[self.cookie].value

    def page(self, path: str) -> bytes | None:
        """A page of the session; None where there is none of that name."""
        folder = self.folder_of_pages().resolve()
        place = (folder / unquote(path.partition("?")[0]).removeprefix(PAGES)).resolve()
        if place.suffix != ".html" or not place.is_relative_to(folder) or not place.is_file():
            return None
        return place.read_bytes()

    def answer(self, connection: sockets.ServerConnection, request: Request) -> Response | None:
        """The answer to a request that is refused or asks for a page; None to go on."""
        address = connection.remote_address
        is_page = request.path.startswith(PAGES) and request.headers.get("Upgrade") != "websocket"
        why = self.refusal(str(address[0]) if address else "", request)
        if why:
            return _response(HTTPStatus.FORBIDDEN, why.encode(), "text/plain; charset=utf-8")
        if is_page:
            content = self.page(request.path)
            if content is None:
                return _response(HTTPStatus.NOT_FOUND, b"there is no such page", "text/plain")
            return _response(HTTPStatus.OK, content, "text/html; charset=utf-8")
        return None

    def marked(self, request: Request, response: Response | None) -> Response | None:
        """A response of the page with the rules for the browser, and the token as a cookie."""
        if response is not None and "Content-Security-Policy" not in response.headers:
            response.headers["Content-Security-Policy"] = POLICY
            if parse_qs(urlsplit(request.path).query).get("token"):
                response.headers["Set-Cookie"] = (
                    f"{self.cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                )
        return response


def is_loopback(name: str) -> bool:
    """Whether a host's name or address is this computer by itself."""
    if name == "localhost":
        return True
    try:
        return ipaddress.ip_address(name.strip("[]")).is_loopback
    except ValueError:
        return False


def _response(status: HTTPStatus, content: bytes, kind: str) -> Response:
    headers = Headers()
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(content))
    headers["Content-Security-Policy"] = POLICY
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, content)


@contextmanager
def _guarded(door: Door) -> Iterator[None]:
    """Have a server that is made meanwhile ask the door first.

    viser 1.1 takes no hook for requests: it makes its own inside the call that begins to listen,
    and a second server before it would leave its port open beside the door. So the function with
    which it begins to listen is replaced while it does, and only then. A viser that begins in
    another way is not let in: nobody would ask who comes.

    Raises
    ------
    OptionError
        If the server that was made does not ask.
    """
    asking = threading.Event()
    with _patching:
        serve = sockets.serve

        def guarded(*given: Any, process_request: Any = None, **named: Any) -> Any:
            def ask(connection: sockets.ServerConnection, request: Request) -> Any:
                try:
                    refused = door.answer(connection, request)
                    if refused is not None or process_request is None:
                        return refused
                    return door.marked(request, process_request(connection, request))
                except (ValueError, OSError):
                    # bytes that no browser sends in an address, a name no disk takes
                    words = b"nothing can be read there"
                    return _response(HTTPStatus.BAD_REQUEST, words, "text/plain")

            asking.set()
            return serve(*given, process_request=ask, **named)

        sockets.serve = guarded  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            sockets.serve = serve  # type: ignore[misc]
    if not asking.is_set():
        raise OptionError(
            f"viser {viser.__version__} cannot be told who may come in",
            remedy="pip install 'viser==1.1.1', and report this",
        )


def open_server(
    folder_of_pages: Callable[[], Path], host: str = LOOPBACK, port: int | None = None
) -> tuple[viser.ViserServer, str]:
    """Open the port and give the page an address.

    Parameters
    ----------
    folder_of_pages
        As of `Door`.
    host
        Address of this computer to listen at.
    port
        None for `PORT`, or another where that is taken.

    Returns
    -------
    server
        The page.
    address
        To open in a browser, with the token where one is needed.

    Raises
    ------
    DeviceError
        If the port is taken, or the address is not this computer's.
    OptionError
        If there is no such port.
    """
    host = host.strip("[]")
    if port is not None and not 0 <= port < 2**16:
        raise OptionError(f"port {port}", where="--port", remedy="give 1024 to 65535")
    token = secrets.token_urlsafe(24)
    chosen = _free_port(host, PORT if port is None else port, is_asked=port is not None)
    # viser prints a box with its own addresses: ours is told by who opens the console
    with ExitStack() as made, redirect_stdout(StringIO()):
        with _guarded(Door(token, folder_of_pages)):
            server = viser.ViserServer(host=host, port=chosen, label="armscan", verbose=False)
            made.callback(server.stop)
        made.pop_all()
    name = "localhost" if is_loopback(host) else host
    # an address that means all of this computer's is none to open
    name = socket.gethostname() if host in ("0.0.0.0", "::") else name
    shown = f"http://{f'[{name}]' if ':' in name else name}:{server.get_port()}/"
    return server, shown if is_loopback(host) else f"{shown}?token={token}"


def close_server(server: viser.ViserServer) -> None:
    """Close the port; browsers that have the page say so."""
    # viser tells the terminal
    with redirect_stdout(StringIO()):
        server.stop()


def _free_port(host: str, port: int, *, is_asked: bool) -> int:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for candidate in (port,) if is_asked else (port, 0):
        try:
            with socket.socket(family) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, candidate))
                return int(probe.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
            if error.errno not in (errno.EADDRINUSE, errno.EACCES, errno.EPERM):
                raise DeviceError(
                    f"{host} is no address of this computer ({reason})",
                    where="--host",
                    remedy="give one that it has, or 0.0.0.0 for all of them",
                ) from error
    raise DeviceError(
        f"nothing can listen at {host} port {port} ({reason})",
        where="--port",
        remedy="close the program that holds it, or give another port",
    )
