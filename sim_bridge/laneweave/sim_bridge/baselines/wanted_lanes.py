"""The lane that a vehicle of the rule-based method wants, and where it must have reached it.

A vehicle wants a lane of its exit, its preferred lane at the end of the road, or its own lane if it
has no preference. If its lane ends before that, as a dead end or at the exit of others, it wants
the nearest lane that is open beyond; of two, the one towards its goal, otherwise the left one. The
checks of scenarios ensure that it is open long enough before the end.
"""

from __future__ import annotations

from attrs import frozen

from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, LaneSection, end_exit
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import ReferenceVehicle


@frozen
class WantedLane:
    """The lane that a vehicle wants."""

    lane: int
    end_m: float
    """Where the vehicle must be in it: at the end of the road, of its present lane, or its exit."""
    stops: bool
    """Whether a vehicle in another lane must not drive on from there: its lane ends, or it would
    miss its exit."""


class WantedLanes:
    """The open parts of a road's lanes, and the lanes that vehicles want."""

    def __init__(self, scenario: Scenario) -> None:
        """Read the road."""
        road = scenario.road
        self._sections = [
            [section for section in scenario.geometry.sections if section.lane == lane]
            for lane in range(road.lanes)
        ]
        self._end_m = road.length_m
        self._length_m = scenario.vehicle.length_m

    def of(self, vehicle: ReferenceVehicle) -> WantedLane:
        """Return the lane that a vehicle wants."""
        lane, goal = vehicle.lane, self._goal(vehicle)
        own = self._section(lane, vehicle.s_m)
        if own is None or own.to_m >= goal.end_m:
            return goal
        open_beyond = (
            other for other in range(len(self._sections)) if self._section(other, own.to_m)
        )
        wanted = min(
            open_beyond,
            key=lambda other: (abs(other - lane), abs(other - goal.lane), -other),
            default=lane,
        )
        return WantedLane(wanted, own.to_m, stops=True)

    def may_enter(self, vehicle: ReferenceVehicle, lane: int) -> bool:
        """Return whether a vehicle can change into a lane beside it that leads on for it."""
        there, own = self._section(lane, vehicle.s_m), self._section(vehicle.lane, vehicle.s_m)
        rear_m = vehicle.s_m - self._length_m
        if there is None or rear_m < there.moves_from_m:
            return False
        if own is None:
            return True
        if rear_m < own.moves_from_m:
            return False
        leads_to_goal = there.serves(vehicle.preferred_lane, vehicle.destination)
        return leads_to_goal or there.to_m >= own.to_m

    def _goal(self, vehicle: ReferenceVehicle) -> WantedLane:
        """Return the lane in which a vehicle wants to leave the road, and where."""
        lane, preferred = vehicle.lane, vehicle.preferred_lane
        if vehicle.destination == END_OF_ROAD:
            goal = lane if preferred == ANY_LANE else preferred
            return WantedLane(goal, self._end_m, stops=False)
        exits = (
            section
            for sections in self._sections
            for section in sections
            if section.exit == vehicle.destination
        )
        nearest = min(exits, key=lambda section: abs(section.lane - lane))
        return WantedLane(nearest.lane, nearest.to_m, stops=nearest.lane != lane)

    def _section(self, lane: int, s_m: float) -> LaneSection | None:
        """Return the open part of a lane in which a body has room; None if there is none."""
        for section in self._sections[lane]:
            continues = s_m < section.to_m or section.exit == end_exit(lane)
            if section.from_m <= s_m - self._length_m and continues:
                return section
        return None
