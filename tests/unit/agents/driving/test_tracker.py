"""The tracker in closed loop with a vehicle without lag: its states are commanded ones."""

from __future__ import annotations

import copy
import math
import pickle
import random
import threading
from collections.abc import Callable

import numpy as np
import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.agents.driving.qp_solver import QuadraticProgram
from laneweave.agents.driving.reference import Reference, Window
from laneweave.agents.driving.stopping_points import StoppingPoints
from laneweave.agents.driving.surroundings import Surroundings
from laneweave.agents.driving.tracker import Tracker, TrackResult
from laneweave.agents.driving.tracking_problem import (
    NO_GAPS,
    SETTINGS,
    Gaps,
    ProgramKind,
    TrackingProgram,
    shared_program,
)
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import Jerk, State, cell_state, integrate, limited_jerk
from laneweave.protocol.wire.messages import Neighbour
from support.examples import examples
from support.states import sense_in
from support.tables import for_each

SCENARIO = Scenario()
SHORTCUT = evolve(SCENARIO, tracking=evolve(SCENARIO.tracking, shortcut=True))
LIMITS = SCENARIO.vehicle
LATTICE = SCENARIO.lattice
TICK_S = SCENARIO.runtime.tick_s
N = SCENARIO.timing.horizon_ticks
HOME: Cell = (0, 1)
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0)]
TIMES_S = TICK_S * np.arange(N + 1)

Predict = Callable[[int], np.ndarray]
"""Predicted rear bumper of the vehicle ahead at a tick and the next N."""


def excess(state: State, jerk: Jerk) -> float:
    """Return by how much a state or the jerk that led to it breaks a limit, at most."""
    _, v, a, _, v_y, a_y = state
    return max(
        a - LIMITS.max_accel_mps2,
        LIMITS.min_accel_mps2 - a,
        -v,
        v - LIMITS.max_speed_mps,
        abs(a_y) - LIMITS.max_lateral_accel_mps2,
        abs(v_y) - LIMITS.max_slip_ratio * v,
        abs(jerk[0]) - LIMITS.max_jerk_mps3,
        abs(jerk[1]) - LIMITS.max_lateral_jerk_mps3,
    )


def shifted(state: State, *by: float) -> State:
    s, v, a, y, v_y, a_y = (now + more for now, more in zip(state, by, strict=True))
    return s, v, a, y, v_y, a_y


def error(state: State, cell: Cell, tick: int) -> np.ndarray:
    return np.array(state) - cell_state(LATTICE, cell, tick * TICK_S)


def behind_of(rear_m: np.ndarray) -> Gaps:
    """Return the gaps that a vehicle ahead leaves whose rear bumper will be there."""
    return Gaps(latest=rear_m - SCENARIO.tracking.min_gap_m)


def drive(
    reference: Reference,
    state: State,
    ticks: int,
    predict: Predict | None = None,
    tracker: Tracker | None = None,
) -> list[tuple[State, TrackResult]]:
    """Close the loop with the exact plant; return each tick's next state and result."""
    tracker = tracker or Tracker(SCENARIO, LIMITS)
    log = []
    for tick in range(ticks):
        gaps = behind_of(predict(tick)) if predict else Gaps()
        result = tracker.solve(state, reference.window(tick), gaps)
        assert result.usable
        jerk = (float(result.jerk[0, 0]), float(result.jerk[0, 1]))
        state = integrate(state, jerk, TICK_S)
        log.append((state, result))
    return log


def first_jerk(result: TrackResult) -> Jerk:
    return float(result.jerk[0, 0]), float(result.jerk[0, 1])


def braking(gap_m: float, decel: float, start_tick: int, end_speed: float = 0.0) -> Predict:
    """Return predictions of a vehicle `gap_m` ahead that brakes from 15 m/s to `end_speed`."""

    def rear(t: np.ndarray) -> np.ndarray:
        braked = np.clip(t - start_tick * TICK_S, 0.0, (15.0 - end_speed) / decel)
        return (
            gap_m
            + 15.0 * t
            - decel * braked * (np.maximum(t - start_tick * TICK_S, 0.0))
            + (decel / 2.0 * braked * braked)
        )

    return lambda tick: rear(tick * TICK_S + TIMES_S)


@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_ideal_move_ends_in_the_target_cell_within_limits(dx: int, dy: int) -> None:
    reference = Reference.move(SCENARIO, LIMITS, (0, 1), (dx, 1 + dy), 5)
    log = drive(reference, cell_state(LATTICE, (0, 1), 0.0), 43)
    for state, result in log:
        assert excess(state, first_jerk(result)) <= 1e-6
        assert result.iterations <= 25
    assert np.abs(error(log[-1][0], (dx, 1 + dy), 43)).max() < 0.01


@pytest.mark.slow
@examples(12)
@given(
    st.floats(-60, 60),
    st.floats(-14, 9),
    st.floats(-4, 4),
    st.floats(-4, 4),
)
def test_far_starts_converge_within_limits(ds: float, dv: float, a: float, dy: float) -> None:
    """Whatever the state, if limits can be kept from it they are, and the cell is reached."""
    start = shifted(cell_state(LATTICE, (0, 1), 0.0), ds, dv, a, dy, 0.0, 0.0)
    _, v, a, *_ = start
    keepable = a * a / 30.0 + abs(a) * TICK_S
    if v < keepable or v > LIMITS.max_speed_mps - keepable:
        return
    log = drive(Reference.hold(SCENARIO, LIMITS, (0, 1)), start, 420)
    assert max(excess(state, first_jerk(result)) for state, result in log) <= 1e-3
    assert np.abs(error(log[-1][0], (0, 1), 420)).max() < 0.05


@pytest.mark.parametrize(
    "start",
    [
        (0.0, 0.5, -10.0, 5.25, 0.0, 0.0),
        (0.0, 3.0, -10.0, 5.25, 0.0, 0.0),
        (0.0, 4.0, -10.0, 5.25, 1.6, 1.4),
        (0.0, 24.9, 5.0, 5.25, 0.0, 0.0),
        (0.0, 27.0, 0.0, 5.25, 0.0, 0.0),
        (0.0, 15.0, 6.0, 5.25, 0.0, 4.0),
        (0.0, -0.5, 0.0, 5.25, 0.1, 0.0),
    ],
)
def test_states_that_break_a_limit_are_recovered_from(start: State) -> None:
    log = drive(Reference.hold(SCENARIO, LIMITS, (0, 1)), start, 400)
    assert all(excess(state, first_jerk(result)) <= 1e-3 for state, result in log[20:])
    assert np.abs(error(log[-1][0], (0, 1), 400)).max() < 0.02


def predicted(state: State, result: TrackResult) -> list[tuple[State, Jerk]]:
    way = []
    for along, across in result.jerk.tolist():
        state = integrate(state, (along, across), TICK_S)
        way.append((state, (along, across)))
    return way


@examples(60)
@given(
    st.tuples(
        st.floats(-8, 8),
        st.floats(-4, 4),
        st.floats(-5, 4),
        st.floats(-2, 2),
        st.floats(-1, 1),
        st.floats(-1, 1),
    ),
    st.sampled_from(MOVES),
    st.integers(0, 40),
)
def test_the_whole_plan_keeps_the_limits(
    by: tuple[float, ...], move: tuple[int, int], tick: int
) -> None:
    """What the fallback may have to play is within the limits too, not only the first tick."""
    window = Reference.move(SCENARIO, LIMITS, (0, 1), (move[0], 1 + move[1]), 0).window(tick)
    now: State = tuple(window.states[0].tolist())
    start = shifted(now, *by)
    if excess(start, (0.0, 0.0)) > 0.0 or _doomed(start):
        return
    if LIMITS.max_slip_ratio * start[1] - abs(start[4]) < 1.0:
        return  # where the slip limit holds a body back, its lateral jerk gives way
    result = Tracker(SCENARIO, LIMITS).solve(start, window)
    assert result.usable
    for state, (along, across) in predicted(start, result):
        room = LIMITS.max_slip_ratio * state[1] - abs(state[4])
        # As above.
        counted = across if room >= 1.0 else 0.0
        assert excess(state, (along, counted)) <= 2e-3


def _doomed(state: State) -> bool:
    """Tell whether the limits cannot be kept from here with the jerk limits."""
    jerk = limited_jerk(state, (0.0, 0.0), LIMITS, TICK_S)
    for _ in range(30):
        if excess(state, jerk) > 1e-9:
            return True
        state = integrate(state, jerk, TICK_S)
        jerk = limited_jerk(state, (0.0, 0.0), LIMITS, TICK_S)
    return False


@pytest.mark.slow
@pytest.mark.parametrize("decel", [1.0, 3.0, 6.0, 9.0])
def test_stays_behind_a_vehicle_that_brakes_to_standstill(decel: float) -> None:
    predict = braking(10.0, decel, 10)
    log = drive(
        Reference.hold(SCENARIO, LIMITS, (0, 1)), cell_state(LATTICE, (0, 1), 0.0), 220, predict
    )
    gaps = [predict(tick + 1)[0] - state[0] for tick, (state, _) in enumerate(log)]
    assert min(gaps) >= SCENARIO.tracking.min_gap_m - 0.2
    assert gaps[-1] <= SCENARIO.tracking.min_gap_m + 1.5
    assert log[-1][0][1] == pytest.approx(0.0, abs=0.05)
    assert max(excess(state, first_jerk(result)) for state, result in log) <= 1e-3
    assert min(state[2] for state, _ in log) >= -1.2 * decel - 1.0


@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_a_vehicle_that_stops_ahead_during_a_move(dx: int, dy: int) -> None:
    """Braking to standstill in the middle of a lane change: no collision, no sideways slide."""
    predict = braking(10.0 + 15.0 * max(dx, 0), 6.0, 18)
    reference = Reference.move(SCENARIO, LIMITS, (0, 1), (dx, 1 + dy), 0)
    log = drive(reference, cell_state(LATTICE, (0, 1), 0.0), 120, predict)
    gaps = [predict(tick + 1)[0] - state[0] for tick, (state, _) in enumerate(log)]
    assert min(gaps) >= SCENARIO.tracking.min_gap_m - 0.5
    for state, result in log:
        _, v, a, _, v_y, a_y = state
        assert v >= -1e-3
        assert LIMITS.min_accel_mps2 - 1e-3 <= a <= LIMITS.max_accel_mps2 + 1e-3
        assert abs(a_y) <= LIMITS.max_lateral_accel_mps2 + 1e-3
        assert abs(v_y) <= LIMITS.max_slip_ratio * v + 0.05
        assert abs(result.jerk[0, 0]) <= LIMITS.max_jerk_mps3 + 1e-3
    assert max(result.iterations for _, result in log) <= 800


def test_follows_a_slower_vehicle_and_returns_to_its_cell_when_it_has_gone() -> None:
    slow = braking(10.0, 2.0, 10, end_speed=10.0)
    reference = Reference.hold(SCENARIO, LIMITS, (0, 1))

    def predict(tick: int) -> np.ndarray:
        return slow(tick) if tick < 100 else np.full(N + 1, np.inf)

    log = drive(reference, cell_state(LATTICE, (0, 1), 0.0), 420, predict)
    gap = predict(100 - 1)[0] - log[98][0][0]
    assert SCENARIO.tracking.min_gap_m - 0.2 <= gap <= SCENARIO.tracking.min_gap_m + 1.5
    assert log[98][0][1] == pytest.approx(10.0, abs=0.3)
    assert np.abs(error(log[-1][0], (0, 1), 420)).max() < 0.02


def test_a_vehicle_cutting_in_opens_the_gap_again() -> None:
    def predict(tick: int) -> np.ndarray:
        return 1.0 + 15.0 * (tick * TICK_S + TIMES_S)

    log = drive(
        Reference.hold(SCENARIO, LIMITS, (0, 1)), cell_state(LATTICE, (0, 1), 0.0), 200, predict
    )
    gaps = [predict(tick + 1)[0] - state[0] for tick, (state, _) in enumerate(log)]
    assert min(gaps) >= 0.9
    assert gaps[40] >= SCENARIO.tracking.min_gap_m - 0.1
    assert gaps[-1] <= SCENARIO.tracking.min_gap_m + 1.0
    assert max(excess(state, first_jerk(result)) for state, result in log) <= 1e-3


@for_each("tick_s", [0.06, 0.1, 0.13, 0.15, 0.2, 0.35])
def test_the_gap_behind_a_vehicle_that_is_too_near_is_opened_again(tick_s: float) -> None:
    """Also where a second, for which neighbours are predicted, is no whole number of ticks."""
    gap_m, v_f, slot_s = 1.5, LATTICE.speed_mps, 60 * tick_s if tick_s < 0.1 else 40 * tick_s
    scenario = parse_scenario(
        {
            "runtime": {"tick_s": tick_s},
            "braking": {"reaction_s": tick_s},
            "formation": {"cycle_s": slot_s, "move_s": slot_s - 2 * tick_s},
        }
    )
    surroundings, tracker = Surroundings(scenario, LIMITS), Tracker(scenario, LIMITS)
    reference, state = Reference.hold(scenario, LIMITS, HOME), cell_state(LATTICE, HOME, 0.0)
    for tick in range(round(4.0 / tick_s)):
        near = (Neighbour(HOME[1], gap_m, v_f),)
        felt = sense_in(HOME, tick, measured=state, ahead=near)
        gaps = surroundings.gaps(felt, state, HOME[1])
        result = tracker.solve(state, reference.window(tick), gaps)
        moved = integrate(state, (result.jerk[0, 0], result.jerk[0, 1]), tick_s)
        gap_m += v_f * tick_s - (moved[0] - state[0])
        state = moved
    assert gap_m > 3.0


@pytest.mark.parametrize("distance", [1e3, 1e9, math.inf])
def test_a_distant_vehicle_changes_nothing(distance: float) -> None:
    reference = Reference.move(SCENARIO, LIMITS, (0, 1), (1, 2), 0)
    alone, behind = Tracker(SCENARIO, LIMITS), Tracker(SCENARIO, LIMITS)
    start = shifted(cell_state(LATTICE, (0, 1), 0.0), 0.3, -0.2, 0.0, 0.1, 0.0, 0.0)
    expected = alone.solve(start, reference.window(0))
    result = behind.solve(start, reference.window(0), behind_of(np.full(N + 1, distance)))
    np.testing.assert_allclose(result.jerk, expected.jerk, atol=0.05)


@pytest.mark.parametrize("side", ["ahead", "behind"])
@pytest.mark.parametrize("scenario", [SCENARIO, SHORTCUT])
def test_gap_rows_leave_nothing_behind(scenario: Scenario, side: str) -> None:
    window = Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)
    state = cell_state(LATTICE, (0, 1), 0.0)
    tracker = Tracker(scenario, scenario.vehicle)
    if side == "ahead":
        pressed = tracker.solve(state, window, behind_of(np.full(N + 1, state[0] + 6.0)))
        assert pressed.jerk[0, 0] < -1.0
    else:
        pressed = tracker.solve(state, window, Gaps(earliest=window.states[:, 0] + 0.9))
        assert pressed.jerk[0, 0] > 0.2
    assert pressed.usable
    for _ in range(20):
        result = tracker.solve(state, window)
    np.testing.assert_allclose(result.jerk, 0.0, atol=0.05)


def script(tracker: Tracker) -> bytes:
    """Drive through moves, noise and a braking vehicle; return all jerks, bit by bit."""
    rng = random.Random(7)
    predict = braking(14.0, 2.0, 60, end_speed=9.0)
    state, jerks = cell_state(LATTICE, (0, 1), 0.0), b""
    moves = [
        Reference.move(SCENARIO, LIMITS, (0, 1), (-1, 2), 10),
        Reference.move(SCENARIO, LIMITS, (-1, 2), (-1, 1), 50),
    ]
    for tick in range(110):
        reference = moves[tick >= 50]
        gaps = behind_of(predict(tick)) if tick > 55 else Gaps()
        result = tracker.solve(state, reference.window(tick), gaps)
        jerks += result.jerk.tobytes() + bytes([result.usable])
        state = integrate(state, first_jerk(result), TICK_S)
        state = shifted(state, *(rng.gauss(0.0, 0.02) for _ in state))
    return jerks


def test_two_trackers_agree_to_the_last_bit() -> None:
    assert script(Tracker(SCENARIO, LIMITS)) == script(Tracker(SCENARIO, LIMITS))


def good_input() -> tuple[State, Window, Gaps]:
    window = Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)
    gaps = Gaps(np.full(N + 1, -500.0), np.full(N + 1, 500.0))
    return cell_state(LATTICE, (0, 1), 0.0), window, gaps


@for_each("number", [math.nan, math.inf, -math.inf])
@for_each("part", ["state", "states", "jerks", "earliest", "latest"])
def test_bad_numbers_raise_and_leave_nothing_behind(part: str, number: float) -> None:
    if part in ("earliest", "latest") and not math.isnan(number):
        return
    used = Tracker(SCENARIO, LIMITS)
    state, window, gaps = good_input()
    expected = [used.solve(state, window, each).jerk for each in (gaps, NO_GAPS)]
    bad_state, bad_window, bad_gaps = good_input()
    if part == "state":
        bad_state = (*bad_state[:4], number, 0.0)
    elif part in ("earliest", "latest"):
        getattr(bad_gaps, part)[17] = number
    else:
        bad_window = Window(bad_window.states.copy(), bad_window.jerks.copy())
        getattr(bad_window, part)[11, 1] = number
    with pytest.raises(ValueError, match=r".+"):
        used.solve(bad_state, bad_window, bad_gaps)
    for each, jerk in zip((gaps, NO_GAPS), expected, strict=True):
        after = used.solve(state, window, each)
        assert after.usable
        assert after.jerk.tobytes() == jerk.tobytes()


def test_bad_shapes_raise() -> None:
    state, window, _ = good_input()
    short = np.full(N, 500.0)
    for name, bad_window, bad_gaps in (
        ("window", Window(window.states[:-1], window.jerks), Gaps()),
        ("window", Window(window.states, window.jerks[:-1]), Gaps()),
        ("latest", window, Gaps(latest=short)),
        ("earliest", window, Gaps(earliest=-short)),
        ("stopping", window, Gaps(stopping=short)),
    ):
        with pytest.raises(ValueError, match=name):
            Tracker(SCENARIO, LIMITS).solve(state, bad_window, bad_gaps)


# --- the shared program ---------------------------------------------------------------------------


def test_bounds_that_are_written_once_for_holding_vehicles_are_right() -> None:
    """The bounds do not depend on earlier writes."""
    held = Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)
    moves = Reference.move(SCENARIO, LIMITS, (0, 1), (1, 1), 0).window(20)
    assert held.holds
    assert not moves.holds
    behind = Gaps(latest=held.states[:, 0] + 0.3)
    rng = np.random.default_rng(3)
    kind = ProgramKind(N, TICK_S, SCENARIO.formation.speed_mps, LIMITS)
    shared = shared_program(kind)
    iterations = set()
    for _ in range(60):
        error = tuple(rng.normal(0.0, rng.choice([0.2, 1.0]), 6).tolist())
        window, gaps = (held, moves)[rng.random() < 0.25], (NO_GAPS, behind)[rng.random() < 0.25]
        if rng.random() < 0.25:
            shared.write_gaps(window.states, behind)
        new = TrackingProgram(kind)
        new.write_bounds(error, window.states, window.jerks, None, gaps)
        shared.write_bounds(error, window.states, window.jerks, None, gaps, holds=window.holds)
        if rng.random() < 0.2:
            new.admit_zero()
            shared.admit_zero()
        expected, got = new.solve(error), shared.solve(error)
        assert got.x.tobytes() == expected.x.tobytes()
        iterations.add(got.iterations)
    assert min(iterations) == 1 < max(iterations)


def test_threads_have_programs_of_their_own() -> None:
    tracker, found = Tracker(SCENARIO, LIMITS), list[TrackingProgram]()
    own = tracker.program
    copies = list[Tracker]()

    def work() -> None:
        copies.append(copy.deepcopy(tracker))
        found.extend([tracker.program, copies[0].program])

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found[0] is found[1]
    assert found[0] is not own
    # Also after another thread has used or copied the tracker.
    assert tracker.program is copies[0].program is Tracker(SCENARIO, LIMITS).program is own


def test_programs_of_other_kinds_are_others() -> None:
    own = Tracker(SCENARIO, LIMITS).program
    faster = evolve(SCENARIO, formation=evolve(SCENARIO.formation, speed_mps=16.0))
    stronger = evolve(LIMITS, max_accel_mps2=LIMITS.max_accel_mps2 + 1.0)
    assert Tracker(faster, LIMITS).program is not own
    assert Tracker(SCENARIO, stronger).program is not own
    exact = ProgramKind(N, TICK_S, 15.0, LIMITS, evolve(SETTINGS, eps_abs=1e-7))
    assert pickle.loads(pickle.dumps(shared_program(exact))) is shared_program(exact)  # noqa: S301


def test_an_interrupted_solve_leaves_no_bounds_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    held = Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)
    state = shifted(tuple(held.states[0].tolist()), -2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    expected = Tracker(SCENARIO, LIMITS).solve(state, held)
    pushed = Gaps(earliest=held.states[:, 0] + 0.9)
    Tracker(SCENARIO, LIMITS).solve(state, held, pushed)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(QuadraticProgram, "update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            Tracker(SCENARIO, LIMITS).solve(state, held)
    got = Tracker(SCENARIO, LIMITS).solve(state, held)
    assert got.jerk.tobytes() == expected.jerk.tobytes()


def test_the_reference_yields_to_bounds_of_stopping_points() -> None:
    held = Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)
    state: State = tuple(held.states[0].tolist())
    points = StoppingPoints(SCENARIO, LIMITS)
    ahead = Neighbour(1, 6.0, 11.0, -2.0)
    bounds = points.bounds(state, state[0], [ahead])
    result = Tracker(SCENARIO, LIMITS).solve(state, held, Gaps(stopping=bounds))
    assert bounds is not None
    assert result.usable
    path = np.array([state, *(then for then, _ in predicted(state, result))])
    later = round(0.9 / TICK_S)
    behind = path[:, 0] + points.distances_m(path) - bounds
    assert behind[0] > 0.5
    assert (behind[later:] < 0.3).all()
    # It brakes about as hard as needed; limited jerk delays and then increases the braking.
    needed = points.needed_decel_mps2(state, bounds)
    assert -1.3 * needed - 1.0 < path[:, 2].min() < -0.5 * needed
