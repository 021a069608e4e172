"""A router and coordinators that plan for others, and who asks them."""

from __future__ import annotations

import json
import queue
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Self

import psutil
from attrs import define, field

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.service.client import PlanClient, PlanError
from laneweave.coordinator.service.rendezvous import is_assigned_to
from laneweave.protocol.runtime.queries import JSON
from laneweave.protocol.runtime.transport import Delivery, TokenDown, TokenUp
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import COORDINATOR_ALIVE, Keys
from support.deployments import free_tcp
from support.harness import END_S, Ended, Lab
from support.waiting import wait_until

REALM = "default"
LEASE_S = 1.0


def request(name: str = "", **changes: object) -> dict[str, Any]:
    """Return a request that is planned within milliseconds."""
    named = {"id": name} if name else {}
    return {
        "schema": "laneweave.plan.request/1",
        **named,
        "grid": {"columns": 6, "lanes": 3},
        "vehicles": [{"id": f"v{i}", "cell": [0, i], "lane": (i + 1) % 3} for i in range(3)],
        "targets": [[column, lane] for column in range(2, 6) for lane in range(3)],
        "deadline_s": 20.0,
        **changes,
    }


def slow_request(name: str, deadline_s: float) -> dict[str, Any]:
    """Return a request that takes as long as it may."""
    return request(
        name,
        grid={"columns": 12, "lanes": 4},
        vehicles=[
            {"id": f"v{i}", "cell": [i // 4 * 2, i % 4], "lane": 3 - i % 4} for i in range(20)
        ],
        targets=[[column, lane] for column in range(12) for lane in range(4)],
        deadline_s=deadline_s,
    )


def cpu_s(process: int) -> float:
    """Return the CPU time that a process has used."""
    times = psutil.Process(process).cpu_times()
    return float(times.user + times.system)


@define
class ServiceLab:
    """Coordinators with one worker each; those that a test kills are started again."""

    lab: Lab
    names: tuple[str, ...]
    limits: str = ""
    endpoint: str = field(factory=free_tcp)
    options: tuple[str, ...] = ()
    """Options of the coordinators."""
    coordinators: dict[str, subprocess.Popen[str]] = field(factory=dict)
    ended: list[Ended] = field(factory=list)
    """What became of coordinators that were killed."""
    _news: queue.SimpleQueue[Delivery] = field(factory=queue.SimpleQueue)
    _alive: set[str] = field(factory=set)

    @contextmanager
    def running(self) -> Iterator[ServiceLab]:
        """Run the router and all coordinators; they must end in good order."""
        config = f"""schema = "laneweave.scenario/1"
[network]
realm = "{REALM}"
endpoint = "{self.endpoint}"
lease_s = {LEASE_S}
[service]
workers = 1
{self.limits}"""
        self.lab.path("deployment.toml", config)
        router = self.lab.start("router", "--config", "deployment.toml")
        watcher = wait_until(self._connected, END_S)
        keys = Keys(REALM)
        watcher.watch(keys.all_of(COORDINATOR_ALIVE))
        try:
            self.revive()
            yield self
        finally:
            watcher.close()
        for name in tuple(self.coordinators):
            self.stop(name)
        router.terminate()
        ended = self.lab.finish(router, END_S)
        assert (ended.status, ended.out, ended.complaints) == (0, "", []), ended
        self.lab.check_nothing_left()

    def _connected(self) -> ZenohTransport | None:
        with suppress(ValueError):
            return ZenohTransport(self.access, self._news.put)
        return None

    @property
    def access(self) -> Access:
        """How tests get onto the network."""
        return Access(self.endpoint, REALM, LEASE_S)

    @property
    def alive(self) -> set[str]:
        """Names of the coordinators that the network shows."""
        while not self._news.empty():
            news = self._news.get()
            if isinstance(news, TokenUp | TokenDown):
                name = news.key.split("/")[-2]
                (self._alive.add if isinstance(news, TokenUp) else self._alive.discard)(name)
        return self._alive

    def revive(self, least: int = 0) -> None:
        """Start the coordinators that do not run, and wait until each has planned something.

        Args:
            least: so many are enough; 0: all.
        """
        missing = [name for name in self.names if name not in self.coordinators]
        if 0 < least <= len(self.coordinators):
            missing = []
        for name in missing:
            self.coordinators[name] = self.lab.start(
                "coordinator", "--config", "deployment.toml", "--name", name, *self.options
            )
        self.lab.wait_until(lambda: self.alive == set(self.coordinators), END_S)
        with PlanClient(self.access) as client:
            for name in missing:
                client.plan(PlanRequest.from_dict(self.for_one(name, request())), END_S)

    def for_one(self, name: str, data: dict[str, Any]) -> dict[str, Any]:
        """Return a request like this one, under an id with which it falls to a coordinator."""
        others = [other for other in self.coordinators if other != name]
        number = 0
        while True:
            number += 1
            named = data | {"id": f"{data.get('id', '')}-{name}-{number}-{time.monotonic_ns()}"}
            # As the client writes it.
            payload = JSON.write(PlanRequest.from_dict(named).to_dict())
            if is_assigned_to(name, others, payload):
                result: dict[str, Any] = json.loads(payload)
                return result

    def kill(self, name: str) -> float:
        """SIGKILL a coordinator; returns when."""
        process = self.coordinators.pop(name)
        process.kill()
        killed_s = time.monotonic()
        self.ended.append(self.lab.finish(process, END_S))
        return killed_s

    def stop(self, name: str) -> float:
        """Ask a coordinator to end, which it must do in good order; returns the seconds it took."""
        process = self.coordinators.pop(name)
        asked_s = time.monotonic()
        process.terminate()
        ended = self.lab.finish(process, END_S)
        took_s = time.monotonic() - asked_s
        assert (ended.status, ended.out) == (0, ""), ended
        assert "Traceback" not in ended.err, ended
        return took_s

    def worker(self, name: str, other_than: int = 0) -> int:
        """Return the id of a coordinator's only worker, once there is no other process.

        A worker that was replaced is a child of the fork server until it has freed its memory and
        the server has reaped it.
        """

        def found() -> list[int]:
            servers = psutil.Process(self.coordinators[name].pid).children()
            return [worker.pid for server in servers for worker in server.children()]

        def is_alone() -> bool:
            workers = found()
            return len(workers) == 1 and other_than not in workers

        self.lab.wait_until(is_alone, END_S)
        (worker,) = found()
        return worker

    def rss_mb(self, name: str) -> float:
        """Return the memory of a coordinator's own process."""
        rss: int = psutil.Process(self.coordinators[name].pid).memory_info().rss
        return rss / 1e6


@define
class Load:
    """Requests that are asked in turn until it is over, by threads or by tasks."""

    plan: Callable[..., Any]
    threads: int = 0
    make: Callable[[], dict[str, Any]] = request
    asked: int = 0
    over: threading.Event = field(factory=threading.Event)
    failures: list[Exception] = field(factory=list)
    outcomes: list[str] = field(factory=list)
    """Of each request: the plan's status, or the error's kind."""
    _answered: list[tuple[float, float]] = field(factory=list)
    """When each was asked and answered, in s."""
    _running: list[threading.Thread] = field(factory=list)

    def __enter__(self) -> Self:
        """Begin."""
        for _ in range(self.threads):
            thread = threading.Thread(target=self._ask_in_turn, daemon=True)
            thread.start()
            self._running.append(thread)
        return self

    def __exit__(self, *_: object) -> None:
        """End, when all that was asked has been answered."""
        self.over.set()
        for thread in self._running:
            thread.join(END_S)
            assert not thread.is_alive()

    def wait_answers(self, more: int) -> None:
        """Wait until so many more requests have been answered, or one has failed."""
        enough = len(self.outcomes) + more
        wait_until(lambda: len(self.outcomes) >= enough or self.failures, END_S)

    def _ask_in_turn(self) -> None:
        while not self.over.is_set():
            made, asked_s = self._make()
            try:
                self._note(asked_s, self.plan(made, END_S))
            except (PlanError, TimeoutError) as error:
                self._fail(error)

    async def ask_in_turn(self) -> None:
        """Ask as a task."""
        while not self.over.is_set():
            made, asked_s = self._make()
            try:
                self._note(asked_s, await self.plan(made, END_S))
            except (PlanError, TimeoutError) as error:
                self._fail(error)

    def _make(self) -> tuple[PlanRequest, float]:
        made, asked_s = PlanRequest.from_dict(self.make()), time.monotonic()
        self.asked += 1
        return made, asked_s

    def _note(self, asked_s: float, response: PlanResponse) -> None:
        self.outcomes.append(response.status)
        self._answered.append((asked_s, time.monotonic()))

    def _fail(self, error: Exception) -> None:
        self.outcomes.append(type(error).__name__)
        self.failures.append(error)
        self.over.set()

    def in_flight(self, t_s: float) -> int:
        """Return how many of the answered requests were in flight at a time."""
        return sum(asked_s < t_s < answered_s for asked_s, answered_s in self._answered)
