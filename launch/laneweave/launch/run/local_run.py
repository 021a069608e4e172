"""A run on this machine: router, coordinators, bridge and agents as processes over Zenoh.

The supervisor starts them, starts an agent for every vehicle that is announced, watches them,
injects faults, and always cleans up: on success, on failure, on Ctrl-C, and when a process dies.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import attrs
from attrs import define, field

from laneweave.coordinator.planning import warm_up
from laneweave.launch.faults.local_faults import ProcessFaults
from laneweave.launch.faults.specification import Faults
from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.logs import last_error
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run.role_processes import ROUTER, Order, RoleEnd, RoleProcesses
from laneweave.launch.run.roles import fork_server
from laneweave.protocol.config.loading import to_tables
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.deployment import Security
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.security.rights import access_of
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import Keys
from laneweave.sim_bridge.road.demand import arrivals

MAX_TEMPORARY_BYTES = 70
"""Sockets lie up to 37 characters below TMPDIR, and their paths have at most 107 bytes."""
ROUTER_START_S = 20.0
STALL_S = 90.0
"""A run whose road clock stands still for this long has failed."""
MOST_FAILED_AGENTS = 5
"""A run in which more agents than that end by themselves with an error is given up."""
LEADER_S = 5.0
"""How long a run waits for a leader beyond the election time before it begins without one."""
POLL_S = 0.1


@define
class _Stall:
    """Notices a road clock that stands still."""

    scenario: Scenario
    advanced_s: float
    road_s: float = -1.0

    def lasts(self, road_s: float, now_s: float) -> bool:
        """Tell whether the clock has stood still for too long."""
        if road_s != self.road_s:
            self.road_s, self.advanced_s = road_s, now_s
        # An entrance that waits for an agent stands still in good order.
        patience_s = max(STALL_S, 2 * self.scenario.runtime.agent_start_s)
        return now_s - self.advanced_s > patience_s


@define
class LocalRun:
    """One run under supervision; `run` does it all."""

    scenario: Scenario
    folder: Path
    method: str = "formation"
    faults: Faults = field(factory=Faults)
    show_progress: bool = True
    pace: float | None = None
    watch: Callable[[RoadView, Mapping[str, int]], None] | None = None
    """Called ten times a second with what is known and the process id of each role."""
    _processes: RoleProcesses = field(init=False)
    _options: dict[str, Any] = field(init=False)
    """What every role needs beside the scenario."""
    _active_faults: ProcessFaults | None = None
    _group_of: dict[str, int] = field(init=False)
    """Which vehicles share a process: neighbours in the order of their arrival."""
    _started_groups: set[int] = field(factory=set)
    _problems: list[str] = field(factory=list)
    _failed_agents: int = 0
    _stop: bool = False

    def __attrs_post_init__(self) -> None:
        """Group the vehicles of the demand."""
        per_process = self.scenario.runtime.vehicles_per_process
        self._group_of = {
            arrival.vehicle: index // per_process
            for index, arrival in enumerate(arrivals(self.scenario))
        }

    def run(self) -> Outcome:
        """Run the scenario and return what came of it.

        Raises:
            BadInputError: the environment does not allow the run.
        """
        check_temporary_folder()
        # Compiled once, if need be, and not by each coordinator.
        warm_up()
        self.folder.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(prefix="laneweave-") as temporary,
            self._signals(),
            RunProgress(self.scenario, show=self.show_progress) as progress,
        ):
            network = attrs.evolve(
                self.scenario.network,
                endpoint=f"unixsock-stream/{temporary}/router.sock",
                listen=(),
            )
            # A socket in a folder of its own: nobody else gets at it.
            self.scenario = attrs.evolve(self.scenario, network=network, security=Security())
            self._options = {
                "folder": str(self.folder),
                "temporary": temporary,
                "method": self.method,
                "pace": self.pace,
            }
            names = coordinator_names(self.scenario)
            self._processes = RoleProcesses(fork_server(), self._prepare, names)
            try:
                self._open_faults(Path(temporary))
                self._supervise(progress)
            except CommandFailedError as error:
                self._problems.append(str(error))
            finally:
                self._processes.end_all()
                if self._active_faults is not None:
                    self._active_faults.close()
            return self._outcome()

    def _outcome(self) -> Outcome:
        """Return what came of the run; its temporary folder is still there."""
        faults = self._active_faults
        return complete_summary(
            self.folder,
            problems=self._problems,
            processes=self._processes.peak,
            failover=faults.injection.failover if faults is not None else None,
            dropped=faults.board.dropped if faults is not None else 0,
            faults=faults.summary() if faults is not None else None,
        )

    def _prepare(self, order: Order) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the tables and options for the start of a role."""
        tables, options = to_tables(self.scenario), self._options | dict(order.options)
        if self._active_faults is None:
            return tables, options
        return self._active_faults.equip(order, tables, options)

    def _open_faults(self, temporary: Path) -> None:
        if self.faults:
            self._active_faults = ProcessFaults.open(
                self.faults, self.scenario, self._processes, temporary
            )

    # --- supervision --------------------------------------------------------------------------

    def _supervise(self, progress: RunProgress) -> None:
        processes, faults = self._processes, self._active_faults
        processes.start("router", ROUTER)
        observer = Observer(Keys(self.scenario.network.realm))
        with contextlib.closing(self._connect(observer)) as transport:
            observer.subscribe(transport)
            for name in processes.coordinators:
                processes.start("coordinator", name)
            # Road time must not begin before somebody can plan.
            self._await_leader(observer)
            processes.start("bridge", "bridge")
            stall = _Stall(self.scenario, time.monotonic())
            while not self._stop and self._processes_fine():
                observer.wait(POLL_S)
                view, now = observer.view, time.monotonic()
                progress.update(view)
                for group in self._agents_to_start(observer):
                    processes.start("agent", f"agent-{group[0]}", vehicles=group)
                if faults is not None:
                    faults.step(now, view)
                if self.watch is not None:
                    self.watch(view, processes.ids)
                if stall.lasts(self._road_s(view), now):
                    self._problems.append(f"the road clock stands still at {view.t_s:.1f} s")
                    return
            if self._stop:
                self._problems.append("interrupted")
            if faults is not None:
                self._problems += faults.injection.never_happened()

    def _road_s(self, view: RoadView) -> float:
        """Return the road time, also where a fault keeps its news from the supervisor."""
        faults = self._active_faults
        return max(view.t_s, faults.board.road_s) if faults is not None else view.t_s

    def _connect(self, observer: Observer) -> ZenohTransport:
        access = access_of(self.scenario, "observer.run")
        give_up = time.monotonic() + ROUTER_START_S
        while True:
            try:
                return ZenohTransport(access, observer.inbox.put)
            except BadInputError:
                if self._stop:
                    raise KeyboardInterrupt from None
                if time.monotonic() > give_up or not self._processes.is_alive(ROUTER):
                    raise
                time.sleep(0.02)

    def _await_leader(self, observer: Observer) -> None:
        give_up = time.monotonic() + LEADER_S + 2 * self.scenario.network.election_s
        while observer.view.leader is None and not self._stop and time.monotonic() < give_up:
            observer.wait(POLL_S)

    def _processes_fine(self) -> bool:
        """Take note of processes that ended; false when the run is over."""
        for end in self._processes.ended():
            if end.name in ("bridge", ROUTER):
                if end.status != 0 or end.name == ROUTER:
                    self._note_end(f"the {end.name}", end)
                return False
            if end.status != 0:
                self._note_end(end.name, end)
                self._failed_agents += end.name.startswith("agent-")
        if self._failed_agents > MOST_FAILED_AGENTS:
            self._problems.append("agents cannot start or stay up")
            return False
        return True

    def _note_end(self, who: str, end: RoleEnd) -> None:
        words = last_error(self.folder / "log.jsonl", end.name)
        reason = f": {words}" if words else ""
        self._problems.append(f"{who} ended with status {end.status}{reason}")

    def _agents_to_start(self, observer: Observer) -> Iterator[list[str]]:
        """Return groups of vehicles that share a process, when its first one is announced."""
        census = observer.view.census
        for announced in census.announced if census is not None else ():
            index = self._group_of.get(announced.vehicle)
            if index is not None and index not in self._started_groups:
                self._started_groups.add(index)
                yield [name for name, group in self._group_of.items() if group == index]

    # --- the end ------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        def stop(_number: int, _frame: object) -> None:
            self._stop = True

        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def check_temporary_folder() -> None:
    """Check that sockets can be made in the temporary folder.

    Raises:
        BadInputError: its path is too long.
    """
    folder = tempfile.gettempdir()
    if len(os.fsencode(folder)) > MAX_TEMPORARY_BYTES:
        raise BadInputError("TMPDIR", folder, f"a path of at most {MAX_TEMPORARY_BYTES} bytes")
