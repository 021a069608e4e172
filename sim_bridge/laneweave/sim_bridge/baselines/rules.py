"""The rules of the rule-based method (paper, Section 5.2.2; decision 20 interprets it).

Rule 1. Vehicles drive at v_F: in S1 and S2 in their current lane, in S3 in their preferred lane.
Rule 2. A vehicle changes to the next lane towards the preferred one when the gaps there, to the
        vehicle ahead and to the vehicle behind, satisfy the constant time headway policy.
Rule 3. If a gap is too small, the vehicle with lower priority slows down. Its speed decreases
        towards the end of the road.

On roads with closed parts of lanes, ramps and exits, `wanted_lanes` defines the preferred lane. The
end of a lane, or the exit of a vehicle, counts as the end of the road for vehicles that must change
lanes before it.

Lane changes and speeds are pure functions of the positions.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from itertools import pairwise

from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import ReferenceVehicle
from laneweave.sim_bridge.baselines.wanted_lanes import WantedLanes


def priority(vehicle: ReferenceVehicle) -> tuple[float, str]:
    """Return the sort key: vehicles closer to the end of the road come first.

    Ties are broken by name; otherwise three vehicles side by side would wait for each other
    forever.
    """
    return -vehicle.s_m, vehicle.name


def safe_change_m(scenario: Scenario) -> float:
    """Return the length of a lane change at any speed, for those that must be complete in time."""
    change_m = scenario.formation.speed_mps * scenario.rule.lane_change_s
    slip_m = scenario.road.lane_width_m / scenario.vehicle.max_slip_ratio
    return max(change_m, slip_m) if change_m else 0.0


class Following:
    """Car following: gaps and speeds behind a vehicle ahead.

    Positions are those of front bumpers. Speeds are chosen from front to rear, so a follower knows
    the position of the vehicle ahead at the end of the tick. Both vehicles have constant
    acceleration during a tick.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Read the parameters from the tables `rule` and `vehicle`."""
        rule, vehicle = scenario.rule, scenario.vehicle
        self._standstill_m = rule.standstill_gap_m
        if rule.gap == "net":
            self._standstill_m += vehicle.length_m
        self._headway_s = rule.headway_s
        self._min_distance_m = vehicle.length_m + rule.min_gap_m
        self._braking_mps2 = -vehicle.min_accel_mps2
        self._tick_s = scenario.runtime.tick_s

    def gap_m(self, speed_mps: float) -> float:
        """Return the required gap d_R = d_0 + v tau, front to front, of a follower at speed v."""
        return max(self._standstill_m + self._headway_s * speed_mps, self._min_distance_m)

    def is_safe(
        self, s_m: float, speed_mps: float, ahead_s_m: float, ahead_speed_mps: float
    ) -> bool:
        """Return whether a vehicle may start following another: at least d_R behind, able to stop.

        Behind a much slower vehicle d_R alone is not sufficient.
        """
        if ahead_s_m - s_m < self.gap_m(speed_mps):
            return False
        return self.can_stop(s_m, speed_mps, ahead_s_m, ahead_speed_mps)

    def can_stop(
        self, s_m: float, speed_mps: float, ahead_s_m: float, ahead_speed_mps: float
    ) -> bool:
        """Return whether a vehicle can stop behind another if both brake with full deceleration.

        A lane change without this on both sides can end in an overlap.
        """
        stopping_m = (speed_mps**2 - ahead_speed_mps**2) / (2.0 * self._braking_mps2)
        return max(stopping_m, 0.0) <= ahead_s_m - s_m - self._min_distance_m

    def speed_mps(
        self, s_m: float, speed_mps: float, ahead_s_m: float, ahead_speed_mps: float
    ) -> float:
        """Return the highest safe speed of a follower at the end of a tick.

        The result is the lower of two speeds v', reached over the distance (v + v') / 2 dt:

        - the speed at which the gap is d_R at the end of the tick. If all vehicles keep d_R, speeds
          follow the speed ahead with a first-order lag of time constant tau;
        - the speed from which the follower can still stop behind the vehicle ahead if both brake
          with maximum deceleration. This is Krauss' condition for a follower that reacts within the
          tick.

        The position and speed of the follower are given for the beginning of the tick, those of the
        vehicle ahead for the end of the tick.
        """
        half_s, braking = 0.5 * self._tick_s, self._braking_mps2
        room_m = ahead_s_m - s_m - speed_mps * half_s
        keeping = (room_m - self._standstill_m) / (self._headway_s + half_s)
        braking_room_m = room_m - self._min_distance_m + ahead_speed_mps**2 / (2.0 * braking)
        if keeping <= 0.0 or braking_room_m <= 0.0:
            return 0.0
        slack = braking * half_s
        return min(keeping, math.sqrt(slack * slack + 2.0 * braking * braking_room_m) - slack)


class Lanes:
    """The vehicles in each lane by priority; during a lane change a vehicle is in two lanes."""

    def __init__(self, lanes: int) -> None:
        """Begin with an empty road."""
        self._lanes: list[list[ReferenceVehicle]] = [[] for _ in range(lanes)]

    def __getitem__(self, lane: int) -> Sequence[ReferenceVehicle]:
        """Return the vehicles in a lane, from front to rear."""
        return self._lanes[lane]

    def __iter__(self) -> Iterator[Sequence[ReferenceVehicle]]:
        """Yield the vehicles in each lane."""
        return iter(self._lanes)

    def neighbours(
        self, vehicle: ReferenceVehicle, lane: int
    ) -> tuple[ReferenceVehicle | None, ReferenceVehicle | None]:
        """Return the next vehicles ahead and behind in another lane."""
        there = self._lanes[lane]
        place = bisect_left(there, priority(vehicle), key=priority)
        return (
            there[place - 1] if place > 0 else None,
            there[place] if place < len(there) else None,
        )

    def enter(self, vehicle: ReferenceVehicle, lane: int) -> None:
        """Add a vehicle to a lane, at its position along the road."""
        there = self._lanes[lane]
        there.insert(bisect_left(there, priority(vehicle), key=priority), vehicle)

    def leave(self, vehicle: ReferenceVehicle) -> None:
        """Remove a vehicle from the road."""
        self.end_change(vehicle)
        self._lanes[vehicle.lane].remove(vehicle)

    def begin_change(self, vehicle: ReferenceVehicle, lane: int) -> None:
        """Begin a lane change; the vehicle is in both lanes until `end_change`."""
        self.enter(vehicle, lane)
        vehicle.previous_lane, vehicle.lane = vehicle.lane, lane

    def end_change(self, vehicle: ReferenceVehicle) -> None:
        """Remove a vehicle from its previous lane, if it is still there."""
        if vehicle.previous_lane is not None:
            self._lanes[vehicle.previous_lane].remove(vehicle)
            vehicle.previous_lane = None

    def leaders(self) -> dict[ReferenceVehicle, list[ReferenceVehicle]]:
        """Return the next vehicles ahead of each vehicle, one per lane that it occupies.

        During a lane change a vehicle follows both leaders: the nearer need not be the slower.
        """
        found: dict[ReferenceVehicle, list[ReferenceVehicle]] = {}
        for lane in self._lanes:
            for ahead, vehicle in pairwise(lane):
                found.setdefault(vehicle, []).append(ahead)
        return found


class Rules:
    """Lane changes and speeds by rules 1 to 3.

    Attributes:
        following: car following.
        wanted: the lanes that vehicles want.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Read the parameters from the tables `rule`, `road`, `formation` and `vehicle`."""
        self.following = Following(scenario)
        self.wanted = WantedLanes(scenario)
        rule, road = scenario.rule, scenario.road
        self._sorting_start_m = road.sorting_start_m
        self._sorting_m = road.s3_m
        self._end_m = road.length_m
        self._stop_m = rule.stop_distance_m
        self._speed_mps = scenario.formation.speed_mps
        self._all_yield = rule.yielding == "all"
        self._change_m = self._speed_mps * rule.lane_change_s
        self._safe_change_m = safe_change_m(scenario)

    def sort(self, lanes: Lanes) -> dict[ReferenceVehicle, float]:
        """Apply rules 2 and 3 to all vehicles off the lane that they want, by priority.

        A vehicle changes lanes if `accepts` allows it; otherwise those in `yielding` slow down. A
        lane change occupies the gap in the new lane at once.

        Returns:
            The vehicles that slow down, to let another vehicle in or to get in behind it, and the
            end [m] before which the lane change must be complete.
        """
        unsorted = sorted(
            (
                vehicle
                for lane in lanes
                for vehicle in lane
                if vehicle.previous_lane is None and vehicle.s_m >= self._sorting_start_m
            ),
            key=priority,
        )
        slowing: dict[ReferenceVehicle, float] = {}
        for vehicle in unsorted:
            wanted = self.wanted.of(vehicle)
            if wanted.lane == vehicle.lane:
                continue
            lane = vehicle.lane + (1 if wanted.lane > vehicle.lane else -1)
            if not self.wanted.may_enter(vehicle, lane):
                continue
            if self.accepts(vehicle, lane, lanes):
                lanes.begin_change(vehicle, lane)
                if self._change_m == 0.0:
                    lanes.end_change(vehicle)
                continue
            for one in self.yielding(vehicle, lane, lanes):
                slowing[one] = min(wanted.end_m, slowing.get(one, wanted.end_m))
        return slowing

    def accepts(self, vehicle: ReferenceVehicle, lane: int, lanes: Lanes) -> bool:
        """Return whether a vehicle may begin a change to the next lane now (rule 2).

        Every lane change is decided here. Methods with another criterion override this.
        """
        ahead, behind = lanes.neighbours(vehicle, lane)
        return self._suits(vehicle, ahead) and self._suits(behind, vehicle)

    def _suits(self, behind: ReferenceVehicle | None, ahead: ReferenceVehicle | None) -> bool:
        """Return whether a vehicle may follow another; either may be missing."""
        return (
            behind is None
            or ahead is None
            or self.following.is_safe(behind.s_m, behind.speed_mps, ahead.s_m, ahead.speed_mps)
        )

    def yielding(
        self, vehicle: ReferenceVehicle, lane: int, lanes: Lanes
    ) -> Iterator[ReferenceVehicle]:
        """Yield the vehicles that slow down until a vehicle can change to the next lane (rule 3).

        These are vehicles with too small a gap ahead, also if `accepts` has another criterion.
        """
        ahead, behind = lanes.neighbours(vehicle, lane)
        if not self._suits(vehicle, ahead):
            yield vehicle
        if behind is not None and not self._suits(behind, vehicle):
            # By rule 1, a vehicle that has finished continues at v_F, and the other one waits. A
            # vehicle that is still changing may be blocked by the other one in its old lane.
            yields = self._all_yield or not self.has_finished(behind)
            yield behind if yields else vehicle

    def has_finished(self, vehicle: ReferenceVehicle) -> bool:
        """Return whether a vehicle has completed all lane changes."""
        return vehicle.previous_lane is None and self.wanted.of(vehicle).lane == vehicle.lane

    def slow_speed_mps(self, s_m: float, end_m: float) -> float:
        """Return v_slow, the speed of a vehicle that slows down for others (rule 3).

        Args:
            s_m: its position.
            end_m: where the lane change for which it slows down must be complete.
        """
        beyond_stop_m = end_m - s_m - self._stop_m
        share = beyond_stop_m / (self._sorting_m - (self._end_m - end_m) - self._stop_m)
        return self._speed_mps * min(max(share, 0.0), 1.0)

    def approach_speed_mps(self, vehicle: ReferenceVehicle) -> float:
        """Return the maximum speed near the end of the road or lane: v_F in the lane it wants.

        In other lanes, the distance for the remaining lane changes is reserved before the end, and
        speed decreases linearly over the distance d_stop before that point. A yielding vehicle in
        the next lane stops farther back, so that a gap opens.
        """
        wanted = self.wanted.of(vehicle)
        remaining = abs(wanted.lane - vehicle.lane)
        if remaining == 0 and not wanted.stops:
            return self._speed_mps
        change_m = self._safe_change_m if wanted.stops else self._change_m
        left_m = wanted.end_m - vehicle.s_m - remaining * change_m
        return self._speed_mps * min(max(left_m / self._stop_m, 0.0), 1.0)
