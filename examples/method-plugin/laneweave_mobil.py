"""Lane changes by accelerations: a simple form of MOBIL (Kesting, Treiber and Helbing, 2007).

A vehicle changes to the next lane towards its preferred one if all can still stop, if no vehicle
has to brake harder than `safe_mps2`, and if its own deceleration, plus that of the vehicle behind
times `politeness`, is at most an incentive, which grows towards the end of the road. Everything
else is as in the method `rule`: car following, entering, and yielding to vehicles that find no gap.
"""

from __future__ import annotations

import math

from laneweave.methods import Lanes, ReferenceVehicle, RuleMethod, Rules, Scenario

RESPONSE_S = 1.0
"""Time in which a vehicle would adapt its speed to a new vehicle ahead."""


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
    """Rules of one run. `laneweave` calls `accepts` for every lane change that a vehicle wants."""

    def __init__(self, scenario: Scenario, politeness: float, safe_mps2: float) -> None:
        """Read the road."""
        super().__init__(scenario)
        self.politeness = politeness
        self.safe_mps2 = safe_mps2
        self.start_m, self.end_m = scenario.road.sorting_start_m, scenario.road.length_m
        self.tick_s = scenario.runtime.tick_s

    def accepts(self, vehicle: ReferenceVehicle, lane: int, lanes: Lanes) -> bool:
        """Return whether the safety and the incentive criterion allow a lane change."""
        ahead, behind = lanes.neighbours(vehicle, lane)
        own_mps2 = 0.0 if ahead is None else self.braking_mps2(vehicle, ahead)
        other_mps2 = 0.0 if behind is None else self.braking_mps2(behind, vehicle)
        done = (vehicle.s_m - self.start_m) / (self.end_m - self.start_m)
        incentive_mps2 = self.safe_mps2 * (0.2 + done)
        return (
            max(own_mps2, other_mps2) <= self.safe_mps2
            and own_mps2 + self.politeness * other_mps2 <= incentive_mps2
        )

    def braking_mps2(self, behind: ReferenceVehicle, ahead: ReferenceVehicle) -> float:
        """Return the deceleration with which a vehicle would begin to follow another [m/s2].

        It is infinite if the vehicle might be unable to stop.
        """
        positions = behind.s_m, behind.speed_mps, ahead.s_m, ahead.speed_mps
        if not self.following.can_stop(*positions):
            return math.inf
        next_s_m = ahead.s_m + ahead.speed_mps * self.tick_s
        safe_mps = self.following.speed_mps(behind.s_m, behind.speed_mps, next_s_m, ahead.speed_mps)
        return max(0.0, behind.speed_mps - safe_mps) / RESPONSE_S
