"""What an observer heard of a realm while it listened: the material of `status`."""

from __future__ import annotations

from typing import TypeVar

from attrs import define, field

from laneweave.launch.observe.observer import News
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.wire.messages import Census, Heartbeat, Name, RoadClock, VehicleState
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COORDINATOR_ALIVE,
    TOPICS,
    VEHICLE_ALIVE,
    Quality,
    incarnation_of,
)

HEARD = tuple(
    topic for topic in TOPICS if topic.kind is not None and topic.quality is Quality.LATEST
)
"""Topics that are listened to. Whoever sends one of the others waits for slow listeners: one who
only looks could hold everybody up."""
TOKENS = (COORDINATOR_ALIVE, VEHICLE_ALIVE, BRIDGE_ALIVE)
SETTLED_S = 1.0
"""A vehicle shows its state at each tick when it has been on the road for this long (road time)."""

T = TypeVar("T")
Process = tuple[str, int]
"""Name and incarnation of a coordinator."""


@define
class RoadTally:
    """What was heard of one road."""

    bridge: int = 0
    """Incarnation of its bridge; 0: not known."""
    first: RoadClock | None = None
    newest: RoadClock | None = None
    first_heard_s: float = 0.0
    newest_heard_s: float = 0.0
    census: Census | None = None
    ticks: set[int] = field(factory=set)
    """Of the clock messages."""
    states: dict[Name, VehicleState] = field(factory=dict)
    """The newest one of each vehicle."""
    shown_s: dict[Name, set[float]] = field(factory=dict)
    """Road times of the states of each vehicle."""

    def on_clock(self, clock: RoadClock, now_s: float) -> None:
        """Take a clock message."""
        self.ticks.add(clock.tick)
        if self.first is None or clock.tick < self.first.tick:
            self.first, self.first_heard_s = clock, now_s
        if self.newest is None or clock.tick >= self.newest.tick:
            self.newest, self.newest_heard_s = clock, now_s

    def on_state(self, state: VehicleState) -> None:
        """Take a vehicle's state."""
        self.shown_s.setdefault(state.vehicle, set()).add(state.t_s)
        known = self.states.get(state.vehicle)
        if known is None or state.t_s >= known.t_s:
            self.states[state.vehicle] = state

    @property
    def clock_loss(self) -> float | None:
        """Share of the clock's ticks that did not arrive; None: nothing was expected."""
        if len(self.ticks) < 2:
            return None
        expected = max(self.ticks) - min(self.ticks) + 1
        return 1.0 - len(self.ticks) / expected

    @property
    def state_loss(self) -> float | None:
        """Share of the expected states that did not arrive; None: none was expected.

        Expected is one state for each vehicle and tick: between the first and the last tick of the
        clock that were heard, those two not counted, since one may have been heard in part and
        answers to the other may be under way. Of a vehicle that enters meanwhile from the first
        that it shows on; of one that leaves up to the last that it has shown.
        """
        if self.first is None or self.newest is None or self.census is None or not self.newest.tick:
            return None
        tick_s = self.newest.t_s / self.newest.tick
        listed_tick = round(self.census.t_s / tick_s)
        on_road = {entry.vehicle: entry.entered_s for entry in self.census.on_road}
        missing = expected = 0
        for vehicle in on_road.keys() | self.shown_s.keys():
            shown = {round(t_s / tick_s) for t_s in self.shown_s.get(vehicle, ())}
            entered_s = on_road.get(vehicle)
            begin, end = self.first.tick + 1, self.newest.tick - 1
            if entered_s is None or entered_s > self.first.t_s - SETTLED_S:
                begin = max(begin, min(shown, default=end + 1))
            last = max(shown, default=-1)
            end = min(end, last if entered_s is None else max(last, listed_tick))
            expected += max(0, end - begin + 1)
            missing += max(0, end - begin + 1) - sum(begin <= tick <= end for tick in shown)
        return missing / expected if expected else None


@define
class Tally:
    """What was heard of a realm."""

    began_s: float
    """When listening began, on the clock of `now_s`."""
    linked: bool = True
    """Whether the observer is connected."""
    counts: dict[str, int] = field(factory=dict)
    """Messages by topic."""
    heartbeats: dict[Process, tuple[Heartbeat, float]] = field(factory=dict)
    """The newest one of each process, and when it was heard."""
    candidates: set[Process] = field(factory=set)
    """Coordinators whose tokens are there."""
    gone: set[Process] = field(factory=set)
    """Coordinators whose tokens have vanished."""
    agents: set[str] = field(factory=set)
    """Vehicles whose agents' tokens are there."""
    bridges: set[int] = field(factory=set)
    """Incarnations of bridges whose tokens are there."""
    road: RoadTally = field(factory=RoadTally)

    def take(self, news: News, now_s: float) -> None:
        """Take note of what was heard."""
        match news:
            case Arrived(topic, _, message):
                self.counts[topic.name] = self.counts.get(topic.name, 0) + 1
                self._on_message(message, now_s)
            case PeerUp() | PeerDown():
                self._on_token(news, up=isinstance(news, PeerUp))
            case LinkUp() | LinkDown():
                self.linked = isinstance(news, LinkUp)

    def _on_message(self, message: object, now_s: float) -> None:
        match message:
            case Heartbeat():
                self.heartbeats[message.coordinator, message.incarnation] = message, now_s
            case RoadClock() if self._is_of_this_road(message.bridge):
                self.road.on_clock(message, now_s)
            case Census() if self._is_of_this_road(message.bridge):
                if self.road.census is None or message.t_s >= self.road.census.t_s:
                    self.road.census = message
            case VehicleState():
                self.road.on_state(message)
            case _:
                pass

    def _is_of_this_road(self, bridge: int) -> bool:
        """Tell whether news is of the newest road; with a newer one everything begins anew."""
        if bridge > self.road.bridge:
            # What was heard of vehicles before the first clock is of the same road, most likely.
            known = self.road.bridge != 0
            self.road = RoadTally(bridge) if known else self._named(bridge)
        return bridge in (0, self.road.bridge)

    def _named(self, bridge: int) -> RoadTally:
        self.road.bridge = bridge
        return self.road

    def _on_token(self, news: PeerUp | PeerDown, *, up: bool) -> None:
        topic, parameters = news.topic, news.parameters
        if topic is COORDINATOR_ALIVE:
            process = parameters["coordinator"], incarnation_of(parameters)
            _note(self.candidates, process, there=up)
            _note(self.gone, process, there=not up)
        elif topic is BRIDGE_ALIVE:
            _note(self.bridges, incarnation_of(parameters), there=up)
        elif topic is VEHICLE_ALIVE:
            _note(self.agents, parameters["vehicle"], there=up)


def _note(known: set[T], one: T, *, there: bool) -> None:
    (known.add if there else known.discard)(one)
