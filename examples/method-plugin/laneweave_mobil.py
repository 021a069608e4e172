"""Lane changes by accelerations: a simple form of MOBIL (Kesting, Treiber and Helbing, 2007).

A vehicle changes to the next lane towards its preferred one if there is room, if no vehicle has to
brake harder than `safe_mps2`, and if its own deceleration, plus that of the vehicle behind times
`politeness`, is less than an incentive, which grows towards the end of the road. Everything else is
as in the method `rule`: car following, entering, and yielding to vehicles that find no gap.
"""

from __future__ import annotations

from laneweave.methods import Lanes, ReferenceVehicle, RuleMethod, Rules, Scenario, priority


class Mobil(RuleMethod):
    """The reference method: like `rule`, with the lane changes below."""

    def __init__(self, politeness: float = 0.2, safe_mps2: float = 3.0) -> None:
        """Set how much the deceleration of others counts, and its maximum [m/s2]."""
        self.politeness = politeness
        self.safe_mps2 = safe_mps2

    def rules(self, scenario: Scenario) -> Rules:
        """Return the rules for a run."""
        return MobilRules(scenario, self.politeness, self.safe_mps2)


POLITE = Mobil(politeness=1.0)


class MobilRules(Rules):
    """Rules of one run. `laneweave` calls `sort` once per tick, before the vehicles move."""

    def __init__(self, scenario: Scenario, politeness: float, safe_mps2: float) -> None:
        """Read the road."""
        super().__init__(scenario)
        self.politeness = politeness
        self.safe_mps2 = safe_mps2
        self.start_m, self.end_m = scenario.road.sorting_start_m, scenario.road.length_m
        self.tick_s = scenario.runtime.tick_s
        self.instantaneous = scenario.rule.lane_change_s == 0.0

    def sort(self, lanes: Lanes) -> dict[ReferenceVehicle, float]:
        """Begin lane changes; return the vehicles that slow down for others."""
        for vehicle in sorted((one for lane in lanes for one in lane), key=priority):
            if vehicle.previous_lane is not None or vehicle.s_m < self.start_m:
                continue  # changing already, or before the part of the road for lane changes
            wanted = self.wanted.of(vehicle).lane
            if wanted == vehicle.lane:
                continue
            lane = vehicle.lane + (1 if wanted > vehicle.lane else -1)
            if self.wanted.may_enter(vehicle, lane) and self.accepts(vehicle, lane, lanes):
                lanes.begin_change(vehicle, lane)
                if self.instantaneous:
                    lanes.end_change(vehicle)
        return super().sort(lanes)  # rules 2 and 3, for those that have found no gap

    def accepts(self, vehicle: ReferenceVehicle, lane: int, lanes: Lanes) -> bool:
        """Return whether the safety and the incentive criterion allow a lane change."""
        ahead, behind = lanes.neighbours(vehicle, lane)
        room_m = self.following.gap_m(0.0)  # between front bumpers, at standstill
        if any(one and abs(one.s_m - vehicle.s_m) < room_m for one in (ahead, behind)):
            return False
        own_mps2 = 0.0 if ahead is None else self.braking_mps2(vehicle, ahead)
        other_mps2 = 0.0 if behind is None else self.braking_mps2(behind, vehicle)
        done = (vehicle.s_m - self.start_m) / (self.end_m - self.start_m)
        incentive_mps2 = self.safe_mps2 * (0.2 + done)
        return (
            max(own_mps2, other_mps2) <= self.safe_mps2
            and own_mps2 + self.politeness * other_mps2 <= incentive_mps2
        )

    def braking_mps2(self, behind: ReferenceVehicle, ahead: ReferenceVehicle) -> float:
        """Return the deceleration with which a vehicle would have to follow another [m/s2]."""
        safe_mps = self.following.speed_mps(
            behind.s_m, behind.speed_mps, ahead.s_m, ahead.speed_mps
        )
        return max(0.0, behind.speed_mps - safe_mps) / self.tick_s
