"""Rooms: what the vehicle's limits leave beside a reference.

A reference has the same rooms whatever the road clock shows, so they are laid out once for all of
it, and each tick takes its part (`Reference.window`). The fast path of the tracker compares with
them.
"""

from __future__ import annotations

import numpy as np
from attrs import define
from numpy.typing import NDArray

from laneweave.protocol.scenario.tables import Vehicle

Array = NDArray[np.float64]

SPEED_PLAY_MPS = 0.3
SLIP_PLAY_MPS = 0.1
"""Play of OSQP's prediction near standstill. The fast path has none."""


@define(eq=False)
class Rooms:
    """Least and greatest errors beside a reference with which no limit is exceeded, for n ticks."""

    low: Array
    """(5, n): of v, a, a_y, v_y - slip v and v_y + slip v; -inf for none."""
    high: Array
    """Likewise; +inf for none."""
    low_jerk: Array
    """(n, 2)."""
    high_jerk: Array

    @classmethod
    def beside(cls, states: Array, jerks: Array, limits: Vehicle) -> Rooms:
        """Return the rooms beside states (n, 6) and jerks (n, 2).

        The play is added and taken off again, which is not the same to the last bit: these are the
        bounds that OSQP would be given, without it.
        """
        _, speed, accel, _, slip, lateral_accel = states.T
        low, high = np.full((5, len(states)), -np.inf), np.full((5, len(states)), np.inf)
        low[0] = (-SPEED_PLAY_MPS - speed) + SPEED_PLAY_MPS
        high[0] = limits.max_speed_mps - speed
        low[1] = limits.min_accel_mps2 - accel
        high[1] = limits.max_accel_mps2 - accel
        low[2] = -limits.max_lateral_accel_mps2 - lateral_accel
        high[2] = limits.max_lateral_accel_mps2 - lateral_accel
        room = limits.max_slip_ratio * speed + SLIP_PLAY_MPS
        high[3] = (room - slip) - SLIP_PLAY_MPS
        low[4] = -(room + slip) + SLIP_PLAY_MPS
        most = np.array([limits.max_jerk_mps3, limits.max_lateral_jerk_mps3])
        return cls(low, high, -(most + jerks), most - jerks)

    def part(self, first: int, end: int) -> Rooms:
        """Return the rooms of ticks `first` to `end`, without the latter."""
        return Rooms(
            self.low[:, first:end],
            self.high[:, first:end],
            self.low_jerk[first:end],
            self.high_jerk[first:end],
        )
