"""The motion controller plays what it was told, then brings its vehicle to rest."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from attrs import evolve

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import Command, Name
from laneweave.protocol.motion import cell_state
from laneweave.protocol.scenario import Scenario
from laneweave.sim_bridge.motion_controller import MAX_COLUMN, MotionController
from laneweave.sim_bridge.plant import Plant

SCENARIO = Scenario()
LATTICE, TICK_S = SCENARIO.lattice, SCENARIO.runtime.tick_s
HOME: Cell = (0, 1)


@pytest.fixture
def controller() -> MotionController:
    plant = Plant(cell_state(LATTICE, HOME, 0.0), SCENARIO.vehicle, TICK_S)
    return MotionController(plant, SCENARIO.vehicle, LATTICE, TICK_S, HOME)


def command(tick: int, *pairs: tuple[float, float], hold_cell: Cell = HOME) -> Command:
    played = np.array(pairs, dtype="<f4").tobytes()
    return Command(Name("v"), tick, hold_cell, tick + len(pairs), HOME, played)


def test_without_a_command_it_holds_its_cell(controller: MotionController) -> None:
    for tick in range(50):
        controller.step(tick)
    assert controller.plant.state == pytest.approx(cell_state(LATTICE, HOME, 50 * TICK_S))
    assert controller.played_from_hold == 50
    assert (controller.motion_origin, controller.motion_end_tick) == (HOME, 0)


def test_plays_jerk_by_jerk_and_from_the_middle_when_ticks_were_missed(
    controller: MotionController,
) -> None:
    assert controller.take(command(10, (1.0, 0.0), (2.0, 0.5), (-4.0, 0.0)))
    controller.step(11)
    assert controller.plant.state[2] == pytest.approx(2.0 * TICK_S)
    assert controller.plant.state[5] == pytest.approx(0.5 * TICK_S)
    controller.step(12)
    assert controller.plant.state[2] == pytest.approx(-2.0 * TICK_S)
    assert controller.played_from_hold == 0


def test_comes_to_rest_in_the_last_cell_when_the_trajectory_has_run_out(
    controller: MotionController,
) -> None:
    target: Cell = (1, 2)
    controller.take(command(0, *[(3.0, 0.0)] * 4, hold_cell=target))
    for tick in range(300):
        controller.step(tick)
    assert controller.played_from_hold == 296
    assert controller.plant.state == pytest.approx(cell_state(LATTICE, target, 30.0), abs=0.01)


def test_the_newest_command_counts(controller: MotionController) -> None:
    assert controller.take(command(5, (1.0, 0.0)))
    for tick in (5, 4, -1):
        assert not controller.take(command(tick, (9.0, 0.0), hold_cell=(1, 1)))
    assert (controller.command_tick, controller.hold_cell) == (5, HOME)
    assert controller.take(command(6, (2.0, 0.0), hold_cell=(1, 1)))
    assert (controller.command_tick, controller.hold_cell) == (6, (1, 1))
    assert (controller.motion_origin, controller.motion_end_tick) == (HOME, 7)


def test_a_command_without_jerks_is_a_hold(controller: MotionController) -> None:
    assert controller.take(command(0))
    controller.step(0)
    assert controller.played_from_hold == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"jerks": b"1234"},
        {"jerks": struct.pack("<3f", 1.0, 1.0, 1.0)},
        {"jerks": struct.pack("<2f", float("nan"), 0.0)},
        {"jerks": struct.pack("<4f", 0.0, 0.0, 0.0, float("-inf"))},
        {"hold_cell": (0, -1)},
        {"hold_cell": (0, LATTICE.lanes)},
        {"hold_cell": (MAX_COLUMN + 1, 0)},
        {"motion_origin": (-MAX_COLUMN - 1, 0)},
        {"motion_origin": (0, 2**62)},
    ],
)
def test_a_bad_command_is_refused_whole(
    controller: MotionController, changes: dict[str, object]
) -> None:
    controller.take(command(3, (1.0, 0.0)))
    bad = evolve(command(4, (2.0, 0.0), hold_cell=(1, 1)), **changes)  # type: ignore[arg-type]
    with pytest.raises(BadInputError):
        controller.take(bad)
    assert (controller.command_tick, controller.hold_cell) == (3, HOME)
    assert controller._jerk(3) == (1.0, 0.0)


def test_the_body_has_its_own_limits(controller: MotionController) -> None:
    controller.take(command(0, *[(3e38, -3e38)] * 100))
    for tick in range(100):
        controller.step(tick)
        _, v, a, _, v_y, a_y = controller.plant.state
        assert 0.0 <= v <= SCENARIO.vehicle.max_speed_mps + 1e-9
        assert a <= SCENARIO.vehicle.max_accel_mps2 + 1e-9
        assert abs(a_y) <= SCENARIO.vehicle.max_lateral_accel_mps2 + 1e-9
        assert abs(v_y) <= SCENARIO.vehicle.max_slip_ratio * v + 1e-9
