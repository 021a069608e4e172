"""Vehicles that enter beside their cells settle in them, also when another process takes over."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.agents.driving.driver import TrackingDriver
from laneweave.agents.driving.reference import Reference
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state
from laneweave.protocol.wire.messages import CurrentMotion, Name, Sense, VehicleRecord
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.examples import examples

SCENARIO = Scenario()
LATTICE, LIMITS, TICK_S = SCENARIO.lattice, SCENARIO.vehicle, SCENARIO.runtime.tick_s
CELL: Cell = (-3, 1)
BEGIN_TICK = 30
END_TICK = BEGIN_TICK + round(SCENARIO.formation.settle_s / TICK_S)
TWO_CLOSE_M = 13.0
"""What `formation.settle_s` promises of two that follow each other closely, front to front."""


def beside(offset_m: float, tick: int = BEGIN_TICK, *, faster_mps: float = 0.0) -> State:
    """Return the state of a vehicle that is so far ahead of its cell."""
    s, v, a, y, v_y, a_y = cell_state(LATTICE, CELL, tick * TICK_S)
    return (s + offset_m, v + faster_mps, a, y, v_y, a_y)


def settling(state: State, tick: int = BEGIN_TICK) -> Reference:
    return Reference.settling(SCENARIO, LIMITS, CELL, state, tick, END_TICK)


def path(reference: Reference, tick: int = BEGIN_TICK) -> np.ndarray:
    """Return where the reference is at each tick, relative to the cell."""
    rows = [
        reference.window(each).states[0] - cell_state(LATTICE, CELL, each * TICK_S)
        for each in range(tick, END_TICK + 20)
    ]
    return np.array(rows)


# --- the reference ----------------------------------------------------------------------------


@given(st.floats(-22.5, 22.5), st.floats(-1.0, 1.0))
@examples(50)
def test_leads_from_where_it_is_to_rest_in_the_cell(offset_m: float, faster_mps: float) -> None:
    rows = path(settling(beside(offset_m, faster_mps=faster_mps)))
    np.testing.assert_allclose(rows[0], [offset_m, faster_mps, 0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(rows[END_TICK - BEGIN_TICK :], 0.0, atol=1e-6)


@given(st.floats(-22.5, 22.5))
@examples(30)
def test_no_limit_is_approached_and_no_vehicle_overshoots(offset_m: float) -> None:
    reference = settling(beside(offset_m))
    rows = path(reference)
    assert np.abs(rows[:, 2]).max() < 0.5 * LIMITS.max_accel_mps2
    assert rows[:, 1].max() + 15.0 < LIMITS.max_speed_mps
    assert np.abs(reference.window(BEGIN_TICK).jerks).max() < 0.5 * LIMITS.max_jerk_mps3
    assert (np.diff(rows[:, 0]) * np.sign(offset_m) <= 1e-9).all()
    assert rows[:, 3:] == pytest.approx(0.0)


@pytest.mark.parametrize("offset_m", [7.5, 0.0, -7.5])
def test_two_that_enter_close_behind_each_other_stay_apart(offset_m: float) -> None:
    """The first one is half a column ahead of its cell, the second one enters the cell behind."""
    first, second = path(settling(beside(7.5)))[:, 0], path(settling(beside(offset_m)))[:, 0]
    later = round((1.0 + (7.5 - offset_m) / 15.0) / TICK_S)
    apart = 15.0 + first[later:] - second[: len(first) - later]
    assert apart[0] >= 13.0
    assert apart.min() >= TWO_CLOSE_M


# --- the vehicle and its driver ---------------------------------------------------------------


def entering(offset_m: float) -> RoadVehicle:
    t_s = BEGIN_TICK * TICK_S
    admission = Admission(Arrival("A", 1, 0, 0.0), CELL, t_s, offset_m)
    vehicle = RoadVehicle.entering(admission, t_s, SCENARIO)
    vehicle.sensors = None
    return vehicle


@pytest.mark.parametrize("offset_m", [-7.5, 0.0, 4.0, 7.5])
def test_a_vehicle_that_enters_beside_its_cell_moves(offset_m: float) -> None:
    vehicle = entering(offset_m)
    controller = vehicle.controller
    assert vehicle.state == pytest.approx(beside(offset_m))
    assert (controller.hold_cell, controller.motion.origin) == (CELL, CELL)
    assert controller.motion.end_tick == (END_TICK if offset_m else 0)
    assert controller.moving(BEGIN_TICK) is bool(offset_m)


def drive(driver: TrackingDriver, plant: Plant, ticks: range) -> list[State]:
    """Let a driver drive, and return where the vehicle is before and after each tick."""
    states = [plant.state]
    for tick in ticks:
        drive = driver.drive(sense(plant, tick), moving=True)
        along, across = np.frombuffer(drive.jerks, "<f4").reshape(-1, 2)[0].tolist()
        plant.step(along, across)
        states.append(plant.state)
        assert (drive.motion.origin, drive.motion.end_tick) == (CELL, max(END_TICK, tick + 1))
    return states


def body(offset_m: float, tick: int = BEGIN_TICK) -> Plant:
    return Plant(beside(offset_m, tick), LIMITS, TICK_S)


def sense(plant: Plant, tick: int) -> Sense:
    return Sense(
        Name("A"), tick, tick * TICK_S, plant.state, CELL, CurrentMotion(CELL, END_TICK), 0,
        VehicleRecord(), (), setpoint=plant.setpoint,
    )  # fmt: skip


@pytest.mark.parametrize("takes_over", [5, 50, 95])
@pytest.mark.parametrize("offset_m", [-7.5, 7.5])
def test_a_driver_takes_over_in_the_middle(offset_m: float, takes_over: int) -> None:
    """The next driver goes on from where the vehicle is, and is there at the same time."""
    first, second = TrackingDriver(SCENARIO, LIMITS), TrackingDriver(SCENARIO, LIMITS)
    plant = body(offset_m)
    first.take_over(sense(plant, BEGIN_TICK))
    assert not first.at_rest(sense(plant, BEGIN_TICK))
    middle, end = BEGIN_TICK + takes_over, END_TICK + 5
    states = drive(first, plant, range(BEGIN_TICK, middle))
    second.take_over(sense(plant, middle))
    states += drive(second, plant, range(middle, end))[1:]
    assert states[-1] == pytest.approx(cell_state(LATTICE, CELL, end * TICK_S), abs=0.1)
    assert second.at_rest(sense(plant, end))
    along = [
        state[0] - LATTICE.cell_s_m(CELL[0], (BEGIN_TICK + index) * TICK_S)
        for index, state in enumerate(states)
    ]
    assert max(abs(each) for each in along) <= abs(offset_m) + 0.1
    assert min(each * np.sign(offset_m) for each in along) > -0.1


def test_settling_is_not_published() -> None:
    """Only moves between cells are."""
    driver = TrackingDriver(SCENARIO, LIMITS)
    driver.take_over(sense(body(7.5), BEGIN_TICK))
    assert [tick for tick in range(BEGIN_TICK, END_TICK) if driver.motion(tick)] == []


@pytest.mark.parametrize("ticks_left", [0, 1, 3])
def test_with_no_time_left_the_driver_holds(ticks_left: int) -> None:
    driver = TrackingDriver(SCENARIO, LIMITS)
    tick = END_TICK - ticks_left
    here = sense(body(0.01, tick), tick)
    driver.take_over(here)
    jerks = np.frombuffer(driver.drive(here, moving=True).jerks, "<f4")
    assert np.isfinite(jerks).all()
    assert np.abs(jerks).max() <= LIMITS.max_jerk_mps3
