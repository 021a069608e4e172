"""Room at the exits: which vehicles wait before the corridor because of queues behind exits.

A vehicle whose exit is full would stop in the corridor, beside the exit, and so would all vehicles
behind it. So a vehicle that departs at the start enters only if there will be room for it, and for
all vehicles on the way to the same exit, between the exit and the tail of the queue, after they
have braked. The queue is expected to move no further: a vehicle needs up to a minute to the exit,
and a traffic light may be red for longer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from attrs import frozen

from laneweave.protocol.road_layout import END_OF_ROAD, LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.road.demand import Arrival

SEEN_BEYOND_M = 200.0
"""Distance behind an exit up to which SUMO's vehicles are seen."""
QUEUEING_MPS = 3.0
"""Speed below which vehicles are in a queue."""
QUEUE_DECEL_MPS2 = 3.0
"""Deceleration with which vehicles brake for a queue."""
SPACE_M = 2.5
"""Net gap in a queue, SUMO's default."""
HELD_ANNOUNCED = 4
"""Maximum number of vehicles for each exit that are announced while they are held back."""


@frozen
class _Way:
    """A lane that leads to an exit."""

    lane: int
    exit_m: float
    inside_m: float
    """Length of the part before the exit in which vehicles may brake, after they changed lanes."""

    def queue(self, others: Iterable[OtherBody]) -> tuple[float, int]:
        """Return the distance of the queue's tail from the exit, and how many drive towards it.

        If there is no queue, the distance is infinite.
        """
        own = [one for one in others if (one.lane, one.exit_m) == (self.lane, self.exit_m)]
        standing_m = (one.rear_m for one in own if one.speed_mps < QUEUEING_MPS)
        tail_m = min(standing_m, default=math.inf)
        return tail_m - self.exit_m, sum(one.rear_m < tail_m for one in own)


class ExitRoom:
    """Holds vehicles at the start back while their exits have no room for them."""

    def __init__(self, scenario: Scenario) -> None:
        """Read the exits of a road."""
        self._braking_m = scenario.formation.speed_mps**2 / (2.0 * QUEUE_DECEL_MPS2)
        self._place_m = scenario.types.longest_body_m + SPACE_M
        self._held: list[Arrival] = []
        """Vehicles whose exits have no room."""
        self._was_held = Counter[str]()
        """Their number by exit, at the last call."""
        step_m = scenario.types.step_m
        self._ways: dict[str, list[_Way]] = {one.name: [] for one in scenario.exit}
        for section in scenario.geometry.sections:
            if section.exit in self._ways:
                way = _Way(section.lane, section.to_m, _inside_m(section, step_m))
                self._ways[section.exit].append(way)

    def release(
        self,
        coming: Sequence[Arrival],
        ahead: Iterable[Arrival],
        others: Callable[[], Sequence[OtherBody]],
    ) -> Sequence[Arrival]:
        """Return which vehicles at the start may enter; see `OutsideTraffic.release`.

        `others` returns the bodies on the road and behind its exits.
        """
        held = [*self._held, *coming]
        if not held:
            return ()
        going = Counter(one.destination for one in ahead)
        waiting, released = Counter[str](), []
        self._held.clear()
        for arrival in held:
            to = arrival.destination
            if not waiting[to] and self.has_room(to, going[to], self._was_held[to], others()):
                going[to] += 1
                released.append(arrival)
            else:
                waiting[to] += 1
                self._held.append(arrival)
        self._was_held = waiting
        return released

    @property
    def announced(self) -> Sequence[Arrival]:
        """The first vehicles that are held back for each exit."""
        by_exit: dict[str, list[Arrival]] = {}
        for arrival in self._held:
            by_exit.setdefault(arrival.destination, []).append(arrival)
        return [one for held in by_exit.values() for one in held[:HELD_ANNOUNCED]]

    def has_room(
        self, destination: str, going: int, waiting: int, others: Sequence[OtherBody]
    ) -> bool:
        """Return whether another vehicle may enter.

        Args:
            destination: name of its exit, or `END_OF_ROAD`, which is not watched.
            going: number of vehicles that are on the way to the same exit.
            waiting: number of those that are held back.
            others: bodies on the road and behind its exits.
        """
        if destination == END_OF_ROAD:
            return True
        queues = [(way, *way.queue(others)) for way in self._ways[destination]]
        if not waiting and all(math.isinf(tail_m) for _, tail_m, _ in queues):
            return True
        if not going and any(tail_m >= 2.0 * self._place_m for _, tail_m, _ in queues):
            # A queue that always stands somewhere may still advance.
            return True
        return going + 1 <= sum(self._places(*queue) for queue in queues)

    def _places(self, way: _Way, tail_m: float, before: int) -> float:
        """Return the number of vehicles on the way that fit behind a queue; see `_Way.queue`."""
        if math.isinf(tail_m):
            # The queue may be back before all vehicles that have waited are at the exit.
            room_m = SEEN_BEYOND_M
        else:
            # They may brake in the lane of the exit, but stand behind it. One place remains free,
            # since vehicles brake earlier than they have to.
            braking_m = max(0.0, self._braking_m - way.inside_m)
            room_m = tail_m - braking_m - self._place_m
        return max(0.0, room_m / self._place_m - before)


def _inside_m(section: LaneSection, step_m: float) -> float:
    """Return how far before its end vehicles are in the lane of an exit, all moves completed."""
    begin_m = max(section.from_m, section.moves_from_m)
    return max(0.0, section.to_m - begin_m - step_m) if begin_m > 0.0 else 0.0
