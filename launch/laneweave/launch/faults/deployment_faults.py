"""Faults of a deployment whose roles were started by hand: kills and pauses from outside.

An observer of the realm follows the road's clock and finds the processes by their tokens. Only
those on this host are affected (`host_processes`).
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Collection, Mapping

from attrs import define, field

from laneweave.launch.faults.fault_file import FaultSpec
from laneweave.launch.faults.host_processes import HostProcess, NotOnThisHostError, find_process
from laneweave.launch.faults.injection import LAUNCHER, FaultInjection
from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.process_view import ProcessToken
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.transports.zenoh.transport import ZenohTransport, connect_blocking
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.events import FAULT_INJECTED
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import LogEvent
from laneweave.protocol.wire.topics import (
    CENSUS,
    CLOCK,
    EVENT,
    HEARTBEAT,
    PROCESS_ALIVE,
    ROLES,
    Keys,
    Party,
)

POLL_S = 0.1
HEARD_S = 3.0
"""Time without a clock of a road after which the command says that it waits."""
SENDER = Name("faults")
Report = Callable[[str], None]
"""Prints a line."""


@define
class DeploymentRoles:
    """The processes of a realm on this host by name; implements `RoleControl`."""

    realm: str
    view: RoadView
    elsewhere: dict[str, str] = field(factory=dict)
    """Processes that get no signals, and why."""
    process_ids: dict[str, int] = field(factory=dict)
    """Id of each process that got a signal."""
    _found: dict[ProcessToken, HostProcess | None] = field(factory=dict)
    """Each token that has been examined, with its process on this host."""
    _paused: dict[str, HostProcess] = field(factory=dict)

    @property
    def _processes(self) -> dict[str, HostProcess]:
        """The running processes by name; of two with one name, the newer one."""
        tokens = self.view.processes.tokens
        for token in self._found.keys() - tokens:
            process = self._found[token]
            # The token of a paused process vanishes when its lease expires.
            if process is None or process not in self._paused.values():
                del self._found[token]
                self.elsewhere.pop(token.label, None)
                if process is not None:
                    process.close()
        for token in tokens - self._found.keys():
            try:
                self._found[token] = find_process(token, self.realm)
            except NotOnThisHostError as error:
                self._found[token] = None
                self.elsewhere[token.label] = str(error)
        return {
            _name_of(token): process
            for token, process in sorted(self._found.items(), key=lambda one: one[0].incarnation)
            if process is not None and process.is_alive
        }

    @property
    def running(self) -> Collection[str]:
        """Names of the running processes."""
        return self._processes.keys()

    @property
    def coordinators(self) -> Collection[str]:
        """Names of the coordinators with a token."""
        role = ROLES[Party.COORDINATOR]
        return [token.name for token in self.view.processes.tokens if token.role == role]

    def agent_of(self, vehicle: str) -> str | None:
        """Return the process that drives a vehicle; None: none of this host, or no such vehicle."""
        census = self.view.census
        if census is None:
            return None
        vehicles = {one.vehicle for one in census.on_road}
        vehicles |= {one.vehicle for one in census.announced}
        # Any name belongs to some shard, also one that is not the name of a vehicle.
        if vehicle not in vehicles:
            return None
        # Of several agents of a vehicle, the one that was started last is in charge.
        processes = reversed(self._processes.items())
        return next((name for name, process in processes if process.drives(vehicle)), None)

    def kill(self, name: str) -> None:
        """Kill a process with SIGKILL."""
        self._send(self._processes[name], name, signal.SIGKILL)

    def pause(self, name: str) -> None:
        """Suspend a process with SIGSTOP."""
        process = self._paused[name] = self._processes[name]
        self._send(process, name, signal.SIGSTOP)

    def resume(self, name: str) -> None:
        """Resume a paused process with SIGCONT, unless it has exited."""
        self._paused.pop(name).send(signal.SIGCONT)

    def restart(self, name: str) -> None:
        """Refuse: only the program that started a process can start it again.

        Raises:
            CommandFailedError: always.
        """
        raise CommandFailedError(f"{name} cannot be restarted from outside")

    def _send(self, process: HostProcess, name: str, number: signal.Signals) -> None:
        self.process_ids[name] = process.pid
        process.send(number)


def _name_of(token: ProcessToken) -> str:
    """Return the name of a process in fault files, and of an agent process in events."""
    if token.role in (ROLES[Party.COORDINATOR], ROLES[Party.BRIDGE]):
        return token.name
    return f"{token.role}-{token.name}"


@define
class DeploymentFaults:
    """Application of faults to a deployment; call `apply` once."""

    settings: Scenario
    """Endpoint, realm and seed."""
    specification: FaultSpec
    report: Report
    """Called with a line for each effect of a fault."""
    warn: Report
    """Called with a line for what the command waits for."""
    _view: RoadView = field(factory=RoadView)
    _roles: DeploymentRoles = field(init=False)
    _transport: ZenohTransport = field(init=False)
    _waits: set[str] = field(factory=set)
    """Faults whose wait for a target has been reported."""
    _stop: bool = False

    def __attrs_post_init__(self) -> None:
        """Begin without any process."""
        self._roles = DeploymentRoles(self.settings.network.realm, self._view)

    def apply(self) -> None:
        """Apply all faults when they are due, until the last one, or until the road has ended.

        Paused processes are resumed, however it ends, unless this process is killed.

        Raises:
            BadInputError: a fault cannot be applied from outside; there is no router.
            CommandFailedError: some faults had no effect.
            KeyboardInterrupt: a signal has ended the command.
        """
        self.specification.check_outside()
        network = self.settings.network
        observer = Observer(
            Keys(network.realm),
            view=self._view,
            topics=(CLOCK, CENSUS, HEARTBEAT),
            tokens=(PROCESS_ALIVE,),
        )
        injection = FaultInjection(
            self.specification,
            self.settings.seed,
            self._roles,
            network.lease_s,
            log_event=self._log_event,
        )
        access = access_of(self.settings, "observer.status")
        with stop_signals(self._request_stop):
            transport = connect_blocking(access, observer.inbox.put)
            with contextlib.closing(transport):
                self._transport = transport
                observer.subscribe(transport)
                if self.settings.security.mode != "off":
                    self.warn("a secured network lets only roles send events: none is recorded")
                try:
                    self._await_road(observer)
                    if not self._stop:
                        injection.skip(self._view.t_s)
                    while not self._stop and not injection.finished and not self._road_ended:
                        injection.step(self._view.t_s, time.monotonic(), self._view)
                        self._report_waiting(injection)
                        self._report_end(injection)
                        observer.wait(POLL_S)
                finally:
                    injection.resume_paused()
        if self._stop:
            raise KeyboardInterrupt
        unused = injection.unused_faults()
        if unused:
            raise CommandFailedError("; ".join(unused))

    @property
    def _road_ended(self) -> bool:
        return self._view.clock is not None and self._view.clock.ended

    def _await_road(self, observer: Observer) -> None:
        warn_s: float | None = time.monotonic() + HEARD_S
        while self._view.clock is None and not self._stop:
            observer.wait(POLL_S)
            if warn_s is not None and time.monotonic() >= warn_s:
                network = self.settings.network
                self.warn(f"waiting for a road in realm {network.realm} at {network.endpoint}")
                warn_s = None

    def _report_end(self, injection: FaultInjection) -> None:
        """Report once that the bridge was killed: without it, road time stands still."""
        if injection.end and not injection.finished and injection.end not in self._waits:
            self._waits.add(injection.end)
            self.warn(f"{injection.end}: the other faults wait for a new bridge")

    def _report_waiting(self, injection: FaultInjection) -> None:
        for event in injection.waiting:
            if event.fault_name not in self._waits:
                self._waits.add(event.fault_name)
                reasons = [f"; {name} {why}" for name, why in self._roles.elsewhere.items()]
                line = f"{event.fault_name} waits for {event.fault.target} on this host"
                self.warn(line + "".join(sorted(reasons)))

    def _log_event(self, t_s: float, data: Mapping[str, object]) -> None:
        """Report an effect, and send it to the bridge's recorder."""
        fault, action, target = (str(data[name]) for name in ("fault", "action", "target"))
        pid = self._roles.process_ids.get(target)
        process = "" if pid is None else f" (process {pid})"
        self.report(f"{t_s:.1f} s: {fault}: {target}{process} {action}")
        if self.settings.security.mode == "off":
            event = LogEvent(Name(LAUNCHER), SENDER, t_s, Name(FAULT_INJECTED), dict(data))
            key = Keys(self.settings.network.realm).key(EVENT, role=LAUNCHER, name=SENDER)
            self._transport.publish(key, encode(event), EVENT.quality)

    def _request_stop(self) -> None:
        self._stop = True
