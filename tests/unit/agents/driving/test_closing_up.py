"""Bodies that follow the planned moves: where they get, and whether they could still brake."""

from __future__ import annotations

import pytest

from laneweave.agents.driving.trajectory import (
    _TRACKING_ERROR_M,
    check_moves,
    move_profile,
)
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import ERROR_SIGMAS, EmergencyBrake, spare_error_m
from laneweave.protocol.vehicle.motion import Jerk, cell_state
from laneweave.protocol.wire.messages import Neighbour
from laneweave.sim_bridge.bodies.plant import Plant

SCENARIO = Scenario()
LIMITS, LATTICE, TICK_S = SCENARIO.vehicle, SCENARIO.lattice, SCENARIO.runtime.tick_s
V_F = LATTICE.speed_mps
SLOT_TICKS = round(SCENARIO.timing.cycles_s[0] / TICK_S)
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
BRAKE = EmergencyBrake(LIMITS, SCENARIO.braking, TICK_S)
ERROR_M = spare_error_m(LIMITS, SCENARIO.braking, SCENARIO.sensing, 1.5 * V_F, V_F)
PROMISED_M = ERROR_SIGMAS * ERROR_M + _TRACKING_ERROR_M
"""What moves forwards leave beyond the margin."""


def mover(origin: Cell) -> Plant:
    return Plant(cell_state(LATTICE, origin, 0.0), LIMITS, TICK_S)


def jerk_of(dx: int, dy: int, tick: int) -> Jerk:
    profile = move_profile(SCENARIO, LIMITS, dx, dy)
    return tuple(profile.jerks[tick].tolist()) if tick < profile.ticks else (0.0, 0.0)


def spare_m(own: Plant, jerk: Jerk, other: Plant) -> float:
    gap_m = other.state[0] - LIMITS.length_m - own.state[0]
    seen = Neighbour(1, gap_m, other.state[1], other.state[2])
    return BRAKE.spare_m(own.state, own.setpoint[0], jerk, [seen])


@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_a_body_is_in_its_cell_when_the_move_is_over_and_closer_when_the_slot_is(
    dx: int, dy: int
) -> None:
    own = mover((0, 1))
    for tick in range(SLOT_TICKS + 1):
        goal = cell_state(LATTICE, (dx, 1 + dy), tick * TICK_S)
        errors = abs(own.state[0] - goal[0]), abs(own.state[3] - goal[3])
        if tick == move_profile(SCENARIO, LIMITS, dx, dy).ticks:
            assert max(errors) <= 0.12
        if tick == SLOT_TICKS:
            assert max(errors) <= 0.05
        own.step(*jerk_of(dx, dy, tick))


@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_every_move_leaves_room_to_brake_behind_a_vehicle_that_holds_beyond(
    dx: int, dy: int
) -> None:
    """One column beyond the target, or beyond the origin where the vehicle falls back."""
    own, other = mover((0, 1)), mover((max(dx, 0) + 1, 1))
    least_m = float("inf")
    for tick in range(SLOT_TICKS):
        jerk = jerk_of(dx, dy, tick)
        least_m = min(least_m, spare_m(own, jerk, other))
        own.step(*jerk)
        other.step(0.0, 0.0)
    # Between the tangents that stand for it, the square of the speed is up to this much greater.
    assert least_m >= PROMISED_M - 0.045
    if dx > 0:
        assert least_m <= PROMISED_M + 0.2  # and no more than that: it is what costs time


@pytest.mark.parametrize("dy", [-1, 0, 1])
def test_a_vehicle_that_holds_behind_has_room_to_brake_when_another_falls_back(dy: int) -> None:
    own, other = mover((0, 1)), mover((2, 1))
    for tick in range(SLOT_TICKS):
        assert spare_m(own, (0.0, 0.0), other) > 3.0
        own.step(0.0, 0.0)
        other.step(*jerk_of(-1, dy, tick))


@pytest.mark.parametrize(
    ("table", "names"),
    [
        ({"braking": {"lead_lag_s": 0.0}}, ("formation.gap_m", "braking")),
        ({"braking": {"margin_m": 3.0}}, ("formation.gap_m", "braking")),
        ({"formation": {"cycle_s": 4.0, "move_s": 3.0}}, ("formation.gap_m", "braking")),
        ({"vehicle": {"max_lateral_accel_mps2": 0.3}}, ("table vehicle",)),
    ],
)
def test_moves_that_cannot_be_driven_are_refused_with_what_to_change(
    table: dict[str, dict[str, float]], names: tuple[str, ...]
) -> None:
    with pytest.raises(BadInputError) as caught:
        check_moves(parse_scenario(table))
    error = caught.value
    assert error.field == "formation.move_s"
    assert len(str(error).splitlines()) == 1
    assert all(name in error.allowed for name in names)
    assert ("room to brake" in error.allowed) == ("braking" in names)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [1, 2])
def test_the_defaults_can_be_driven(mode: int) -> None:
    check_moves(parse_scenario({"formation": {"mode": mode}}))
