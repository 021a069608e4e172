"""The fault engine, which applies a fault specification to a local or a simulated run.

Kills and pauses affect roles through `RoleControl`, which both kinds of runs implement. Message
faults and partitions are rules that roles receive at start-up; in local runs, network namespaces
may implement partitions instead, and implement faults of links.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol

import structlog
from attrs import define, field, frozen

from laneweave.launch.faults.failover import Failover
from laneweave.launch.faults.fault_file import (
    AGENT,
    BRIDGE,
    COORDINATOR,
    LEADER,
    MESSAGES,
    NAMESPACES,
    FaultSpec,
    LinkFault,
    Partition,
)
from laneweave.launch.faults.network_namespaces import (
    GroupNetwork,
    Link,
    NamespacesUnavailableError,
)
from laneweave.launch.faults.schedule import FaultEvent, FaultSchedule
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.runtime.message_faults import MessageRule

LAUNCHER = "launcher"
"""Role of the process that injects faults, in its events."""
LogEvent = Callable[[float, Mapping[str, object]], None]
"""Writes an event `fault-injected` with this road time [s] and data."""
log = structlog.get_logger(__name__)


class RoleControl(Protocol):
    """Operations that faults perform on the roles of a run, by name."""

    @property
    def running(self) -> Collection[str]:
        """Names of the running roles, including paused ones."""

    @property
    def coordinators(self) -> Collection[str]:
        """Names of all coordinators, running or not."""

    def agent_of(self, vehicle: str) -> str | None:
        """Return the role that drives a vehicle, or None before it is started."""

    def kill(self, name: str) -> None:
        """Kill a role immediately, without clean-up."""

    def pause(self, name: str) -> None:
        """Suspend a role."""

    def resume(self, name: str) -> None:
        """Resume a paused role, unless it has exited."""

    def restart(self, name: str) -> None:
        """Restart a killed role with empty memory."""


@frozen
class Recovery:
    """The end of a pause, or the restart after a kill."""

    due_s: float
    """Time on the clock of `FaultInjection.step`."""
    fault_name: str
    role: str
    restarts: bool


def _log_nowhere(_: float, __: Mapping[str, object]) -> None:
    pass


@define
class FaultInjection:
    """Fault engine of a run."""

    specification: FaultSpec
    seed: int
    """Seed of the scenario; a seed in the specification takes precedence."""
    roles: RoleControl
    lease_s: float
    network: GroupNetwork | None = None
    """Namespaces for partitions; None: partitions drop messages."""
    no_network_reason: str = ""
    """Why there are no namespaces."""
    log_event: LogEvent = _log_nowhere
    injected: list[dict[str, Any]] = field(factory=list)
    """Applied faults: road time, name of the fault, and the effect with its target."""
    end: str = ""
    """Why the faults have ended the run; empty: they have not."""
    failover: Failover = field(init=False)
    schedule: FaultSchedule = field(init=False)
    _starts: dict[str, int] = field(factory=dict)
    """Number of times that each role was started."""
    waiting: list[FaultEvent] = field(factory=list)
    """Due events that wait for a target."""
    _recoveries: list[Recovery] = field(factory=list)
    """Pending resumes and restarts."""
    _targets: dict[tuple[str, int], set[str]] = field(factory=dict)
    """Targets of each fault and repetition. A fault affects each agent at most once, and each
    coordinator at most once in a repetition."""
    _paused: set[str] = field(factory=set)
    _began: set[str] = field(factory=set)
    """Names of the rules, partitions and faults of links that have begun."""
    _ended: set[str] = field(factory=set)
    """Those that have ended."""
    _unmet: dict[str, MessageRule] = field(init=False)
    """Rules whose single processes have not all run while the rule was in force."""
    _first_step_s: float | None = None
    _road_s: float = 0.0
    """Road time of the current step."""
    _run_s: float = 0.0
    """Time of the current step since the first one."""

    def __attrs_post_init__(self) -> None:
        """Draw the schedule of the faults."""
        rules = enumerate(self.specification.messages)
        self._unmet = {f"messages[{index}]": rule for index, rule in rules if rule.names}
        self.failover = Failover(self.lease_s)
        self.schedule = FaultSchedule(self.specification, self.seed)

    @property
    def wakeup_s(self) -> float | None:
        """Time by which `step` must be called, on the clock of `now_s`; None: any time."""
        return min((recovery.due_s for recovery in self._recoveries), default=None)

    def message_rules(self) -> tuple[MessageRule, ...]:
        """Return the message rules, including those that implement partitions."""
        partitions = (
            rule
            for partition in self.specification.partition
            if not self._uses_links(partition)
            for rule in partition.message_rules()
        )
        return (*self.specification.messages, *partitions)

    def seed_of_start(self, name: str) -> str:
        """Return the seed of the message faults for the next start of a role."""
        start = self._starts[name] = self._starts.get(name, 0) + 1
        seed = self.specification.seed_of_run(self.seed)
        return f"{seed}/{name}/{start}"

    def step(self, road_s: float, now_s: float, view: RoadView) -> None:
        """Apply all faults that are due.

        Args:
            road_s: road time.
            now_s: wall-clock time, or virtual time of the simulated network.
            view: observed leader and census; `leader` is cleared when it becomes a target.

        Raises:
            CommandFailedError: a role cannot be restarted, or a link cannot be changed.
        """
        if self._first_step_s is None:
            self._first_step_s = now_s
        self._road_s, self._run_s = road_s, now_s - self._first_step_s
        self._recover(now_s)
        self.failover.update(view, now_s)
        self.waiting += self.schedule.due(road_s)
        waiting, self.waiting = self.waiting, []
        for event in waiting:
            name = self._choose(event, view)
            if name is None:
                self.waiting.append(event)
            else:
                self._apply(event, name, now_s, view)
        self._begin_and_end_windows(road_s)

    def skip(self, road_s: float) -> None:
        """Drop the kills and pauses that were due before a road time; call it before `step`."""
        self.schedule.skip(road_s)

    def resume_paused(self) -> None:
        """Resume all paused roles now; call it if `step` is not called any more."""
        paused = [one for one in self._recoveries if not one.restarts]
        self._recoveries = []
        for recovery in paused:
            self.roles.resume(recovery.role)
        for recovery in paused:
            self._report(recovery.fault_name, "resumed", recovery.role)

    @property
    def finished(self) -> bool:
        """Whether all kills and pauses have been applied, and undone where they are undone."""
        return not self.waiting and not self._recoveries and self.schedule.is_empty

    def unused_faults(self) -> list[str]:
        """Return a line for each fault that had no effect."""
        return self.schedule.unused_faults({name for name, _ in self._targets}) + [
            f"{name}: {' and '.join(rule.names)} did not run while it was in force"
            for name, rule in self._unmet.items()
            if name in self._began
        ]

    def results(self, dropped: int) -> dict[str, Any]:
        """Return the fault-related arguments of `complete_summary`.

        `dropped` is the number of messages dropped by faults.
        """
        methods = {
            name: NAMESPACES if self._uses_links(partition) else MESSAGES
            for name, partition in self.specification.partitions()
        }
        faults: dict[str, Any] = {"injected": self.injected, "partition_methods": methods}
        if self.no_network_reason:
            faults["why_no_namespaces"] = self.no_network_reason
        breakdowns = sum(fault.count for _, fault in self.specification.breakdowns())
        return {
            "failover": self.failover,
            "dropped": dropped,
            "faults": faults,
            "breakdowns": breakdowns,
        }

    def close(self) -> None:
        """Release the network namespaces; call this after all roles have exited."""
        if self.network is not None:
            self.network.close()

    # --- kills and pauses ---------------------------------------------------------------------

    def _recover(self, now_s: float) -> None:
        due = [recovery for recovery in self._recoveries if recovery.due_s <= now_s]
        self._recoveries = [recovery for recovery in self._recoveries if recovery.due_s > now_s]
        for recovery in due:
            role = recovery.role
            if recovery.restarts:
                self.roles.restart(role)
                self._report(recovery.fault_name, "restarted", role)
            else:
                self._paused.discard(role)
                exited = role not in self.roles.running
                self.roles.resume(role)
                if not exited:
                    self._report(recovery.fault_name, "resumed", role)

    def _choose(self, event: FaultEvent, view: RoadView) -> str | None:
        running = [name for name in self.roles.running if name not in self._paused]
        target = event.fault.target
        if target in (COORDINATOR, AGENT):
            earlier = {
                name
                for (fault, repetition), names in self._targets.items()
                if fault == event.fault_name and (target == AGENT or repetition == event.repetition)
                for name in names
            }
            candidates = sorted(self._names_of(target, view) & set(running) - earlier)
            return event.draw.choice(candidates) if candidates else None
        name = view.leader if target == LEADER else target
        if name not in running:
            name = self.roles.agent_of(target)
        return name if name in running else None

    def _names_of(self, target: str, view: RoadView) -> set[str]:
        """Return the names of all coordinators, or of the agents of vehicles on the road."""
        if target == COORDINATOR:
            return set(self.roles.coordinators)
        entries = view.census.on_road if view.census is not None else ()
        agents = {self.roles.agent_of(entry.vehicle) for entry in entries}
        return {name for name in agents if name is not None}

    def _apply(self, event: FaultEvent, name: str, now_s: float, view: RoadView) -> None:
        fault = event.fault_name
        self._targets.setdefault((fault, event.repetition), set()).add(name)
        self._record(fault, event.fault.verb, name)
        if event.for_s is not None:
            self.roles.pause(name)
            self._paused.add(name)
            self._recoveries.append(Recovery(now_s + event.for_s, fault, name, restarts=False))
        else:
            self.roles.kill(name)
            if event.restart_after_s is not None:
                restart_s = now_s + event.restart_after_s
                self._recoveries.append(Recovery(restart_s, fault, name, restarts=True))
        self._report(fault, event.fault.verb, name)
        if name == BRIDGE:
            self.end = f"the bridge was killed at {self._road_s:.1f} s by {fault}"
        if name == view.leader:
            self.failover.on_leader_fault(view, now_s, event.for_s)

    def _record(self, fault: str, verb: str, target: str) -> None:
        self.injected.append({"t_s": round(self._road_s, 3), "fault": fault, verb: target})
        log.warning(verb, target=target, t_s=self._road_s, fault=fault)

    def _report(self, fault: str, action: str, target: str) -> None:
        data = {"role": LAUNCHER, "fault": fault, "action": action, "target": target}
        self.log_event(round(self._road_s, 3), data | {"run_s": round(self._run_s, 3)})

    # --- rules, partitions and links ----------------------------------------------------------

    def _uses_links(self, partition: Partition) -> bool:
        return self.network is not None and partition.may_use_links

    def _begin_and_end_windows(self, road_s: float) -> None:
        """Begin and end rules, partitions and faults of links, and note which rules have met.

        The road may advance by more than the length of a window between two steps.
        """
        windows = dict(self.specification.windows())
        began = {
            name
            for name, window in windows.items()
            if window.from_s <= road_s and name not in self._began
        }
        ended = {
            name
            for name in (self._began | began) - self._ended
            if (until_s := windows[name].until_s) is not None and until_s <= road_s
        }
        self._began |= began
        self._ended |= ended
        for name in self._unmet.keys() & (began | self._began - self._ended):
            if all(map(self._runs, self._unmet[name].names)):
                del self._unmet[name]
        if not began and not ended:
            return
        self._set_links()
        for names, action in ((began, "began"), (ended, "ended")):
            for name in sorted(names):
                window = windows[name]
                if not isinstance(window, MessageRule):
                    self._record(name, name.partition("[")[0], action)
                self._report(name, action, window.label)

    def _runs(self, process: str) -> bool:
        """Return whether a coordinator, or the agent of a vehicle, runs."""
        running = self.roles.running
        return process in running or self.roles.agent_of(process) in running

    def _set_links(self) -> None:
        """Set each link to the state that the faults in force require."""
        if self.network is None:
            return
        links: dict[str, Link] = {}
        for name, fault in self.specification.timed_faults():
            if name not in self._began or name in self._ended:
                continue
            if isinstance(fault, LinkFault):
                links = dict.fromkeys(fault.groups, _state(fault)) | links
            elif self._uses_links(fault):
                links[fault.between[0]] = Link(up=False)
        try:
            self.network.set_links(links)
        except NamespacesUnavailableError as error:
            raise CommandFailedError(f"cannot change a link: {error}") from error


def _state(fault: LinkFault) -> Link:
    """Return the state of a link with a fault."""
    return Link(loss=fault.loss, burst=fault.burst, delay_s=fault.delay_s, jitter_s=fault.jitter_s)
