"""A viser server that answers only authorized requests, and receives the keys that are held on its pages.

viser has no access control and no key events. All its traffic, both plain requests and WebSocket handshakes, passes one
hook of the `websockets` library. `open_server` wraps this hook while viser opens its port:

*Host and origin.* If the server is bound to this machine alone, it answers only requests for a loopback name, so that
sites whose names point here cannot read it (DNS rebinding). A handshake must come from the server's own page.
*Token.* If the server is bound to any other address, each request needs the token: the first one in its address, later
ones as a cookie. Without TLS both can be read on the network.
*Script.* The page contains `page.js`, which reports held keys to the socket `/keys` and uploads dropped photos.
*Threads.* viser wakes its pages' senders from any thread, which asyncio does not allow; here only from their own.
"""

import asyncio
import contextlib
import errno
import hmac
import http
import io
import ipaddress
import json
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from viser.infra import _infra
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from twin.errors import InputError

KEYS = "wasd"
"""Keys that drive."""

_KEYS_PATH = "/keys"
_HELD_TIME = 0.35  # [s] for which a report of held keys is valid; the page repeats it every 0.1 s
_MAX_REPORT = 200  # characters
_STOP_TIME = 3.0  # [s] longest wait for a thread of the server to end
_PORTS = 50  # number of ports to try, from the given one on

Check = Callable[[ServerConnection, Request], Response | None]


class _LoopEvent(asyncio.Event):
    """An event that can be set only on a loop's thread."""

    def set(self) -> None:
        with contextlib.suppress(RuntimeError):
            asyncio.get_running_loop()
            super().set()


@dataclass
class _MessageBuffer(AsyncMessageBuffer):
    """A buffer that several threads may fill.

    viser's sets its event on the thread that sends a message, and then again on the loop. The first may raise "deque
    mutated during iteration", or coincide with the beginning of a wait, which then never ends.
    """

    message_event: asyncio.Event = field(default_factory=_LoopEvent)


class HeldKeys:
    """The keys that are held on any page."""

    def __init__(self) -> None:
        self._reports: dict[int, tuple[frozenset[str], float]] = {}
        self._lock = threading.Lock()

    def report(self, page: int, keys: str) -> None:
        """Stores the held keys that a page reports; without any, the page is removed."""
        with self._lock:
            self._reports.pop(page, None)
            if held := frozenset(keys) & frozenset(KEYS):
                self._reports[page] = held, time.monotonic()

    def held(self) -> frozenset[str]:
        """Keys held at present."""
        oldest = time.monotonic() - _HELD_TIME
        with self._lock:
            return frozenset().union(*(held for held, reported in self._reports.values() if reported > oldest))


class Gate:
    """Decides which requests are answered."""

    def __init__(self, port: int, token: str | None) -> None:
        """Without a token, only requests for `localhost` or a loopback address are answered."""
        self._token, self._cookie = token, f"twin_{port}"

    def refusal(self, request: Request) -> Response | None:
        """A refusal, or the redirect that stores the token as a cookie; None if the request is allowed."""
        host, origin = _header(request, "Host"), _header(request, "Origin")
        if self._token is None and (host is None or not _is_loopback(_hostname(host))):
            return _answer(http.HTTPStatus.FORBIDDEN, "this page is for this machine only; see twin view --host\n")
        if _is_handshake(request) and origin is not None and (host is None or urlsplit(origin).netloc != host):
            return _answer(http.HTTPStatus.FORBIDDEN, "another site's page may not connect\n")
        if self._token is None or self._equal(self._cookie_value(request)):
            return None
        given = parse_qs(urlsplit(request.path).query).get("token", [])
        if len(given) == 1 and self._equal(given[0]) and not _is_handshake(request):
            redirect = _answer(http.HTTPStatus.SEE_OTHER, "")
            redirect.headers["Location"] = "/"
            redirect.headers["Set-Cookie"] = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Lax"
            return redirect
        return _answer(http.HTTPStatus.UNAUTHORIZED, "open the address that twin view printed, with its token\n")

    def _equal(self, given: str | None) -> bool:
        assert self._token is not None
        return given is not None and hmac.compare_digest(given.encode(), self._token.encode())

    def _cookie_value(self, request: Request) -> str | None:
        for part in (_header(request, "Cookie") or "").split(";"):
            name, _, value = part.strip().partition("=")
            if name == self._cookie:
                return value
        return None


class GuardedServer:
    """A running viser server behind a gate."""

    def __init__(
        self, server: viser.ViserServer, keys: HeldKeys, url: str, port: int, threads: list[threading.Thread]
    ) -> None:
        """`threads` are those that the server started."""
        self.viser, self.keys, self.url, self.port, self._threads = server, keys, url, port, threads
        self._pages: set[ServerConnection] = set()
        self._driving = False
        self._loop: asyncio.AbstractEventLoop | None = None

    def set_driving(self, driving: bool) -> None:
        """Makes the keys W A S D drive the robot (True) or move the camera (False), on all pages."""
        self._driving = driving
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the server has stopped
                asyncio.run_coroutine_threadsafe(self._tell_pages(), self._loop)

    def stop(self) -> None:
        with _silent():
            self.viser.stop()
            for thread in self._threads:  # one of them prints when it ends
                thread.join(_STOP_TIME)

    async def _tell_pages(self) -> None:
        for page in tuple(self._pages):
            with contextlib.suppress(ConnectionClosed):
                await page.send(json.dumps({"driving": self._driving}))

    async def hear_keys(self, page: ServerConnection) -> None:
        """Receives the held keys of one page until its socket closes."""
        self._loop = asyncio.get_running_loop()
        self._pages.add(page)
        try:
            await page.send(json.dumps({"driving": self._driving}))
            async for message in page:
                self.keys.report(id(page), message[:_MAX_REPORT] if isinstance(message, str) else "")
        except ConnectionClosed:
            pass
        finally:
            self._pages.discard(page)
            self.keys.report(id(page), "")


def open_server(host: str, port: int, label: str) -> GuardedServer:
    """Opens viser's server on the first free port from `port` on.

    Raises:
        InputError: an address that is not this machine's, or no free port.
    """
    port = _free_port(host, port)
    token = None if _is_loopback(host) else secrets.token_urlsafe(24)
    gate, keys, index = Gate(port, token), HeldKeys(), _index_page()
    opened: list[GuardedServer] = []
    checked: list[bool] = []

    def wrap(handler: Callable[..., Any], check: Check) -> tuple[Callable[..., Any], Check]:
        checked.append(True)

        def guarded_check(connection: ServerConnection, request: Request) -> Response | None:
            if refusal := gate.refusal(request):
                return refusal
            if not _is_handshake(request) and urlsplit(request.path).path == "/":
                page = _answer(http.HTTPStatus.OK, index, "text/html")
                page.headers["Referrer-Policy"] = "no-referrer"
                return page
            return check(connection, request)

        async def guarded_handler(connection: ServerConnection) -> None:
            assert connection.request is not None
            if urlsplit(connection.request.path).path == _KEYS_PATH:
                if opened:
                    await opened[0].hear_keys(connection)
            else:
                await handler(connection)

        return guarded_handler, guarded_check

    _infra.AsyncMessageBuffer = _MessageBuffer  # type: ignore[misc]
    before = set(threading.enumerate())
    with _silent(), _wrapped_serve(wrap):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    if not checked:
        with _silent():
            server.stop()
        raise RuntimeError(f"viser {viser.__version__} opens its port in another way: the page would be unguarded")
    # viser lets a page request a public tunnel to this server; such requests do nothing here.
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    name = f"[{host}]" if ":" in host else host
    shown = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(host, name)
    url = f"http://{shown}:{server.get_port()}/" + (f"?token={token}" if token else "")
    started = [thread for thread in threading.enumerate() if thread not in before]
    opened.append(GuardedServer(server, keys, url, server.get_port(), started))
    return opened[0]


@contextlib.contextmanager
def _wrapped_serve(wrap: Callable[[Callable[..., Any], Check], tuple[Callable[..., Any], Check]]) -> Iterator[None]:
    """Within the block, `websockets.asyncio.server.serve` wraps its handler and request check."""
    original: Any = websockets.asyncio.server.serve

    def serve(handler: Any, host: Any, port: Any, *, process_request: Check, **more: Any) -> Any:
        handler, process_request = wrap(handler, process_request)
        return original(handler, host, port, process_request=process_request, **more)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]


def _silent() -> contextlib.redirect_stdout[io.StringIO]:
    """Suppresses viser's own banner, whose address lacks the token."""
    return contextlib.redirect_stdout(io.StringIO())


def _free_port(host: str, port: int) -> int:
    """The first free port from `port` on."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError):
        raise InputError(f"--host {host!r}: no such address; give 127.0.0.1, or one of this machine's") from None
    for one in range(port, min(port + _PORTS, 65536)):
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address[0], one))
                return int(probe.getsockname()[1])
            except PermissionError:
                raise InputError(f"--port {port}: not allowed; give one from 1024 on") from None
            except OSError as error:
                reason = error
    if reason.errno != errno.EADDRINUSE:
        raise InputError(f"--host {host!r}: {reason.strerror}; give 127.0.0.1, or an address of this machine")
    raise InputError(f"--port {port}: it and the next {_PORTS - 1} are in use; give another")


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _index_page() -> str:
    """viser's page, in which `page.js` is embedded."""
    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(encoding="utf-8")
    script = resources.files("twin.view").joinpath("page.js").read_text(encoding="utf-8")
    head = page.index("</head>")
    return f"{page[:head]}<script>{script}</script>{page[head:]}"


def _header(request: Request, name: str) -> str | None:
    """The value of a header; None if it is missing or given twice."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _is_handshake(request: Request) -> bool:
    """True for a WebSocket handshake, which viser, too, recognizes by this header."""
    return bool(request.headers.get_all("Upgrade"))


def _hostname(host: str) -> str:
    """The host of a Host header, without its port and the brackets of IPv6, in lower case."""
    name = host.lower()
    return name[1 : name.index("]")] if name.startswith("[") and "]" in name else name.partition(":")[0]


def _answer(status: http.HTTPStatus, text: str, kind: str = "text/plain") -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))})
    headers["Cache-Control"] = "no-store"
    return Response(status, status.phrase, headers, body)
