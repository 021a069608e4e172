"""The vehicles that want to enter the road: their number, their queues, their announcements.

Drawn vehicles wait at the entrances from their arrival on. Others may be driven to the entrances by
a simulator.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Protocol, TypeVar

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Announcement, Name, OffLattice
from laneweave.sim_bridge.road.demand import Arrival, count_until
from laneweave.sim_bridge.road.entry import TIME_TOLERANCE_S, Admission, EntryMeter


class OnRoad(Protocol):
    """A vehicle on the road, as the simulator of outside traffic needs to know it."""

    @property
    def arrival(self) -> Arrival:
        """Its arrival at the entrance."""

    @property
    def state(self) -> State:
        """Position, speed and acceleration of its body."""

    @property
    def body_lane(self) -> int:
        """Lane in which the centre of its body is."""

    @property
    def keeps_lane(self) -> bool:
        """Whether the body is in its lane, and no plan in force leads it out of its cell."""


OnRoadT = TypeVar("OnRoadT", bound=OnRoad)


class OutsideTraffic:
    """Vehicles that a simulator drives to the entrances; of this class itself, none."""

    @property
    def start_lanes(self) -> Sequence[int]:
        """Lanes to whose beginning vehicles come from upstream."""
        return ()

    @property
    def exhausted(self) -> bool:
        """Whether no more vehicles will come."""
        return True

    @property
    def never_came(self) -> Sequence[Arrival]:
        """The vehicles that were to come, and have not come near an entrance."""
        return ()

    def demanded(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that have become known since the last call."""
        del t_s
        return ()

    def announced(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that will enter soon, with the times at which they are expected."""
        del t_s
        return ()

    def release(self, coming: Sequence[Arrival], ahead: Iterable[Arrival]) -> Sequence[Arrival]:
        """Return which of the vehicles at the start may enter; the others wait for a later call.

        Args:
            coming: vehicles that have come to the start since the last call.
            ahead: vehicles that queue at the entrances or are on the road.
        """
        del ahead
        return coming

    def full_lanes(self, t_s: float) -> set[int]:
        """Return the lanes that no vehicle may enter at their start now.

        There, the numbers of lanes are those of entry points.
        """
        del t_s
        return set()

    def admit(self, t_s: float, meter: EntryMeter, occupied: Iterable[Cell]) -> list[Admission]:
        """Return the vehicles that have come to their entrances since the last call.

        Args:
            t_s: road time.
            meter: assigns cells.
            occupied: cells in which vehicles are, or to which they move.
        """
        del t_s, meter, occupied
        return []

    def given_back(self, vehicles: Iterable[OnRoadT]) -> Iterable[OnRoadT]:
        """Return the vehicles on the road that the simulator takes back before their exits."""
        del vehicles
        return ()

    def plans_end(self) -> tuple[OffLattice, ...]:
        """Return lanes with positions beyond which no plan may use them."""
        return ()

    def is_stuck(self, t_s: float, *, moving: bool) -> bool:
        """Return whether vehicles, of which some or none are `moving`, will not leave the road."""
        del t_s, moving
        return False


NO_OUTSIDE_TRAFFIC = OutsideTraffic()


class DemandQueue:
    """Arrivals by time: those so far are demanded, then queue at the meter; the next are announced.

    Vehicles of outside traffic count, too, but come to the meter by themselves.
    """

    def __init__(
        self,
        scenario: Scenario,
        arrivals: Sequence[Arrival],
        meter: EntryMeter,
        outside: OutsideTraffic,
    ) -> None:
        """Begin before the first arrival."""
        self._arrivals = arrivals
        self._meter = meter
        self._outside = outside
        self._entry_points = len(scenario.geometry.entry_points)
        self._announce_s = scenario.runtime.announce_s
        self._tick_s = scenario.runtime.tick_s
        ahead_s = self._announce_s + self._tick_s
        self._announced_each = math.ceil(ahead_s / scenario.formation.entry_spacing_s) + 1
        self._arrived = 0
        """Arrivals so far."""
        self._queued = 0
        self.demanded = 0
        """Arrivals so far, with outside traffic."""

    def newly_demanded(self, t_s: float) -> Sequence[Arrival]:
        """Return the arrivals since the last call."""
        first, self._arrived = self._arrived, count_until(self._arrivals, t_s + TIME_TOLERANCE_S)
        new = (*self._arrivals[first : self._arrived], *self._outside.demanded(t_s))
        self.demanded += len(new)
        return new

    def queue(self, t_s: float, on_road: Iterable[Arrival]) -> None:
        """Queue the vehicles that arrive before the next tick, since cells pass between ticks."""
        first, self._queued = self._queued, count_until(self._arrivals, t_s + self._tick_s)
        ahead = chain(self._meter.waiting, on_road)
        for arrival in self._outside.release(self._arrivals[first : self._queued], ahead):
            self._meter.demand(arrival)

    def exhausted(self, t_s: float) -> bool:
        """Return whether no vehicle waits or will arrive."""
        return (
            self._queued == len(self._arrivals)
            and not self._meter.waiting
            and self._outside.exhausted
            and (not self._arrivals or self._arrivals[-1].t_s <= t_s)
        )

    def announcements(self, t_s: float) -> tuple[Announcement, ...]:
        """Return the vehicles that may enter within `announce_s`."""
        room = [self._announced_each] * self._entry_points
        coming = [*self._outside.announced(t_s)]
        until = count_until(self._arrivals, t_s + self._announce_s)
        for arrival in (*self._meter.waiting, *self._arrivals[self._queued : until]):
            if room[arrival.entry_point] > 0:
                room[arrival.entry_point] -= 1
                coming.append(arrival)
        return tuple(
            announcement_of(arrival)
            for arrival in sorted(coming, key=lambda arrival: (arrival.t_s, arrival.vehicle))
        )


def announcement_of(arrival: Arrival) -> Announcement:
    """Return the announcement of an arrival."""
    return Announcement(
        vehicle=Name(arrival.vehicle),
        lane=arrival.lane,
        preferred_lane=arrival.preferred_lane,
        arrival_s=arrival.t_s,
    )
