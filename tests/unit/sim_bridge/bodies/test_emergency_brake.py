"""The emergency brake in closed loop: it brakes in time, and no earlier than it has to."""

from __future__ import annotations

import attrs
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from msgspec.structs import astuple

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake, last_tick_m
from laneweave.protocol.vehicle.motion import Jerk, commanded_state, limited_jerk
from laneweave.protocol.wire.messages import CurrentMotion, Name, Neighbour
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel, MotionController
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Neighbours
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.bodies.sensors import Sensors
from support.examples import examples
from support.paper import EXACT
from support.road_vehicles import controller_in
from support.states import command
from support.tables import for_each

SCENARIO = Scenario()
LIMITS, TICK_S = SCENARIO.vehicle, SCENARIO.runtime.tick_s
MARGIN_M = SCENARIO.braking.margin_m
WITHIN_A_TICK_M = 10.0 * TICK_S**2 / 8.0
"""A body that stops within a tick goes so much farther than with full brake all the time."""
BRAKE = EmergencyBrake(LIMITS, SCENARIO.braking, SCENARIO.runtime.tick_s)


def plant_at(front_m: float, v_mps: float, a_mps2: float = 0.0) -> Plant:
    return Plant((front_m, v_mps, a_mps2, 1.75, 0.0, 0.0), LIMITS, TICK_S)


def seen(own: Plant, ahead: Plant) -> Neighbour:
    gap_m = ahead.state[0] - LIMITS.length_m - own.state[0]
    return Neighbour(0, gap_m, ahead.state[1], ahead.state[2])


def spare_m(own: Plant, ahead: Plant, jerk: Jerk) -> float:
    """Return what a motion controller would find; the body allows no more than its limits."""
    pursued = commanded_state(own.state, own.setpoint, LIMITS, 0.0)
    allowed = limited_jerk(pursued, jerk, LIMITS, TICK_S)
    return BRAKE.spare_m(own.state, own.setpoint[0], allowed, [seen(own, ahead)])


def keepable(v_mps: float, a_mps2: float) -> bool:
    """Tell whether a vehicle that keeps its limits can be in this state."""
    pursued = v_mps + LIMITS.actuator_lag_s * a_mps2
    needed = a_mps2 * a_mps2 / (2.0 * LIMITS.max_jerk_mps3) + abs(a_mps2) * TICK_S
    return needed <= pursued <= LIMITS.max_speed_mps - needed


@for_each("v_mps", [0.5, 3.0, 15.0, 24.0])
@for_each("a_mps2", [-4.0, 0.0, 3.0])
@for_each("jerk", [-15.0, 0.0, 15.0])
def test_what_is_to_spare_is_where_the_body_stops_that_brakes_one_tick_later(
    v_mps: float, a_mps2: float, jerk: float
) -> None:
    if not keepable(v_mps, a_mps2):
        return
    own, wall = plant_at(0.0, v_mps, a_mps2), plant_at(80.0, 0.0)
    expected_m = spare_m(own, wall, (jerk, 0.0))
    own.step(jerk, 0.0)
    while own.state[1] > 1e-6:
        own.brake(0.0)
    left_m = seen(own, wall).gap_m - MARGIN_M
    # What is to spare counts the longest last tick.
    longest_m = last_tick_m(-LIMITS.min_accel_mps2, TICK_S)
    assert expected_m - 1e-4 <= left_m <= expected_m + longest_m + 1e-4


JERKS = st.lists(st.sampled_from((-15.0, -5.0, 0.0, 5.0, 15.0)), min_size=1, max_size=10)


@pytest.mark.slow
@given(
    st.tuples(st.floats(0.0, 25.0), st.floats(-9.0, 5.0)),
    st.tuples(st.floats(0.0, 25.0), st.floats(-9.0, 5.0)),
    st.one_of(st.just(0.0), st.floats(0.0, 30.0)),
    JERKS,
    JERKS,
    st.integers(0, 60),
)
@example((16.5, -6.0), (16.0, 0.0), 0.0, [-15.0], [-15.0], 0)
@example((20.8, -8.48), (19.45, 0.1), 0.0, [-15.0], [-15.0], 0)
@examples(150)
def test_no_vehicle_hits_one_that_brakes_as_hard_as_it_can(
    own_motion: tuple[float, float],
    other_motion: tuple[float, float],
    extra_m: float,
    own_jerks: list[float],
    other_jerks: list[float],
    braking_tick: int,
) -> None:
    """For every command, from every state that leaves room to brake."""
    assume(keepable(*own_motion))
    assume(keepable(*other_motion))
    own, other = plant_at(0.0, *own_motion), plant_at(LIMITS.length_m, *other_motion)
    lacking_m = -spare_m(own, other, (own_jerks[0], 0.0))
    gap_m = max(lacking_m, MARGIN_M) + extra_m
    other = plant_at(LIMITS.length_m + gap_m, *other_motion)
    for tick in range(braking_tick + 60):
        jerk: Jerk = (own_jerks[tick // 4 % len(own_jerks)], 0.0)
        brakes = spare_m(own, other, jerk) < 0.0
        if tick >= braking_tick:
            other.brake(0.0)
        else:
            other.step(other_jerks[tick // 4 % len(other_jerks)], 0.0)
        if brakes:
            own.brake(0.0)
        else:
            own.step(*jerk)
        # The margin is what is left at the end. Before, it is less where a faster vehicle begins
        # near while it already brakes.
        assert seen(own, other).gap_m >= 0.3 * MARGIN_M
    assert seen(own, other).gap_m >= MARGIN_M - 2.0 * WITHIN_A_TICK_M
    assert other.state[1] == pytest.approx(0.0, abs=0.05)


@for_each("lead_lag_s", [0.0, 0.2, 0.6])
@for_each("lead_brake_mps2", [3.0, 5.0, 8.0, 12.0])
@for_each(("v_mps", "other_mps"), [(15.0, 15.0), (25.0, 15.0), (8.0, 20.0)])
def test_no_vehicle_hits_one_with_other_brakes_than_its_own(
    v_mps: float, other_mps: float, lead_brake_mps2: float, lead_lag_s: float
) -> None:
    """Behind a vehicle that brakes less hard, the gap is smallest before both have stopped."""
    braking = attrs.evolve(SCENARIO.braking, lead_brake_mps2=lead_brake_mps2, lead_lag_s=lead_lag_s)
    brake = EmergencyBrake(LIMITS, braking, TICK_S)
    limits = attrs.evolve(LIMITS, min_accel_mps2=-lead_brake_mps2, actuator_lag_s=lead_lag_s)

    def other_at(gap_m: float) -> Plant:
        front_m = LIMITS.length_m + gap_m
        return Plant((front_m, other_mps, 0.0, 1.75, 0.0, 0.0), limits, TICK_S)

    def to_spare_m(other: Plant) -> float:
        return brake.spare_m(own.state, own.setpoint[0], (0.0, 0.0), [seen(own, other)])

    own = plant_at(0.0, v_mps)
    other = other_at(max(-to_spare_m(other_at(0.0)), MARGIN_M))
    assert to_spare_m(other) >= -1e-9
    while own.state[1] > 1e-6:
        if to_spare_m(other) < -1e-9:
            own.brake(0.0)
        else:
            own.step(0.0, 0.0)
        other.brake(0.0)
        assert seen(own, other).gap_m >= 0.3 * MARGIN_M


def drive_behind(
    scenario: Scenario, number: int, gap_m: float, *, braking_tick: int
) -> tuple[float, MotionController]:
    """Let a vehicle speed up behind one that holds and then brakes; return the smallest gap."""
    controller = controller_in((0, 0), scenario, state=(0.0, 15.0, 0.0, 1.75, 0.0, 0.0))
    own, other = controller.plant, plant_at(LIMITS.length_m + gap_m, 15.0)
    sensors = Sensors(scenario, Name(f"v{number}"))
    least_m = gap_m
    for tick in range(braking_tick + 60):
        controller.accept_command(
            command(tick, (15.0, 0.0), hold_cell=(0, 0), motion=CurrentMotion((0, 0), tick + 1))
        )
        around = sensors.measure_neighbours(([astuple(seen(own, other))], []))
        controller.perceive(sensors.measure(own.state), around)
        controller.step(tick)
        if tick >= braking_tick:
            other.brake(0.0)
        else:
            other.step(0.0, 0.0)
        least_m = min(least_m, seen(own, other).gap_m)
    return least_m, controller


@pytest.mark.parametrize("jerk", [-40.0, -1000.0, -3e38])
def test_commanding_more_than_the_body_can_brake_does_not_count_as_braking(jerk: float) -> None:
    controller = controller_in((0, 0), SCENARIO, state=(0.0, 15.0, 0.0, 1.75, 0.0, 0.0))
    own, wall = controller.plant, plant_at(24.0, 0.0)
    for tick in range(40):
        controller.accept_command(
            command(tick, (jerk, 0.0), hold_cell=(0, 0), motion=CurrentMotion((0, 0), tick + 1))
        )
        controller.perceive(own.state, Neighbours((seen(own, wall),), ()))
        controller.step(tick)
        assert seen(own, wall).gap_m > MARGIN_M - 0.1
    assert controller.level_ticks[FallbackLevel.EMERGENCY] > 0


@for_each("number", range(24))
def test_errors_of_measurement_do_not_make_it_too_late(number: int) -> None:
    """A faulty agent speeds up behind a vehicle that brakes sooner or later."""
    least_m, controller = drive_behind(SCENARIO, number, 4.0 + number, braking_tick=3 * number)
    assert least_m > 0.0
    assert controller.level_ticks[FallbackLevel.EMERGENCY] > 0


def test_it_is_not_more_careful_than_it_has_to_be() -> None:
    """With exact sensors a vehicle stops little more than its margin behind the one ahead."""
    scenario = attrs.evolve(SCENARIO, sensing=EXACT)
    least_m, _ = drive_behind(scenario, 0, 12.0, braking_tick=12)
    assert MARGIN_M - 3.0 * WITHIN_A_TICK_M <= least_m <= MARGIN_M + 1.5
