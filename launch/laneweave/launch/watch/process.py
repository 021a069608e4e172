"""The process of the live page: socket, signals, observer thread.

The thread processes Zenoh deliveries and makes frames; the event loop serves browsers. Only
complete frames are passed from the thread to the loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import attrs
import structlog
import uvicorn

from laneweave.launch.observe.findings import FindingsMetrics
from laneweave.launch.observe.metrics_server import text_of
from laneweave.launch.observe.observed import Expected
from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.status import TOKENS
from laneweave.launch.watch.frames import FrameBuffer, FrameSource, compact, ending, scene_of
from laneweave.launch.watch.listening import address_of, open_socket
from laneweave.launch.watch.live_road import TOPICS, LiveRoad
from laneweave.launch.watch.server import Browsers, Health, Metrics, make_app, no_metrics
from laneweave.protocol.runtime.node import Arrived
from laneweave.protocol.runtime.processes import accepted_stop_signals
from laneweave.protocol.runtime.transport import Delivery
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.transports.zenoh.transport import connect_blocking
from laneweave.protocol.wire.topics import Keys

log = structlog.get_logger(__name__)

STEP_S: Final = 0.1
"""Wall-clock time between two frames."""
SLACK_S: Final = 0.02
"""Time by which a frame may be early, so that each tick gets a frame despite irregular timing."""
IDLE_S: Final = 1.0
"""Maximum time between two frames if nothing changes."""
POLL_S: Final = 0.02
MAX_BATCH: Final = 5_000
"""Maximum number of messages processed between two frames."""
IDENTITY: Final = "observer.watch"
"""Identity of the process in a secured network."""
MAX_QUEUED: Final = 20_000
"""Maximum number of queued messages; further ones are dropped."""
END_S: Final = 1.0
"""Grace period for browsers to disconnect at shutdown."""


def watch_live(
    scenario: Scenario, listen: str, ready: Callable[[str], None], expected: Expected
) -> None:
    """Serve the page of a deployment until SIGINT or SIGTERM; call `ready` with the page's URL.

    `expected`: processes that should be there.

    Raises:
        BadInputError: there is no router at the endpoint, or the address cannot be used.
    """
    with (
        contextlib.closing(open_socket(listen)) as listener,
        _LiveObserver(scenario, expected) as observer,
    ):
        _serve(
            listener,
            observer.buffer,
            observer.browsers,
            observer.health,
            ready,
            observer.start,
            metrics=observer.metrics,
        )
        observer.check()


def watch_run(
    scenario: Scenario, title: str, listener: socket.socket, launcher: Connection
) -> None:
    """Serve the page of a run at a listening socket until its launcher ends it.

    Args:
        scenario: road and network of the run, whose router must already listen.
        title: title of the page.
        listener: listening socket.
        launcher: receives how the run has ended, which the page then shows; closed without: nothing
            is shown.

    Raises:
        BadInputError: there is no router at the endpoint.
    """
    with (
        contextlib.closing(listener),
        _LiveObserver(scenario, Expected.of(scenario, bridge=True), title) as observer,
    ):
        _serve(
            listener,
            observer.buffer,
            observer.browsers,
            observer.health,
            lambda _: None,
            observer.start,
            launcher,
        )
        observer.check()


def watch_recorded(folder: Path, listen: str, ready: Callable[[str], None]) -> None:
    """Serve the page of a recorded run until SIGINT or SIGTERM; call `ready` with the page's URL.

    Raises:
        BadInputError: the folder does not hold a finished run, or the address cannot be used.
    """
    from laneweave.launch.watch.recorded_run import RecordedFrames  # noqa: PLC0415 (needs pyarrow)

    recording = RecordedFrames(folder)

    def health() -> tuple[bool, dict[str, Any]]:
        return True, {"recorded": str(folder)}

    with contextlib.closing(open_socket(listen)) as listener:
        _serve(listener, recording, Browsers(), health, ready)


class _LiveObserver:
    """Observer of a deployment that makes frames in a separate thread."""

    def __init__(self, scenario: Scenario, expected: Expected, title: str = "") -> None:
        """Connect to the router, with retries; the default title of the page is the realm.

        Raises:
            BadInputError: there is no router at the endpoint.
        """
        self.browsers = Browsers()
        title = title or scenario.network.realm
        self.buffer = FrameBuffer(scene_of(scenario, "live", title, STEP_S))
        self._observer = Observer(Keys(scenario.network.realm), topics=TOPICS, tokens=TOKENS)
        self._transport = connect_blocking(access_of(scenario, IDENTITY), self._deliver)
        # Offset for wall-clock times that do not jump when the system clock is set.
        self._offset_s = time.time() - time.monotonic()
        self._road = LiveRoad(scenario, self._wall_s(), expected)
        self._made_s = self._wall_s()
        self._number = 0  # of the next frame
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._failure: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._abort: Callable[[], None] = lambda: None

    def __enter__(self) -> _LiveObserver:
        """Return this observer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the thread and close the connection."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(END_S)
        self._transport.close()

    def start(self, abort: Callable[[], None]) -> None:
        """In the event loop, subscribe and start the thread; `abort` ends the process."""
        self._loop, self._abort = asyncio.get_running_loop(), abort
        self._observer.subscribe(self._transport)
        self._thread.start()

    def check(self) -> None:
        """Raise the error that ended the thread, if any."""
        if self._failure is not None:
            raise self._failure

    def health(self) -> tuple[bool, dict[str, Any]]:
        """Return whether nothing is wrong with the deployment, and this observer makes frames."""
        age_s = self._wall_s() - self._made_s
        view, findings = self._road.view, self._road.findings
        makes_frames = age_s < 3.0 * IDLE_S
        facts = {
            "serving": view.linked and makes_frames,
            "connected": view.linked,
            "runs": view.roads,
            "frame_age_s": round(age_s, 3),
            "findings": [attrs.asdict(one) for one in findings],
        }
        return not findings and makes_frames, facts

    def metrics(self) -> bytes:
        """Return metrics of the findings in the Prometheus text format."""
        return text_of(FindingsMetrics.of(self._road.findings))

    def _wall_s(self) -> float:
        return time.monotonic() + self._offset_s

    def _deliver(self, delivery: Delivery) -> None:
        inbox = self._observer.inbox
        if inbox.qsize() < MAX_QUEUED:
            inbox.put(delivery)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                for event in islice(self._observer.receive(POLL_S), MAX_BATCH):
                    message = event.message if isinstance(event, Arrived) else event
                    self._road.update(message, self._wall_s())
                self._make_frame()
        except Exception as error:  # noqa: BLE001 (reported by the main thread, which ends)
            self._failure = error
            self._call(self._abort)

    def _make_frame(self) -> None:
        wall_s = self._wall_s()
        age_s = wall_s - self._made_s
        due = age_s >= STEP_S - SLACK_S and self._road.changed(wall_s)
        if due or age_s >= IDLE_S:
            self._made_s = wall_s
            frame = self._road.frame(self._number, wall_s)
            self._number += 1
            self._call(self._publish, compact(frame))

    def _publish(self, frame: str) -> None:
        """In the event loop, send a frame to all browsers."""
        self.buffer.append(frame)
        self.browsers.offer(frame)

    def _call(self, function: Callable[..., None], *arguments: object) -> None:
        assert self._loop is not None  # noqa: S101 (set before the thread starts)
        # The loop is already closed if the process is ending.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)


class _Server(uvicorn.Server):
    """Server without signal handlers."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signals: uvicorn's handler would raise them again."""
        yield


def _serve(
    listener: socket.socket,
    source: FrameSource,
    browsers: Browsers,
    health: Health,
    ready: Callable[[str], None],
    start: Callable[[Callable[[], None]], None] = lambda _: None,
    launcher: Connection | None = None,
    metrics: Metrics = no_metrics,
) -> None:
    config = uvicorn.Config(
        make_app(source, browsers, health, metrics),
        log_config=None,
        # Do not log connects and disconnects of browsers on the terminal.
        log_level="critical",
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_graceful_shutdown=int(END_S),
        ws="websockets-sansio",
        ws_max_size=4096,
        ws_max_queue=4,
        ws_ping_interval=5.0,
        ws_ping_timeout=10.0,
        # Compression costs more time than it saves on a local network.
        ws_per_message_deflate=False,
    )
    server = _Server(config)

    def end() -> None:
        server.should_exit = True

    def on_launcher(connection: Connection) -> None:
        asyncio.get_running_loop().remove_reader(connection.fileno())
        with contextlib.suppress(EOFError, OSError):
            browsers.end(ending(connection.recv()))
        # Closing the browsers' connections waits until the ending has been sent.
        asyncio.get_running_loop().call_later(END_S if browsers.connected else 0.0, end)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        for number in accepted_stop_signals():
            loop.add_signal_handler(number, end)
        if launcher is not None:
            loop.add_reader(launcher.fileno(), on_launcher, launcher)
        start(end)
        ready(address_of(listener))
        await server.serve(sockets=[listener])

    asyncio.run(main())
