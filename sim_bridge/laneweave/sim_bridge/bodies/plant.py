"""The plant: motion of a vehicle's body.

Along and across the road, the acceleration set-point changes with a jerk that is constant during a
tick, and the body's acceleration follows it with a first-order lag: the body follows a commanded
state (`protocol.vehicle.motion`). The plant keeps the commanded state within the vehicle's limits
and integrates both states exactly.
"""

from __future__ import annotations

import math

from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import Jerk, State, commanded_state, integrate, limited_jerk

Axis = tuple[float, float, float]
"""(position [m], speed [m/s], acceleration [m/s2])."""
PARKED_MPS = 0.05
"""Speed below which a vehicle stands that is to stand."""


class Plant:
    """State and actuator set-points of one vehicle's body."""

    def __init__(self, state: State, limits: Vehicle, tick_s: float) -> None:
        """Start at a state, with its accelerations as set-points."""
        self._state = state
        self._setpoint = (state[2], state[5])
        self.limits = limits
        # Used in each tick.
        self._lag_s, self._lag_y_s = limits.actuator_lag_s, limits.lateral_actuator_lag_s
        self._slip_ratio = limits.max_slip_ratio
        self._tick_s = tick_s
        self._decay = _decay(tick_s, limits.actuator_lag_s)
        self._decay_y = _decay(tick_s, limits.lateral_actuator_lag_s)

    @property
    def state(self) -> State:
        """(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""
        return self._state

    @property
    def setpoint(self) -> tuple[float, float]:
        """Acceleration set-points, along and across [m/s2]."""
        return self._setpoint

    def step(self, jerk_s: float, jerk_y: float, *, parks: bool = False) -> State:
        """Move by one tick with limited jerks [m/s3]; return the new state.

        `parks`: once it stands, the brake holds it, whatever the errors of measurement are.
        """
        if parks and self._state[1] < PARKED_MPS:
            return self.brake(jerk_y)
        commanded = commanded_state(self._state, self._setpoint, self.limits, 0.0)
        self._move(commanded, limited_jerk(commanded, (jerk_s, jerk_y), self.limits, self._tick_s))
        return self._state

    def brake(self, jerk_y: float) -> State:
        """Brake with maximum deceleration for one tick, beyond the limit on longitudinal jerk.

        The lateral jerk [m/s3] is limited. Returns the new state.
        """
        s, v, _, y, v_y, a_y = commanded_state(self._state, self._setpoint, self.limits, 0.0)
        # The commanded state stops before the body does.
        accel = max(self.limits.min_accel_mps2, -v / self._tick_s)
        now = (s, v, accel, y, v_y, a_y)
        _, allowed_y = limited_jerk(now, (0.0, jerk_y), self.limits, self._tick_s)
        self._move(now, (0.0, allowed_y))
        if v + accel * self._tick_s <= 1e-9:
            self._setpoint = (0.0, self._setpoint[1])
        return self._state

    def _move(self, commanded: State, jerk: Jerk) -> None:
        """Move by one tick from a commanded state in road coordinates."""
        from_s, from_v, from_a, from_y, from_vy, from_ay = commanded
        to_s, to_v, to_a, to_y, to_vy, to_ay = integrate(commanded, jerk, self._tick_s)
        s, v, a, y, v_y, a_y = self._state
        along, across = (from_s, from_v, from_a), (from_y, from_vy, from_ay)
        to_along, to_across = (to_s, to_v, to_a), (to_y, to_vy, to_ay)
        lag_s, lag_y_s = self._lag_s, self._lag_y_s
        next_s, next_v, a = _follow((s, v, a), along, to_along, jerk[0], lag_s, self._decay)
        y, v_y, a_y = _follow((y, v_y, a_y), across, to_across, jerk[1], lag_y_s, self._decay_y)
        # Neither braking nor rounding may move a body backwards.
        next_s, next_v = max(next_s, s), max(next_v, 0.0)
        slip = self._slip_ratio * next_v
        if abs(v_y) > slip:
            # Different lags must not make a body slide sideways; this overrides the limit on
            # lateral jerk.
            v_y, a_y, to_ay = math.copysign(slip, v_y), 0.0, 0.0
        self._state = (next_s, next_v, a, y, v_y, a_y)
        self._setpoint = (to_a, to_ay)


def _follow(
    body: Axis, commanded: Axis, then: Axis, jerk: float, lag_s: float, decay: float
) -> Axis:
    """Return one axis of a body after a tick in which the commanded state has constant jerk.

    The commanded position is a cubic in time. The body converges to another cubic; its deviation
    from this cubic decays by the factor `decay`.
    """
    if lag_s <= 0.0:
        return then
    # Both ends of the cubic to which the body converges.
    s, v, a = commanded
    begin_a = a - lag_s * jerk
    begin_v = v - lag_s * begin_a
    end_s, end_v, end_a = then
    end_a -= lag_s * jerk
    end_v -= lag_s * end_a
    end_s -= lag_s * end_v
    body_s, body_v, body_a = body
    return (
        end_s + (body_s - (s - lag_s * begin_v)) * decay,
        end_v + (body_v - begin_v) * decay,
        end_a + (body_a - begin_a) * decay,
    )


def _decay(tick_s: float, lag_s: float) -> float:
    """Return the factor by which a deviation decays in a tick."""
    return math.exp(-tick_s / lag_s) if lag_s > 0.0 else 0.0
