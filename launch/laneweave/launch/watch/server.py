"""The page, its websocket, and the health check, as one ASGI application.

A browser that is slower than the road gets fewer frames: for each one there is one place for the
newest frame and one for its newest wish, and nothing else waits for it.
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

from laneweave.launch.watch.frames import Film, opening, reel
from laneweave.launch.web import road_script, text_of

MOST_BROWSERS: Final = 50
MOST_WISH_CHARACTERS: Final = 200
"""A longer message is none from the page."""
POLICY_VIOLATION, TRY_LATER = 1008, 1013
"""Status codes of websockets."""
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
    "/film.js": ("film.js", "text/javascript"),
    "/layers.js": ("layers.js", "text/javascript"),
    "/watch.js": ("watch.js", "text/javascript"),
    "/style.css": ("style.css", "text/css"),
}


@define(eq=False)
class Browser:
    """What waits for one browser: at most one frame and one wish."""

    frame: str | None = None
    wish: tuple[int, int] | None = None
    left_out: int = 0
    """Frames that newer ones have replaced."""
    _news: asyncio.Event = field(factory=asyncio.Event)

    def offer(self, frame: str) -> None:
        """Let it have a frame instead of one that it has not taken yet."""
        self.left_out += self.frame is not None
        self.frame = frame
        self._news.set()

    def ask(self, wish: tuple[int, int]) -> None:
        """Note a wish; an older one that waits still is forgotten."""
        self.wish = wish
        self._news.set()

    async def next(self, film: Film) -> str:
        """Wait for what is to be sent next; wishes come first."""
        while self.wish is None and self.frame is None:
            self._news.clear()
            await self._news.wait()
        if self.wish is not None:
            (begin, end), self.wish = self.wish, None
            return reel(film, begin, end)
        frame, self.frame = self.frame, None
        assert frame is not None  # noqa: S101 (one of both is there)
        return frame


@define
class Audience:
    """All browsers."""

    browsers: set[Browser] = field(factory=set)

    def offer(self, frame: str) -> None:
        """Let everybody have a frame."""
        for browser in self.browsers:
            browser.offer(frame)


Health = Callable[[], tuple[bool, dict[str, Any]]]
"""Whether all is well, and what there is to say about it."""


def make_app(film: Film, audience: Audience, health: Health) -> Starlette:
    """Return the application.

    Args:
        film: the frames that can be asked for.
        audience: whom frames are offered to as they come.
        health: asked at each health check.
    """
    scene = partial(opening, film, uuid4().hex)

    async def healthz(_request: Request) -> Response:
        well, facts = health()
        facts = {"ok": well, **facts, "browsers": len(audience.browsers)}
        return JSONResponse(facts, status_code=200 if well else 503, headers=HEADERS)

    async def stream(socket: WebSocket) -> None:
        if not same_origin(socket):
            await socket.close(POLICY_VIOLATION)
        elif len(audience.browsers) >= MOST_BROWSERS:
            await socket.accept()
            await socket.close(TRY_LATER)
        else:
            await _serve(socket, film, audience, scene)

    return Starlette(
        routes=[
            *(_file(path, name, kind) for path, (name, kind) in _FILES.items()),
            Route("/road.js", _answer(road_script(), "text/javascript")),
            Route("/healthz", healthz),
            WebSocketRoute("/stream", stream),
        ]
    )


def same_origin(socket: WebSocket) -> bool:
    """Tell whether a page of this server opens the socket, or none at all.

    Browsers let any page open a websocket to anywhere and say whose page it is.
    """
    origin = socket.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == socket.headers.get("host")


def wish_of(text: str | None) -> tuple[int, int] | None:
    """Return the numbers of the frames that a message of the page asks for, None if it is none."""
    if text is None or len(text) > MOST_WISH_CHARACTERS:
        return None
    with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
        begin, end = json.loads(text)["want"]
        if type(begin) is int and type(end) is int and 0 <= begin <= end < 2**53:
            return begin, end
    return None


async def _serve(
    socket: WebSocket, film: Film, audience: Audience, scene: Callable[[], str]
) -> None:
    await socket.accept()
    browser = Browser()
    audience.browsers.add(browser)
    sender = asyncio.create_task(_send(socket, browser, film, scene()))
    try:
        await _listen(socket, browser)
    finally:
        audience.browsers.discard(browser)
        sender.cancel()
        await asyncio.gather(sender, return_exceptions=True)


async def _send(socket: WebSocket, browser: Browser, film: Film, scene: str) -> None:
    # A browser that has vanished is noticed by the listener, too, which ends this.
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await socket.send_text(scene)
        while True:
            # Waits while the browser does not read: then frames are left out, not queued.
            await socket.send_text(await browser.next(film))


async def _listen(socket: WebSocket, browser: Browser) -> None:
    while True:
        message = await socket.receive()
        if message["type"] != "websocket.receive":
            return
        wish = wish_of(message.get("text"))
        if wish is None:
            if socket.application_state is WebSocketState.CONNECTED:
                await socket.close(POLICY_VIOLATION)
            return
        browser.ask(wish)


def _file(path: str, name: str, kind: str) -> Route:
    return Route(path, _answer(text_of("laneweave.launch.watch", f"templates/{name}"), kind))


def _answer(text: str, kind: str) -> Callable[[Request], Response]:
    body = text.encode()

    def answer(_request: Request) -> Response:
        return Response(body, media_type=kind, headers=HEADERS)

    return answer
