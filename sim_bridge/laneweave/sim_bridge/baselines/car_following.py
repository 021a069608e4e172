"""Car following of the rule-based method: a constant time headway, and room to brake.

Positions are those of front bumpers. Whoever follows knows where the vehicle ahead will be at the
end of the tick, since speeds are chosen from the front to the back, and both move at constant
acceleration during a tick.
"""

from __future__ import annotations

import math

from laneweave.protocol.scenario.tables import Scenario


class Following:
    """Gaps and speeds of those who follow."""

    def __init__(self, scenario: Scenario) -> None:
        """Take the parameters from the tables `rule` and `vehicle`."""
        rule, vehicle = scenario.rule, scenario.vehicle
        self._standstill_m = rule.standstill_gap_m
        if rule.gap == "net":
            self._standstill_m += vehicle.length_m
        self._headway_s = rule.headway_s
        self._closest_m = vehicle.length_m + rule.min_gap_m
        self._braking_mps2 = -vehicle.min_accel_mps2
        self._tick_s = scenario.runtime.tick_s

    def gap_m(self, speed_mps: float) -> float:
        """Return the least gap at which somebody follows, d_R = d_0 + v tau, front to front.

        Args:
            speed_mps: v, of the follower.
        """
        return max(self._standstill_m + self._headway_s * speed_mps, self._closest_m)

    def suits(self, s_m: float, speed_mps: float, ahead_s_m: float, ahead_speed_mps: float) -> bool:
        """Tell whether somebody may begin to follow: d_R is there, and room to brake.

        d_R alone is not enough behind somebody who is much slower.
        """
        distance_m = ahead_s_m - s_m
        if distance_m < self.gap_m(speed_mps):
            return False
        stopping_m = (speed_mps**2 - ahead_speed_mps**2) / (2.0 * self._braking_mps2)
        return stopping_m <= distance_m - self._closest_m

    def speed_mps(
        self, s_m: float, speed_mps: float, ahead_s_m: float, ahead_speed_mps: float
    ) -> float:
        """Return the greatest speed at the end of a tick with which somebody follows.

        It is the lesser of two speeds, v' after the way (v + v') / 2 dt:

        - the one at which the gap is d_R at the end of the tick. Where everybody keeps d_R, speeds
          follow the speed ahead as a first-order lag of tau does, with no harder braking;
        - the one from which the follower can still stop behind the one ahead, if both brake as
          hard as they can from then on. This is Krauss' condition for a follower that reacts
          within the tick.

        Args:
            s_m: follower, at the beginning of the tick.
            speed_mps: its speed then.
            ahead_s_m: vehicle ahead, at the end of the tick.
            ahead_speed_mps: its speed then.
        """
        half_s, braking = 0.5 * self._tick_s, self._braking_mps2
        room_m = ahead_s_m - s_m - speed_mps * half_s
        keeping = (room_m - self._standstill_m) / (self._headway_s + half_s)
        braking_room_m = room_m - self._closest_m + ahead_speed_mps**2 / (2.0 * braking)
        if keeping <= 0.0 or braking_room_m <= 0.0:
            return 0.0
        slack = braking * half_s
        return min(keeping, math.sqrt(slack * slack + 2.0 * braking * braking_room_m) - slack)
