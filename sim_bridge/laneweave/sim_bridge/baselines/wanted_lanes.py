"""The lane that a vehicle of the rule-based method wants, and where it must have reached it.

A vehicle wants its preferred lane, or its own lane if it has no preference. If its lane has a dead
end ahead, it wants the nearest lane that is open beyond the dead end; of two, the one towards its
preferred lane, otherwise the left one. The checks of scenarios ensure that it is a neighbouring
lane, open long enough before the dead end.
"""

from __future__ import annotations

from attrs import frozen

from laneweave.protocol.road_layout import ANY_LANE, LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import ReferenceVehicle


@frozen
class WantedLane:
    """The lane that a vehicle wants."""

    lane: int
    end_m: float
    """Where the vehicle must be in this lane: at the end of the road or of a lane."""
    dead_end: bool
    """Whether a lane ends there."""


class WantedLanes:
    """The open parts of a road's lanes, and the lanes that vehicles want."""

    def __init__(self, scenario: Scenario) -> None:
        """Read the road."""
        road = scenario.road
        self._sections = [
            [section for section in scenario.sections if section.lane == lane]
            for lane in range(road.lanes)
        ]
        self._end_m = road.length_m
        self._length_m = scenario.vehicle.length_m

    def of(self, vehicle: ReferenceVehicle) -> WantedLane:
        """Return the lane that a vehicle wants."""
        lane, preferred = vehicle.lane, vehicle.preferred_lane
        if preferred == ANY_LANE:
            preferred = lane
        own = self._section(lane, vehicle.s_m)
        if own is None or own.exit:
            return WantedLane(preferred, self._end_m, dead_end=False)
        open_beyond = (
            other for other in range(len(self._sections)) if self._section(other, own.to_m)
        )
        wanted = min(
            open_beyond,
            key=lambda other: (abs(other - lane), abs(other - preferred), -other),
            default=lane,
        )
        return WantedLane(wanted, own.to_m, dead_end=True)

    def may_enter(self, vehicle: ReferenceVehicle, lane: int) -> bool:
        """Return whether a lane is open beside a vehicle, and does not end before its own lane."""
        there, own = self._section(lane, vehicle.s_m), self._section(vehicle.lane, vehicle.s_m)
        return there is not None and (bool(there.exit) or own is None or there.to_m >= own.to_m)

    def _section(self, lane: int, s_m: float) -> LaneSection | None:
        """Return the open part of a lane in which a body has room; None if there is none."""
        for section in self._sections[lane]:
            if section.from_m <= s_m - self._length_m and (section.exit or s_m < section.to_m):
                return section
        return None
