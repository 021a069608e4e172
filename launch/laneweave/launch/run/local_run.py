"""A run over Zenoh with router, coordinators, bridge and agents as processes on this machine.

The launcher starts these roles (agents once their vehicles are announced), monitors them, applies
faults, and terminates all of them on success, on failure and on Ctrl-C.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import attrs
import structlog
from attrs import Factory, define, field

from laneweave.coordinator.planning.kernels import KERNELS
from laneweave.launch.faults.breakdowns import breakdowns_of
from laneweave.launch.faults.fault_file import BRIDGE, ROUTER, SENDER_OF_GROUP, FaultSpec
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.faults.network_namespaces import ENDPOINT, HUB, LISTEN, open_network
from laneweave.launch.faults.shared_counters import MessageFaults, SharedBoard
from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.recordings.files import EVENTS_FILE
from laneweave.launch.run.logs import last_error
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run.role_processes import RoleExit, RoleProcesses, RoleStart
from laneweave.launch.run.roles import BAD_INPUT, fork_server
from laneweave.launch.run.run_folder import LOG_FILE, ROUTER_READY_FILE
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.config.scenario_files import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
from laneweave.protocol.runtime.message_faults import SENDER_OF_ROLE
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.deployment_fields import Network
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.security.certificates import check_credentials
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.events import FAULT_INJECTED
from laneweave.protocol.wire.identities import Incarnations
from laneweave.protocol.wire.topics import Keys
from laneweave.sim_bridge.recording.events import append_event
from laneweave.sim_bridge.road_sources import RunDemand, demand_of

OBSERVER = "observer.watch"
"""Identity of the launcher in a secured network."""
MAX_TEMPORARY_BYTES = 70
"""Maximum length of TMPDIR: socket paths are up to 37 bytes longer, and limited to 107 bytes."""
ROUTER_START_S = 20.0
STALL_S = 90.0
"""Wall-clock time after which a run fails if the road clock does not advance."""
MAX_FAILED_AGENTS = 5
"""Maximum number of agents that may exit with an error; one more aborts the run."""
LEADER_S = 5.0
"""Maximum wait for a leader before the bridge starts, in addition to two election timeouts."""
POLL_S = 0.1
log = structlog.get_logger(__name__)
_GROUP_OF_SENDER = {sender: group for group, sender in SENDER_OF_GROUP.items()}


StartPage = Callable[[ForkServerContext, dict[str, Any], dict[str, Any]], None]
"""See `LivePage.start`."""


@define
class _StallDetector:
    """Detector for a stalled road clock."""

    scenario: Scenario
    advanced_s: float
    road_s: float = -1.0

    def is_stalled(self, road_s: float, now_s: float) -> bool:
        """Return whether the clock has been stopped for too long."""
        if road_s != self.road_s:
            self.road_s, self.advanced_s = road_s, now_s
        # The clock also waits until the agent of an entering vehicle has started.
        limit_s = max(STALL_S, 2 * self.scenario.runtime.agent_start_s)
        return now_s - self.advanced_s > limit_s


@define
class LocalRun:
    """A run whose roles are processes; call `run` once."""

    scenario: Scenario
    folder: Path
    faults: FaultSpec = field(factory=FaultSpec)
    show_progress: bool = True
    pace: float | None = None
    watch: Callable[[RoadView, Mapping[str, int]], None] | None = None
    """Called ten times per second with the observed state and the process ids of the roles."""
    announce: Callable[[str], None] = lambda _: None
    """Called with the endpoint of the router once it listens."""
    warn: Callable[[str], None] = lambda _: None
    """Called with a line if the run is slower than real time."""
    start_page: StartPage | None = None
    """Starts the live page of this run once the router listens; see `LivePage.start`."""
    demand: RunDemand = Factory(lambda self: demand_of(self.scenario), takes_self=True)
    """The vehicles of the run, if the caller has drawn them already."""
    _processes: RoleProcesses = field(init=False)
    _options: dict[str, Any] = field(init=False)
    """Options that every role receives."""
    _injection: FaultInjection | None = None
    _board: SharedBoard = field(init=False)
    _group_of: dict[str, tuple[str, ...]] = field(factory=dict)
    """Group of each vehicle without an agent so far: successive arrivals that share a process."""
    _problems: list[str] = field(factory=list)
    _failed_agents: int = 0
    _stop: bool = False

    def __attrs_post_init__(self) -> None:
        """Assign the demanded vehicles to groups."""
        per_process = self.scenario.runtime.vehicles_per_process
        names = self.demand.vehicles
        for first in range(0, len(names), per_process):
            group = names[first : first + per_process]
            self._group_of |= dict.fromkeys(group, group)

    def run(self) -> Outcome:
        """Run the scenario and return its outcome.

        Raises:
            BadInputError: the run is not possible in this environment.
            RefusedError: its router cannot listen.
            KeyboardInterrupt: a signal has stopped the run before the bridge began.
        """
        check_temporary_folder()
        check_network(self.scenario, self.demand.vehicles)
        context = fork_server(KERNELS.keys() & {self.scenario.formation.planner})
        self.folder.mkdir(parents=True, exist_ok=True)
        with (
            stop_signals(self._request_stop),
            temporary_folder() as temporary,
            RunProgress(self.scenario, show=self.show_progress) as progress,
        ):
            self.scenario = attrs.evolve(
                self.scenario, network=network_in(temporary, self.scenario.network)
            )
            self._options = {
                "folder": str(self.folder),
                "temporary": str(temporary),
                "pace": self.pace,
            }
            names = coordinator_names(self.scenario)
            self._processes = RoleProcesses(context, self._prepare, names)
            try:
                if self.faults:
                    self._board = SharedBoard(temporary / "board")
                    self._injection = fault_injection(self.faults, self.scenario, self._processes)
                    self._injection.log_event = self._log_fault
                self._supervise(progress)
            except CommandFailedError as error:
                # Processes that a signal has ended, too, are no failure.
                if not self._stop:
                    self._problems.append(str(error))
            finally:
                self._processes.end_all()
                if self._injection is not None:
                    self._injection.close()
            injection, processes = self._injection, self._processes.peak
            results = {} if injection is None else injection.results(self._board.dropped)
            return complete_summary(
                self.folder,
                problems=self._problems,
                interrupted=self._stop,
                cut_short=injection is not None and bool(injection.end),
                processes=processes,
                **results,
            )

    def _prepare(self, start: RoleStart) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the scenario tables and the options with which to start a role."""
        tables, options = to_tables(self.scenario), self._options | dict(start.options)
        if self._injection is not None:
            add_faults(self._injection, self._board, start, tables, options)
        return tables, options

    # --- supervision --------------------------------------------------------------------------

    def _supervise(self, progress: RunProgress) -> None:
        processes, injection = self._processes, self._injection
        processes.start(ROUTER, ROUTER)
        runtime = self.scenario.runtime
        bounds = runtime.bounds(Incarnations()())
        view = RoadView(bounds=bounds)
        observer = Observer(Keys(self.scenario.network.realm), view=view)
        self._await_router()
        with contextlib.closing(self._connect(observer)) as transport:
            observer.subscribe(transport)
            self.announce(self.scenario.network.endpoint)
            if self.start_page is not None:
                self.start_page(processes.context, to_tables(self.scenario), self._options)
            for name in processes.coordinators:
                processes.start("coordinator", name)
            # Start road time only once a coordinator can plan.
            self._await_leader(observer)
            if self._stop:
                return
            processes.start(BRIDGE, BRIDGE)
            stall = _StallDetector(self.scenario, time.monotonic())
            wanted_pace: float | None = min(1.0, self.pace or runtime.max_pace)
            while not self._stop and self._check_processes():
                observer.wait(POLL_S)
                view, now = observer.view, time.monotonic()
                progress.show(view)
                if wanted_pace and (slowness := progress.meter.slowness(wanted_pace)):
                    self.warn(slowness)
                    wanted_pace = None  # warn once
                for group in self._agents_to_start(observer):
                    processes.start("agent", f"agent-{group[0]}", vehicles=group)
                road_s = view.t_s
                if injection is not None:
                    board_s = self._board.road_s
                    injection.step(board_s, now, view)
                    if injection.end:
                        self._problems.append(injection.end)
                        return
                    # Faults may drop clock messages to the launcher.
                    road_s = max(road_s, board_s)
                if self.watch is not None:
                    self.watch(view, processes.ids)
                if stall.is_stalled(road_s, now):
                    self._problems.append(f"the road clock stopped at {view.t_s:.1f} s")
                    return
            if injection is not None and not self._stop:
                self._problems += injection.unused_faults()

    def _await_router(self) -> None:
        """Wait until this run's router listens; another one may be at the same endpoint.

        Raises:
            RefusedError: the router cannot listen.
            CommandFailedError: the router has not started in time.
        """
        deadline_s = time.monotonic() + ROUTER_START_S
        while not (Path(self._options["temporary"]) / ROUTER_READY_FILE).exists():
            if self._stop:
                raise KeyboardInterrupt
            for end in self._processes.ended():
                if end.name == ROUTER:
                    reason = last_error(self.folder / LOG_FILE, ROUTER)
                    error = RefusedError if end.status == BAD_INPUT else CommandFailedError
                    raise error(reason or f"the router ended with status {end.status}")
            if time.monotonic() > deadline_s:
                raise CommandFailedError(f"the router did not start within {ROUTER_START_S:g} s")
            time.sleep(0.02)

    def _connect(self, observer: Observer) -> ZenohTransport:
        access = access_of(self.scenario, OBSERVER)
        deadline_s = time.monotonic() + ROUTER_START_S
        while True:
            try:
                return ZenohTransport(access, observer.inbox.put)
            except BadInputError as error:
                if self._stop:
                    raise KeyboardInterrupt from None
                if error.field != "network.endpoint" or time.monotonic() > deadline_s:
                    raise
                time.sleep(0.02)

    def _await_leader(self, observer: Observer) -> None:
        deadline_s = time.monotonic() + LEADER_S + 2 * self.scenario.network.election_s
        while observer.view.leader is None and not self._stop and time.monotonic() < deadline_s:
            observer.wait(POLL_S)

    def _check_processes(self) -> bool:
        """Record the processes that have exited; return whether the run continues."""
        for end in self._processes.ended():
            if self._stop:
                return False
            if end.name in (BRIDGE, ROUTER):
                if end.status != 0 or end.name == ROUTER:
                    self._record_end(f"the {end.name}", end)
                return False
            if end.status != 0:
                self._record_end(end.name, end)
                self._failed_agents += end.name.startswith("agent-")
        if self._failed_agents > MAX_FAILED_AGENTS:
            self._problems.append("too many agents failed")
            return False
        return True

    def _record_end(self, subject: str, end: RoleExit) -> None:
        error = last_error(self.folder / LOG_FILE, end.name)
        reason = f": {error}" if error else ""
        self._problems.append(f"{subject} ended with status {end.status}{reason}")

    def _agents_to_start(self, observer: Observer) -> Iterator[tuple[str, ...]]:
        """Yield each group of vehicles once its first vehicle has been announced."""
        census = observer.view.census
        for announced in census.announced if census is not None else ():
            group = self._group_of.get(announced.vehicle, ())
            for vehicle in group:
                del self._group_of[vehicle]
            if group:
                yield group

    def _log_fault(self, t_s: float, data: Mapping[str, object]) -> None:
        """Write an event to the file of the bridge, which cannot receive it if it is dead."""
        try:
            append_event(self.folder / EVENTS_FILE, t_s, FAULT_INJECTED, data)
        except OSError as error:
            log.critical("a fault is not recorded", reason=str(error), **data)

    def _request_stop(self) -> None:
        self._stop = True


def check_network(scenario: Scenario, vehicles: Iterable[str]) -> None:
    """Check that the processes of a run, with its vehicles, can use the network of a scenario.

    Raises:
        BadInputError: they cannot; for example, a certificate is missing.
    """
    network, security, runtime = scenario.network, scenario.security, scenario.runtime
    if security.mode == "off":
        return
    if not network.endpoint:
        allowed = "tls/HOST:PORT or quic/HOST:PORT, as security.mode is mtls"
        raise BadInputError("network.endpoint", "", allowed)
    if runtime.vehicles_per_process != 1:
        allowed = "1, as security.mode is mtls: every agent has the certificate of its vehicle"
        value = runtime.vehicles_per_process
        raise BadInputError("runtime.vehicles_per_process", value, allowed)
    roles = ("bridge", OBSERVER, *(f"coordinator.{name}" for name in coordinator_names(scenario)))
    for identity in (*roles, *(f"vehicle.{vehicle}" for vehicle in vehicles)):
        credentials = access_of(scenario, identity).credentials
        assert credentials is not None  # noqa: S101 (the network is secured)
        check_credentials(credentials, identity)


def network_in(temporary: Path, network: Network) -> Network:
    """Return the network of a run; without an endpoint, roles use a socket that only this user can.

    Args:
        temporary: temporary folder of the run.
        network: that of the scenario. If it has no endpoint, its `listen` are additional endpoints.
    """
    if network.endpoint:
        return network
    endpoint = f"unixsock-stream/{temporary}/router.sock"
    listen = (endpoint, *network.listen) if network.listen else ()
    return attrs.evolve(network, endpoint=endpoint, listen=listen)


def fault_injection(
    faults: FaultSpec, scenario: Scenario, processes: RoleProcesses
) -> FaultInjection:
    """Return the fault engine of a run; call this before starting the run's processes.

    Raises:
        BadInputError: a partition requires network namespaces, which cannot be created.
    """
    breakdowns_of(faults, scenario)  # refused before anything is started
    seed = faults.seed_of_run(scenario.seed)
    network, reason = open_network(faults, processes.context, seed)
    endpoint = scenario.network.endpoint
    if network is not None and endpoint and not endpoint.startswith("unixsock-stream/"):
        network.close()
        allowed = "none, or unixsock-stream/PATH: the faults use network namespaces"
        raise BadInputError("network.endpoint", endpoint, allowed)
    lease_s = scenario.network.lease_s
    return FaultInjection(faults, scenario.seed, processes, lease_s, network, reason)


def add_faults(
    injection: FaultInjection,
    board: SharedBoard,
    start: RoleStart,
    tables: dict[str, Any],
    options: dict[str, Any],
) -> None:
    """Add the message faults and the network namespace of a role to its tables and options."""
    network, sender = injection.network, SENDER_OF_ROLE.get(start.role)
    if start.role == BRIDGE:
        options["breakdowns"] = breakdowns_of(injection.specification, parse_scenario(tables))
    if network is not None and start.role == ROUTER:
        options |= {"namespace": network.process_id(HUB), "listen": (LISTEN,)}
    if sender is None:
        return
    group = _GROUP_OF_SENDER[sender]
    if network is not None and group in network.groups:
        options["namespace"] = network.process_id(group)
        tables["network"] = tables["network"] | {"endpoint": ENDPOINT}
    options["faults"] = MessageFaults(
        injection.message_rules(),
        board.path,
        board.new_counter(),
        receiver=sender,
        names=tuple(start.options.get("vehicles", (start.name,))),
        seed=injection.seed_of_start(start.name),
    )


def check_temporary_folder() -> None:
    """Check that the path of the temporary folder is short enough for socket paths.

    Raises:
        BadInputError: the path is too long.
    """
    folder = tempfile.gettempdir()
    if len(os.fsencode(folder)) > MAX_TEMPORARY_BYTES:
        raise BadInputError("TMPDIR", folder, f"a path of at most {MAX_TEMPORARY_BYTES} bytes")
