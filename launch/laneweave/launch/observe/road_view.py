"""Observed state of a deployment: newest road, coordinators, processes.

Each bridge process has an incarnation number. A clock or census from a newer bridge starts a new
road; those from older bridges are ignored. Road times within the bounds of `wire.newest` count.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Any

from attrs import define, field, frozen

from laneweave.launch.observe.process_view import OtherVersion, ProcessView
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.deployment_fields import HIGHEST_PACE
from laneweave.protocol.wire.bounds import Bounds
from laneweave.protocol.wire.messages import Census, Heartbeat, Name, RoadClock, VehicleState
from laneweave.protocol.wire.newest import NewestRoad
from laneweave.protocol.wire.obstacle_messages import Obstacles
from laneweave.protocol.wire.process_messages import LogEvent
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COORDINATOR_ALIVE,
    VEHICLE_ALIVE,
    incarnation_of,
)

NetworkEvent = Arrived | PeerUp | PeerDown | LinkUp | LinkDown | OtherVersion

MAX_EVENTS = 1000
"""Maximum number of log events kept for `take_events`."""
FORGET_S = 5.0
"""Difference from the road clock above which a state belongs to an earlier road."""
REMEMBERED_S = 60.0
"""Age at which heartbeats are removed."""

Process = tuple[Name, int]
"""Name and incarnation of a coordinator."""


@frozen
class Coordinator:
    """Observed state of a coordinator process."""

    coordinator: Name
    incarnation: int
    leading: bool
    """Whether the process claims to lead and its last heartbeat has not timed out."""
    term: int | None
    """None, here and in the next two fields: no heartbeat was received."""
    plans_in_force: int | None
    heard_s_ago: float | None
    token: bool
    """Whether the process has a liveliness token."""

    def is_active(self, election_s: float) -> bool:
        """Return whether a heartbeat arrived less than `election_s` ago."""
        return self.heard_s_ago is not None and self.heard_s_ago < election_s


def claims_of(coordinators: Sequence[Coordinator]) -> list[Coordinator]:
    """Return the coordinators that claim to lead; the first one leads.

    The highest term leads; ties go to the lowest name.
    """
    return sorted(
        (one for one in coordinators if one.leading),
        key=lambda one: (-(one.term or 0), one.coordinator),
    )


@define
class RoadView:
    """State of a deployment according to messages and liveliness tokens."""

    clock: RoadClock | None = None
    """Newest clock."""
    census: Census | None = None
    obstacles: Obstacles | None = None
    """Newest parts of lanes that are not open as always."""
    leader: Name | None = None
    """Coordinator that last claimed to lead."""
    incarnation: int = 0
    """Incarnation of the leader."""
    term: int = 0
    _leading: tuple[Name, int] | None = None
    """Name and incarnation of the process that last claimed to lead."""
    states: dict[Name, VehicleState] = field(factory=dict)
    """Newest state of each vehicle."""
    road: NewestRoad = field(factory=lambda: NewestRoad(HIGHEST_PACE))
    """The newest road, at any pace: observers do not know the scenario."""
    bounds: Bounds | None = None
    """Limits of received numbers; None: none."""
    roads: int = 0
    """Number of roads observed so far."""
    clock_received_s: float = 0.0
    first_clock: RoadClock | None = None
    """Clock with the lowest tick."""
    first_clock_received_s: float = 0.0
    heartbeats: dict[Process, tuple[Heartbeat, float]] = field(factory=dict)
    """Newest heartbeat of each process, and when it arrived."""
    linked: bool = True
    """Whether the observer is connected to the router."""
    message_counts: Counter[str] = field(factory=Counter)
    """Number of received messages by topic."""
    coordinator_tokens: set[Process] = field(factory=set)
    departed: set[Process] = field(factory=set)
    """Coordinators whose tokens have disappeared."""
    agent_tokens: dict[Name, set[str]] = field(factory=dict)
    """Processes with tokens for the agent of each vehicle."""
    bridge_tokens: set[int] = field(factory=set)
    """Incarnations of the bridges with tokens."""
    processes: ProcessView = field(factory=ProcessView)
    _events: deque[LogEvent] = field(factory=lambda: deque(maxlen=MAX_EVENTS))

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.clock.t_s if self.clock is not None else 0.0

    def update(self, event: object, now_s: float) -> None:
        """Process a message or another `NetworkEvent`; ignore outdated messages.

        Args:
            event: message or event.
            now_s: time of arrival on the clock of the observer.
        """
        self.processes.update(event, now_s)
        match event:
            case Arrived(topic, _, message):
                self.message_counts[topic.name] += 1
                self.update(message, now_s)
            case VehicleState():
                self._on_state(event)
            case RoadClock() | Census() | Obstacles():
                if self._is_of_newest_road(event, now_s):
                    self._on_road(event, now_s)
            case Heartbeat():
                self._on_heartbeat(event, now_s)
            case LogEvent():
                self._events.append(event)
            case PeerUp() | PeerDown():
                self._on_token(event)
            case LinkUp() | LinkDown():
                self.linked = isinstance(event, LinkUp)
            case _:
                pass

    def _on_road(self, message: RoadClock | Census | Obstacles, now_s: float) -> None:
        """Keep a message about the newest road if none is newer."""
        if isinstance(message, RoadClock):
            self._on_clock(message, now_s)
        elif isinstance(message, Census):
            if self.census is None or message.t_s >= self.census.t_s:
                self.census = message
        elif self.obstacles is None or message.t_s >= self.obstacles.t_s:
            self.obstacles = message

    def take_events(self) -> Iterator[LogEvent]:
        """Yield the log events that have arrived since the last call."""
        while self._events:
            yield self._events.popleft()

    def coordinators(self, now_s: float, election_s: float) -> list[Coordinator]:
        """Return the coordinators with a token or a heartbeat, sorted by name and incarnation.

        Args:
            now_s: current time on the clock of the observer.
            election_s: time without a heartbeat after which a coordinator no longer leads.
        """
        self.heartbeats = {
            process: (heartbeat, received_s)
            for process, (heartbeat, received_s) in self.heartbeats.items()
            if now_s - received_s <= REMEMBERED_S
        }
        found = []
        for process in sorted(self.coordinator_tokens | (self.heartbeats.keys() - self.departed)):
            name, incarnation = process
            token = process in self.coordinator_tokens
            if process not in self.heartbeats:
                found.append(Coordinator(name, incarnation, False, None, None, None, token))
                continue
            heartbeat, received_s = self.heartbeats[process]
            found.append(
                Coordinator(
                    name,
                    incarnation,
                    leading=heartbeat.leading and now_s - received_s < election_s,
                    term=heartbeat.term,
                    plans_in_force=heartbeat.plans,
                    heard_s_ago=round(now_s - received_s, 3),
                    token=token,
                )
            )
        return found

    def candidates(self, now_s: float, election_s: float) -> list[Coordinator]:
        """Return the coordinators with a token or a recent heartbeat; see `coordinators`."""
        return [
            one
            for one in self.coordinators(now_s, election_s)
            if one.token or one.is_active(election_s)
        ]

    @property
    def bridge(self) -> int:
        """Incarnation of the newest bridge; -1: unknown."""
        return self.road.bridge

    def _is_of_newest_road(self, message: RoadClock | Census | Obstacles, now_s: float) -> bool:
        """Return whether a message belongs to the newest road; start a new road if necessary."""
        number = self.road.number
        try:
            if self.bounds is not None:
                self.bounds.check(message, self.road.latest_s(now_s), now_s)
            is_newest = self.road.on_message(message.bridge, message.t_s, now_s)
        except BadInputError:
            return False
        if self.roads == 0 or self.road.number != number:
            if self.roads:
                self.clock = self.first_clock = self.census = self.obstacles = None
                self.states = {}
            self.roads += 1
        return is_newest

    def _on_clock(self, clock: RoadClock, now_s: float) -> None:
        if self.clock is None:
            # States that arrived before the first clock may belong to an earlier road.
            self.states = {
                name: state
                for name, state in self.states.items()
                if abs(state.t_s - clock.t_s) <= FORGET_S
            }
        if self.first_clock is None or clock.tick < self.first_clock.tick:
            self.first_clock, self.first_clock_received_s = clock, now_s
        if self.clock is None or clock.tick >= self.clock.tick:
            self.clock, self.clock_received_s = clock, now_s

    def _on_state(self, state: VehicleState) -> None:
        if self.clock is not None and abs(state.t_s - self.clock.t_s) > FORGET_S:
            return
        known = self.states.get(state.vehicle)
        if known is None or state.t_s >= known.t_s:
            self.states[state.vehicle] = state

    def _on_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> None:
        if heartbeat.leading and heartbeat.term >= self.term:
            self.leader, self.incarnation = heartbeat.coordinator, heartbeat.incarnation
            self.term = heartbeat.term
            self._leading = heartbeat.coordinator, heartbeat.incarnation
        self.heartbeats[heartbeat.coordinator, heartbeat.incarnation] = heartbeat, now_s

    def _on_token(self, event: PeerUp | PeerDown) -> None:
        topic, parameters, up = event.topic, event.parameters, isinstance(event, PeerUp)
        if topic is COORDINATOR_ALIVE:
            process = Name(parameters["coordinator"]), incarnation_of(parameters)
            _update(self.coordinator_tokens, process, present=up)
            _update(self.departed, process, present=not up)
            if process == self._leading and not up:
                # If all candidates have been restarted, terms begin anew.
                self.term = 0
        elif topic is BRIDGE_ALIVE:
            _update(self.bridge_tokens, incarnation_of(parameters), present=up)
        elif topic is VEHICLE_ALIVE:
            self._on_agent_token(Name(parameters["vehicle"]), parameters["process"], present=up)

    def _on_agent_token(self, vehicle: Name, process: str, *, present: bool) -> None:
        processes = self.agent_tokens.setdefault(vehicle, set())
        _update(processes, process, present=present)
        if not processes:
            del self.agent_tokens[vehicle]


def _update(members: set[Any], member: object, *, present: bool) -> None:
    (members.add if present else members.discard)(member)
