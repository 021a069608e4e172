"""The emergency brake: decides from a vehicle's own sensors whether it must brake now.

At each tick, the vehicle compares two stopping points: that of the vehicle ahead under full braking
from now on, and its own under braking from the next tick on. If its own is behind the other, it
continues for one tick. Otherwise it brakes now, without a jerk limit, because jerk-limited braking
would be too late. By induction there is no impact (docs/SAFETY.md has the derivation, with
measurement errors).

A body that moves at v with acceleration a and brakes with b through a first-order lag L travels

    (v + L (a + b))^2 / (2 b)  -  L^2 (a + b)

until it stands still: the lag acts like an additional speed of L (a + b). Cells of length d_F and
moves of duration T_F are possible only up to some reaction time, which `config.motion_checks` and
`check_moves` of the agents check.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from laneweave.protocol.scenario.vehicle_tables import Braking, Sensing, Vehicle
from laneweave.protocol.wire.messages import Neighbour

ERROR_SIGMAS = 4.5
"""Measurement error that plans allow for, in standard deviations."""


def stopping_distance_m(
    speed_mps: float, accel_mps2: float, brake_mps2: float, lag_s: float
) -> float:
    """Return the distance that a body travels until it stands still, if it brakes from now on.

    Args:
        speed_mps: initial speed, >= 0.
        accel_mps2: initial acceleration.
        brake_mps2: commanded deceleration, > 0.
        lag_s: time constant with which the acceleration approaches the command.
    """
    change = accel_mps2 + brake_mps2
    gained = speed_mps + lag_s * change
    travelled = gained * gained / (2.0 * brake_mps2) - lag_s * lag_s * change
    # Near standstill the body stops before the lag has decayed; the second term is a lower bound.
    return max(travelled, speed_mps * speed_mps / (2.0 * brake_mps2))


def own_braking_mps2(limits: Vehicle, assumed: Braking) -> float:
    """Return the deceleration a vehicle assumes for itself: at most that of the vehicle ahead.

    With harder braking, the gap could reach its minimum before both vehicles have stopped.
    """
    return min(-limits.min_accel_mps2, assumed.lead_brake_mps2)


def lead_lag_s(limits: Vehicle, assumed: Braking) -> float:
    """Return the brake lag assumed for the vehicle ahead: at most the vehicle's own."""
    return min(assumed.lead_lag_s, limits.actuator_lag_s)


def lead_path_m(speed_mps: float, accel_mps2: float, brake_mps2: float, lag_s: float) -> float:
    """Return the minimum distance that a vehicle ahead travels if it brakes from now on."""
    # It may stop accelerating at once. Harder braking than assumed counts as the assumed braking.
    accel = min(max(accel_mps2, -brake_mps2), 0.0)
    return stopping_distance_m(max(speed_mps, 0.0), accel, brake_mps2, lag_s)


def spare_error_m(
    limits: Vehicle, assumed: Braking, noise: Sensing, speed_mps: float, lead_mps: float
) -> float:
    """Return the standard deviation of `EmergencyBrake.spare_m` that sensor errors cause.

    Args:
        limits: those of the vehicle.
        assumed: assumptions about the vehicle ahead.
        noise: measurement errors.
        speed_mps: speed of the vehicle.
        lead_mps: speed of the vehicle ahead.
    """
    own_mps2 = own_braking_mps2(limits, assumed)
    own_s = limits.actuator_lag_s + assumed.reaction_s + speed_mps / own_mps2
    other_s = lead_mps / assumed.lead_brake_mps2 + assumed.lead_lag_s
    return math.hypot(
        noise.gap_noise_m,
        noise.speed_noise_mps * own_s,
        noise.accel_noise_mps2 * limits.actuator_lag_s * own_s,
        noise.other_speed_noise_mps * other_s,
        noise.other_accel_noise_mps2 * assumed.lead_lag_s * other_s,
    )


def last_tick_m(brake_mps2: float, tick_s: float) -> float:
    """Return the maximum distance added by stopping only at the end of a tick.

    In its last tick a body brakes just hard enough to stand still at the end of the tick.
    """
    return brake_mps2 * tick_s * tick_s / 8.0


class EmergencyBrake:
    """Decides when a vehicle must brake, independently of its commands."""

    def __init__(self, limits: Vehicle, assumed: Braking, tick_s: float) -> None:
        """Take the limits of the vehicle, and assumptions about the vehicle ahead."""
        self._brake_mps2 = own_braking_mps2(limits, assumed)
        self._lag_s = limits.actuator_lag_s
        self._lead_brake_mps2, self._lead_lag_s = (
            assumed.lead_brake_mps2,
            lead_lag_s(limits, assumed),
        )
        self._tick_s = tick_s
        self._last_tick_m = last_tick_m(self._brake_mps2, self._tick_s)
        self._later_s = max(assumed.reaction_s - self._tick_s, 0.0)
        self._margin_m = assumed.margin_m

    def spare_m(
        self,
        state: Sequence[float],
        setpoint_mps2: float,
        jerk: tuple[float, float],
        others: Iterable[Neighbour],
    ) -> float:
        """Return the net gap that remains beyond the margin if all vehicles brake.

        Args:
            state: measured (s, v, a, y, v_y, a_y) of the body.
            setpoint_mps2: set-point of its acceleration along the road.
            jerk: jerk until the next tick, within the limits; only the part along the road matters.
            others: vehicles ahead that the body must not hit.

        Returns:
            Negative: the vehicle must brake now. Infinite: there is no vehicle ahead.
        """
        spare_m = float("inf")
        own_m: float | None = None
        for other in others:
            if own_m is None:
                own_m = self._own_path_m(state, setpoint_mps2, jerk[0])
            path_m = lead_path_m(
                other.speed_mps, other.accel_mps2, self._lead_brake_mps2, self._lead_lag_s
            )
            spare_m = min(spare_m, other.gap_m + path_m - own_m)
        return spare_m - self._margin_m

    def _own_path_m(self, state: Sequence[float], setpoint_mps2: float, jerk_mps3: float) -> float:
        """Return the distance that the vehicle travels if it brakes after its reaction time."""
        _, v, a, _, _, _ = state
        lag_s, tick_s, later_s = self._lag_s, self._tick_s, self._later_s
        # The commanded state has no lag, and the same stopping point as the body. It is integrated
        # as in `integrate`, for a tick and for the rest of the reaction time.
        speed, half = v + lag_s * a, tick_s * tick_s / 2.0
        ahead_m = (
            lag_s * v + speed * tick_s + setpoint_mps2 * half + jerk_mps3 * (half * tick_s / 3.0)
        )
        speed = speed + setpoint_mps2 * tick_s + jerk_mps3 * half
        accel = setpoint_mps2 + jerk_mps3 * tick_s
        ahead_m = ahead_m + speed * later_s + accel * (later_s * later_s / 2.0)
        speed = max(speed + accel * later_s, 0.0)
        return ahead_m + speed * speed / (2.0 * self._brake_mps2) + self._last_tick_m
