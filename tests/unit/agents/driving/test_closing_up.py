"""Bodies that follow the planned moves: where they get, and whether they could still brake."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from laneweave.agents.driving.move_bounds import TRACKING_ERROR_M, Envelope
from laneweave.agents.driving.qp_solver import SOLVED, QPResult, QuadraticProgram
from laneweave.agents.driving.trajectory import (
    InfeasibleTrajectoryError,
    Trajectory,
    check_moves,
    move_profile,
    plan_trajectory,
)
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.timing import MIN_TTC_S
from laneweave.protocol.vehicle.emergency_brake import ERROR_SIGMAS, EmergencyBrake, spare_error_m
from laneweave.protocol.vehicle.motion import Jerk, cell_state
from laneweave.protocol.wire.messages import Neighbour
from laneweave.sim_bridge.bodies.plant import Plant

SCENARIO = Scenario()
LIMITS, LATTICE, TICK_S = SCENARIO.vehicle, SCENARIO.lattice, SCENARIO.runtime.tick_s
V_F = LATTICE.speed_mps
SLOTS_S = (4.0, 4.6, 5.0, 5.4, 6.0, 7.0)
"""The paper's T_F, the shortest with gentle moves, those of the rolling operation, the longest."""
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
BRAKE = EmergencyBrake(LIMITS, SCENARIO.braking, TICK_S)
ERROR_M = spare_error_m(LIMITS, SCENARIO.braking, SCENARIO.sensing, 1.5 * V_F, V_F)
PROMISED_M = ERROR_SIGMAS * ERROR_M + TRACKING_ERROR_M
"""What moves forwards leave beyond the margin."""


def mover(origin: Cell) -> Plant:
    return Plant(cell_state(LATTICE, origin, 0.0), LIMITS, TICK_S)


def profile_of(dx: int, dy: int, slot_s: float) -> Trajectory:
    return move_profile(SCENARIO, LIMITS, dx, dy, SCENARIO.timing.move_ticks(slot_s))


def jerks_of(dx: int, dy: int, slot_s: float) -> Iterator[Jerk]:
    """Yield the jerks of a slot: those of a move, and none after it."""
    profile = profile_of(dx, dy, slot_s)
    for tick in range(round(slot_s / TICK_S)):
        yield tuple(profile.jerks[tick].tolist()) if tick < profile.ticks else (0.0, 0.0)


def spare_m(own: Plant, jerk: Jerk, other: Plant) -> float:
    gap_m = other.state[0] - LIMITS.length_m - own.state[0]
    seen = Neighbour(1, gap_m, other.state[1], other.state[2])
    return BRAKE.spare_m(own.state, own.setpoint[0], jerk, [seen])


@pytest.mark.parametrize("slot_s", SLOTS_S)
@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_a_body_is_in_its_cell_when_the_move_is_over_and_closer_when_the_slot_is(
    dx: int, dy: int, slot_s: float
) -> None:
    own, errors = mover((0, 1)), []
    for tick, jerk in enumerate(jerks_of(dx, dy, slot_s), start=1):
        own.step(*jerk)
        goal = cell_state(LATTICE, (dx, 1 + dy), tick * TICK_S)
        errors.append(max(abs(own.state[0] - goal[0]), abs(own.state[3] - goal[3])))
    assert errors[profile_of(dx, dy, slot_s).ticks - 1] <= 0.12
    assert errors[-1] <= 0.05


@pytest.mark.parametrize("slot_s", SLOTS_S)
@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_every_move_leaves_room_to_brake_behind_a_vehicle_that_holds_beyond(
    dx: int, dy: int, slot_s: float
) -> None:
    """One column beyond the target, or beyond the origin where the vehicle falls back."""
    own, other = mover((0, 1)), mover((max(dx, 0) + 1, 1))
    least_m = float("inf")
    for jerk in jerks_of(dx, dy, slot_s):
        least_m = min(least_m, spare_m(own, jerk, other))
        own.step(*jerk)
        other.step(0.0, 0.0)
    # Between the tangents that stand for it, the square of the speed is up to this much greater.
    assert least_m >= PROMISED_M - 0.045
    if dx > 0 and slot_s == SLOTS_S[0]:
        assert least_m <= PROMISED_M + 0.2  # and no more than that: it is what costs time


@pytest.mark.parametrize("slot_s", SLOTS_S)
@pytest.mark.parametrize("dy", [-1, 0, 1])
def test_a_vehicle_that_holds_behind_has_room_to_brake_when_another_falls_back(
    dy: int, slot_s: float
) -> None:
    own, other = mover((0, 1)), mover((2, 1))
    for jerk in jerks_of(-1, dy, slot_s):
        assert spare_m(own, (0.0, 0.0), other) > 3.0
        own.step(0.0, 0.0)
        other.step(*jerk)


@pytest.mark.parametrize("slot_s", [one for one in SCENARIO.timing.slots_s if one > 4.5])
@pytest.mark.parametrize("dy", [-1, 0, 1])
@pytest.mark.parametrize("dx", [-1, 1])
def test_moves_by_a_column_are_gentle_where_the_slot_permits(
    dx: int, dy: int, slot_s: float
) -> None:
    """No body comes below 3 s to collision with a vehicle that holds beyond the target."""
    own, other = mover((0, 1)), mover((2 * dx, 1))
    least_s = float("inf")
    for jerk in jerks_of(dx, dy, slot_s):
        own.step(*jerk)
        other.step(0.0, 0.0)
        gap_m = abs(other.state[0] - own.state[0]) - LIMITS.length_m
        closing_mps = dx * (own.state[1] - other.state[1])
        if closing_mps > 0.0:
            least_s = min(least_s, gap_m / closing_mps)
    assert least_s >= MIN_TTC_S - 0.05
    _, v, a, *_ = profile_of(dx, dy, slot_s).states.T
    move_s = slot_s - SCENARIO.formation.slack_s
    assert abs(v).max() < 0.93 * 15.0 / 8.0 * SCENARIO.formation.gap_m / move_s  # minimum jerk
    assert abs(a).max() <= LIMITS.max_accel_mps2
    assert (dx * np.diff(profile_of(dx, dy, slot_s).states[:, 0]) >= -1e-4).all()


def test_forward_moves_close_up_early() -> None:
    """They brake for longer than they accelerate; braking burns no fuel."""
    ahead, back = (profile_of(dx, 0, 6.0).states for dx in (1, -1))
    half = len(ahead) // 2
    assert ahead[half, 0] > 0.505 * SCENARIO.formation.gap_m
    assert abs(back[half, 0]) == pytest.approx(0.5 * SCENARIO.formation.gap_m, rel=1e-3)
    assert (ahead[:, 2] < 0.0).sum() > (ahead[:, 2] > 0.0).sum()


@pytest.mark.parametrize("dx", [-1, 1])
def test_moves_in_the_papers_slots_are_those_of_minimum_jerk(dx: int) -> None:
    """They cannot be gentle within the limits."""
    pitch_m, gap_m = SCENARIO.formation.gap_m, 2.0 * SCENARIO.formation.gap_m - LIMITS.length_m
    envelope = Envelope.behind(SCENARIO, LIMITS, gap_m) if dx > 0 else None
    fastest = plan_trajectory(LIMITS, V_F, TICK_S, 38, dx * pitch_m, 0.0, envelope)
    assert (profile_of(dx, 0, 4.0).states == fastest.states).all()


def test_moves_keep_what_the_limits_allow() -> None:
    """Where the first bound is infeasible, the second applies; without a feasible one, neither."""
    stiff = parse_scenario(
        {
            "formation": {"gap_m": 20.0, "speed_mps": 20.0, "cycle_s": 5.0},
            "vehicle": {"max_jerk_mps3": 10.0, "max_speed_mps": 30.0},
        }
    )
    assert min_ttc_s(stiff, 1) == pytest.approx(MIN_TTC_S, abs=0.01)
    assert min_ttc_s(parse_scenario({"formation": {"gap_m": 20.0, "cycle_s": 4.6}}), -1) < 2.9


@pytest.mark.parametrize(
    ("gap_m", "limits"),
    [
        *((gap_m, {}) for gap_m in (9.0, 10.0, 13.0, 15.0, 25.0)),
        (10.0, {"max_accel_mps2": 3.5}),
        (15.0, {"max_accel_mps2": 3.0}),
        (20.0, {"max_accel_mps2": 8.0}),
        (15.0, {"max_jerk_mps3": 10.0}),
        (15.0, {"max_accel_mps2": 8.0, "length_m": 3.0}),
        (15.0, {"length_m": 7.0}),
    ],
)
def test_slots_from_which_moves_are_gentle(gap_m: float, limits: dict[str, float]) -> None:
    def are_gentle(cycle_s: float) -> bool:
        formation = {"gap_m": gap_m, "cycle_s": cycle_s}
        scenario = parse_scenario({"formation": formation, "vehicle": limits})
        try:
            return all(min_ttc_s(scenario, dx) >= MIN_TTC_S - 0.01 for dx in (1, -1))
        except InfeasibleTrajectoryError:
            return False

    found = parse_scenario({"formation": {"gap_m": gap_m}, "vehicle": limits}).timing
    assert are_gentle(found.gentle_cycle_s)
    shorter_s = found.gentle_cycle_s - 1.4
    assert shorter_s < found.slots_s[0] or not are_gentle(shorter_s)


def test_the_slots_of_the_default_scenario() -> None:
    timing = SCENARIO.timing
    slots_s = (timing.gentle_cycle_s, timing.brisk_cycle_s, timing.comfortable_cycle_s)
    assert slots_s == pytest.approx((4.6, 5.2, 5.6))


def min_ttc_s(scenario: Scenario, dx: int) -> float:
    """Return the time to collision of a planned move with a vehicle that holds beyond."""
    _, v, *_ = (states := move_profile(scenario, scenario.vehicle, dx, 0).states).T
    gaps_m = 2.0 * scenario.formation.gap_m - scenario.vehicle.length_m - np.abs(states[:, 0])
    return float((gaps_m[1:-1] / np.abs(v[1:-1])).min())


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[QPResult]:
    """Return a list to which all results of quadratic programs are added; caches are empty."""
    found: list[QPResult] = []
    solve = QuadraticProgram.solve

    def counted(program: QuadraticProgram) -> QPResult:
        found.append(solve(program))
        return found[-1]

    monkeypatch.setattr(QuadraticProgram, "solve", counted)
    for cached in (move_profile, plan_trajectory):
        cached.cache_clear()
    return found


def test_profiles_are_found_far_below_the_iteration_limit(solved: list[QPResult]) -> None:
    """Other builds of OSQP may need more iterations."""
    for slot_s in (4.6, 5.0, 5.4, 6.0):
        for dx, dy in displacements(2)[1:]:
            profile_of(dx, dy, slot_s)
    assert all(one.status == SOLVED for one in solved)
    assert max(one.iterations for one in solved) < 20_000


def test_scenarios_with_equal_moves_share_profiles_and_infeasible_bounds(
    solved: list[QPResult],
) -> None:
    tables = {"formation": {"operation": "rolling", "cycle_s": 4.0}}
    check_moves(parse_scenario(tables))
    assert any(not one.usable for one in solved)
    count = len(solved)
    check_moves(parse_scenario({"seed": 2, **tables}))
    assert len(solved) == count


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
