"""The observed state of a deployment: its newest road, its coordinators, and its processes.

Every bridge process numbers itself (its incarnation). A clock or census of a newer bridge begins a
new road; those of an older one are ignored.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from typing import Any

from attrs import define, field, frozen

from laneweave.launch.observe.message_loss import LossMeter
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.wire.messages import (
    Census,
    Heartbeat,
    LogEvent,
    Name,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COORDINATOR_ALIVE,
    VEHICLE_ALIVE,
    incarnation_of,
)

NetworkEvent = Arrived | PeerUp | PeerDown | LinkUp | LinkDown

MAX_EVENTS = 1000
"""Log events that are kept until they are taken."""
FORGET_S = 5.0
"""A state further from the clock than this belongs to an earlier road."""
REMEMBERED_S = 60.0
"""A heartbeat that is older is forgotten."""

Process = tuple[Name, int]
"""Name and incarnation of a coordinator."""


@frozen
class Coordinator:
    """A coordinator process, as an observer sees it."""

    coordinator: Name
    incarnation: int
    leading: bool
    """It claims to lead, and was heard within the election time."""
    term: int | None
    """None, as in the next two: no heartbeat was heard."""
    plans_in_force: int | None
    heard_s_ago: float | None
    token: bool
    """Its liveliness token exists."""


def claims_of(coordinators: Sequence[Coordinator]) -> list[Coordinator]:
    """Return the coordinators that claim to lead; the first one leads.

    The protocol's rule: the highest term leads, the lowest name among equals.
    """
    return sorted(
        (one for one in coordinators if one.leading),
        key=lambda one: (-(one.term or 0), one.coordinator),
    )


@define
class RoadView:
    """What is known from messages and liveliness tokens."""

    clock: RoadClock | None = None
    """The newest one."""
    census: Census | None = None
    leader: Name | None = None
    """The coordinator that was last heard to lead, however long ago."""
    incarnation: int = 0
    """Of the leader."""
    term: int = 0
    loss_window_ticks: int = 0
    """Ticks over which message loss is measured; 0: it is not."""
    states: dict[Name, VehicleState] = field(factory=dict)
    """The newest state of each vehicle."""
    loss: LossMeter = field(init=False)
    bridge: int = -1
    """Incarnation of the newest bridge."""
    roads: int = 0
    """Number of roads observed so far."""
    clock_heard_s: float = 0.0
    first_clock: RoadClock | None = None
    """The one with the lowest tick."""
    first_clock_heard_s: float = 0.0
    heartbeats: dict[Process, tuple[Heartbeat, float]] = field(factory=dict)
    """The newest one of each process, and when it was heard."""
    linked: bool = True
    """Whether the observer is connected to the router."""
    message_counts: Counter[str] = field(factory=Counter)
    """By topic."""
    coordinator_tokens: set[Process] = field(factory=set)
    departed: set[Process] = field(factory=set)
    """Coordinators whose tokens have vanished."""
    agent_tokens: set[Name] = field(factory=set)
    """Vehicles whose agents have tokens."""
    bridge_tokens: set[int] = field(factory=set)
    """Incarnations of bridges."""
    _events: deque[LogEvent] = field(factory=lambda: deque(maxlen=MAX_EVENTS))

    @loss.default
    def _new_meter(self) -> LossMeter:
        return LossMeter(self.loss_window_ticks)

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.clock.t_s if self.clock is not None else 0.0

    def update(self, event: object, now_s: float) -> None:
        """Process a message or other `NetworkEvent`; messages older than what is known are ignored.

        Args:
            event: what arrived.
            now_s: when, on the observer's clock.
        """
        match event:
            case Arrived(topic, _, message):
                self.message_counts[topic.name] += 1
                self.update(message, now_s)
            case VehicleState():
                self._on_state(event)
            case RoadClock() if self._is_of_newest_road(event.bridge):
                self._on_clock(event, now_s)
            case Census() if self._is_of_newest_road(event.bridge):
                if self.census is None or event.t_s >= self.census.t_s:
                    self.census = event
                    self.loss.on_census(event)
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

    def take_events(self) -> Iterator[LogEvent]:
        """Yield the log events that arrived since the last call."""
        while self._events:
            yield self._events.popleft()

    def coordinators(self, now_s: float, election_s: float) -> list[Coordinator]:
        """Return the coordinators that have a token or were heard, by name and incarnation.

        Args:
            now_s: now, on the observer's clock.
            election_s: a coordinator that was not heard for this long does not lead.
        """
        self.heartbeats = {
            process: (heartbeat, heard_s)
            for process, (heartbeat, heard_s) in self.heartbeats.items()
            if now_s - heard_s <= REMEMBERED_S
        }
        found = []
        for process in sorted(self.coordinator_tokens | (self.heartbeats.keys() - self.departed)):
            name, incarnation = process
            token = process in self.coordinator_tokens
            if process not in self.heartbeats:
                found.append(Coordinator(name, incarnation, False, None, None, None, token))
                continue
            heartbeat, heard_s = self.heartbeats[process]
            found.append(
                Coordinator(
                    name,
                    incarnation,
                    leading=heartbeat.leading and now_s - heard_s < election_s,
                    term=heartbeat.term,
                    plans_in_force=heartbeat.formations,
                    heard_s_ago=round(now_s - heard_s, 3),
                    token=token,
                )
            )
        return found

    def _is_of_newest_road(self, bridge: int) -> bool:
        """Tell whether a message is not of an earlier road; begin anew with a newer one."""
        if bridge > self.bridge:
            if self.roads:
                self.clock = self.first_clock = self.census = None
                self.states, self.loss = {}, self._new_meter()
            self.bridge = bridge
            self.roads += 1
        return bridge == self.bridge

    def _on_clock(self, clock: RoadClock, now_s: float) -> None:
        if self.clock is None:
            # States that arrived before the first clock may be of an earlier road.
            self.states = {
                name: state
                for name, state in self.states.items()
                if abs(state.t_s - clock.t_s) <= FORGET_S
            }
        if self.first_clock is None or clock.tick < self.first_clock.tick:
            self.first_clock, self.first_clock_heard_s = clock, now_s
        if self.clock is None or clock.tick >= self.clock.tick:
            self.clock, self.clock_heard_s = clock, now_s
        self.loss.on_clock(clock)

    def _on_state(self, state: VehicleState) -> None:
        if self.clock is not None and abs(state.t_s - self.clock.t_s) > FORGET_S:
            return
        self.loss.on_state(state)
        known = self.states.get(state.vehicle)
        if known is None or state.t_s >= known.t_s:
            self.states[state.vehicle] = state

    def _on_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> None:
        if heartbeat.leading and heartbeat.term >= self.term:
            self.leader, self.incarnation = heartbeat.coordinator, heartbeat.incarnation
            self.term = heartbeat.term
        self.heartbeats[heartbeat.coordinator, heartbeat.incarnation] = heartbeat, now_s

    def _on_token(self, event: PeerUp | PeerDown) -> None:
        topic, parameters, up = event.topic, event.parameters, isinstance(event, PeerUp)
        if topic is COORDINATOR_ALIVE:
            process = Name(parameters["coordinator"]), incarnation_of(parameters)
            _update(self.coordinator_tokens, process, present=up)
            _update(self.departed, process, present=not up)
        elif topic is BRIDGE_ALIVE:
            _update(self.bridge_tokens, incarnation_of(parameters), present=up)
        elif topic is VEHICLE_ALIVE:
            _update(self.agent_tokens, Name(parameters["vehicle"]), present=up)


def _update(members: set[Any], member: object, *, present: bool) -> None:
    (members.add if present else members.discard)(member)
