"""The fault engine, which applies a fault specification to a local or a simulated run.

Kills and pauses affect roles through `RoleControl`, which both kinds of runs implement. Message
faults and partitions are rules that roles receive at start-up; in local runs, network namespaces
may implement partitions instead, and implement faults of links.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, Protocol

import structlog
from attrs import define, field

from laneweave.launch.faults.failover import Failover
from laneweave.launch.faults.fault_file import (
    AGENT,
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
    injected: list[dict[str, Any]] = field(factory=list)
    """Applied faults: road time, name of the fault, and the effect with its target."""
    failover: Failover = field(init=False)
    schedule: FaultSchedule = field(init=False)
    _starts: dict[str, int] = field(factory=dict)
    """Number of times that each role was started."""
    _waiting: list[FaultEvent] = field(factory=list)
    """Due events that wait for a target."""
    _recoveries: list[tuple[float, str, Callable[[str], None]]] = field(factory=list)
    """Pending resumes and restarts: time on the clock of `now_s`, role, and action."""
    _targets: dict[str, set[str]] = field(factory=dict)
    """Targets of each fault; a fault affects each agent at most once."""
    _paused: set[str] = field(factory=set)
    _in_force: set[str] = field(factory=set)
    """Names of the partitions and the faults of links in force."""

    def __attrs_post_init__(self) -> None:
        """Draw the schedule of the faults."""
        self.failover = Failover(self.lease_s)
        self.schedule = FaultSchedule(self.specification, self.seed)

    @property
    def wakeup_s(self) -> float | None:
        """Time by which `step` must be called, on the clock of `now_s`; None: any time."""
        return min((due_s for due_s, _, _ in self._recoveries), default=None)

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
        self._recover(now_s)
        self.failover.update(view, now_s)
        self._waiting += self.schedule.due(road_s)
        waiting, self._waiting = self._waiting, []
        for event in waiting:
            name = self._choose(event, view)
            if name is None:
                self._waiting.append(event)
            else:
                self._apply(event, name, road_s, now_s, view)
        self._change_links(road_s)

    def unused_faults(self) -> list[str]:
        """Return a line for each fault that had no effect."""
        return self.schedule.unused_faults(set(self._targets))

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
        return {"failover": self.failover, "dropped": dropped, "faults": faults}

    def close(self) -> None:
        """Release the network namespaces; call this after all roles have exited."""
        if self.network is not None:
            self.network.close()

    # --- kills and pauses ---------------------------------------------------------------------

    def _recover(self, now_s: float) -> None:
        due = [recovery for recovery in self._recoveries if recovery[0] <= now_s]
        self._recoveries = [recovery for recovery in self._recoveries if recovery[0] > now_s]
        for _, role, recover in due:
            self._paused.discard(role)
            recover(role)

    def _choose(self, event: FaultEvent, view: RoadView) -> str | None:
        running = [name for name in self.roles.running if name not in self._paused]
        target = event.fault.target
        if target in (COORDINATOR, AGENT):
            candidates = sorted(
                self._names_of(target, view)
                & set(running) - self._targets.get(event.fault_name, set())
            )
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

    def _apply(
        self, event: FaultEvent, name: str, road_s: float, now_s: float, view: RoadView
    ) -> None:
        self._targets.setdefault(event.fault_name, set()).add(name)
        self._record(road_s, event.fault_name, event.fault.verb, name)
        if event.for_s is not None:
            self.roles.pause(name)
            self._paused.add(name)
            self._recoveries.append((now_s + event.for_s, name, self.roles.resume))
        else:
            self.roles.kill(name)
            if event.restart_after_s is not None:
                restart_s = now_s + event.restart_after_s
                self._recoveries.append((restart_s, name, self.roles.restart))
        if name == view.leader:
            self.failover.on_leader_fault(view, now_s, event.for_s)

    def _record(self, road_s: float, fault: str, verb: str, target: str) -> None:
        self.injected.append({"t_s": round(road_s, 3), "fault": fault, verb: target})
        log.warning(verb, target=target, t_s=road_s, fault=fault)

    # --- links --------------------------------------------------------------------------------

    def _uses_links(self, partition: Partition) -> bool:
        return self.network is not None and partition.may_use_links

    def _change_links(self, road_s: float) -> None:
        """Begin and end partitions and faults of links."""
        faults = self.specification.timed_faults()
        in_force = {name: fault for name, fault in faults if fault.holds(road_s)}
        if in_force.keys() == self._in_force:
            return
        if self.network is not None:
            links: dict[str, Link] = {}
            for fault in in_force.values():
                if isinstance(fault, LinkFault):
                    links = dict.fromkeys(fault.groups, _state(fault)) | links
                elif self._uses_links(fault):
                    links[fault.between[0]] = Link(up=False)
            try:
                self.network.set_links(links)
            except NamespacesUnavailableError as error:
                raise CommandFailedError(f"cannot change a link: {error}") from error
        for name in sorted(in_force.keys() ^ self._in_force):
            kind = name.partition("[")[0]
            self._record(road_s, name, kind, "began" if name in in_force else "ended")
        self._in_force = set(in_force)


def _state(fault: LinkFault) -> Link:
    """Return the state of a link with a fault."""
    return Link(loss=fault.loss, burst=fault.burst, delay_s=fault.delay_s, jitter_s=fault.jitter_s)
