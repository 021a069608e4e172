"""The plant: how a vehicle really moves, whatever its agent asks for.

A vehicle is a triple integrator along and across the road (`protocol.motion`). The plant takes a
jerk for each tick, keeps it within the vehicle's limits, integrates exactly, and remembers the
extremes. The emergency brake is the one thing that bypasses the jerk limit: braking that builds up
over most of a second comes too late.
"""

from __future__ import annotations

import math

from laneweave.protocol.motion import State, integrate, limited_jerk
from laneweave.protocol.scenario import Vehicle
from laneweave.sim_bridge.overlap import Pose, pose_of

_ROUNDING_MPS = 1e-9


class Plant:
    """One vehicle's body: state, limits, and what its motion has demanded of it so far."""

    def __init__(self, state: State, limits: Vehicle, tick_s: float) -> None:
        """Start at a state.

        Args:
            state: (s, v, a, y, v_y, a_y) in m and s.
            limits: the vehicle's limits.
            tick_s: length of a tick [s].
        """
        self._state = state
        self._limits = limits
        self._tick_s = tick_s
        self._braked = False
        self._max_jerk = 0.0
        self._min_accel = self._max_accel = state[2]

    @property
    def state(self) -> State:
        """(s, v, a, y, v_y, a_y) in m and s."""
        return self._state

    @property
    def pose(self) -> Pose:
        """(s m, y m, heading rad, speed m/s)."""
        return pose_of(self._state)

    @property
    def max_jerk_mps3(self) -> float:
        """Largest change of longitudinal acceleration in a tick, per second; braking included."""
        return self._max_jerk

    @property
    def min_accel_mps2(self) -> float:
        """Least longitudinal acceleration so far: the hardest braking."""
        return self._min_accel

    @property
    def max_accel_mps2(self) -> float:
        """Greatest longitudinal acceleration so far."""
        return self._max_accel

    def step(self, jerk_s: float, jerk_y: float, *, brake: bool = False) -> State:
        """Move on by one tick.

        Args:
            jerk_s: wanted longitudinal jerk [m/s3]; limited as `limited_jerk` does, NaN is 0.
            jerk_y: wanted lateral jerk [m/s3]; limited likewise.
            brake: emergency brake: full braking throughout the tick instead of `jerk_s`, down to
                standstill; the jerk limit does not hold.

        Returns:
            The new state.
        """
        before = self._state
        s, v, a, y, v_y, a_y = before
        limits, tick_s = self._limits, self._tick_s
        if brake:
            a = max(limits.min_accel_mps2, -v / tick_s)
        elif self._braked:
            # Released: from here the jerk limit is enough to come to rest without rolling back.
            a = max(a, -math.sqrt(2.0 * limits.max_jerk_mps3 * max(v, 0.0)))
        state = (s, v, a, y, v_y, a_y)
        j_s, j_y = limited_jerk(state, (jerk_s, jerk_y), limits, tick_s)
        self._state = self._rolling(state, integrate(state, (0.0 if brake else j_s, j_y), tick_s))
        self._braked = brake
        accel = self._state[2]
        self._max_jerk = max(self._max_jerk, abs(accel - before[2]) / self._tick_s)
        self._min_accel = min(self._min_accel, accel)
        self._max_accel = max(self._max_accel, accel)
        return self._state

    def _rolling(self, before: State, after: State) -> State:
        """Return the state after a tick with the wheels rolling: neither backwards nor sideways.

        `limited_jerk` sees to that but for rounding, except after an emergency brake, when lateral
        limits can be too tight to follow the forward speed; the lateral acceleration jumps then.
        A body that slid sideways at standstill would point across the road.
        """
        s, v, a, y, v_y, a_y = after
        v = max(v, 0.0)
        most = self._limits.max_slip_ratio * v
        if abs(v_y) <= most:
            return (s, v, a, y, v_y, a_y)
        wanted = math.copysign(most, v_y)
        if abs(v_y) - most > _ROUNDING_MPS:
            a_y = (wanted - before[4]) / self._tick_s
            y = before[3] + 0.5 * (before[4] + wanted) * self._tick_s
        return (s, v, a, y, wanted, a_y)
