"""Whatever is commanded, a body stays in the cells of its vehicle."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.motion import (
    ARRIVED_ACROSS_M,
    DISPLACED_ALONG_M,
    State,
    cell_state,
    commanded_state,
    hold_law,
)
from laneweave.sim_bridge.bodies.cell_guard import CellGuard, stopping_distance_m, stopping_jerk
from laneweave.sim_bridge.bodies.plant import Plant
from support.examples import examples
from support.paper import PAPER

LATTICE, LIMITS, TICK_S = PAPER.lattice, PAPER.vehicle, PAPER.runtime.tick_s
SPEED_MPS = LATTICE.speed_mps
HOME: Cell = (0, 1)
DRIFT_M = 0.03
"""How far a body gets out of its cells because jerks are constant during ticks; the most in 120,000
random sequences of commands: 0.025 m."""


@examples(200)
@given(
    st.floats(-8.0, 8.0),
    st.floats(-1.0, 1.0),
    st.floats(3.0, 20.0),
    st.floats(1.0, 12.0),
)
def test_a_body_stops_within_its_stopping_distance(
    speed: float, share: float, max_jerk: float, max_accel: float
) -> None:
    accel, dt = share * max_accel, 0.002
    bound = stopping_distance_m(speed, accel, max_jerk, max_accel)
    position = farthest = 0.0
    for _ in range(round(30.0 / dt)):
        jerk = stopping_jerk(speed, accel, max_jerk, max_accel, dt)
        position += speed * dt + accel * dt * dt / 2.0
        speed += accel * dt + jerk * dt * dt / 2.0
        accel += jerk * dt
        farthest = max(farthest, position)
        if abs(speed) < 1e-3 and abs(accel) < 0.05:
            break
    assert farthest <= bound + 1e-3


def test_a_stopping_distance_is_no_larger_than_needed() -> None:
    """From 2 m/s with a jerk of 8 m/s3 and unlimited acceleration: 2 sqrt(w^3 / J) / 2."""
    assert stopping_distance_m(2.0, 0.0, 8.0, 100.0) == pytest.approx(1.0)
    # Within 3 m/s2: 2 / 3 + 3 / 8 seconds at 1 m/s on average.
    assert stopping_distance_m(2.0, 0.0, 8.0, 3.0) == pytest.approx(2.0 / 3.0 + 3.0 / 8.0)
    assert stopping_distance_m(-1.0, 0.0, 8.0, 3.0) == 0.0
    assert stopping_distance_m(0.0, -1.0, 8.0, 3.0) == 0.0


def driven(
    plant: Plant, guard: CellGuard, cells: tuple[Cell, Cell], jerk: float, across: float, tick: int
) -> bool:
    """Move by a tick with a jerk, or as the guard wants; return whether the jerk was executed."""
    t_s = tick * TICK_S
    commanded = commanded_state(plant.state, plant.setpoint, LIMITS, SPEED_MPS)
    wanted = jerk, across
    refused = guard.excess_m(commanded, wanted, cells, t_s) > 0.0
    if refused:
        goal = cell_state(LATTICE, cells[1], t_s)
        hold = hold_law(commanded, goal, LIMITS, TICK_S)
        wanted = guard.keep_in_cells(commanded, hold, cells, t_s)
    plant.step(*wanted)
    return not refused


MOVES = [HOME, (1, 1), (-1, 1), (0, 0), (0, 2), (1, 2), (-1, 0)]


@examples(100)
@given(st.data())
def test_no_jerks_lead_a_body_out_of_its_cells(data: st.DataObject) -> None:
    cells = (HOME, data.draw(st.sampled_from(MOVES)))
    guard = CellGuard(PAPER, LIMITS, lead_m=0.0)
    plant = Plant(cell_state(LATTICE, HOME, 0.0), LIMITS, TICK_S)
    every = data.draw(st.integers(1, 30))
    along = across = 0.0
    for tick in range(120):
        if tick % every == 0:
            along = data.draw(st.floats(-200.0, 200.0))
            across = data.draw(st.floats(-100.0, 100.0))
        driven(plant, guard, cells, along, across, tick)
        s_m, _, _, y_m, _, _ = plant.state
        t_s = (tick + 1) * TICK_S
        front_m = max(LATTICE.cell_s_m(column, t_s) for column, _ in cells)
        lanes_m = [LATTICE.cell_y_m(lane) for _, lane in cells]
        assert s_m <= front_m + DISPLACED_ALONG_M + DRIFT_M
        assert min(lanes_m) - ARRIVED_ACROSS_M - DRIFT_M <= y_m
        assert y_m <= max(lanes_m) + ARRIVED_ACROSS_M + DRIFT_M


def test_a_body_may_brake_and_come_back() -> None:
    guard = CellGuard(PAPER, LIMITS, lead_m=0.0)
    plant = Plant(cell_state(LATTICE, HOME, 0.0), LIMITS, TICK_S)
    assert all(driven(plant, guard, (HOME, HOME), -10.0, 0.0, tick) for tick in range(10))
    assert driven(plant, guard, (HOME, HOME), 10.0, 0.0, 10)


@pytest.mark.parametrize(("ahead_m", "executed"), [(3.0, True), (4.7, False)])
def test_a_body_that_has_entered_ahead_of_its_cell_only_falls_back(
    ahead_m: float, *, executed: bool
) -> None:
    guard = CellGuard(PAPER, LIMITS, lead_m=8.0)
    s, *rest = cell_state(LATTICE, HOME, 0.0)
    for lead_m in (8.0, 4.0, 6.0):
        guard.update((s + lead_m, *rest), HOME, 0.0)  # type: ignore[arg-type]
    assert guard.lead_m == 4.5
    state: State = (s + ahead_m, *rest)  # type: ignore[assignment]
    assert driven(Plant(state, LIMITS, TICK_S), guard, (HOME, HOME), 8.0, 0.0, 0) is executed


def test_a_body_outside_its_cells_gets_no_farther_out() -> None:
    guard = CellGuard(PAPER, LIMITS, lead_m=0.0)
    s, v, a, y, v_y, a_y = cell_state(LATTICE, HOME, 0.0)
    outside = (s, v, a, y + 2.0, v_y, a_y)
    assert not driven(Plant(outside, LIMITS, TICK_S), guard, (HOME, HOME), 0.0, 8.0, 0)
    assert driven(Plant(outside, LIMITS, TICK_S), guard, (HOME, HOME), 0.0, -8.0, 0)
