"""The web server, over real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from attrs import define, field
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from laneweave.launch.observe.findings import RULES, Finding, FindingsMetrics
from laneweave.launch.observe.metrics_server import text_of
from laneweave.launch.watch.frames import MAX_REQUESTED, FrameBuffer, FrameSource, compact, ending
from laneweave.launch.watch.listening import open_socket
from laneweave.launch.watch.recorded_run import RecordedFrames
from laneweave.launch.watch.server import Browser, Browsers, make_app, request_of
from laneweave.protocol.errors import BadInputError
from support.tables import for_each
from support.waiting import wait_until

WAIT_S = 60.0
BIG = "x" * 100_000


@define
class Site:
    """A server in a thread."""

    source: FrameSource
    browsers: Browsers = field(factory=Browsers)
    healthy: bool = True
    _listener: socket.socket = field(factory=lambda: open_socket("127.0.0.1:0"))
    _loop: asyncio.AbstractEventLoop | None = None

    @contextlib.contextmanager
    def running(self) -> Iterator[Site]:
        app = make_app(
            self.source, self.browsers, lambda: (self.healthy, {"more": 1}), lambda: METRICS
        )
        config = uvicorn.Config(app, log_config=None, lifespan="off", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: asyncio.run(self._serve(server)))
        thread.start()
        try:
            yield self
        finally:
            server.should_exit = True
            thread.join(WAIT_S)
            assert not thread.is_alive()

    async def _serve(self, server: uvicorn.Server) -> None:
        self._loop = asyncio.get_running_loop()
        await server.serve(sockets=[self._listener])

    def offer(self, frame: str) -> None:
        """Offer a frame to all browsers."""
        self.call(self.browsers.offer, frame)

    def call(self, function: Callable[[str], None], text: str) -> None:
        """Call a function in the server's thread."""
        wait_until(lambda: self._loop is not None, WAIT_S)
        assert self._loop is not None
        self._loop.call_soon_threadsafe(function, text)

    @property
    def host(self) -> str:
        return f"127.0.0.1:{self._listener.getsockname()[1]}"

    def get(self, path: str) -> tuple[int, str, str]:
        """Return status, content type and text."""
        try:
            with urllib.request.urlopen(f"http://{self.host}{path}", timeout=WAIT_S) as answer:
                return answer.status, answer.headers["content-type"], answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.headers["content-type"], error.read().decode()

    def browser(self, **options: Any) -> ClientConnection:  # noqa: ANN401 - those of the library
        # The library's own type has no room for its options.
        browser: ClientConnection = connect(
            f"ws://{self.host}/stream", open_timeout=WAIT_S, **options
        )
        return browser


METRICS = text_of(FindingsMetrics.of([Finding("no-bridge", "bridge", "gone", 1.0, "start it")]))


def receive(browser: ClientConnection) -> dict[str, Any]:
    message: dict[str, Any] = json.loads(browser.recv(timeout=WAIT_S))
    return message


def live_source(count: int = 5) -> FrameBuffer:
    ring = FrameBuffer({"kind": "live"})
    for _ in range(count):
        ring.append(compact({"n": ring.next}))
    return ring


@pytest.fixture(scope="module")
def shared_site() -> Iterator[Site]:
    with Site(live_source()).running() as running:
        yield running


@pytest.fixture
def site(shared_site: Site) -> Site:
    """Return a healthy server without browsers."""
    shared_site.healthy = True
    wait_until(lambda: not shared_site.browsers.connected, WAIT_S)
    return shared_site


@for_each("path", ["/", "/road.js", "/closed_parts.js", "/frames.js", "/layers.js", "/watch.js"])
def test_the_page_needs_no_other_server(site: Site, path: str) -> None:
    status, kind, text = site.get(path)
    assert status == 200
    assert kind.startswith("text/html" if path == "/" else "text/javascript")
    addresses = set(re.findall(r"\w+://[^'\"`\s]+", text)) - {"http://www.w3.org/2000/svg"}
    assert not addresses


def test_the_health_check(site: Site) -> None:
    status, kind, text = site.get("/healthz")
    assert (status, kind) == (200, "application/json")
    assert json.loads(text) == {"ok": True, "more": 1, "browsers": 0}
    site.healthy = False
    status, _, text = site.get("/healthz")
    assert (status, json.loads(text)["ok"]) == (503, False)


def test_a_page_is_alive_whatever_it_shows(site: Site) -> None:
    site.healthy = False
    assert site.get("/livez")[0] == 200


def test_metrics_of_the_findings(site: Site) -> None:
    status, kind, text = site.get("/metrics")
    assert (status, kind.partition(";")[0]) == (200, "text/plain")
    (family,) = text_string_to_metric_families(text)
    values = {sample.labels["rule"]: sample.value for sample in family.samples}
    assert values == {rule.name: float(rule.name == "no-bridge") for rule in RULES}


def test_a_browser_gets_the_scene_and_new_frames_and_those_that_it_requests(site: Site) -> None:
    with site.browser() as browser:
        assert receive(browser)["scene"]["last"] == 4
        site.offer('{"n":5}')
        assert receive(browser) == {"n": 5}
        browser.send('{"want":[1,3]}')
        answer = receive(browser)
        assert (answer["reel"], answer["frames"]) == ([1, 3], [{"n": 1}, {"n": 2}, {"n": 3}])


def test_several_browsers_come_and_go(site: Site) -> None:
    with site.browser() as one, site.browser() as other:
        receive(one), receive(other)
        wait_until(lambda: len(site.browsers.connected) == 2, WAIT_S)
        # One disconnects without closing the websocket.
        one.socket.shutdown(socket.SHUT_RDWR)
        wait_until(lambda: len(site.browsers.connected) == 1, WAIT_S)
        site.offer('{"n":5}')
        assert receive(other) == {"n": 5}
    wait_until(lambda: not site.browsers.connected, WAIT_S)


def test_a_slow_browser_gets_fewer_frames_and_delays_no_other(site: Site) -> None:
    with contextlib.closing(deaf_socket(site)), site.browser(max_size=None) as fast:
        receive(fast)
        wait_until(lambda: len(site.browsers.connected) == 2, WAIT_S)
        for number in range(120):
            site.offer(compact({"n": number, "filling": BIG}))
            # The fast one reads every frame, the slow one none.
            assert receive(fast)["n"] == number
        assert max(browser.skipped for browser in site.browsers.connected) > 20
    # It is disconnected at last, with frames still unsent.
    wait_until(lambda: not site.browsers.connected, WAIT_S)


def deaf_socket(site: Site) -> socket.socket:
    """Return a socket of a browser that opens a websocket and never reads from it."""
    deaf = socket.socket()
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    host, _, port = site.host.partition(":")
    deaf.connect((host, int(port)))
    deaf.sendall(
        f"GET /stream HTTP/1.1\r\nHost: {site.host}\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
    )
    return deaf


@for_each(
    "message",
    [
        "",
        "nonsense",
        "[]",
        "{}",
        '{"want":5}',
        '{"want":[2,1]}',
        '{"want":[-1,1]}',
        '{"want":[0.5,1]}',
        '{"want":[true,true]}',
        '{"want":[1,9007199254740992]}',
        '{"want":[1,2]' + " " * 200 + "}",
        "[" * 150,
        b"\x00",
    ],
)
def test_malformed_requests_close_the_connection(site: Site, message: str | bytes) -> None:
    assert request_of(None if isinstance(message, bytes) else message) is None
    with site.browser() as browser:
        receive(browser)
        browser.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            receive(browser)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008
    assert site.get("/healthz")[0] == 200


def test_pages_of_other_servers_are_refused(site: Site) -> None:
    with pytest.raises(InvalidStatus), site.browser(origin="http://elsewhere.example"):
        pass
    with site.browser(origin=f"http://{site.host}") as browser:
        assert "scene" in receive(browser)


def test_the_number_of_browsers_is_limited(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("laneweave.launch.watch.server.MAX_BROWSERS", 1)
    with site.browser() as first, site.browser() as second:
        receive(first)
        with pytest.raises(ConnectionClosed):
            receive(second)


def test_the_ending_is_the_last_message(site: Site) -> None:
    with site.browser() as one, site.browser() as other:
        assert "scene" in receive(one)
        assert "scene" in receive(other)
        wait_until(lambda: len(site.browsers.connected) == 2, WAIT_S)
        site.offer(compact({"n": 5}))
        site.call(site.browsers.end, ending("run ended"))
        for browser in (one, other):
            assert receive(browser) == {"n": 5}
            assert receive(browser) == {"end": "run ended"}
            with pytest.raises(ConnectionClosed):
                browser.recv(timeout=WAIT_S)


def test_the_end_does_not_wait_for_browsers() -> None:
    with contextlib.ExitStack() as stack:
        with Site(live_source()).running() as site:
            browser = stack.enter_context(site.browser())
            receive(browser)
            began = time.monotonic()
        assert time.monotonic() - began < 10.0
        with pytest.raises(ConnectionClosed):
            receive(browser)


@pytest.mark.slow
def test_a_recorded_run_over_the_websocket(recorded: Path) -> None:
    recording = RecordedFrames(recorded)
    with Site(recording).running() as site, site.browser() as browser:
        scene = receive(browser)["scene"]
        assert (scene["kind"], scene["first"], scene["last"]) == ("recorded", 0, recording.last)
        browser.send(json.dumps({"want": [20, 10**6]}))
        frames = receive(browser)["frames"]
        assert [frame["n"] for frame in frames] == list(range(20, 20 + MAX_REQUESTED))
        assert frames[-1]["vehicles"]


def test_nothing_queues_for_a_browser() -> None:
    browser = Browser()
    for number in range(1000):
        browser.offer(str(number))
        browser.set_request((number, number))
    assert (browser.frame, browser.request, browser.skipped) == ("999", (999, 999), 999)


def test_unusable_addresses_are_refused() -> None:
    with contextlib.closing(open_socket("127.0.0.1:0")) as taken:
        port = taken.getsockname()[1]
        for listen in (
            *("", "8080", "localhost", ":8080", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:65536"),
            *(f"127.0.0.1:{port}", "192.0.2.1:8080", "no.such.host.invalid:80"),
        ):
            with pytest.raises(BadInputError, match="--listen"):
                open_socket(listen)
