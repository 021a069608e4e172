"""How vehicles that enter more slowly than v_F get into their cells."""

from __future__ import annotations

import numpy as np
import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from laneweave.agents.driving.trajectory import settling_trajectory
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.sim_bridge.corridors.settling import (
    BRAKE_MPS2,
    LIMIT_SHARE,
    LONGEST_S,
    MIN_SPEED_MPS,
    fall_back,
    settling_s,
)
from laneweave.sim_bridge.corridors.take_over import _cruising_s, _shortest_s, _slow_mps
from support.examples import examples

SPEED_MPS = 25.0
CAR = Vehicle(max_accel_mps2=2.6, min_accel_mps2=-9.0, max_speed_mps=40.0)
TRUCK = Vehicle(max_accel_mps2=1.3, min_accel_mps2=-7.0, max_speed_mps=36.0)
ROAD = evolve(Scenario(), formation=evolve(Scenario().formation, speed_mps=SPEED_MPS))
TICK_S = ROAD.runtime.tick_s


@examples(40)
@given(st.floats(0.0, 150.0), st.floats(-3.0, 15.0), st.sampled_from([CAR, TRUCK]))
def test_a_vehicle_settles_within_its_limits_and_not_behind_its_cell(
    ahead_m: float, slower_mps: float, limits: Vehicle
) -> None:
    """The time suffices for the trajectory that the agent plans, also if it begins a tick late."""
    time_s = settling_s(ahead_m, slower_mps, SPEED_MPS, limits)
    if time_s is None:
        return
    assert time_s <= LONGEST_S
    own = evolve(ROAD, vehicle=limits, formation=evolve(ROAD.formation, change_columns=False))
    late_m = ahead_m - slower_mps * TICK_S
    start = np.array([late_m, -slower_mps, 0.0, 0.0, 0.0, 0.0])
    trajectory = settling_trajectory(own, own.vehicle, start, round(time_s / TICK_S) - 1)
    position, speed, accel = trajectory.states.T[:3]
    assert abs(position[-1]) + abs(speed[-1]) + abs(accel[-1]) < 1e-3
    assert position.min() >= -0.5
    assert accel.max() <= limits.max_accel_mps2
    assert accel.min() >= limits.min_accel_mps2
    assert np.abs(trajectory.jerks).max() <= limits.max_jerk_mps3
    assert (speed + SPEED_MPS).min() > 0.0


def feasible(ahead_m: float, slower_mps: float, time_s: float, limits: Vehicle) -> bool:
    """Return whether accelerations exist that lead to rest in the cell, without limits of jerk."""
    count = 200
    step_s = time_s / count
    ends_s = time_s - step_s * (np.arange(count) + 0.5)
    found = linprog(
        np.zeros(count),
        A_eq=np.stack([np.full(count, step_s), step_s * ends_s]),
        b_eq=[slower_mps, slower_mps * time_s - ahead_m],
        A_ub=-step_s * np.tril(np.ones((count, count))),
        b_ub=np.full(count, SPEED_MPS - slower_mps - MIN_SPEED_MPS),
        bounds=(-BRAKE_MPS2, LIMIT_SHARE * limits.max_accel_mps2),
    )
    return bool(found.success)


@pytest.mark.parametrize("limits", [CAR, TRUCK])
@pytest.mark.parametrize(("ahead_m", "slower_mps"), [(20.0, 4.0), (77.0, 7.5), (120.0, 2.0)])
def test_the_time_is_hardly_longer_than_needed(
    ahead_m: float, slower_mps: float, limits: Vehicle
) -> None:
    time_s = settling_s(ahead_m, slower_mps, SPEED_MPS, limits)
    assert time_s is not None
    assert feasible(ahead_m, slower_mps, time_s, limits)
    assert not feasible(ahead_m, slower_mps, time_s - 1.0, limits)


def test_a_vehicle_in_its_cell_settles_at_once() -> None:
    assert settling_s(0.0, 0.0, SPEED_MPS, CAR) == 1.0


def test_a_weak_vehicle_needs_more_room() -> None:
    (car, car_s), (truck, truck_s) = (fall_back(6.0, SPEED_MPS, one) for one in (CAR, TRUCK))
    assert 5.0 <= car < truck <= 30.0
    assert car_s < truck_s
    assert settling_s(car, 6.0, SPEED_MPS, CAR) == car_s
    assert settling_s(0.0, 6.0, SPEED_MPS, CAR) is None


@given(st.floats(60.0, 400.0), st.floats(0.0, 30.0), st.floats(12.0, 22.0), st.floats(0.8, 2.0))
def test_advice_brings_a_vehicle_to_its_ramp_in_time(
    distance_m: float, delay_s: float, end_mps: float, accel_mps2: float
) -> None:
    shortest_s = _shortest_s(distance_m, end_mps, end_mps, accel_mps2)
    assert shortest_s == pytest.approx(distance_m / end_mps)
    time_s = shortest_s + delay_s
    slow_mps = _slow_mps(distance_m, time_s, end_mps, accel_mps2)
    if slow_mps is None:
        return
    assert 0.0 < slow_mps <= end_mps
    needed_s = _cruising_s(distance_m, slow_mps, end_mps, accel_mps2)
    lowest_mps = max(3.0, (max(end_mps**2 - 2.0 * accel_mps2 * distance_m, 0.0)) ** 0.5)
    # In time, or as slowly as it may be, or there is no room for more.
    assert needed_s == pytest.approx(time_s, abs=0.3) or slow_mps <= lowest_mps + 0.02
