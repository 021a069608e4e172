"""Vehicles in closed loop keep to the lattice, to their limits and away from each other."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from laneweave.protocol.lattice import PlannedMove, footprint
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Name
from support import emergencies, switches
from support.driving import Record, Road, lattice_errors_m, limit_use, road_scenario

SCENARIO = road_scenario(seed=0)
ME, OTHER = Name("me"), Name("other")
SLOT_TICKS = 40

# --- formation switches ---------------------------------------------------------------------------

SWITCHES = 12
"""In each mode."""


@pytest.mark.more
@pytest.mark.slow
@pytest.mark.parametrize("mode", [2, 1])
def test_formation_switches_reach_all_goals(mode: int) -> None:
    numbers = range(mode - 1, 2 * SWITCHES, 2)
    results = [switches.switch_result(0, n, vehicles=(3, 5), columns=(6, 7)) for n in numbers]
    assert {result.mode for result in results} == {mode}
    figures = switches.summary(results)
    assert switches.missed_goals(figures) == []
    assert figures["points"] > 100
    assert (figures["late"], figures["unusable"]) == (0, 0)


def test_equal_seeds_give_equal_switches() -> None:
    one, other = (switches.switch_result(3, 5, vehicles=(3, 3)) for _ in range(2))
    assert one == other
    assert one != switches.switch_result(4, 5, vehicles=(3, 3))


# --- OSQP -----------------------------------------------------------------------------------------


def test_osqp_in_every_tick_drives_the_same_trajectories() -> None:
    """Trajectories are the same with `tracking.shortcut`."""
    shortcut = attrs.evolve(SCENARIO, tracking=attrs.evolve(SCENARIO.tracking, shortcut=True))
    moves: dict[int, dict[Name, PlannedMove]] = {
        20: {ME: (1, (0, 1), (0, 0))},
        80: {OTHER: (1, (1, 1), (0, 1))},
    }
    driven = []
    for scenario in (SCENARIO, shortcut):
        road = Road(scenario, {ME: (0, 1), OTHER: (1, 1)})
        for tick in range(150):
            road.step(moves.get(tick))
        efforts = [one.driver.solver_stats for one in road.driven.values()]
        assert [effort.solves for effort in efforts] == [150, 150]
        expected = 0 if scenario.tracking.shortcut else 150
        assert [effort.osqp_solves for effort in efforts] == [expected, expected]
        driven.append(np.array(road.record.states))
    # OSQP's tolerance is 6e-3 m/s3.
    assert np.abs(driven[0] - driven[1]).max() < 5e-3


# --- emergencies ----------------------------------------------------------------------------------

EMERGENCIES = 20
"""Of each kind."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", emergencies.KINDS)
def test_no_vehicle_hits_one_that_brakes_to_a_stop_while_messages_stop(kind: str) -> None:
    first, every = emergencies.KINDS.index(kind), len(emergencies.KINDS)
    numbers = range(first, EMERGENCIES * every, every)
    outcomes = [emergencies.outcome(0, number) for number in numbers]
    assert {outcome.kind for outcome in outcomes} == {kind}
    figures = emergencies.summary(outcomes)
    assert emergencies.missed_goals(figures) == []
    # In a lane-entry, a vehicle that has not begun to move when messages stop drives past.
    assert kind == "lane-entry" or figures["standing"] == EMERGENCIES


def test_situations_cover_all_kinds() -> None:
    chosen = [emergencies.random_situation(0, number) for number in range(300)]
    assert {len(one.cells) for one in chosen} == {2, 3}
    assert {(one.kind, one.diagonal) for one in chosen} == {
        ("holding", False),
        ("closing", False),
        ("lane-entry", False),
        ("lane-entry", True),
    }
    for one in chosen:
        first, second, *third = one.cells.values()
        assert one.target == (first[0] - 1, first[1])
        own = footprint(second, one.target)
        assert first not in own
        assert own.isdisjoint(third)
    phases = [one.braking_tick - emergencies.MOVE_TICK for one in chosen if one.kind == "closing"]
    assert min(phases) < 0 < 38 < max(phases)
    assert len(set(phases)) > 30


def test_equal_seeds_give_equal_emergencies() -> None:
    assert emergencies.outcome(3, 5) == emergencies.outcome(3, 5)
    assert emergencies.random_situation(3, 5).cells == emergencies.random_situation(3, 5).cells
    assert emergencies.outcome(3, 5) != emergencies.outcome(4, 5)


# --- closing up -----------------------------------------------------------------------------------


def closing_up(slots: int) -> Road:
    """Let two close up from three columns to one, the one ahead so many slots later."""
    road = Road(SCENARIO, {ME: (0, 1), OTHER: (3, 1)})
    moves: dict[Name, PlannedMove] = {ME: (0, (0, 1), (1, 1)), OTHER: (0, (3, 1), (2, 1))}
    first = SLOT_TICKS * (1 + max(-slots, 0))
    begin = {ME: first, OTHER: first + slots * SLOT_TICKS}
    while road.tick <= max(begin.values()) + SLOT_TICKS:
        road.step({name: move for name, move in moves.items() if begin[name] == road.tick})
    return road


@pytest.mark.parametrize("slots", [-1, 1])
def test_closing_up_head_on_one_after_the_other_needs_no_emergency_brake(slots: int) -> None:
    assert closing_up(slots).braked == 0


def test_closing_up_head_on_in_one_slot_does() -> None:
    """The reason why plans keep such moves apart, across the borders of blocks, too."""
    road = closing_up(0)
    assert road.braked > 0
    assert road.record.overlaps == []


# --- the measures themselves ----------------------------------------------------------------------


def test_a_body_that_is_late_is_measured_as_late() -> None:
    """It holds although its path leads ahead and to the left."""
    road = Road(SCENARIO, {ME: (0, 0), OTHER: (3, 2)})
    for _ in range(SLOT_TICKS):
        road.step()
    errors = lattice_errors_m(road.record, SCENARIO, [SLOT_TICKS], [[(1, 1), (3, 2)]])
    assert errors.shape == (1, 2, 2)
    assert errors[0, 0] == pytest.approx([15.0, 3.5], abs=0.2)
    assert errors[0, 1] == pytest.approx([0.0, 0.0], abs=0.2)


def test_gaps_and_overlaps_are_those_of_true_bodies() -> None:
    road = Road(SCENARIO, {ME: (0, 1), OTHER: (1, 1)})
    assert (road.record.gaps_m, road.record.overlaps) == ([10.0], [])
    long = attrs.evolve(SCENARIO, vehicle=attrs.evolve(SCENARIO.vehicle, length_m=16.0))
    road = Road(long, {ME: (0, 1), OTHER: (1, 1)})
    assert (road.record.gaps_m, road.record.overlaps) == ([-1.0], [(0, ME, OTHER)])


def test_hard_braking_is_as_hard_as_it_can_be_and_is_no_violation() -> None:
    road = Road(SCENARIO, {ME: (0, 1)})
    for _ in range(40):
        road.step(braking=[ME])
    states = np.array(road.record.states)[:, 0]
    # 11.25 m from 15 m/s with 10 m/s2, and what the brakes take to build that up.
    assert 11.0 < states[-1, 0] < 15.5
    assert states[-1, 1] == pytest.approx(0.0, abs=0.05)
    assert states[:, 2].min() < -9.0
    assert np.array(road.record.exempt).any()
    assert {use.violations for use in limit_use(road.record, SCENARIO).values()} == {0}


def rest(states: dict[int, State], exempt: int | None = None) -> Record:
    """Return the record of a body that goes at 15 m/s for five ticks, but for some states."""
    at_rest: State = (0.0, 15.0, 0.0, 0.0, 0.0, 0.0)
    record = Record([[states.get(tick, at_rest)] for tick in range(6)])
    record.exempt += [[tick == exempt] for tick in range(5)]
    return record


@pytest.mark.parametrize(
    ("state", "excess"),
    [
        ((0.0, 25.5, 0.0, 0.0, 0.0, 0.0), {"speed_mps": 0.5}),
        ((0.0, -0.5, 0.0, 0.0, 0.0, 0.0), {"speed_mps": 0.5, "slip_mps": 0.125}),
        ((0.0, 15.0, 5.1, 0.0, 0.0, 0.0), {"accel_mps2": 0.1, "jerk_mps3": 36.0}),
        ((0.0, 15.0, -1.6, 0.0, 0.0, 0.0), {"jerk_mps3": 1.0}),
        ((0.0, 15.0, 0.0, 0.0, 0.0, -0.9), {"lateral_jerk_mps3": 1.0}),
        (
            (0.0, 15.0, 0.0, 0.0, 0.0, 3.5),
            {"lateral_accel_mps2": 0.5, "lateral_jerk_mps3": 27.0},
        ),
        ((0.0, 15.0, 0.0, 0.0, -4.0, 0.0), {"slip_mps": 0.25}),
    ],
)
def test_each_limit_is_measured(state: State, excess: dict[str, float]) -> None:
    used = limit_use(rest({3: state}), SCENARIO)
    violated = {name: use for name, use in used.items() if use.violations}
    assert {name: use.excess for name, use in violated.items()} == pytest.approx(excess)
    # A change of acceleration counts on the way there and on the way back.
    assert all(use.violations == (2 if "jerk" in name else 1) for name, use in violated.items())


def test_emergency_braking_may_exceed_the_jerk_limit_only() -> None:
    braking: State = (0.0, 15.0, -10.0, 0.0, 0.0, 0.0)
    after = {3: braking, 4: braking, 5: braking}
    jerk = limit_use(rest(after), SCENARIO)["jerk_mps3"]
    assert (round(jerk.excess, 9), jerk.violations) == (85.0, 1)
    assert limit_use(rest(after, exempt=2), SCENARIO)["jerk_mps3"].violations == 0
    beyond: dict[int, State] = {3: (0.0, 15.0, -10.1, 0.0, 0.0, 0.0)}
    accel = limit_use(rest(beyond, exempt=2), SCENARIO)["accel_mps2"]
    assert (round(accel.excess, 9), accel.violations) == (0.1, 1)
