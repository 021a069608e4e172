"""The processes of a local run: started, watched, killed and paused by name, and ended for sure."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from multiprocessing.connection import wait as wait_for_sentinels
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Any

import structlog
from attrs import define, field, frozen

from laneweave.launch.run.roles import start_role

log = structlog.get_logger(__name__)

STOP_S = 5.0
"""How long processes get to end by themselves."""
ROUTER = "router"


@frozen
class Order:
    """How a role is started, the first time and again."""

    role: str
    name: str
    options: Mapping[str, Any]


@frozen
class RoleEnd:
    """A process that has ended."""

    name: str
    status: int | None


@define
class RoleProcesses:
    """All role processes of a run, by name; a `Stage` for faults."""

    context: ForkServerContext
    prepare: Callable[[Order], tuple[dict[str, Any], dict[str, Any]]]
    """Returns the scenario's tables and the options for each start of a role."""
    coordinators: tuple[str, ...]
    peak: int = 0
    """Most processes at one time."""
    _running: dict[str, ForkServerProcess] = field(factory=dict)
    _orders: dict[str, Order] = field(factory=dict)
    _process_of: dict[str, str] = field(factory=dict)
    """Which role drives each vehicle."""
    _paused: set[str] = field(factory=set)

    def start(self, role: str, name: str, **options: object) -> None:
        """Start a role.

        Args:
            role: `router`, `coordinator`, `bridge` or `agent`.
            name: of the process; nothing else of this name runs.
            **options: what only this one needs, such as the `vehicles` of an agent.

        Raises:
            CommandFailedError: no process can be made.
        """
        order = self._orders[name] = Order(role, name, options)
        for vehicle in order.options.get("vehicles", ()):
            self._process_of[vehicle] = name
        tables, all_options = self.prepare(order)
        self._running[name] = start_role(self.context, role, name, tables, all_options)
        self.peak = max(self.peak, len(self._running))

    @property
    def ids(self) -> dict[str, int]:
        """Process ids by name."""
        return {name: process.pid or 0 for name, process in self._running.items()}

    def is_alive(self, name: str) -> bool:
        """Tell whether a role is up."""
        process = self._running.get(name)
        return process is not None and process.is_alive()

    def ended(self) -> Iterator[RoleEnd]:
        """Yield the processes that have ended by themselves since the last call."""
        names = {process.sentinel: name for name, process in self._running.items()}
        for sentinel in wait_for_sentinels(list(names), timeout=0):
            assert isinstance(sentinel, int)  # noqa: S101 (narrows the type)
            name = names[sentinel]
            process = self._running.pop(name)
            process.join()
            self._paused.discard(name)
            yield RoleEnd(name, process.exitcode)

    # --- what faults do -----------------------------------------------------------------------

    @property
    def running(self) -> Collection[str]:
        """Roles that are up, as far as is known."""
        return self._running.keys()

    def agent_of(self, vehicle: str) -> str | None:
        """Return the agent process that drives a vehicle, if one has been started."""
        return self._process_of.get(vehicle)

    def kill(self, name: str) -> None:
        """End a role with SIGKILL."""
        self._paused.discard(name)
        process = self._running.pop(name)
        process.kill()
        process.join(STOP_S)

    def pause(self, name: str) -> None:
        """Stop a role with SIGSTOP."""
        self._paused.add(name)
        self._signal(name, signal.SIGSTOP)

    def resume(self, name: str) -> None:
        """Let a role go on with SIGCONT, if it has been paused."""
        if name in self._paused:
            self._paused.discard(name)
            self._signal(name, signal.SIGCONT)

    def start_again(self, name: str) -> None:
        """Start a role that has ended as it was started before.

        Raises:
            CommandFailedError: no process can be made.
        """
        order = self._orders[name]
        self.start(order.role, name, **order.options)

    def _signal(self, name: str, number: signal.Signals) -> None:
        process = self._running.get(name)
        if process is not None and process.pid is not None and process.is_alive():
            os.kill(process.pid, number)

    # --- the end ------------------------------------------------------------------------------

    def end_all(self) -> None:
        """End every process: asked first, then killed. The router goes last."""
        for name in list(self._paused):
            self.resume(name)
        router = self._running.pop(ROUTER, None)
        _end(list(self._running.values()))
        self._running.clear()
        if router is not None:
            _end([router])


def _end(processes: list[ForkServerProcess]) -> None:
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + STOP_S
    for process in processes:
        process.join(max(0.0, deadline - time.monotonic()))
        if process.is_alive():
            log.warning("killing a process that did not end", process=process.name)
            process.kill()
            process.join(STOP_S)
        process.close()
