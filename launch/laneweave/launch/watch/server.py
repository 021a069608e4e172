"""ASGI application with the page, its websocket, the health check and metrics.

Slow browsers get fewer frames: only the newest frame and the newest request of each browser are
kept.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from functools import partial
from typing import Any, Final
from urllib.parse import urlsplit
from uuid import uuid4

from attrs import define, field
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from laneweave.launch.drawing.road_scene import closed_parts_script
from laneweave.launch.watch.frames import FrameSource, batch, opening
from laneweave.launch.web import road_script, text_of

MAX_BROWSERS: Final = 50
MAX_REQUEST_CHARACTERS: Final = 200
"""Maximum length of messages from the page."""
POLICY_VIOLATION, TRY_LATER = 1008, 1013
"""Websocket status codes."""
METRICS_TYPE: Final = "text/plain; version=0.0.4"
HEADERS: Final = {
    "cache-control": "no-cache",
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
_FILES: Final = {
    "/": ("page.html", "text/html"),
    "/frames.js": ("frames.js", "text/javascript"),
    "/layers.js": ("layers.js", "text/javascript"),
    "/watch.js": ("watch.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}


@define(eq=False)
class Browser:
    """Pending output for one browser: at most one frame, one request and the ending."""

    frame: str | None = None
    request: tuple[int, int] | None = None
    ending: str | None = None
    """Last message, after which the connection is closed; None: not yet."""
    skipped: int = 0
    """Number of unsent frames replaced by newer ones."""
    _pending: asyncio.Event = field(factory=asyncio.Event)

    def offer(self, frame: str) -> None:
        """Set the next frame, replacing an unsent one."""
        self.skipped += self.frame is not None
        self.frame = frame
        self._pending.set()

    def set_request(self, request: tuple[int, int]) -> None:
        """Set the next request, replacing an unanswered one."""
        self.request = request
        self._pending.set()

    def end(self, ending: str) -> None:
        """Set the last message."""
        self.ending = ending
        self._pending.set()

    async def next(self, source: FrameSource) -> str:
        """Wait for the next message to send, and return it: responses, live frames, the ending."""
        while self.request is None and self.frame is None:
            if self.ending is not None:
                return self.ending
            self._pending.clear()
            await self._pending.wait()
        if self.request is not None:
            (begin, end), self.request = self.request, None
            return batch(source, begin, end)
        frame, self.frame = self.frame, None
        assert frame is not None  # noqa: S101 (there is a request or a frame)
        return frame


@define
class Browsers:
    """The connected browsers."""

    connected: set[Browser] = field(factory=set)

    def offer(self, frame: str) -> None:
        """Set the next frame of every browser."""
        for browser in self.connected:
            browser.offer(frame)

    def end(self, ending: str) -> None:
        """Set the last message of every browser."""
        for browser in self.connected:
            browser.end(ending)


Health = Callable[[], tuple[bool, dict[str, Any]]]
"""Returns whether what is shown is healthy, and details, with `serving`: whether the server is."""


Metrics = Callable[[], bytes]
"""Returns metrics in the Prometheus text format."""


def no_metrics() -> bytes:
    """Return no metrics."""
    return b""


def make_app(
    source: FrameSource, browsers: Browsers, health: Health, metrics: Metrics = no_metrics
) -> Starlette:
    """Return the application; `browsers` will contain the connected browsers."""
    scene = partial(opening, source, uuid4().hex)

    async def healthz(_request: Request) -> Response:
        healthy, facts = health()
        facts = {"ok": healthy, **facts, "browsers": len(browsers.connected)}
        return JSONResponse(facts, status_code=200 if healthy else 503, headers=HEADERS)

    async def livez(_request: Request) -> Response:
        _, facts = health()
        serving = bool(facts.get("serving", True))
        return JSONResponse({"ok": serving}, status_code=200 if serving else 503, headers=HEADERS)

    async def show_metrics(_request: Request) -> Response:
        return Response(metrics(), media_type=METRICS_TYPE, headers=HEADERS)

    async def stream(socket: WebSocket) -> None:
        if not same_origin(socket):
            await socket.close(POLICY_VIOLATION)
        elif len(browsers.connected) >= MAX_BROWSERS:
            await socket.accept()
            await socket.close(TRY_LATER)
        else:
            await _serve(socket, source, browsers, scene)

    return Starlette(
        routes=[
            *(_file(path, name, kind) for path, (name, kind) in _FILES.items()),
            Route("/road.js", _answer(road_script(), "text/javascript")),
            Route("/closed_parts.js", _answer(closed_parts_script(), "text/javascript")),
            Route("/healthz", healthz),
            Route("/livez", livez),
            Route("/metrics", show_metrics),
            WebSocketRoute("/stream", stream),
        ]
    )


def same_origin(socket: WebSocket) -> bool:
    """Return whether the socket was opened by a page of this server, or outside a browser.

    Browsers let any page open a websocket to any server, and send the page's origin.
    """
    origin = socket.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == socket.headers.get("host")


def request_of(text: str | None) -> tuple[int, int] | None:
    """Return the frame range that a message from the page requests; None if it is malformed."""
    if text is None or len(text) > MAX_REQUEST_CHARACTERS:
        return None
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        begin, end = json.loads(text)["want"]
        if type(begin) is int and type(end) is int and 0 <= begin <= end < 2**53:
            return begin, end
    return None


async def _serve(
    socket: WebSocket, source: FrameSource, browsers: Browsers, scene: Callable[[], str]
) -> None:
    await socket.accept()
    browser = Browser()
    browsers.connected.add(browser)
    sender = asyncio.create_task(_send(socket, browser, source, scene()))
    try:
        await _listen(socket, browser)
    finally:
        browsers.connected.discard(browser)
        sender.cancel()
        await asyncio.gather(sender, return_exceptions=True)


async def _send(socket: WebSocket, browser: Browser, source: FrameSource, scene: str) -> None:
    # If the browser disconnects, the listener cancels this task.
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await socket.send_text(scene)
        message = ""
        while message != browser.ending:
            message = await browser.next(source)
            # This waits while the browser does not read; meanwhile frames are skipped, not queued.
            await socket.send_text(message)
        await socket.close()


async def _listen(socket: WebSocket, browser: Browser) -> None:
    while True:
        message = await socket.receive()
        if message["type"] != "websocket.receive":
            return
        request = request_of(message.get("text"))
        if request is None:
            if socket.application_state is WebSocketState.CONNECTED:
                await socket.close(POLICY_VIOLATION)
            return
        browser.set_request(request)


def _file(path: str, name: str, kind: str) -> Route:
    return Route(path, _answer(text_of("laneweave.launch.watch", f"templates/{name}"), kind))


def _answer(text: str, kind: str) -> Callable[[Request], Response]:
    body = text.encode()

    def answer(_request: Request) -> Response:
        return Response(body, media_type=kind, headers=HEADERS)

    return answer
