"""Slots of plans: as long as the road allows, and only those of the scenario."""

from __future__ import annotations

from collections.abc import Collection

import pytest
from msgspec.structs import replace

from laneweave.coordinator.formations import pacing
from laneweave.coordinator.formations.pacing import MIN_RESERVE_S, RESERVE_S, Neighbours, steps_of
from laneweave.coordinator.formations.roster import exit_time_s, start_time_s
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.wire.messages import Plan
from support.states import A, B, make_plan

SCENARIO = Scenario()
LATTICE = SCENARIO.lattice
FRONT = 0


def climbing(steps: int) -> Plan:
    """Return a plan of one vehicle that makes a step in each slot, up and down between lanes."""
    cells: list[Cell] = [(FRONT, step % 2) for step in range(steps + 1)]
    moves = tuple((step, cells[step], cells[step + 1]) for step in range(steps))
    t0_s = start_time_s(cells, 0.0, SCENARIO)
    return make_plan({A: cells[0]}, {A: moves}, t0_s=t0_s, slot_s=SCENARIO.timing.cycles_s[0])


def paced(plan: Plan, scenario: Scenario = SCENARIO) -> Plan:
    end_s = plan.t0_s + left_s(plan)
    return pacing.paced(plan, [], plan.t0_s, lambda _: end_s, scenario)


def left_s(plan: Plan) -> float:
    return exit_time_s(plan.territory, SCENARIO) - plan.t0_s


@pytest.mark.parametrize("late_s", [0.0, 7.0, 14.0, 16.1])
@pytest.mark.parametrize("steps", range(12))
def test_slots_are_the_longest_that_leave_a_reserve(steps: int, late_s: float) -> None:
    plan = climbing(steps)
    plan = replace(plan, t0_s=plan.t0_s + late_s)
    chosen = paced(plan)
    assert chosen == replace(plan, slot_s=chosen.slot_s)
    timing = SCENARIO.timing
    leisurely, hasty = (
        max(
            (s for s in timing.slots_s if steps * s <= left_s(plan) - reserve_s),
            default=timing.slots_s[0],
        )
        for reserve_s in (RESERVE_S, MIN_RESERVE_S)
    )
    expected = leisurely if leisurely >= timing.comfortable_cycle_s else hasty
    if expected < timing.gentle_cycle_s and steps * timing.gentle_cycle_s <= left_s(plan):
        # The reserve is used for gentle moves, and only as much of it as they need.
        expected = timing.gentle_cycle_s
    assert chosen.slot_s == pytest.approx(expected)


def test_more_steps_have_shorter_slots() -> None:
    slots = [paced(climbing(steps)).slot_s for steps in range(1, 12)]
    assert slots == sorted(slots, reverse=True)
    assert (slots[0], slots[-1]) == (7.0, 4.0)
    assert len(set(slots)) > 2
    assert set(slots) <= set(SCENARIO.timing.slots_s)


def test_a_plan_begins_before_its_rear_is_in_s3_unless_a_lane_change_does() -> None:
    along: tuple[PlannedMove, ...] = ((0, (-3, 0), (-2, 0)), (1, (-2, 0), (-2, 1)))
    plan = replace(
        climbing(0),
        start_cells={A: (-3, 0)},
        moves={A: along},
        t0_s=start_time_s([(-3, 0)], 0.0, SCENARIO),
        territory=((-3, 0), (-2, 0), (-2, 1)),
    )

    def end_s(cells: Collection[Cell]) -> float:
        return exit_time_s(cells, SCENARIO)

    early = pacing.paced(plan, [], 0.0, end_s, SCENARIO)
    changes_s = early.t0_s + early.slot_s
    assert early.t0_s < plan.t0_s
    assert changes_s == pytest.approx(start_time_s([(-2, 0)], 0.0, SCENARIO))
    assert pacing.paced(plan, [], plan.t0_s - 1.0, end_s, SCENARIO).t0_s == pytest.approx(
        plan.t0_s - 1.0
    )


def test_each_move_ends_before_its_vehicle_leaves() -> None:
    """Slots are longer than if all moves had to end before the front of the formation leaves."""
    plan = replace(
        climbing(6),
        start_cells={A: (FRONT, 0), B: (-6, 0)},
        moves=climbing(6).moves
        | {B: tuple((step, (-6, step % 2), (-6, 1 - step % 2)) for step in range(8))},
    )

    def end_s(cells: Collection[Cell]) -> float:
        return exit_time_s(cells, SCENARIO)

    chosen = pacing.paced(plan, [], plan.t0_s, end_s, SCENARIO)
    together = pacing.paced(plan, [], plan.t0_s, lambda _: end_s([(FRONT, 0)]), SCENARIO)
    assert chosen.slot_s > together.slot_s
    for steps, column in ((6, FRONT), (8, -6)):
        assert chosen.t0_s + steps * chosen.slot_s <= end_s([(column, 0)]) - MIN_RESERVE_S


def test_a_given_cycle_leaves_no_choice() -> None:
    scenario = Scenario(formation=FormationSettings(cycle_s=5.0))
    assert scenario.timing.slots_s == (5.0,)
    assert {paced(climbing(steps), scenario).slot_s for steps in (1, 6, 12)} == {5.0}


@pytest.mark.parametrize(
    ("slot_s", "their_slot_s", "late_s", "pauses"),
    [
        (4.0, 7.0, 0.0, 1),
        (7.0, 4.0, 0.0, 1),
        (4.0, 7.0, 6.7, 1),
        (4.0, 7.0, 6.8, 0),
        (4.0, 7.0, -4.0, 0),
    ],
)
def test_neighbours_with_slots_of_other_lengths_are_kept_apart(
    slot_s: float, their_slot_s: float, late_s: float, pauses: int
) -> None:
    """Their move lasts as long as their slot but for the slack."""
    mine = replace(climbing(1), moves={A: ((0, (-5, 1), (-4, 1)),)}, slot_s=slot_s)
    theirs = replace(mine, moves={A: ((0, (-2, 1), (-3, 1)),)}, slot_s=their_slot_s)
    late = replace(mine, t0_s=mine.t0_s + late_s)
    paused = Neighbours([theirs], SCENARIO.formation.slack_s).with_pauses(late, lambda _: True)
    assert (steps_of(paused) - 1 > 0) is bool(pauses)


CLOSING = replace(climbing(0), moves={A: ((0, (-5, 1), (-4, 1)), (1, (-4, 1), (-4, 2)))})
"""A vehicle moves forwards, and then to another lane."""


def beside(their_slot_s: float, room_s: float, scenario: Scenario) -> tuple[Plan, set[int]]:
    """Return the plan beside one with a closing move in its first slot, and its conflicts."""
    theirs = replace(CLOSING, moves={B: ((0, (-2, 1), (-3, 1)),)}, slot_s=their_slot_s)
    end_s = CLOSING.t0_s + room_s
    chosen = pacing.paced(CLOSING, [theirs], CLOSING.t0_s, lambda _: end_s, scenario)
    neighbours = Neighbours([theirs], scenario.formation.slack_s)
    return chosen, set(neighbours.conflicts_s(chosen))


@pytest.mark.parametrize(
    ("their_slot_s", "room_s", "slot_s", "steps", "late_s"),
    [
        (4.0, 3 * 7.0 + RESERVE_S, 7.0, 3, 0.0),  # with a pause
        (4.0, 2 * 7.0 + 4.0 + RESERVE_S, 7.0, 2, 4.0),  # with a later start
        (4.0, 2 * 6.4 + 4.0 + RESERVE_S, 6.4, 2, 4.0),
        (4.0, 2 * 5.2 + 4.0 + MIN_RESERVE_S, 5.2, 2, 4.0),
        (8.9, 4 * 5.2 + MIN_RESERVE_S, 5.2, 4, 0.0),
        (8.9, 4 * 4.6 + MIN_RESERVE_S, 4.6, 4, 0.0),  # instead of a long conflict
    ],
)
def test_a_plan_pauses_or_begins_later_or_its_slots_are_shortened(
    their_slot_s: float, room_s: float, slot_s: float, steps: int, late_s: float
) -> None:
    chosen, conflicts = beside(their_slot_s, room_s, SCENARIO)
    assert (chosen.slot_s, chosen.t0_s - CLOSING.t0_s) == pytest.approx((slot_s, late_s))
    assert steps_of(chosen) == steps
    assert not conflicts


@pytest.mark.parametrize(
    ("their_slot_s", "room_s", "slot_s", "late_s"),
    [
        (8.9, 4 * 4.4 + MIN_RESERVE_S, 5.8, 0.0),  # two pauses would need too short slots
        (4.0, 2 * 5.4 + MIN_RESERVE_S, 4.6, 1.5),
        # Slots of 4.6 s would avoid the conflict, but it is short.
        (4.0, 2 * 4.6 + 4.0 + MIN_RESERVE_S, 5.2, 2.5),
        (4.0, 2 * 4.4 + MIN_RESERVE_S, 4.0, 1.5),  # there is no time for longer slots at all
    ],
)
def test_the_shortest_conflict_remains_if_slots_would_be_too_short(
    their_slot_s: float, room_s: float, slot_s: float, late_s: float
) -> None:
    chosen, conflicts = beside(their_slot_s, room_s, SCENARIO)
    assert (chosen.slot_s, chosen.t0_s - CLOSING.t0_s) == pytest.approx((slot_s, late_s))
    assert len(conflicts) == 1


def test_a_pause_may_take_the_reserve() -> None:
    scenario = Scenario(formation=FormationSettings(cycle_s=5.0))
    chosen, conflicts = beside(5.0, 3 * 5.0, scenario)
    assert steps_of(chosen) == 3
    assert not conflicts
    chosen, conflicts = beside(5.0, 3 * 5.0 - 0.1, scenario)
    assert steps_of(chosen) == 2
    assert conflicts == {0}


def test_the_shortest_conflict_remains_also_if_the_shortest_slots_are_gentle() -> None:
    """With a later start it lasts 2.8 s, without 3.8 s."""
    quick = Vehicle(max_accel_mps2=6.0)
    scenario = Scenario(vehicle=quick, formation=FormationSettings(gap_m=20.0))
    assert scenario.timing.gentle_cycle_s == scenario.timing.slots_s[0]
    chosen, conflicts = beside(4.0, 11.0, scenario)
    assert len(conflicts) == 1
    assert (chosen.slot_s, chosen.t0_s - CLOSING.t0_s) == pytest.approx((5.0, 1.0))
