"""Control of the role processes of a local run, by name."""

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

from laneweave.launch.faults.fault_file import BRIDGE, ROUTER
from laneweave.launch.run.roles import end_role, start_role

log = structlog.get_logger(__name__)

STOP_S = 5.0
"""Grace period after the request to end before processes are killed."""
WRITING_S = 30.0
"""Grace period of the bridge, which has files to complete."""


@frozen
class RoleStart:
    """Arguments with which a role is started and restarted."""

    role: str
    name: str
    options: Mapping[str, Any]


@frozen
class RoleExit:
    """Name and exit status of a process that has exited."""

    name: str
    status: int | None


@define
class RoleProcesses:
    """All role processes of a run by name; implements `RoleControl`."""

    context: ForkServerContext
    prepare: Callable[[RoleStart], tuple[dict[str, Any], dict[str, Any]]]
    """Returns the scenario tables and the options with which to start a role."""
    coordinators: tuple[str, ...]
    peak: int = 0
    """Maximum number of simultaneous processes."""
    _running: dict[str, ForkServerProcess] = field(factory=dict)
    _starts: dict[str, RoleStart] = field(factory=dict)
    _process_of: dict[str, str] = field(factory=dict)
    """Name of the agent process of each vehicle, until it exits on its own."""
    _paused: set[str] = field(factory=set)

    def start(self, role: str, name: str, **options: object) -> None:
        """Start a role in the process `name`; `options` are specific to the role.

        Raises:
            CommandFailedError: the process cannot be created.
        """
        start = self._starts[name] = RoleStart(role, name, options)
        for vehicle in start.options.get("vehicles", ()):
            self._process_of[vehicle] = name
        tables, all_options = self.prepare(start)
        self._running[name] = start_role(self.context, role, name, tables, all_options)
        self.peak = max(self.peak, len(self._running))

    @property
    def ids(self) -> dict[str, int]:
        """Process id of each role by name."""
        return {name: process.pid or 0 for name, process in self._running.items()}

    def is_alive(self, name: str) -> bool:
        """Return whether a role is running."""
        process = self._running.get(name)
        return process is not None and process.is_alive()

    def ended(self) -> Iterator[RoleExit]:
        """Yield the processes that have exited on their own since the last call."""
        names = {process.sentinel: name for name, process in self._running.items()}
        for sentinel in wait_for_sentinels(list(names), timeout=0):
            assert isinstance(sentinel, int)  # noqa: S101 (narrows the type)
            name = names[sentinel]
            process = self._running.pop(name)
            process.join()
            self._paused.discard(name)
            for vehicle in self._starts.pop(name).options.get("vehicles", ()):
                del self._process_of[vehicle]
            yield RoleExit(name, process.exitcode)

    # --- control by faults --------------------------------------------------------------------

    @property
    def running(self) -> Collection[str]:
        """Names of the roles whose exit has not been observed."""
        return self._running.keys()

    def agent_of(self, vehicle: str) -> str | None:
        """Return the agent process of a vehicle, or None before it is started."""
        return self._process_of.get(vehicle)

    def kill(self, name: str) -> None:
        """Kill a role with SIGKILL."""
        self._paused.discard(name)
        process = self._running.pop(name)
        process.kill()
        process.join(STOP_S)

    def pause(self, name: str) -> None:
        """Suspend a role with SIGSTOP."""
        self._paused.add(name)
        self._signal(name, signal.SIGSTOP)

    def resume(self, name: str) -> None:
        """Resume a role with SIGCONT if it is paused."""
        if name in self._paused:
            self._paused.discard(name)
            self._signal(name, signal.SIGCONT)

    def restart(self, name: str) -> None:
        """Restart a role that was killed, with its original arguments.

        Raises:
            CommandFailedError: the process cannot be created.
        """
        start = self._starts[name]
        self.start(start.role, name, **start.options)

    def _signal(self, name: str, number: signal.Signals) -> None:
        process = self._running.get(name)
        if process is not None and process.pid is not None and process.is_alive():
            os.kill(process.pid, number)

    # --- shutdown -----------------------------------------------------------------------------

    def end_all(self) -> None:
        """Ask all processes to end, kill them if necessary; the bridge first, the router last."""
        for name in list(self._paused):
            self.resume(name)
        first, last = ((self._running.pop(name, None)) for name in (BRIDGE, ROUTER))
        rest = list(self._running.values())
        self._running.clear()
        for processes, grace_s in (([first], WRITING_S), (rest, STOP_S), ([last], STOP_S)):
            _end([process for process in processes if process is not None], grace_s)


def _end(processes: list[ForkServerProcess], grace_s: float) -> None:
    for process in processes:
        end_role(process)
    deadline = time.monotonic() + grace_s
    for process in processes:
        process.join(max(0.0, deadline - time.monotonic()))
        if process.is_alive():
            log.warning("killing a process that did not exit", process=process.name)
            process.kill()
            process.join(STOP_S)
        process.close()
