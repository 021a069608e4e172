"""Neighbouring formations do not close up across the border of their blocks."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from attrs import evolve

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.formations.pacing import Neighbours, steps_of
from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.protocol.lattice import PlannedMove
from laneweave.protocol.runtime.node import Compute, Effect, run_job
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plans import plan_problems
from laneweave.protocol.wire.messages import Ballot, Name, Plan
from laneweave.protocol.wire.process_messages import LogEvent
from support.paper import FORMATIONS, PAPER
from support.service_desk import Cells, Desk, jobs, leading, messages, state
from support.states import A, B, C, D, E, F, make_plan

SCENARIO = evolve(PAPER, formation=evolve(FORMATIONS, solver="branching"))
"""Of the plans with equal cost, those of branching close up across the border."""
SLOT_S, MOVE_S = SCENARIO.timing.cycles_s[0], SCENARIO.timing.move_s
SLACK_S = SCENARIO.formation.slack_s
CLOSING = ConflictModel(("closing",))
T0_S = 30.0
MAX_STEPS = 9


def plan_of(*moves: tuple[PlannedMove, ...], t0_s: float = T0_S) -> Plan:
    each = dict(zip((A, B, C), moves, strict=False))
    return make_plan({name: steps[0][1] for name, steps in each.items()}, each, t0_s=t0_s)


def closing_pairs(one: Plan, other: Plan) -> list[tuple[PlannedMove, PlannedMove]]:
    """Return the moves of two plans that are made at the same time and close up."""
    return [
        (mine, theirs)
        for my_moves in one.moves.values()
        for mine in my_moves
        for their_moves in other.moves.values()
        for theirs in their_moves
        if abs(one.t0_s + mine[0] * SLOT_S - other.t0_s - theirs[0] * SLOT_S) < MOVE_S
        and CLOSING.kind(mine[1:], theirs[1:])
    ]


def fits(most: int) -> Callable[[Plan], bool]:
    return lambda plan: steps_of(plan) <= most


# --- pauses -----------------------------------------------------------------------------------

UP = plan_of(
    ((0, (-6, 1), (-5, 1)), (1, (-5, 1), (-4, 1)), (2, (-4, 1), (-4, 0))),
    ((0, (-7, 2), (-6, 2)), (2, (-6, 2), (-6, 1))),
)
"""In its second slot a vehicle moves to the front column of its block."""


def back(step: int, lane: int = 1, t0_s: float = T0_S) -> Plan:
    """Return a plan of the block ahead: in a slot a vehicle moves back to its last column."""
    return plan_of(((step, (-2, lane), (-3, lane)),), t0_s=t0_s)


def steps(plan: Plan) -> list[list[int]]:
    return [[step for step, _, _ in moves] for moves in plan.moves.values()]


def test_all_pause_before_the_slot_in_which_two_would_close_up() -> None:
    assert closing_pairs(UP, back(1))
    plan = Neighbours([back(1)], SLACK_S).with_pauses(UP, fits(MAX_STEPS))
    assert closing_pairs(plan, back(1)) == []
    assert steps(plan) == [[0, 2, 3], [0, 3]]
    cells = [[move[1:] for move in moves] for moves in plan.moves.values()]
    assert cells == [[move[1:] for move in moves] for moves in UP.moves.values()]
    assert steps_of(plan) == 4


def test_the_plan_of_the_block_ahead_pauses_too_if_it_is_the_later_one() -> None:
    assert steps(Neighbours([UP], SLACK_S).with_pauses(back(1), fits(MAX_STEPS))) == [[2]]


def test_it_pauses_again_while_others_come_back() -> None:
    others = [back(1), back(2), back(4)]
    assert steps(Neighbours(others, SLACK_S).with_pauses(UP, fits(MAX_STEPS))) == [
        [0, 3, 4],
        [0, 4],
    ]


@pytest.mark.parametrize("other", [back(0), back(2), back(1, lane=2), back(1, t0_s=T0_S + SLOT_S)])
def test_moves_at_other_times_or_on_other_lanes_cause_no_pause(other: Plan) -> None:
    assert Neighbours([other], SLACK_S).with_pauses(UP, fits(MAX_STEPS)) == UP


@pytest.mark.parametrize(("late_s", "expected"), [(-2.0, 2), (2.0, 3), (0.3, 3), (-0.3, 2)])
def test_slots_that_overlap_count(late_s: float, expected: int) -> None:
    """Blocks need not pass S3 a whole number of slots apart."""
    plan = Neighbours([back(1, t0_s=T0_S + late_s)], SLACK_S).with_pauses(UP, fits(MAX_STEPS))
    assert closing_pairs(plan, back(1, t0_s=T0_S + late_s)) == []
    assert steps(plan)[0] == [0, expected, expected + 1]


def test_a_plan_does_not_outlast_the_road() -> None:
    assert Neighbours([back(1)], SLACK_S).with_pauses(UP, fits(3)) == UP


def test_without_moves_there_is_nothing_to_keep_apart() -> None:
    nobody = plan_of()
    assert steps_of(nobody) == 0
    assert Neighbours([UP], SLACK_S).with_pauses(nobody, fits(MAX_STEPS)) == nobody


# --- the leader -------------------------------------------------------------------------------

G, H, J, K, L = (Name(letter) for letter in "GHJKL")
AHEAD: Cells = {A: (-1, 1), B: (-3, 1), C: (0, 2), D: (0, 0), E: (-2, 2), F: (-2, 0)}
"""Block 0. In its third slot C comes back to the last column of lane 2."""
BEHIND: Cells = {G: (-5, 1), H: (-4, 2), J: (-7, 1), K: (-4, 0), L: (-6, 2)}
"""Block 1. In its second slot, which is the same time, L would go to the front column of lane 2."""
LANES = {A: 1, B: 0, C: 0, D: 2, E: 0, F: 1, G: 1, H: 0, J: 2, K: 1, L: 1}


def two_formations(scenario: Scenario = SCENARIO, first: int = 0) -> tuple[Desk, Compute]:
    """Collect the promises of both blocks, of one block first; return the order for that one."""
    desk = leading(AHEAD | BEHIND, LANES, scenario=scenario)
    desk.observe(AHEAD | BEHIND)
    effects: list[Effect] = []
    for number in (first, 1 - first):
        ballot = desk.leaders[number].ballot
        for name, cell in (AHEAD, BEHIND)[number].items():
            effects += desk.tell(state(name, cell, ballot, t_s=1.0))
    (job,) = jobs(effects)
    return desk, job


def plans(desk: Desk) -> tuple[Plan, Plan]:
    one, other = desk.leaders[0].plan, desk.leaders[1].plan
    assert one is not None
    assert other is not None
    assert plan_problems(one) == plan_problems(other) == []
    return one, other


def awaited(effects: list[Effect]) -> list[dict[str, object]]:
    found = [send.message for send in messages(effects, LogEvent)]
    return [message.data for message in found if message.kind == "neighbours-awaited"]


@pytest.mark.parametrize("first", [0, 1])
def test_the_later_plan_of_two_neighbours_pauses(first: int) -> None:
    desk, job = two_formations(first=first)
    effects = desk.give(run_job(job))
    assert awaited(effects) == []
    (later,) = jobs(effects)
    assert awaited(desk.give(run_job(later))) == [{"formation": 1 - first, "slots": 1}]
    assert closing_pairs(*plans(desk)) == []


def test_no_formation_pauses_for_a_plan_that_was_outbid() -> None:
    desk, job = two_formations()
    (later,) = jobs(desk.give(run_job(job)))
    desk.tell(state(A, AHEAD[A], Ballot(4, Name("c0"), 3, 2), t_s=2.0))
    assert desk.leaders[0].phase is BallotPhase.BACKING_OFF
    assert awaited(desk.give(run_job(later))) == []


def test_a_scenario_whose_plans_may_close_up_has_no_pauses() -> None:
    formation = evolve(SCENARIO.formation, conflicts=("node", "edge", "special-1"))
    desk, job = two_formations(evolve(SCENARIO, formation=formation))
    effects = desk.give(run_job(job))
    (later,) = jobs(effects)
    assert awaited([*effects, *desk.give(run_job(later))]) == []
    assert closing_pairs(*plans(desk))
