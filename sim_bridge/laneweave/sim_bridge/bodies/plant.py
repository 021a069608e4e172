"""The plant: how a vehicle really moves, whatever its agent asks for.

Along and across the road the set-point of acceleration changes by a jerk that is constant during a
tick, and the body's acceleration follows it as a first-order lag does (`protocol.motion`: the body
pursues a commanded state). The plant keeps the commanded state within the vehicle's limits, moves
both on exactly, and remembers the extremes.
"""

from __future__ import annotations

import math

from laneweave.protocol.scenario.tables import Vehicle
from laneweave.protocol.vehicle.motion import Jerk, State, commanded_state, integrate, limited_jerk
from laneweave.sim_bridge.bodies.footprints import Pose, pose_of

Axis = tuple[float, float, float]
"""(position [m], speed [m/s], acceleration [m/s2])."""


class Plant:
    """One vehicle's body: state, limits, and what its motion has demanded of it so far."""

    def __init__(self, state: State, limits: Vehicle, tick_s: float) -> None:
        """Start at a state, with set-points that are its accelerations.

        Args:
            state: (s, v, a, y, v_y, a_y) in m and s.
            limits: the vehicle's limits and lags.
            tick_s: length of a tick [s].
        """
        self._state = state
        self._setpoint = (state[2], state[5])
        self._limits = limits
        # Looked up in each tick.
        self._lag_s, self._lag_y_s = limits.actuator_lag_s, limits.lateral_actuator_lag_s
        self._slip_ratio = limits.max_slip_ratio
        self._tick_s = tick_s
        self._rest = _rest(tick_s, limits.actuator_lag_s)
        self._rest_y = _rest(tick_s, limits.lateral_actuator_lag_s)
        self._braking = False
        self._max_jerk = 0.0
        self._min_accel = self._max_accel = state[2]

    @property
    def state(self) -> State:
        """(s, v, a, y, v_y, a_y) in m and s."""
        return self._state

    @property
    def setpoint(self) -> tuple[float, float]:
        """Accelerations that its actuators were told, along and across [m/s2]."""
        return self._setpoint

    @property
    def pose(self) -> Pose:
        """(s m, y m, heading rad, speed m/s)."""
        return pose_of(self.state)

    @property
    def in_emergency(self) -> bool:
        """Whether it brakes past the jerk limit, or has not recovered from that."""
        return self._braking

    @property
    def max_jerk_mps3(self) -> float:
        """Largest change of longitudinal acceleration in a tick, per second, but in emergencies."""
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
        commanded = commanded_state(self._state, self._setpoint, self._limits, 0.0)
        before = self._state[2]
        self._move(commanded, limited_jerk(commanded, (jerk_s, jerk_y), self._limits, self._tick_s))
        if self._braking:
            self._braking = self._lags_behind()
        else:
            change = abs(self._state[2] - before) / self._tick_s
            if change > self._max_jerk:
                self._max_jerk = change
        return self._state

    def brake(self, jerk_y: float) -> State:
        """Brake as hard as the vehicle can for one tick, past the limit on jerk.

        Args:
            jerk_y: wanted lateral jerk [m/s3]; limited as `limited_jerk` does.

        Returns:
            The new state.
        """
        self._braking = True
        s, v, _, y, v_y, a_y = commanded_state(self._state, self._setpoint, self._limits, 0.0)
        # The commanded state stands still first, and the body comes to rest behind it.
        accel = max(self._limits.min_accel_mps2, -v / self._tick_s)
        now = (s, v, accel, y, v_y, a_y)
        _, allowed_y = limited_jerk(now, (0.0, jerk_y), self._limits, self._tick_s)
        self._move(now, (0.0, allowed_y))
        if v + accel * self._tick_s <= 1e-9:
            self._setpoint = (0.0, self._setpoint[1])
        return self._state

    def _lags_behind(self) -> bool:
        """Tell whether the body's acceleration changes faster than the jerk limit allows."""
        most = self._limits.max_jerk_mps3 * self._limits.actuator_lag_s
        return abs(self._setpoint[0] - self._state[2]) > most + 1e-6

    def _move(self, commanded: State, jerk: Jerk) -> None:
        """Move on from a commanded state whose frame stands on the road."""
        from_s, from_v, from_a, from_y, from_vy, from_ay = commanded
        to_s, to_v, to_a, to_y, to_vy, to_ay = integrate(commanded, jerk, self._tick_s)
        s, v, a, y, v_y, a_y = self._state
        next_s, next_v, a = _follow(
            (s, v, a),
            (from_s, from_v, from_a),
            (to_s, to_v, to_a),
            jerk[0],
            self._lag_s,
            self._rest,
        )
        y, v_y, a_y = _follow(
            (y, v_y, a_y),
            (from_y, from_vy, from_ay),
            (to_y, to_vy, to_ay),
            jerk[1],
            self._lag_y_s,
            self._rest_y,
        )
        # Brakes hold a body, they do not push it back: not when they are released just before it
        # stands still, nor by rounding.
        next_s, next_v = max(next_s, s), max(next_v, 0.0)
        slip = self._slip_ratio * next_v
        if abs(v_y) > slip:
            # A body does not slide sideways, though its axes lag differently; here the limit on
            # lateral jerk gives way.
            v_y, a_y, to_ay = math.copysign(slip, v_y), 0.0, 0.0
        self._state = (next_s, next_v, a, y, v_y, a_y)
        self._setpoint = (to_a, to_ay)
        if a < self._min_accel:
            self._min_accel = a
        if a > self._max_accel:
            self._max_accel = a


def _follow(
    body: Axis, commanded: Axis, then: Axis, jerk: float, lag_s: float, rest: float
) -> Axis:
    """Return a body's axis after a tick in which its commanded axis goes on with constant jerk.

    The commanded position is a cubic in time, so the body's is another cubic, which follows it,
    and what it was off that cubic dies away, up to a `rest`.
    """
    if lag_s <= 0.0:
        return then
    # Both ends of that cubic, which is a lag behind in position, speed and acceleration.
    s, v, a = commanded
    begin_a = a - lag_s * jerk
    begin_v = v - lag_s * begin_a
    end_s, end_v, end_a = then
    end_a -= lag_s * jerk
    end_v -= lag_s * end_a
    end_s -= lag_s * end_v
    body_s, body_v, body_a = body
    return (
        end_s + (body_s - (s - lag_s * begin_v)) * rest,
        end_v + (body_v - begin_v) * rest,
        end_a + (body_a - begin_a) * rest,
    )


def _rest(tick_s: float, lag_s: float) -> float:
    """Return the share of a deviation that is left after a tick."""
    return math.exp(-tick_s / lag_s) if lag_s > 0.0 else 0.0
