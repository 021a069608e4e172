"""Where vehicles that wait at dead ends can start, and into which lane.

A vehicle that waits at a stop line has the room that it needs in its own lane. One that could not
stop there waits between the line and a part of the lane that is closed for a time. It starts beside
the part once the lane is open, or, behind other vehicles, with the room up to them: slowly, and
into a longer gap (`re_entry_behind`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Protocol, Self

from attrs import evolve, frozen

from laneweave.protocol.road_layout import LanePosition, TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import (
    NEAR_LINE_M,
    LaneEnds,
    lanes_beside,
    sections_to_lines,
)
from laneweave.protocol.vehicle.re_entry import (
    ReEntry,
    own_re_entry,
    re_entry,
    re_entry_behind,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS
from laneweave.sim_bridge.road.vehicles_in_part import BodyOnRoad

ROOM_ERROR_M = 1.0
"""Margin for measurement errors: gaps are requested for this much less room than is measured."""
SOON_S = 30.0
"""Time in which a part will be open so soon that a vehicle behind others waits for it: the longer
gap that it would need costs vehicles in other lanes more."""


class ClosedParts(Protocol):
    """The causes of parts that are closed for a time; see `Obstacles`."""

    def still_closed(self, t_s: float) -> Sequence[TemporaryClosure]:
        """Return the parts whose cause is not over at a road time."""

    def without_vehicles(self, t_s: float) -> Sequence[TemporaryClosure]:
        """Return the parts from which all vehicles are kept out at a road time."""


class WaitingBody(BodyOnRoad, Protocol):
    """What matters of a vehicle that waits; see `RoadVehicle`."""

    controller: MotionController

    @property
    def body_lane(self) -> int:
        """Lane in which most of the body is."""


@frozen(eq=False)
class Waiting:
    """A vehicle that waits at a dead end."""

    vehicle: WaitingBody
    at: LanePosition
    """Lane and position of the dead end."""
    room_m: float
    """Distance to the vehicle ahead of it; inf: there is none."""

    @classmethod
    def of(cls, vehicle: WaitingBody, at: LanePosition) -> Self:
        """Return a vehicle with the distance that its sensors measure."""
        lanes, ahead = vehicle.lanes_used, vehicle.controller.neighbours.ahead
        gaps_m = (one.gap_m for one in ahead if one.lane in lanes)
        return cls(vehicle, at, min(gaps_m, default=math.inf))

    @property
    def s_m(self) -> float:
        """Position of its front."""
        return self.vehicle.state[0]

    @property
    def cautious(self) -> Waiting:
        """This vehicle with the room that it has at least, in spite of measurement errors."""
        return evolve(self, room_m=self.room_m - ROOM_ERROR_M)

    def behind(self, other: Waiting) -> Waiting:
        """Return this vehicle as it will wait when the one ahead of it has started."""
        return evolve(self, room_m=other.room_m + other.s_m - self.s_m)


class Restarts:
    """The dead ends of a road, and how vehicles that wait there start."""

    def __init__(self, scenario: Scenario, closed: ClosedParts, lane_ends: LaneEnds) -> None:
        """Derive where they start.

        Args:
            scenario: the road without obstacles.
            closed: causes of parts that are closed for a time.
            lane_ends: ends of lanes now.
        """
        self._scenario, self._closed = scenario, closed
        self.ends: dict[LanePosition, LaneEnd] = {(end.lane, end.end_m): end for end in lane_ends}
        """Dead ends by lane and position."""
        self.needed = re_entry(scenario) if self.ends else ReEntry(0.0, 0, 0.0)
        """What a vehicle at a stop line needs."""
        parts = lane_ends.temporary.closed
        self._sections = sections_to_lines(scenario, parts) if self.ends else ()

    def merged(self, at: LanePosition) -> LanePosition | None:
        """Return a dead end; if its part has merged into an earlier one, the end before that."""
        if at in self.ends:
            return at
        lane, end_m = at
        ends = (end for end in self.ends.values() if end.lane == lane)
        return next(((lane, end.end_m) for end in ends if end.end_m <= end_m < end.reopens_m), None)

    def end_ahead(self, lane: int, s_m: float) -> LanePosition | None:
        """Return the first dead end of a lane that a body has not passed, or else the last one."""
        ends = [at for at in self.ends if at[0] == lane]
        ahead = (at for at in ends if s_m < self.ends[at].reopens_m)
        return next(ahead, ends[-1] if ends else None)

    def may_start(self, one: Waiting, at_s: float) -> bool:
        """Return whether a vehicle that waits may start at a road time, and has room to start.

        One that has broken down may start in its own lane once it is repaired.
        """
        breaks_down = one.vehicle.controller.broken_mps2 is not None
        if breaks_down and one.vehicle.state[1] > STANDING_MPS:
            return False
        return self.starts_in_own_lane(one, at_s) or (
            not breaks_down and (self._is_before_line(one) or bool(self.lanes_beside(one, at_s)))
        )

    def is_beyond_line(self, one: Waiting, at_s: float) -> bool:
        """Return whether a vehicle waits between the line and a part that is closed."""
        return not self._is_before_line(one) and not self._is_open(one.at, one.s_m, at_s)

    def may_take(self, lane: int, columns: int, one: Waiting, at_s: float) -> bool:
        """Return whether a vehicle can start into a gap in a lane at a road time."""
        if lane == one.at[0]:
            return self.starts_in_own_lane(one, at_s)
        needed = self.needed_by(one, at_s)
        if needed is None or columns < needed.columns:
            return False
        # A longer gap is for a vehicle that starts slowly.
        fits = columns <= self.needed.columns or needed is not self.needed
        return fits and lane in self.lanes_beside(one, at_s)

    def starts_in_own_lane(self, one: Waiting, at_s: float) -> bool:
        """Return whether a vehicle may start in its own lane at a road time, from where it waits.

        The lane is open, and the vehicle settles before the line of the next dead end.
        """
        settles_m = max(self.ends[one.at].reopens_m, one.s_m) + self.needed.distance_m
        return self._is_open(one.at, one.s_m, at_s) and all(
            other.line_m >= settles_m for other in self._later(one)
        )

    def lanes_beside(self, one: Waiting, at_s: float) -> tuple[int, ...]:
        """Return the lanes into which a vehicle at a dead end can re-enter at a road time.

        It needs room in its own lane until it is out of it.
        """
        end, needed = self.ends[one.at], self.needed_by(one, at_s)
        if end.taken_back or needed is None:
            return ()
        starts_m = one.s_m
        if self._is_before_line(one):
            # Without a part that is closed for a time, it drives up to the line.
            starts_m = min(starts_m, end.line_m) if one.vehicle.controller.stays else end.line_m
        return lanes_beside(self._scenario, end.lane, starts_m, self._sections, needed)

    def needed_by(self, one: Waiting, at_s: float) -> ReEntry | None:
        """Return what a vehicle needs for re-entry into a lane beside it, from where it waits.

        None: at this road time, it has not enough room.
        """
        if self._is_before_line(one):
            return self.needed
        end, vehicle = self.ends[one.at], one.vehicle
        room_m = min((each.end_m for each in self._later(one)), default=math.inf) - one.s_m
        if self._is_open(one.at, one.s_m, at_s):
            if room_m >= self.needed.room_m:
                return self.needed
        elif end.end_m - one.s_m >= self.needed.room_m:
            return self.needed
        elif (
            vehicle.controller.broken_mps2 is not None
            or vehicle.state[1] > STANDING_MPS
            or self._is_open(one.at, one.s_m, at_s + SOON_S)
            or not self._only_vehicles_ahead(vehicle, at_s)
        ):
            return None
        room_m = min(room_m, one.room_m)
        if room_m >= 2.0 * self.needed.room_m:  # it need not keep its distance
            return self.needed
        limits = vehicle.controller.plant.limits
        return re_entry_behind(self._scenario, limits, math.floor(room_m))

    def into(self, lane: int, one: Waiting, at_s: float) -> tuple[ReEntry, bool]:
        """Return what a vehicle needs that starts into a lane, and whether it starts slowly.

        See `re_entry_behind`.
        """
        needed = None if lane == one.at[0] else self.needed_by(one, at_s)
        if needed is None or needed is self.needed:
            # Weak types need more columns than strong ones, which arrive earlier.
            return own_re_entry(self._scenario, one.vehicle.controller.plant.limits), False
        return needed, True

    def passable_lanes(self, vehicle: WaitingBody, at_s: float) -> list[int]:
        """Return the lanes of a body in which it can drive on beyond the next dead end.

        They are open, or only other vehicles, which it senses, keep it from driving.
        """
        s_m, only_vehicles = vehicle.state[0], self._only_vehicles_ahead(vehicle, at_s)

        def is_passable(at: LanePosition) -> bool:
            end = self.ends[at]
            starts_slowly = end.sudden and end.end_m - s_m < self.needed.room_m
            return self._is_open(at, s_m, at_s) or (only_vehicles and starts_slowly)

        ahead = {lane: self.end_ahead(lane, s_m) for lane in vehicle.lanes_used}
        return [lane for lane, at in ahead.items() if at and is_passable(at)]

    def _is_open(self, at: LanePosition, s_m: float, at_s: float) -> bool:
        """Return whether a vehicle can drive on in its lane at a road time, beyond a dead end.

        The causes of all that is closed there are over, or its body is beyond.
        """
        end = self.ends[at]
        return s_m >= end.reopens_m or (
            end.sudden
            and not any(_is_ahead(part, end, s_m) for part in self._closed.still_closed(at_s))
        )

    def _only_vehicles_ahead(self, vehicle: WaitingBody, at_s: float) -> bool:
        """Return whether nothing but vehicles can be ahead of a body in its dead ends."""
        lanes, s_m = vehicle.lanes_used, vehicle.state[0]
        ends = [self.ends[at] for lane in lanes if (at := self.end_ahead(lane, s_m))]
        closed = self._closed.without_vehicles(at_s)
        return all(
            end.sudden and not any(_is_ahead(part, end, s_m) for part in closed) for end in ends
        )

    def _later(self, one: Waiting) -> Iterator[LaneEnd]:
        """Yield the dead ends of a lane after the one at which a vehicle waits, ahead of it."""
        end = self.ends[one.at]
        for other in self.ends.values():
            if other.lane == end.lane and other.end_m > end.end_m and one.s_m < other.reopens_m:
                yield other

    def _is_before_line(self, one: Waiting) -> bool:
        """Return whether a vehicle waits at the stop line before a dead end, or before it."""
        return one.s_m <= self.ends[one.at].line_m + NEAR_LINE_M


def _is_ahead(part: TemporaryClosure, end: LaneEnd, s_m: float) -> bool:
    """Return whether a part at a dead end is ahead of a body, or around it."""
    return part.lane == end.lane and s_m < part.to_m and part.from_m < end.reopens_m
