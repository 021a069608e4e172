"""How far braking bodies go, and what the emergency brake makes of it."""

from __future__ import annotations

import math
import random
import re
import statistics

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.motion_checks import min_pitch_m
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Sensing
from laneweave.protocol.vehicle.emergency_brake import (
    ERROR_SIGMAS,
    EmergencyBrake,
    lead_lag_s,
    lead_path_m,
    spare_error_m,
    stopping_distance_m,
)
from laneweave.protocol.vehicle.motion import Jerk, State
from laneweave.protocol.wire.messages import Neighbour
from support.examples import examples
from support.refusals import refusal

SCENARIO = Scenario()
LIMITS, ASSUMED, NOISE = SCENARIO.vehicle, SCENARIO.braking, SCENARIO.sensing
V_F = SCENARIO.formation.speed_mps
CELL_GAP_M = SCENARIO.formation.gap_m - LIMITS.length_m
BRAKE = EmergencyBrake(LIMITS, SCENARIO.braking, SCENARIO.runtime.tick_s)
NO_JERK: Jerk = (0.0, 0.0)


def lead_m(speed_mps: float, accel_mps2: float = 0.0) -> float:
    brake_mps2, lag_s = ASSUMED.lead_brake_mps2, lead_lag_s(LIMITS, SCENARIO.braking)
    return lead_path_m(speed_mps, accel_mps2, brake_mps2, lag_s)


def body(v_mps: float, a_mps2: float = 0.0) -> State:
    return (100.0, v_mps, a_mps2, 1.75, 0.0, 0.0)


def integrated_way_m(v: float, a: float, brake_mps2: float, lag_s: float) -> float:
    """Return how far a body goes whose acceleration goes to -brake, until it stands still."""
    h, way_m = 5e-4, 0.0
    while v > 0.0:
        if lag_s == 0.0:
            a = middle = -brake_mps2
        else:
            middle = a + h / 2.0 * (-brake_mps2 - a) / lag_s
            a += h * (-brake_mps2 - middle) / lag_s
        after = v + h * middle
        way_m += h * (v + max(after, 0.0)) / 2.0
        v = after
    return way_m


# --- stopping distances ---------------------------------------------------------------------------


@given(
    st.floats(0.0, 30.0),
    st.floats(0.0, 1.0),
    st.floats(5.0, 12.0),
    st.sampled_from((0.0, 0.1, 0.2)),
)
@examples(60)
def test_a_body_that_brakes_goes_as_far_as_integration_says(
    v_mps: float, share: float, brake_mps2: float, lag_s: float
) -> None:
    """Never farther, which would count on a lead vehicle too much; near standstill a bit less."""
    accel = -share * brake_mps2
    way_m = stopping_distance_m(v_mps, accel, brake_mps2, lag_s)
    true_m = integrated_way_m(v_mps, accel, brake_mps2, lag_s)
    short_m = brake_mps2 * lag_s**2 / 2.0 if v_mps < 4.0 * lag_s * brake_mps2 else 0.004 * v_mps
    assert true_m - 0.55 * short_m - 2e-3 <= way_m <= true_m + 2e-3


@pytest.mark.parametrize("v_mps", [0.0, 0.1, 0.3, 0.7, 1.0, 1.6, 2.5, 5.0, 25.0])
@pytest.mark.parametrize("accel_mps2", [0.0, -3.0, -10.0])
def test_with_the_assumptions_of_a_scenario_it_is_a_tenth_of_a_metre_off_at_most(
    v_mps: float, accel_mps2: float
) -> None:
    way_m = lead_m(v_mps, accel_mps2)
    true_m = integrated_way_m(v_mps, accel_mps2, ASSUMED.lead_brake_mps2, ASSUMED.lead_lag_s)
    assert true_m - 0.105 <= way_m <= true_m + 1e-3
    if v_mps >= 5.0:
        assert way_m == pytest.approx(true_m, abs=0.02)


def test_the_vehicle_ahead_may_stop_accelerating_at_once_and_then_brakes_hard() -> None:
    assert lead_m(15.0, 4.0) == lead_m(15.0)
    assert lead_m(15.0, -2.0) < lead_m(15.0)
    hardest = lead_m(15.0, -ASSUMED.lead_brake_mps2)
    assert lead_m(15.0, -99.0) == hardest == pytest.approx(15.0**2 / 20.0)
    assert lead_m(-1.0) == lead_m(0.0) == 0.0


# --- what is to spare -----------------------------------------------------------------------------


def test_without_a_vehicle_ahead_the_spare_distance_is_infinite() -> None:
    assert BRAKE.spare_m(body(25.0), 5.0, (15.0, 0.0), ()) == math.inf


def test_the_most_critical_vehicle_ahead_counts() -> None:
    slow, near = Neighbour(0, 30.0, 2.0), Neighbour(1, 12.0, 15.0)
    apart = [BRAKE.spare_m(body(15.0), 0.0, NO_JERK, [other]) for other in (slow, near)]
    assert BRAKE.spare_m(body(15.0), 0.0, NO_JERK, [slow, near]) == min(apart)
    assert BRAKE.spare_m(body(15.0), 0.0, NO_JERK, [near, slow]) == min(apart)
    assert apart[0] != apart[1]


@given(
    st.floats(0.0, 25.0), st.floats(-10.0, 5.0), st.floats(-10.0, 5.0), st.floats(-15.0, 15.0),
    st.floats(0.0, 40.0), st.floats(0.0, 25.0), st.floats(-10.0, 5.0),
)  # fmt: skip
def test_less_room_and_more_speed_never_leave_more(
    v: float, a: float, setpoint: float, jerk: float, gap_m: float, other_v: float, other_a: float
) -> None:
    def spare_m(
        v: float, a: float, u: float, jerk: float, gap_m: float, other_v: float, other_a: float
    ) -> float:
        return BRAKE.spare_m(body(v, a), u, (jerk, 0.0), [Neighbour(0, gap_m, other_v, other_a)])

    now = v, a, setpoint, jerk, gap_m, other_v, other_a
    for place, change in enumerate((0.5, 0.5, 0.5, 0.5, -0.5, -0.5, -0.5)):
        worse = (*now[:place], now[place] + change, *now[place + 1 :])
        assert spare_m(*worse) <= spare_m(*now) + 1e-9


def test_two_that_hold_one_cell_apart_have_metres_to_spare() -> None:
    spare_m = BRAKE.spare_m(body(V_F), 0.0, NO_JERK, [Neighbour(0, CELL_GAP_M, V_F)])
    # Of the net gap, the way in the time of reaction, the margin, 0.2 m that the other's assumed
    # brake stops short, and the last tick.
    assert spare_m == pytest.approx(CELL_GAP_M - V_F * ASSUMED.reaction_s - 0.3 - 0.2 - 0.0125)
    assert spare_m > 5.0


@pytest.mark.parametrize("v_mps", [15.0, 22.0])
def test_errors_of_sensors_make_it_err_as_much_as_is_said(v_mps: float) -> None:
    rng = random.Random(4)
    found = []
    for _ in range(3000):
        v = v_mps + rng.gauss(0.0, NOISE.speed_noise_mps)
        a = rng.gauss(0.0, NOISE.accel_noise_mps2)
        other = Neighbour(
            0,
            30.0 + rng.gauss(0.0, NOISE.gap_noise_m),
            V_F + rng.gauss(0.0, NOISE.other_speed_noise_mps),
            -2.0 + rng.gauss(0.0, NOISE.other_accel_noise_mps2),
        )
        found.append(BRAKE.spare_m(body(v, a), 0.0, NO_JERK, [other]))
    assert 0.85 <= statistics.stdev(found) / error_m(v_mps) <= 1.05


def error_m(v_mps: float, noise: Sensing = NOISE) -> float:
    return spare_error_m(LIMITS, ASSUMED, noise, v_mps, V_F)


def test_each_noise_adds_to_the_error() -> None:
    whole = error_m(V_F)
    for name in (
        "gap_noise_m", "speed_noise_mps", "accel_noise_mps2", "other_speed_noise_mps",
        "other_accel_noise_mps2",
    ):  # fmt: skip
        assert error_m(V_F, evolve(NOISE, **{name: 0.0})) < whole
    # Positions come in as a gap only.
    assert error_m(V_F, evolve(NOISE, position_noise_m=3.0)) == whole


# --- what it asks of a scenario -------------------------------------------------------------------


def with_pitch(gap_m: float, **sensing: float) -> Scenario:
    data = {"formation": {"gap_m": gap_m}, "tracking": {"min_gap_m": 0.0}, "sensing": sensing}
    return parse_scenario(data)


def test_the_least_pitch_leaves_room_for_errors_of_measurement_and_for_nothing_more() -> None:
    least_m = min_pitch_m(SCENARIO, LIMITS)
    assert with_pitch(least_m + 1e-6).formation.gap_m == pytest.approx(least_m)
    state, ahead = body(V_F), Neighbour(0, least_m - LIMITS.length_m, V_F)
    spare_m = BRAKE.spare_m(state, 0.0, NO_JERK, [ahead])
    assert spare_m == pytest.approx(ERROR_SIGMAS * error_m(V_F))
    error = refusal(with_pitch, least_m - 1e-3)
    assert error.field == "formation.gap_m"
    allowed = re.search(r"at least (\S+):", error.allowed)
    assert allowed is not None
    # What is named as allowed is.
    assert with_pitch(float(allowed[1])).formation.gap_m == pytest.approx(least_m, abs=1.1e-3)
