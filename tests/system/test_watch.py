"""The live page: a real server on a real network, seen in a real Chromium."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from attrs import define, field
from websockets.exceptions import ConnectionClosedOK
from websockets.sync.client import connect

from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.trajectories import read_tracks
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.topics import Keys
from support.chromium import Page, needs_chromium, new_page
from support.convoy import COORDINATORS, Convoy
from support.deployments import REALM, deployment, free_tcp, start_router, stop
from support.harness import DEMAND, END_S, RUN_S, Lab, summary
from system.conftest import FinishedRun

VEHICLES = 90
SHOWN_FRAMES = 20
SHORT = """\
schema = "laneweave.scenario/1"
[road]
s2_m = 60.0
s3_m = 240.0
[demand]
volume_veh_per_lane_h = 1600.0
duration_s = 8.0
[network]
realm = "test"
election_s = 3.0
endpoint = "unixsock-stream/router.sock"
"""
FIRST_PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Return a page that the tests here use one after the other."""
    yield from new_page(tmp_path_factory.mktemp("chromium"))


@define
class Traffic:
    """Publishes the messages of a convoy at ten ticks a second, as a deployment would."""

    endpoint: str
    convoy: Convoy
    tick: int
    _stop: threading.Event = field(factory=threading.Event)
    _thread: threading.Thread | None = None

    @contextlib.contextmanager
    def flowing(self) -> Iterator[Traffic]:
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join(END_S)

    def _run(self) -> None:
        keys = Keys(REALM)
        with contextlib.closing(
            ZenohTransport(Access(self.endpoint, REALM), lambda _: None)
        ) as transport:
            for token in self.convoy.tokens():
                transport.announce(keys.key(token.topic, **token.parameters))
            due_s = time.monotonic()
            while not self._stop.is_set():
                for send in self.convoy.messages(self.tick):
                    key = keys.key(send.topic, **send.parameters)
                    transport.publish(key, encode(send.message), send.topic.quality)
                self.tick += 1
                due_s += 0.1
                self._stop.wait(max(0.0, due_s - time.monotonic()))


def traffic(endpoint: str, convoy: Convoy) -> Traffic:
    return Traffic(endpoint, convoy, convoy.first_tick)


def start_watch(lab: Lab, *arguments: object) -> tuple[subprocess.Popen[str], str]:
    """Start the page's server; return it and the page's address."""
    watch = lab.start("watch", *arguments, "--listen", "127.0.0.1:0")
    assert watch.stdout is not None
    address = watch.stdout.readline().strip()
    assert address.startswith("http://127.0.0.1:"), lab.finish(watch, END_S)
    return watch, address


def health(address: str) -> tuple[int, dict[str, Any]]:
    try:
        with urllib.request.urlopen(f"{address}healthz", timeout=END_S) as answer:  # noqa: S310
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def shown_since(page: Page, before: dict[str, int], count: str) -> bool:
    """Return whether the page has counted enough since `before`."""
    return bool(page.run("laneweaveWatch.stats")[count] >= before[count] + SHOWN_FRAMES)


@needs_chromium
@pytest.mark.more
def test_90_vehicles_are_shown(lab: Lab, page: Page) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    router = start_router(lab, config)
    watch, address = start_watch(lab, "--config", config)
    with traffic(endpoint, Convoy(VEHICLES)).flowing():
        page.open(address)
        page.wait_until(lambda: page.text("count") == str(VEHICLES))

        # Rates depend on the machine: benchmarks/watch.py measures them.
        before = page.run("laneweaveWatch.stats")
        for count in ("frames", "shown"):
            page.wait_until(partial(shown_since, page, before, count))
        assert page.run(FIRST_PAINT) > 0.0
        assert page.text("leader") == "c1, term 3"
        assert page.text("candidates") == "c1c2c3"
        page.wait_until(lambda: page.text("pill") == "live")
        _check_pause_and_slider(page)
    assert page.console_errors() == []
    stop(lab, watch, router)
    lab.check_nothing_left()


def _check_pause_and_slider(page: Page) -> None:
    page.click("pause")
    page.wait_until(lambda: page.text("pill") == "paused")
    paused_at, frames = page.text("time"), page.run("laneweaveWatch.stats.frames")
    page.wait_until(lambda: page.run("laneweaveWatch.stats.frames") > frames + 5)
    assert page.text("time") == paused_at
    # From before this page was opened: the server has it.
    page.run("(s => { s.value = 0; s.dispatchEvent(new Event('input')); })(slider)")
    page.wait_until(lambda: "s ago" in page.text("now") and page.text("time") != paused_at)
    page.click("pause")
    page.wait_until(lambda: page.text("pill") == "live" and page.text("time") > paused_at)


@pytest.mark.more
@needs_chromium
def test_what_fails_is_shown_and_recovered_from(lab: Lab, page: Page) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    router = start_router(lab, config)
    watch, address = start_watch(lab, "--endpoint", endpoint, "--config", config)
    page.open(address)
    page.wait_until(lambda: page.text("pill") == "no road")
    page.wait_until(lambda: page.text("banner").startswith("No bridge found: start the bridge"))
    status, facts = health(address)
    assert (status, facts["serving"]) == (503, True)
    with traffic(endpoint, Convoy(6)).flowing():
        page.wait_until(lambda: page.text("pill") == "live")
        page.wait_until(lambda: page.text("count") == "6")

        router.kill()
        lab.finish(router, END_S)
        page.wait_until(lambda: page.text("pill") == "connection lost")
        assert "lost at" in page.text("banner")
        status, facts = health(address)
        assert (status, facts["ok"], facts["connected"]) == (503, False, False)

        router = start_router(lab, config)
        page.wait_until(lambda: page.text("pill") == "live")
        assert page.run("banner.hidden")
        assert health(address)[0] == 200
    page.wait_until(lambda: page.text("pill") == "clock stopped")
    # Another bridge is another road.
    with traffic(endpoint, Convoy(4, bridge=2, coordinators=COORDINATORS[:2])).flowing():
        page.wait_until(lambda: page.text("count") == "4")
        page.wait_until(lambda: page.text("run").startswith("run 2"))
        page.wait_until(lambda: page.text("pill") == "problem")
        assert page.text("banner") == "No coordinator c3 found: start it."
        page.click("pause")
        page.wait_until(lambda: page.text("pill") == "paused")
        page.click("pause")
        page.wait_until(lambda: page.text("pill") == "problem")

    # An open page does not keep its server from ending.
    stop(lab, watch)
    page.wait_until(lambda: page.text("pill") == "offline")
    stop(lab, router)
    lab.check_nothing_left()


@needs_chromium
def test_a_recorded_run_is_played(finished_run: FinishedRun, lab: Lab, page: Page) -> None:
    folder = finished_run("simulated")
    watch, address = start_watch(lab, folder)
    assert health(address) == (200, {"ok": True, "recorded": str(folder), "browsers": 0})
    page.open(address)
    page.wait_until(lambda: page.run("laneweaveWatch.stats.shown") > 5)
    assert page.text("pill") == "recorded"
    page.click("pause")
    page.wait_until(lambda: page.text("pause") == "Play")

    tracks = read_tracks(folder)
    for number in (60, 110):
        script = f"s.value = {number}; s.dispatchEvent(new Event('input'));"
        page.run(f"(s => {{ {script} }})(slider)")
        t_s = 0.2 * number
        shown = f"{t_s:.1f} s"
        page.wait_until(partial(_says, page, "time", shown))
        there = int(np.count_nonzero(np.abs(tracks.t_s - t_s) < 1e-6))
        assert there > 3
        assert page.text("count") == str(there)
    page.run("(v => { v.value = '10'; v.dispatchEvent(new Event('change')); })(pace)")
    page.click("pause")
    page.wait_until(lambda: page.text("pause") == "Play")
    last_s = float(tracks.t_s.max())
    assert 0.0 <= float(page.text("time").removesuffix(" s")) - last_s <= 0.4
    assert page.text("counts").endswith(f"{summary(folder)['vehicles']['left']} left")
    assert page.console_errors() == []
    stop(lab, watch)
    lab.check_nothing_left()


def _says(page: Page, identity: str, words: str) -> bool:
    return page.text(identity) == words


@pytest.mark.more
def test_a_deployment_is_shown_as_it_is(lab: Lab) -> None:
    config = lab.path("short.toml", SHORT)
    router = start_router(lab, config)
    roles = [lab.start("coordinator", "--config", config), lab.start("agent", "--config", config)]
    watch, address = start_watch(lab, "--config", config)
    with connect(address.replace("http", "ws") + "stream", open_timeout=END_S) as browser:
        scene = json.loads(browser.recv(timeout=END_S))["scene"]
        while not _has_a_leader(json.loads(browser.recv(timeout=END_S))):
            pass
        bridge = lab.start("bridge", "--config", config, "--pace", "8", "--out", "out")
        frames: list[dict[str, Any]] = []
        while not frames or frames[-1]["status"] != "ended":
            frames.append(json.loads(browser.recv(timeout=RUN_S)))
    ended = lab.finish(bridge, RUN_S)
    assert (ended.status, ended.complaints) == (0, []), ended
    stop(lab, watch, *roles, router)
    lab.check_nothing_left()

    assert (scene["kind"], scene["title"]) == ("live", REALM)
    assert frames[-1]["counts"][3] == summary(lab.folder / "out")["vehicles"]["left"] > 0
    assert frames[-1]["leader"] == ["c1", 1]
    assert any(row[7] for frame in frames for row in frame["vehicles"]), "no target of a plan"
    closed = [
        [event["formation"], *event["columns"]]
        for event in read_events(lab.folder / "out", "formation-closed")
    ]
    assert closed
    shown = [one for frame in frames for one in frame["formations"]]
    assert sorted(map(tuple, closed)) == sorted(set(map(tuple, shown)))
    assert {row[5] for frame in frames for row in frame["vehicles"]} == {
        -1, *(number for number, *_ in closed)
    }  # fmt: skip
    assert not any(frame["joined"] for frame in frames)
    _check_places(frames, lab.folder / "out")


def _has_a_leader(frame: dict[str, Any]) -> bool:
    return frame.get("leader") is not None


def _check_places(frames: list[dict[str, Any]], folder: Path) -> None:
    """Check that vehicles were shown where they were, up to errors of measurement."""
    tracks = read_tracks(folder)
    checked = 0
    for number, name in enumerate(tracks.names):
        rows = tracks.rows(number)
        t_s = tracks.t_s[rows]
        for frame in frames:
            for row in frame["vehicles"]:
                if row[0] == name and not row[8] & 4 and t_s[0] <= frame["t"] <= t_s[-1]:
                    s_m, y_m = (
                        float(np.interp(frame["t"], t_s, values[rows]))
                        for values in (tracks.s_m, tracks.y_m)
                    )
                    # A state may be a tick old: it is driven on along the road, not across.
                    assert abs(row[1] - s_m) < 1.0
                    assert abs(row[2] - y_m) < 0.6
                    checked += 1
    assert checked > 100


def start_watched_run(lab: Lab, *arguments: object) -> tuple[subprocess.Popen[str], str]:
    """Start a run with a live page; return it and the page's address."""
    run = lab.start("run", *arguments, "--vehicles-per-process", "8", "--out", "out")
    assert run.stderr is not None
    line = run.stderr.readline()
    assert line.startswith("live page: http://127.0.0.1:"), lab.finish(run, END_S)
    return run, line.removeprefix("live page: ").strip()


@needs_chromium
def test_a_run_is_watched_to_its_end(lab: Lab, page: Page, road: Path) -> None:
    options = "--duration", "10", "--watch-listen", "127.0.0.1:0", "--pace", "5", "--report"
    run, address = start_watched_run(lab, road, *DEMAND, *options)
    page.open(address)
    page.wait_until(lambda: page.text("pill") == "live")
    page.wait_until(lambda: len(page.run(PLACES)) > 3)
    first = page.run(PLACES)
    page.wait_until(lambda: moved_m(first, page.run(PLACES)) > 20.0)
    page.wait_until(lambda: page.text("pill") == "ended")

    ended = lab.finish(run)
    assert (ended.status, ended.complaints) == (0, []), ended
    lab.check_nothing_left()
    left = summary(lab.folder / "out")["vehicles"]["left"]
    said = f"run ended: {left} of {left} left, report at out/report.html"
    page.wait_until(lambda: page.text("banner") == said)
    # The page does not try to connect again, and can still go back in time.
    page.run("(s => { s.value = s.max - 5; s.dispatchEvent(new Event('input')); })(slider)")
    page.wait_until(lambda: "s ago" in page.text("now"))
    assert (page.text("pill"), page.text("banner")) == ("ended", said)
    assert page.console_errors() == []
    assert left > 3


PLACES = (
    "Object.fromEntries((laneweaveWatch.picture?.bodies ?? []).map((one) => [one.name, one.s]))"
)


def moved_m(before: dict[str, float], after: dict[str, float]) -> float:
    """Return the longest way of a vehicle that is in both pictures."""
    return max((after[name] - before[name] for name in before.keys() & after.keys()), default=0.0)


@pytest.mark.more
def test_an_interrupted_run_says_so_on_its_page(lab: Lab, road: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        refused = lab.run("run", road, "--watch-listen", f"127.0.0.1:{taken.getsockname()[1]}")
    assert (refused.status, len(refused.complaints)) == (2, 1)
    assert "--watch-listen" in refused.err
    assert not (lab.folder / "runs").exists()

    # Another program has the default port, or this page has it.
    run, address = start_watched_run(lab, road, *DEMAND, "--watch")
    with connect(address.replace("http", "ws") + "stream", open_timeout=END_S) as browser:
        messages = [json.loads(browser.recv(timeout=END_S))]
        assert messages[0]["scene"]["title"] == "out"
        while not messages[-1].get("vehicles"):
            messages.append(json.loads(browser.recv(timeout=RUN_S)))
        run.send_signal(signal.SIGTERM)
        with contextlib.suppress(ConnectionClosedOK):
            while True:
                messages.append(json.loads(browser.recv(timeout=END_S)))
    assert messages[-1]["end"].startswith("run interrupted: 0 of ")
    assert lab.finish(run, END_S).complaints[0].startswith("interrupted at ")
    lab.check_nothing_left()


@pytest.mark.more
def test_a_watcher_waits_for_the_router_of_a_run_and_sees_its_end(lab: Lab) -> None:
    config = lab.path("short.toml", SHORT)
    watch = lab.start("watch", "--config", config, "--wait", "60", "--listen", "127.0.0.1:0")
    run = lab.start("run", config, "--vehicles-per-process", "8", "--out", "out")
    assert watch.stdout is not None
    address = watch.stdout.readline().strip()
    with connect(address.replace("http", "ws") + "stream", open_timeout=END_S) as browser:
        frames: list[dict[str, Any]] = [json.loads(browser.recv(timeout=END_S))]
        while frames[-1].get("status") != "ended":
            frames.append(json.loads(browser.recv(timeout=RUN_S)))
        ended = lab.finish(run)
        assert (ended.status, ended.complaints) == (0, []), ended
        assert "endpoint: unixsock-stream/router.sock (laneweave watch --config " in ended.err
        # The router is gone, but the run has ended.
        lab.wait_until(lambda: not health(address)[1]["connected"], END_S)
        last = json.loads(browser.recv(timeout=END_S))
        while last["w"] < time.time() - 0.2:
            last = json.loads(browser.recv(timeout=END_S))
    assert last["status"] == "ended"
    assert last["counts"][0] == last["counts"][3] == summary(lab.folder / "out")["vehicles"]["left"]
    stop(lab, watch)
    lab.check_nothing_left()


@pytest.mark.more
def test_two_runs_do_not_share_an_endpoint(lab: Lab) -> None:
    config = lab.path("short.toml", SHORT)
    options = ("--vehicles-per-process", "8", "--duration", "600")
    first = lab.start("run", config, *options, "--out", "out")
    assert first.stderr is not None
    assert first.stderr.readline().startswith("endpoint: ")

    second = lab.finish(lab.start("run", config, "--out", "second"), END_S)

    assert (second.status, len(second.complaints)) == (2, 1), second
    assert second.err.startswith("network.endpoint: got 'unixsock-stream/router.sock'")
    assert not (lab.folder / "second").exists()
    first.send_signal(signal.SIGTERM)
    assert lab.finish(first, END_S).complaints[0].startswith("interrupted")
    lab.check_nothing_left()


def test_it_ends_at_ctrl_c(finished_run: FinishedRun, lab: Lab) -> None:
    watch, address = start_watch(lab, finished_run("simulated"))
    with connect(address.replace("http", "ws") + "stream", open_timeout=END_S):
        watch.send_signal(signal.SIGINT)
        ended = lab.finish(watch, END_S)
        assert (ended.status, ended.out, ended.complaints) == (0, "", []), ended
    lab.check_nothing_left()


def test_without_a_router_there_is_nothing_to_watch(lab: Lab) -> None:
    ended = lab.finish(lab.start("watch", "--endpoint", free_tcp(), "--listen", "[::1]:0"), END_S)
    assert (ended.status, ended.out, len(ended.complaints)) == (2, "", 1)
    assert "network.endpoint" in ended.err
