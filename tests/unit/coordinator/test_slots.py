"""Slots of plans: as long as the road allows, and only those of the scenario."""

from __future__ import annotations

import pytest
from attrs import evolve

from laneweave.coordinator.borders import kept_apart, steps_of
from laneweave.coordinator.formation import start_time_s, time_left_s
from laneweave.coordinator.formation_planner import RESERVE_S, FormationPlanner
from laneweave.coordinator.groups import Groups
from laneweave.protocol.lattice import Cell, Move
from laneweave.protocol.messages import Ballot, Name, Plan
from laneweave.protocol.scenario import FormationSettings, Scenario

SCENARIO = Scenario()
LATTICE = SCENARIO.lattice
A = Name("A")
FRONT = 0


def climbing(steps: int) -> Plan:
    """Return a plan of one vehicle that makes a step in each slot, up and down between lanes."""
    cells: list[Cell] = [(FRONT, step % 2) for step in range(steps + 1)]
    moves: tuple[Move, ...] = tuple((step, cells[step], cells[step + 1]) for step in range(steps))
    return Plan(
        ballot=Ballot(1, Name("c1"), 1, 1),
        formations=(0,),
        roster=(A,),
        incarnations={A: 1},
        start_cells={A: cells[0]},
        moves={A: moves},
        t0_s=start_time_s(cells, 0.0, SCENARIO),
        slot_s=SCENARIO.cycles_s[0],
        territory=tuple(sorted(set(cells))),
    )


def paced(plan: Plan, scenario: Scenario = SCENARIO) -> Plan:
    planner = FormationPlanner(scenario, Groups())
    return planner._paced(plan, {})


def left_s(plan: Plan) -> float:
    return time_left_s(plan.territory, plan.t0_s, SCENARIO)


@pytest.mark.parametrize("steps", range(1, 12))
def test_slots_are_the_longest_that_leave_a_reserve(steps: int) -> None:
    plan = climbing(steps)
    chosen = paced(plan)
    assert chosen == evolve(plan, slot_s=chosen.slot_s)
    fitting = [slot_s for slot_s in SCENARIO.slots_s if steps * slot_s <= left_s(plan) - RESERVE_S]
    assert chosen.slot_s == max(fitting, default=SCENARIO.slots_s[0])


def test_more_steps_have_shorter_slots() -> None:
    slots = [paced(climbing(steps)).slot_s for steps in range(1, 12)]
    assert slots == sorted(slots, reverse=True)
    assert (slots[0], slots[-1]) == (7.0, 4.0)
    assert len(set(slots)) > 2
    assert set(slots) <= set(SCENARIO.slots_s)


def test_a_late_plan_has_shorter_slots() -> None:
    plan = climbing(4)
    late = evolve(plan, t0_s=plan.t0_s + left_s(plan) - 4 * 5.0 - RESERVE_S)
    assert paced(plan).slot_s == 7.0
    assert paced(late).slot_s == 5.0
    assert paced(evolve(late, t0_s=late.t0_s + 0.1)).slot_s == 4.5


def test_a_plan_without_moves_has_the_longest_slots() -> None:
    assert paced(climbing(0)).slot_s == SCENARIO.slots_s[-1]


def test_a_given_cycle_leaves_no_choice() -> None:
    scenario = Scenario(formation=FormationSettings(cycle_s=5.0))
    assert scenario.slots_s == (5.0,)
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
    mine = evolve(climbing(1), moves={A: ((0, (-5, 1), (-4, 1)),)}, slot_s=slot_s)
    theirs = evolve(mine, moves={A: ((0, (-2, 1), (-3, 1)),)}, slot_s=their_slot_s)
    late = evolve(mine, t0_s=mine.t0_s + late_s)
    paused = kept_apart(late, [theirs], SCENARIO.formation.slack_s, 9)
    assert (steps_of(paused) - 1 > 0) is bool(pauses)
