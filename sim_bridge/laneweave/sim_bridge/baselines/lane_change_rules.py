"""The rules of the rule-based method (paper, Section 5.2.2; decision 20 says how they are read).

Rule 1. Vehicles drive at v_F on the lane on which they are in S1 and S2, and in S3 once they are
        on the lane that they prefer.
Rule 2. A vehicle changes to the next lane towards the preferred one when the gaps there, to the
        vehicle ahead and to the vehicle behind, satisfy the constant time headway policy.
Rule 3. When a gap is too small, the one of the two vehicles with lower priority slows down: the
        nearer to the end, the slower.

Everything here is pure: who is where goes in, lane changes and slow speeds come out.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from itertools import pairwise

from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.baselines.car_following import Following
from laneweave.sim_bridge.baselines.vehicle import Vehicle


def priority(vehicle: Vehicle) -> tuple[float, str]:
    """Return what vehicles are sorted by: who is closer to the end comes first, then by name.

    The name breaks ties. Without it three vehicles side by side wait for each other for ever.
    """
    return -vehicle.s_m, vehicle.name


class Lanes:
    """Who is on each lane, by priority; who changes lanes is on two."""

    def __init__(self, lanes: int) -> None:
        """Begin with an empty road."""
        self._lanes: list[list[Vehicle]] = [[] for _ in range(lanes)]

    def __getitem__(self, lane: int) -> Sequence[Vehicle]:
        """Return who is on a lane, from the front to the back."""
        return self._lanes[lane]

    def __iter__(self) -> Iterator[Sequence[Vehicle]]:
        """Yield lane by lane."""
        return iter(self._lanes)

    def around(self, vehicle: Vehicle, lane: int) -> tuple[Vehicle | None, Vehicle | None]:
        """Return who is next ahead and next behind on a lane on which a vehicle is not."""
        there = self._lanes[lane]
        place = bisect_left(there, priority(vehicle), key=priority)
        return (
            there[place - 1] if place > 0 else None,
            there[place] if place < len(there) else None,
        )

    def enter(self, vehicle: Vehicle, lane: int) -> None:
        """Put a vehicle on a lane, where it is along the road."""
        there = self._lanes[lane]
        there.insert(bisect_left(there, priority(vehicle), key=priority), vehicle)

    def leave(self, vehicle: Vehicle) -> None:
        """Take a vehicle off the road."""
        self.end_change(vehicle)
        self._lanes[vehicle.lane].remove(vehicle)

    def begin_change(self, vehicle: Vehicle, lane: int) -> None:
        """Let a vehicle change to a lane; it is on both until that ends."""
        self.enter(vehicle, lane)
        vehicle.previous_lane, vehicle.lane = vehicle.lane, lane

    def end_change(self, vehicle: Vehicle) -> None:
        """Take a vehicle off the lane from which it comes, if it is still there."""
        if vehicle.previous_lane is not None:
            self._lanes[vehicle.previous_lane].remove(vehicle)
            vehicle.previous_lane = None

    def leaders(self) -> dict[Vehicle, list[Vehicle]]:
        """Return the next one ahead of each vehicle, on each lane on which it is and has one.

        Who changes lanes follows two: the nearer one need not be the slower one.
        """
        found: dict[Vehicle, list[Vehicle]] = {}
        for lane in self._lanes:
            for ahead, vehicle in pairwise(lane):
                found.setdefault(vehicle, []).append(ahead)
        return found


class Rules:
    """What the rules say."""

    def __init__(self, scenario: Scenario) -> None:
        """Take the parameters from the tables `rule`, `road`, `formation` and `vehicle`."""
        self.following = Following(scenario)
        rule, road = scenario.rule, scenario.road
        self._sorting_start_m = road.sorting_start_m
        self._sorting_m = road.s3_m
        self._end_m = road.length_m
        self._stop_m = rule.stop_distance_m
        self._speed_mps = scenario.formation.speed_mps
        self._all_yield = rule.yielding == "all"
        self._change_m = self._speed_mps * rule.lane_change_s

    def sort(self, lanes: Lanes) -> set[Vehicle]:
        """Apply rules 2 and 3 to everybody who is not on its lane, by priority.

        Who begins to change lanes is on the new one at once, so nobody else takes the same gap.

        Returns:
            Who slows down, for another vehicle or to find a gap behind it.
        """
        unsorted = sorted(
            {
                vehicle
                for lane in lanes
                for vehicle in lane
                if vehicle.lane != vehicle.preferred_lane
                and vehicle.previous_lane is None
                and vehicle.s_m >= self._sorting_start_m
            },
            key=priority,
        )
        slowing: set[Vehicle] = set()
        for vehicle in unsorted:
            lane = self.next_lane(vehicle)
            hindered = list(self._hindered(vehicle, *lanes.around(vehicle, lane)))
            if not hindered:
                lanes.begin_change(vehicle, lane)
                if self._change_m == 0.0:
                    lanes.end_change(vehicle)
            slowing.update(hindered)
        return slowing

    def next_lane(self, vehicle: Vehicle) -> int:
        """Return the next lane towards the preferred one."""
        return vehicle.lane + (1 if vehicle.preferred_lane > vehicle.lane else -1)

    def _hindered(
        self, vehicle: Vehicle, ahead: Vehicle | None, behind: Vehicle | None
    ) -> Iterator[Vehicle]:
        """Yield who slows down so that a vehicle can change lanes; nobody: it can."""
        suits = self.following.suits
        if ahead is not None and not suits(
            vehicle.s_m, vehicle.speed_mps, ahead.s_m, ahead.speed_mps
        ):
            yield vehicle
        if behind is not None and not suits(
            behind.s_m, behind.speed_mps, vehicle.s_m, vehicle.speed_mps
        ):
            # By rule 1 who has finished goes on at v_F: then it is for the other one to wait.
            # Who is still changing has not: it may be stuck on its old lane behind the other one.
            yields = self._all_yield or not behind.finished
            yield behind if yields else vehicle

    def slow_speed_mps(self, s_m: float) -> float:
        """Return v_slow, the speed of somebody who slows down for others (rule 3)."""
        beyond_stop_m = self._end_m - s_m - self._stop_m
        share = beyond_stop_m / (self._sorting_m - self._stop_m)
        return self._speed_mps * min(max(share, 0.0), 1.0)

    def approach_speed_mps(self, vehicle: Vehicle) -> float:
        """Return the greatest speed with which somebody comes near the end: v_F on its lane.

        Who is not on its lane leaves room for the lane changes that are to come, and loses its
        speed over the distance d_stop before that in proportion: so it is slow when it is near,
        somebody beside it who gives way stops farther behind, and the gap opens.
        """
        to_come = abs(vehicle.preferred_lane - vehicle.lane)
        if to_come == 0:
            return self._speed_mps
        left_m = self._end_m - vehicle.s_m - to_come * self._change_m
        return self._speed_mps * min(max(left_m / self._stop_m, 0.0), 1.0)
