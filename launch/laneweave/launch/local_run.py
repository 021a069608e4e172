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
from multiprocessing.connection import wait as wait_for_sentinels
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import attrs
import structlog
from attrs import define, field

from laneweave.launch.faults import LEADER, Faults, Kill
from laneweave.launch.logs import last_error
from laneweave.launch.observer import Observer, View
from laneweave.launch.outcome import Outcome, complete_summary
from laneweave.launch.progress import RunProgress
from laneweave.launch.roles import fork_server, start_role
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario import Scenario, to_tables
from laneweave.protocol.topics import Keys
from laneweave.protocol.zenoh_transport import ZenohTransport
from laneweave.sim_bridge.demand import arrivals

log = structlog.get_logger(__name__)

MAX_TEMPORARY_BYTES = 70
"""Sockets lie up to 37 characters below TMPDIR, and their paths have at most 107 bytes."""
ROUTER_START_S = 20.0
STALL_S = 90.0
"""A run whose road clock stands still for this long has failed."""
MOST_FAILED_AGENTS = 5
"""A run in which more agents than that end by themselves with an error is given up."""
LEADER_S = 5.0
"""How long a run waits for a leader beyond the election time before it begins without one."""
STOP_S = 5.0
"""How long processes get to end by themselves."""
POLL_S = 0.1


@define
class _Failover:
    killed: str
    at_s: float


@define
class _Stall:
    """Notices a road clock that stands still."""

    scenario: Scenario
    advanced_s: float
    tick: int = -1

    def lasts(self, view: View, now_s: float) -> bool:
        """Tell whether the clock has stood still for too long."""
        if view.clock is not None and view.clock.tick != self.tick:
            self.tick, self.advanced_s = view.clock.tick, now_s
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
    watch: Callable[[View, Mapping[str, int]], None] | None = None
    """Called ten times a second with what is known and the process id of each role."""
    _processes: dict[str, ForkServerProcess] = field(factory=dict)
    _group_of: dict[str, int] = field(init=False)
    """Which vehicles share a process: neighbours in the order of their arrival."""
    _started_groups: set[int] = field(factory=set)
    _killed: set[str] = field(factory=set)
    _problems: list[str] = field(factory=list)
    _recovery_s: list[float] = field(factory=list)
    _failover: _Failover | None = None
    _failed_agents: int = 0
    _peak: int = 0
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
        self.folder.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(prefix="laneweave-") as sockets,
            self._signals(),
            RunProgress(self.scenario, show=self.show_progress) as progress,
        ):
            network = attrs.evolve(
                self.scenario.network, endpoint=f"unixsock-stream/{sockets}/router.sock"
            )
            self.scenario = attrs.evolve(self.scenario, network=network)
            try:
                self._supervise(progress, sockets)
            except CommandFailedError as error:
                self._problems.append(str(error))
            finally:
                self._clean_up()
        return complete_summary(
            self.folder,
            problems=self._problems,
            processes=self._peak,
            recovery_s=self._recovery_s,
        )

    # --- supervision --------------------------------------------------------------------------

    def _supervise(self, progress: RunProgress, temporary: str) -> None:
        context = fork_server()
        tables = to_tables(self.scenario)
        options = {
            "folder": str(self.folder),
            "temporary": temporary,
            "method": self.method,
            "pace": self.pace,
        }

        def start(role: str, name: str, **more: object) -> None:
            self._processes[name] = start_role(context, role, name, tables, options | more)
            self._peak = max(self._peak, len(self._processes))

        start("router", "router")
        observer = Observer(Keys(self.scenario.network.realm))
        with contextlib.closing(self._connect(observer)) as transport:
            observer.subscribe(transport)
            for name in coordinator_names(self.scenario):
                start("coordinator", name)
            # Road time must not begin before somebody can plan.
            self._await_leader(observer)
            start("bridge", "bridge")
            stall = _Stall(self.scenario, time.monotonic())
            while not self._stop and self._processes_fine():
                observer.wait(POLL_S)
                view, now = observer.view, time.monotonic()
                progress.update(view)
                for group in self._agents_to_start(observer):
                    start("agent", f"agent-{group[0]}", vehicles=group)
                self._inject(observer)
                if self.watch is not None:
                    self.watch(view, self._process_ids())
                self._note_recovery(observer, now)
                if stall.lasts(view, now):
                    self._problems.append(f"the road clock stands still at {view.t_s:.1f} s")
                    return
            if self._stop:
                self._problems.append("interrupted")
            self._problems += self.faults.never_due()

    def _connect(self, observer: Observer) -> ZenohTransport:
        network = self.scenario.network
        give_up = time.monotonic() + ROUTER_START_S
        while True:
            try:
                return ZenohTransport(network.endpoint, observer.inbox.put, network.lease_s)
            except BadInputError:
                if self._stop:
                    raise KeyboardInterrupt from None
                router = self._processes["router"]
                if time.monotonic() > give_up or not router.is_alive():
                    raise
                time.sleep(0.02)

    def _await_leader(self, observer: Observer) -> None:
        give_up = time.monotonic() + LEADER_S + 2 * self.scenario.network.election_s
        while observer.view.leader is None and not self._stop and time.monotonic() < give_up:
            observer.wait(POLL_S)

    def _processes_fine(self) -> bool:
        """Take note of processes that ended; false when the run is over."""
        names = {process.sentinel: name for name, process in self._processes.items()}
        for sentinel in wait_for_sentinels(list(names), timeout=0):
            assert isinstance(sentinel, int)  # noqa: S101 (narrows the type)
            name = names[sentinel]
            process = self._processes.pop(name)
            process.join()
            if name == "bridge":
                if process.exitcode != 0:
                    self._note_end("the bridge", name, process.exitcode)
                return False
            if name == "router":
                self._note_end("the router", name, process.exitcode)
                return False
            if process.exitcode != 0 and name not in self._killed:
                self._note_end(name, name, process.exitcode)
                self._failed_agents += name.startswith("agent-")
        if self._failed_agents > MOST_FAILED_AGENTS:
            self._problems.append("agents cannot start or stay up")
            return False
        return True

    def _note_end(self, who: str, name: str, status: int | None) -> None:
        words = last_error(self.folder / "log.jsonl", name)
        reason = f": {words}" if words else ""
        self._problems.append(f"{who} ended with status {status}{reason}")

    def _process_ids(self) -> dict[str, int]:
        return {name: process.pid or 0 for name, process in self._processes.items()}

    def _agents_to_start(self, observer: Observer) -> Iterator[list[str]]:
        """Return groups of vehicles that share a process, when its first one is announced."""
        census = observer.view.census
        for announced in census.announced if census is not None else ():
            index = self._group_of.get(announced.vehicle)
            if index is not None and index not in self._started_groups:
                self._started_groups.add(index)
                yield [name for name, group in self._group_of.items() if group == index]

    # --- faults -------------------------------------------------------------------------------

    def _inject(self, observer: Observer) -> None:
        due, self.faults = self.faults.due(observer.view.t_s)
        for kill in due:
            self._kill(kill, observer)

    def _kill(self, kill: Kill, observer: Observer) -> None:
        leader = observer.view.leader
        name = leader if kill.target == LEADER else kill.target
        process = self._processes.get(name) if name is not None else None
        if name is None or process is None or process.pid is None:
            self._problems.append(f"no process to kill for target {kill.target}")
            return
        log.warning("killing", target=name, t_s=observer.view.t_s)
        self._killed.add(name)
        process.kill()
        if name == leader:
            self._failover = _Failover(name, time.monotonic())
            observer.view.leader = None

    def _note_recovery(self, observer: Observer, now: float) -> None:
        failover = self._failover
        if failover is not None and observer.view.leader not in (None, failover.killed):
            self._recovery_s.append(round(now - failover.at_s, 4))
            self._failover = None

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

    def _clean_up(self) -> None:
        """End every process: asked first, then killed. The router goes last."""
        router = self._processes.pop("router", None)
        _end_all(list(self._processes.values()))
        self._processes.clear()
        if router is not None:
            _end_all([router])


def check_temporary_folder() -> None:
    """Check that sockets can be made in the temporary folder.

    Raises:
        BadInputError: its path is too long.
    """
    folder = tempfile.gettempdir()
    if len(os.fsencode(folder)) > MAX_TEMPORARY_BYTES:
        raise BadInputError("TMPDIR", folder, f"a path of at most {MAX_TEMPORARY_BYTES} bytes")


def coordinator_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of a scenario's coordinator candidates, best-ranked first."""
    return tuple(f"c{index + 1}" for index in range(scenario.runtime.coordinators))


def _end_all(processes: list[ForkServerProcess]) -> None:
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
