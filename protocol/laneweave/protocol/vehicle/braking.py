"""The emergency brake: whether a vehicle must brake now, by what its own sensors see.

A vehicle looks at each tick. It may go on for one more tick if, should the vehicle ahead brake as
hard as it can from now on and this one from the next tick on, this one still comes to rest behind
the other. Otherwise it brakes now, past its jerk limit: jerk-limited braking comes too late. By
induction there is no impact: at every tick, braking from now on was enough one tick earlier
(docs/SAFETY.md derives it, with the errors of measurement).

A body that moves at v with acceleration a and brakes with b through a first-order lag L still goes

    (v + L (a + b))^2 / (2 b)  -  L^2 (a + b)

before it stands still. So lag costs a speed of L (a + b), which is what the limit on reaction time
is about: in a cell that is d_F long, with moves that take T_F, little is left
(`scenario_checks`, and `check_moves` of the agents).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import Jerk, State
from laneweave.protocol.wire.messages import Neighbour

ERROR_SIGMAS = 4.5
"""Errors of measurement for which plans leave room, in standard deviations."""


def stopping_distance_m(
    speed_mps: float, accel_mps2: float, brake_mps2: float, lag_s: float
) -> float:
    """Return how far a body goes that brakes from now on until it stands still.

    Args:
        speed_mps: its speed, >= 0.
        accel_mps2: its acceleration.
        brake_mps2: its braking, > 0, towards which its acceleration goes.
        lag_s: time constant with which it does.
    """
    change = accel_mps2 + brake_mps2
    gained = speed_mps + lag_s * change
    travelled = gained * gained / (2.0 * brake_mps2) - lag_s * lag_s * change
    # Close to standstill the lag has not died away when it stops; this much it goes at least.
    return max(travelled, speed_mps * speed_mps / (2.0 * brake_mps2))


def own_braking_mps2(scenario: Scenario) -> float:
    """Return the braking that a vehicle counts on: its own, but no more than is assumed ahead.

    Who can brake harder than the vehicle ahead may come closest on the way, not at the end.
    """
    return min(-scenario.vehicle.min_accel_mps2, scenario.braking.lead_brake_mps2)


def lead_way_m(scenario: Scenario, speed_mps: float, accel_mps2: float = 0.0) -> float:
    """Return how far a vehicle ahead goes at least, by the assumptions of a scenario.

    Args:
        scenario: its `braking` counts.
        speed_mps: speed of the vehicle ahead.
        accel_mps2: its acceleration.
    """
    return _lead_way_m(
        speed_mps, accel_mps2, scenario.braking.lead_brake_mps2, _lead_lag_s(scenario)
    )


def _lead_lag_s(scenario: Scenario) -> float:
    # Nor is it relied upon that brakes ahead take longer to build up than one's own.
    return min(scenario.braking.lead_lag_s, scenario.vehicle.actuator_lag_s)


def _lead_way_m(speed_mps: float, accel_mps2: float, brake_mps2: float, lag_s: float) -> float:
    # Who speeds up may stop doing so at once; who brakes harder than assumed does so for good.
    accel = min(max(accel_mps2, -brake_mps2), 0.0)
    return stopping_distance_m(max(speed_mps, 0.0), accel, brake_mps2, lag_s)


def spare_error_m(scenario: Scenario, speed_mps: float) -> float:
    """Return the standard deviation of `EmergencyBrake.spare_m` that errors of sensors cause.

    Args:
        scenario: its `sensing`, `braking` and `vehicle` count.
        speed_mps: speed of the vehicle itself; whoever is ahead drives at v_F.
    """
    noise, assumed, limits = scenario.sensing, scenario.braking, scenario.vehicle
    own_s = limits.actuator_lag_s + assumed.reaction_s + speed_mps / own_braking_mps2(scenario)
    other_s = scenario.formation.speed_mps / assumed.lead_brake_mps2 + assumed.lead_lag_s
    return math.hypot(
        noise.gap_noise_m,
        noise.speed_noise_mps * own_s,
        noise.accel_noise_mps2 * limits.actuator_lag_s * own_s,
        noise.other_speed_noise_mps * other_s,
        noise.other_accel_noise_mps2 * assumed.lead_lag_s * other_s,
    )


def last_tick_m(brake_mps2: float, tick_s: float) -> float:
    """Return how much further a body goes at most because its last tick of braking is a whole one.

    In that tick it brakes just so hard that it stands still at the end.
    """
    return brake_mps2 * tick_s * tick_s / 8.0


class EmergencyBrake:
    """Decides when a vehicle brakes past everything else that it was told."""

    def __init__(self, scenario: Scenario) -> None:
        """Take the assumptions from a scenario: its `braking`, `vehicle` and tick."""
        limits, assumed = scenario.vehicle, scenario.braking
        self._brake_mps2 = own_braking_mps2(scenario)
        self._lag_s = limits.actuator_lag_s
        self._lead_brake_mps2, self._lead_lag_s = assumed.lead_brake_mps2, _lead_lag_s(scenario)
        self._tick_s = scenario.runtime.tick_s
        self._last_tick_m = last_tick_m(self._brake_mps2, self._tick_s)
        self._later_s = max(assumed.reaction_s - self._tick_s, 0.0)
        self._margin_m = assumed.margin_m

    def spare_m(
        self, state: State, setpoint_mps2: float, jerk: Jerk, others: Iterable[Neighbour]
    ) -> float:
        """Return the net gap beyond the margin that would be left if all braked in time.

        Args:
            state: of the body, as measured.
            setpoint_mps2: set-point of its acceleration along the road.
            jerk: what it would do until it looks again, within its limits; what counts is along
                the road.
            others: those ahead that it must not run into.

        Returns:
            Less than zero: it must brake now. Infinite: nobody is there.
        """
        spare_m = float("inf")
        own_m: float | None = None
        for other in others:
            if own_m is None:
                own_m = self._own_way_m(state, setpoint_mps2, jerk[0])
            way_m = _lead_way_m(
                other.speed_mps, other.accel_mps2, self._lead_brake_mps2, self._lead_lag_s
            )
            spare_m = min(spare_m, other.gap_m + way_m - own_m)
        return spare_m - self._margin_m

    def _own_way_m(self, state: State, setpoint_mps2: float, jerk_mps3: float) -> float:
        """Return how far it goes if it brakes after the time of reaction."""
        _, v, a, _, _, _ = state
        lag_s, tick_s, later_s = self._lag_s, self._tick_s, self._later_s
        # The commanded state has no lag, and the body comes to rest where it does. Along the road
        # alone, as `integrate` moves it on: for a tick, and for what is left of the reaction.
        speed, half = v + lag_s * a, tick_s * tick_s / 2.0
        ahead_m = (
            lag_s * v + speed * tick_s + setpoint_mps2 * half + jerk_mps3 * (half * tick_s / 3.0)
        )
        speed = speed + setpoint_mps2 * tick_s + jerk_mps3 * half
        accel = setpoint_mps2 + jerk_mps3 * tick_s
        ahead_m = ahead_m + speed * later_s + accel * (later_s * later_s / 2.0)
        speed = max(speed + accel * later_s, 0.0)
        return ahead_m + speed * speed / (2.0 * self._brake_mps2) + self._last_tick_m


def min_pitch_m(scenario: Scenario) -> float:
    """Return the column pitch with which two that hold one cell apart do not brake, nearly ever.

    Errors of measurement are less than what is to spare, up to `ERROR_SIGMAS`.
    """
    speed_mps, pitch_m = scenario.formation.speed_mps, scenario.formation.gap_m
    ahead = Neighbour(0, pitch_m - scenario.vehicle.length_m, speed_mps)
    holding = (0.0, speed_mps, 0.0, 0.0, 0.0, 0.0)
    spare_m = EmergencyBrake(scenario).spare_m(holding, 0.0, (0.0, 0.0), [ahead])
    return pitch_m - spare_m + ERROR_SIGMAS * spare_error_m(scenario, speed_mps)
