"""Stopping points agree with the emergency brake, and bound speeds behind slower vehicles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.agents.driving.stopping_points import SENSED_S, StoppingPoints
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake
from laneweave.protocol.vehicle.motion import State, commanded_state
from laneweave.protocol.wire.messages import Neighbour
from support.examples import examples

SCENARIO = Scenario()
LIMITS, TICK_S, V_F = SCENARIO.vehicle, SCENARIO.runtime.tick_s, SCENARIO.lattice.speed_mps
N = SCENARIO.timing.horizon_ticks
POINTS = StoppingPoints(SCENARIO, LIMITS)
BRAKE = EmergencyBrake(LIMITS, SCENARIO.braking, TICK_S)
EARLY_M = 1.0
"""Distance kept behind a vehicle that is much slower than the lattice."""


def state(v_mps: float, a_mps2: float) -> State:
    return (0.0, v_mps, a_mps2, 1.75, 0.0, 0.0)


def bounds_of(commanded: State, *ahead: Neighbour) -> np.ndarray | None:
    return POINTS.bounds(commanded, 0.0, ahead)


@given(
    st.tuples(st.floats(8.0, 20.0), st.floats(-3.0, 3.0)),
    st.tuples(st.floats(0.0, 10.0), st.floats(-9.0, 2.0)),
)
@examples(200)
def test_the_bound_now_is_where_the_emergency_brake_acts_and_a_metre(
    own: tuple[float, float], other: tuple[float, float]
) -> None:
    measured = state(*own)
    commanded = commanded_state(measured, (own[1], 0.0), LIMITS, V_F)
    ahead = Neighbour(0, 5.0, *other)
    spare_m = BRAKE.spare_m(measured, own[1], (0.0, 0.0), [ahead])
    bounds = bounds_of(commanded, ahead)
    if bounds is None:
        assert spare_m > EARLY_M
        return
    stop_m = commanded[0] + POINTS.distances_m(np.array([commanded]))[0]
    assert bounds[0] - stop_m == pytest.approx(spare_m - EARLY_M, abs=1e-6)
    known = round(SENSED_S / TICK_S) + 1
    assert np.isfinite(bounds[:known]).all()
    assert np.isinf(bounds[known:]).all()
    assert len(bounds) == N + 1


# The vehicle ahead stays more than 2 m/s slower than v_F, so that the whole distance is kept.
@given(st.floats(5.0, 20.0), st.floats(0.0, 10.0), st.floats(-6.0, 3.0), st.floats(3.0, 20.0))
@examples(200)
def test_a_vehicle_ahead_is_predicted_with_an_acceleration_that_fades(
    own_mps: float, other_mps: float, other_mps2: float, gap_m: float
) -> None:
    """The bound after `SENSED_S` is the present one of a vehicle that is simulated until then."""
    bounds = bounds_of(state(own_mps, 0.0), Neighbour(0, gap_m, other_mps, other_mps2))
    if bounds is None:
        return
    step_s, speed, moved, accel = 0.001, other_mps, 0.0, other_mps2
    for _ in range(round(SENSED_S / step_s)):
        speed = max(speed + accel * step_s, 0.0)
        moved += speed * step_s
        accel -= accel * step_s / SENSED_S
    there = bounds_of(state(own_mps + 30.0, 0.0), Neighbour(0, gap_m + moved, speed, accel))
    assert there is not None
    assert bounds[round(SENSED_S / TICK_S)] == pytest.approx(there[0], abs=0.1)


@given(st.floats(8.0, 20.0), st.floats(0.0, 10.0), st.floats(3.0, 12.0))
@examples(200)
def test_the_needed_deceleration_keeps_the_bounds_and_less_does_not(
    own_mps: float, other_mps: float, gap_m: float
) -> None:
    commanded = state(own_mps, 0.0)
    bounds = bounds_of(commanded, Neighbour(0, gap_m, other_mps, 0.0))
    if bounds is None:
        return  # far enough
    decel = POINTS.needed_decel_mps2(commanded, bounds)
    times = TICK_S * np.arange(N + 1)

    def excess_m(by: float) -> float:
        """Return by how much a vehicle that brakes passes its bounds after the time to react."""
        states = np.zeros((N + 1, 6))
        moving = np.minimum(times, own_mps / by if by > 0.0 else math.inf)
        states[:, 0] = own_mps * moving - 0.5 * by * moving**2
        states[:, 1], states[:, 2] = own_mps - by * moving, np.where(times > moving, 0.0, -by)
        last = round(SENSED_S / TICK_S) + 1
        behind = states[:, 0] + POINTS.distances_m(states) - bounds
        return float(behind[3:last].max())

    if decel > -LIMITS.min_accel_mps2:
        assert excess_m(-LIMITS.min_accel_mps2) > 0.0
        return  # no deceleration that it can reach is enough
    assert excess_m(decel + 1e-6) <= 1e-6
    assert excess_m(decel - 0.2) > 0.0


@pytest.mark.parametrize("gap_m", [0.5, 5.0, 10.0])
def test_a_vehicle_that_holds_its_cell_sets_no_bound(gap_m: float) -> None:
    """Plans leave room behind it, and forward moves use it."""
    fast = state(22.0, 3.0)
    assert bounds_of(fast, Neighbour(0, gap_m, V_F, 0.0)) is None
    assert bounds_of(fast, Neighbour(0, gap_m, V_F - 1.0, 0.0)) is not None
    assert bounds_of(fast, Neighbour(0, 60.0, V_F - 1.0, 0.0)) is None
    assert bounds_of(fast) is None


def test_the_nearest_bound_counts() -> None:
    own, near, far = state(V_F, 0.0), Neighbour(0, 4.0, 8.0, 0.0), Neighbour(1, 6.0, 2.0, 0.0)
    one, other, both = bounds_of(own, near), bounds_of(own, far), bounds_of(own, near, far)
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(both, np.minimum(one, other))
