"""The plant: how a vehicle really moves, whatever its agent asks for.

A vehicle is a triple integrator along and across the road (`protocol.motion`). The plant takes a
jerk for each tick, keeps it within the vehicle's limits, integrates exactly, and remembers the
extremes.
"""

from __future__ import annotations

from laneweave.protocol.motion import State, integrate, limited_jerk
from laneweave.protocol.scenario import Vehicle
from laneweave.sim_bridge.overlap import Pose, pose_of


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
        """Largest change of longitudinal acceleration in a tick, per second."""
        return self._max_jerk

    @property
    def min_accel_mps2(self) -> float:
        """Least longitudinal acceleration so far: the hardest braking."""
        return self._min_accel

    @property
    def max_accel_mps2(self) -> float:
        """Greatest longitudinal acceleration so far."""
        return self._max_accel

    def step(self, jerk_s: float, jerk_y: float) -> State:
        """Move on by one tick.

        Args:
            jerk_s: wanted longitudinal jerk [m/s3]; limited as `limited_jerk` does, NaN is 0.
            jerk_y: wanted lateral jerk [m/s3]; limited likewise.

        Returns:
            The new state.
        """
        before = self._state
        jerk = limited_jerk(before, (jerk_s, jerk_y), self._limits, self._tick_s)
        s, v, a, y, v_y, a_y = integrate(before, jerk, self._tick_s)
        # Rounding may leave a stopped vehicle rolling back by a hair.
        self._state = (s, max(v, 0.0), a, y, v_y, a_y)
        self._max_jerk = max(self._max_jerk, abs(a - before[2]) / self._tick_s)
        self._min_accel = min(self._min_accel, a)
        self._max_accel = max(self._max_accel, a)
        return self._state
