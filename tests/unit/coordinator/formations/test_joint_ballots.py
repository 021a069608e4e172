"""Joint ballots, members without agents, and observing: the coordinator's core end to end."""

from __future__ import annotations

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.formations.operation import JUST_CLOSED_S
from laneweave.protocol.runtime.node import Compute, Effect, run_job
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plans import plan_problems
from laneweave.protocol.wire.messages import Ballot, Name, Plan, Prepare, RoadClock
from laneweave.protocol.wire.process_messages import LogEvent
from support.paper import PAPER, closing_time_s
from support.service_desk import T_S, Cells, Desk, census, jobs, leading, logged, messages, state
from support.states import A, B, C, D, E, F, changed

JOINING = evolve(PAPER, formation=evolve(PAPER.formation, max_joined=2))
FULL: Cells = {A: (0, 0), B: (-1, 1), C: (-2, 0), D: (-3, 1), E: (-2, 2)}
"""Block 0: all five want lane 1, which has four cells."""
NEXT: Cells = {F: (-5, 1)}
"""Block 1."""
BEHIND: Cells = {name: (column - 4, lane) for name, (column, lane) in FULL.items()}
"""The same five in block 1."""
LANES = dict.fromkeys(FULL, 1) | {F: 0}


def plan_of(effects: list[Effect]) -> Plan:
    """Return the one plan that was sent, to all of its roster."""
    sent = messages(effects, Plan)
    plan = sent[0].message
    assert isinstance(plan, Plan)
    assert [send.parameters["vehicle"] for send in sent] == list(plan.roster)
    assert all(send.message == plan for send in sent)
    return plan


def notes(effects: list[Effect], kind: str) -> list[dict[str, object]]:
    found = [send.message for send in messages(effects, LogEvent)]
    return [message.data for message in found if message.kind == kind]


def overfull(scenario: Scenario) -> tuple[Desk, Compute]:
    """Lead up to the order for the overfull block; block 1 is behind it and has been prepared."""
    desk = leading(FULL | NEXT, LANES, scenario=scenario)
    desk.observe(FULL | NEXT)
    (job,) = jobs(desk.promise(FULL))
    return desk, job


def behind_of_one(desk: Desk, t_s: float) -> list[Effect]:
    """Let those in block 1 promise, who all want lane 1, and before them F in block 0."""
    cells: Cells = {F: (0, 0)} | BEHIND
    desk.lead()
    desk.tell(census(cells, dict.fromkeys(cells, 1), t_s=t_s))
    desk.observe(cells)
    ahead = jobs(desk.promise({F: (0, 0)}))
    ballot, effects = desk.leaders[1].ballot, list[Effect]()
    for name, cell in BEHIND.items():
        effects += desk.tell(state(name, cell, ballot, t_s=1.0))
    for job in ahead:
        effects += desk.give(run_job(job))
    return effects


# --- an overfull lane -------------------------------------------------------------------------


def test_without_joining_all_but_one_get_their_lane_and_that_is_logged() -> None:
    desk, job = overfull(PAPER)
    effects = desk.give(run_job(job))
    plan = plan_of(effects)
    assert plan_problems(plan) == []
    ends = {name: moves[-1][2] if moves else FULL[name] for name, moves in plan.moves.items()}
    missed = [name for name, cell in ends.items() if cell[1] != 1]
    assert len(missed) == 1
    (note,) = notes(effects, "lane-out-of-reach")
    assert (note["formation"], note["vehicles"]) == (0, missed)
    assert (note["reasons"], note["blocked_by"]) == ({missed[0]: "no-room"}, {})
    assert desk.leaders[0].out_of_reach == {*missed}


def test_an_overfull_lane_is_sorted_by_a_joint_ballot_of_two_formations() -> None:
    desk, job = overfull(JOINING)
    separate = desk.leaders[1].ballot
    effects = desk.give(run_job(job))
    assert notes(effects, "formations-joined") == [{"formations": [0, 1]}]
    assert messages(effects, Plan) == []
    assert {number: each.formation.numbers for number, each in desk.leaders.items()} == {0: (0, 1)}
    members = FULL | NEXT
    prepares = []
    for name, cell in members.items():
        prepares += messages(desk.tell(state(name, cell, t_s=0.5)), Prepare)
    assert [send.parameters["vehicle"] for send in prepares] == list(members)
    assert {send.message for send in prepares} == {Prepare(desk.ballot, (0, 1), tuple(members))}
    assert separate is not None
    assert desk.ballot > separate

    # Promised, but not yet known to be remembered by the motion controllers.
    assert jobs(desk.promise(members)) == []
    (job,) = jobs(desk.promise(members, joined=(0, 1)))
    effects = desk.give(run_job(job))
    plan = plan_of(effects)
    assert plan_problems(plan) == []
    assert (plan.ballot, plan.blocks, plan.roster) == (desk.ballot, (0, 1), tuple(members))
    assert set(plan.territory) <= PAPER.lattice.block_cells(0) | PAPER.lattice.block_cells(1)
    for name, moves in plan.moves.items():
        assert (moves[-1][2] if moves else members[name])[1] == LANES[name]
    assert notes(effects, "lane-out-of-reach") == []
    desk.accept(members, joined=(0, 1))
    assert desk.leaders[0].phase is BallotPhase.IN_FORCE


def test_a_result_for_a_formation_that_has_been_joined_meanwhile_is_dropped() -> None:
    desk, job = overfull(JOINING)
    desk.tell(state(F, NEXT[F], joined=(0, 1), t_s=1.0))
    effects = desk.give(run_job(job))
    assert messages(effects, Plan) == []
    assert logged(effects) == []


def test_an_order_for_a_formation_that_has_been_joined_meanwhile_is_not_worked_on() -> None:
    desk, job = overfull(JOINING)
    assert jobs(desk.tell(state(F, NEXT[F], desk.leaders[1].ballot, t_s=1.0))) == []
    effects = desk.give(run_job(job))
    assert logged(effects) == ["formations-joined"]
    assert jobs(effects) == []


def test_without_neighbours_a_formation_is_planned_alone() -> None:
    desk = Desk(scenario=JOINING)
    (job,) = jobs(desk.collect_promises(FULL, LANES))
    effects = desk.give(run_job(job))
    assert plan_of(effects).blocks == (0,)
    assert len(notes(effects, "lane-out-of-reach")) == 1


@pytest.mark.parametrize(("scenario", "again"), [(JOINING, True), (PAPER, False)])
def test_who_is_out_of_reach_is_planned_again_if_there_is_a_formation_to_join(
    scenario: Scenario, again: bool
) -> None:
    desk = Desk(scenario=scenario)
    (job,) = jobs(desk.collect_promises(FULL, LANES))
    desk.give(run_job(job))
    assert desk.leaders[0].out_of_reach
    desk.tell(census(FULL | NEXT, LANES, t_s=T_S))
    assert sorted(desk.leaders) == [0, 1]
    assert (not desk.leaders[0].out_of_reach) == again


def test_the_last_formation_is_joined_with_the_one_before_it() -> None:
    desk = Desk(scenario=JOINING)
    (job,) = jobs(behind_of_one(desk, T_S))
    assert notes(desk.give(run_job(job)), "formations-joined") == [{"formations": [0, 1]}]
    assert desk.leaders[0].formation.roster == (*FULL, F)


def test_formations_are_not_joined_when_together_they_are_too_late() -> None:
    """They begin when the rear of the last one is in S3, and end when the first one leaves."""
    short_road = evolve(JOINING, road=evolve(JOINING.road, s3_m=130.0))
    desk, job = overfull(short_road)
    effects = desk.give(run_job(job))
    assert notes(effects, "formations-joined") == []
    assert plan_of(effects).blocks == (0,)


def test_a_formation_that_has_given_up_is_not_joined() -> None:
    """Block 0 is about to leave; behind it there is an overfull lane."""
    desk = Desk(scenario=JOINING)
    (job,) = jobs(behind_of_one(desk, 63.0))
    assert desk.leaders[0].phase is BallotPhase.ABORTED
    assert plan_of(desk.give(run_job(job))).blocks == (1,)
    assert sorted(desk.leaders) == [0, 1]


def test_no_more_formations_are_joined_than_the_scenario_allows() -> None:
    desk, job = overfull(JOINING)
    desk.give(run_job(job))
    members = FULL | NEXT
    third: Cells = {Name("third"): (-9, 1)}
    crowd = LANES | dict.fromkeys(NEXT, 1) | {Name("third"): 1}
    cells: Cells = members | {Name(f"x{index}"): (-7 + index, 2) for index in range(4)}
    lanes = dict.fromkeys(cells, 1) | crowd
    desk.tell(census(cells | third, lanes, t_s=T_S + 1.0))
    for name, cell in cells.items():
        desk.tell(state(name, cell, t_s=0.5))
    (job,) = jobs(desk.promise(cells, joined=(0, 1)))
    effects = desk.give(run_job(job))
    assert notes(effects, "formations-joined") == []
    assert plan_of(effects).blocks == (0, 1)


# --- groups that others have made -------------------------------------------------------------


def test_a_group_is_learned_from_a_state_of_any_member() -> None:
    desk = leading(FULL | NEXT, LANES)
    assert sorted(desk.leaders) == [0, 1]
    desk.tell(state(F, NEXT[F], joined=(0, 1)))
    assert sorted(desk.leaders) == [0]
    control = desk.leaders[0]
    assert (control.formation.numbers, control.formation.roster) == ((0, 1), (*FULL, F))
    desk.tell(state(F, NEXT[F], joined=(1,), t_s=9.0))  # joined formations never part
    assert desk.leaders[0] is control


def test_a_ballot_is_widened_when_a_promise_shows_more_formations() -> None:
    desk, _ = overfull(PAPER)
    ballot = desk.ballot
    desk.tell(state(A, FULL[A], ballot, joined=(0, 1), t_s=2.0))
    for name, cell in (FULL | NEXT).items():
        desk.tell(state(name, cell, ballot, joined=(0, 1), t_s=3.0))
    control = desk.leaders[0]
    assert (control.phase, control.formation.numbers) == (BallotPhase.PREPARING, (0, 1))
    assert desk.ballot > ballot


def test_an_acceptance_that_shows_more_formations_puts_no_plan_in_force() -> None:
    desk = Desk()
    (job,) = jobs(desk.collect_promises({A: (0, 0)}, {A: 1}))
    desk.give(run_job(job))
    accepted = state(A, (0, 0), desk.ballot, accepted=True, t_s=2.0, joined=(0, 1))
    assert logged(desk.tell(accepted)) == []
    control = desk.leaders[0]
    assert (control.formation.numbers, control.phase) == ((0, 1), BallotPhase.OBSERVING)


def test_groups_that_overlap_become_one() -> None:
    cells: Cells = {A: (0, 0), B: (-5, 1), C: (-9, 1)}
    desk = leading(cells)
    assert sorted(desk.leaders) == [0, 1, 2]
    desk.tell(state(A, cells[A], joined=(0, 1)))
    desk.tell(changed(state(C, cells[C]), block=2, joined=(1, 2)))
    assert {number: each.formation.numbers for number, each in desk.leaders.items()} == {
        0: (0, 1, 2)
    }


def test_a_group_is_planned_only_once_its_later_block_has_closed_in_the_census() -> None:
    """Until then a vehicle may enter that no ballot names."""
    desk = Desk()
    desk.lead()
    cells: Cells = {A: (0, 0), B: (-4, 0)}
    late_s = closing_time_s(1)
    desk.tell(census({A: cells[A]}, t_s=late_s - 3.0))
    assert sorted(desk.leaders) == [0]
    desk.tell(state(A, cells[A], joined=(0, 1)))
    assert desk.leaders == {}
    desk.tell(census(cells, t_s=late_s - 0.1))
    desk.tell(RoadClock(99, late_s + 5.0, 2, 2, 2, 0, ended=False))
    assert desk.leaders == {}
    desk.tell(census(cells, t_s=late_s))
    assert desk.leaders[0].formation.roster == (A, B)


def test_the_remaining_vehicles_of_a_group_stay_joined() -> None:
    desk = leading({A: (0, 0), B: (-4, 0)})
    desk.tell(state(A, joined=(0, 1)))
    desk.tell(census({B: (-4, 0)}, t_s=T_S + 1.0))
    control = desk.leaders[0]
    assert (control.formation.numbers, control.formation.roster) == ((0, 1), (B,))


# --- which formations are observed first ------------------------------------------------------


def just_closed(number: int = 0) -> float:
    return closing_time_s(number) + 0.1


def test_a_formation_that_this_leader_saw_close_is_prepared_at_once() -> None:
    desk = Desk()
    desk.lead()
    desk.watch(PAPER.network.election_s + 0.1)
    prepares = messages(desk.tell(census({A: (0, 0), B: (-1, 1)}, t_s=just_closed())), Prepare)
    assert [send.parameters["vehicle"] for send in prepares] == [A, B]


def test_a_formation_that_closed_before_the_leader_saw_it_is_observed() -> None:
    desk = Desk()
    desk.lead()
    desk.watch(PAPER.network.election_s + 0.1)
    seen_s = closing_time_s(0) + JUST_CLOSED_S + 0.1
    assert messages(desk.tell(census({A: (0, 0)}, t_s=seen_s)), Prepare) == []
    theirs = Ballot(4, Name("c0"), 3, 2)
    desk.tell(state(A, (0, 0), theirs, accepted=True))
    assert desk.leaders[0].phase is BallotPhase.IN_FORCE
    assert desk.ballot == theirs


def test_a_leader_that_has_just_begun_observes_every_formation() -> None:
    desk = Desk()
    desk.watch(2 * PAPER.network.election_s - 0.2)  # of which it has led for the last 0.8 s
    assert desk.core.election.leading
    assert messages(desk.tell(census({A: (0, 0)}, t_s=just_closed())), Prepare) == []
    assert desk.leaders[0].phase is BallotPhase.OBSERVING


def test_a_leader_that_was_paused_observes_every_formation() -> None:
    """Another one may have led and planned meanwhile."""
    desk = Desk()
    desk.lead()
    desk.watch(2 * PAPER.network.election_s)
    desk.wait(PAPER.network.election_s)
    assert messages(desk.tell(census({A: (0, 0)}, t_s=just_closed())), Prepare) == []
    assert desk.leaders[0].phase is BallotPhase.OBSERVING
    desk.watch(PAPER.network.election_s + 0.1)
    later = census({A: (0, 0), B: (-4, 0)}, t_s=just_closed(1))
    assert [send.parameters["vehicle"] for send in messages(desk.tell(later), Prepare)] == [B]


# --- members without agents -------------------------------------------------------------------


def test_a_vehicle_without_an_agent_keeps_its_cell_and_the_others_drive_around_it() -> None:
    """A holds in the middle lane, between B and the lane that B wants."""
    cells: Cells = {A: (-1, 1), B: (-1, 2)}
    desk = leading(cells, {A: 0, B: 0})
    desk.observe(cells)
    (job,) = jobs(desk.promise(cells, unattended=[A]))
    effects = desk.give(run_job(job))
    plan = plan_of(effects)
    assert plan_problems(plan) == []
    assert (plan.moves[A], plan.start_cells[A]) == ((), cells[A])
    assert plan.moves[B][-1][2][1] == 0
    assert all(cells[A] not in move[1:] for move in plan.moves[B])
    (note,) = notes(effects, "lane-out-of-reach")
    assert (note["vehicles"], note["reasons"]) == ([A], {A: "no-agent"})


def test_when_no_vehicle_can_be_moved_the_plan_has_no_moves() -> None:
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    desk = leading(cells, {A: 0, B: 2})
    desk.observe(cells)
    (job,) = jobs(desk.promise(cells, unattended=[A, B]))
    effects = desk.give(run_job(job))
    assert plan_of(effects).moves == {A: (), B: ()}
    assert logged(effects) == ["lane-out-of-reach"]
    for name, cell in cells.items():
        shown = state(name, cell, desk.ballot, accepted=True, t_s=2.0)
        desk.tell(replace(shown, attended=False, done=True))
    desk.watch(3.0)
    assert desk.leaders[0].phase is BallotPhase.IN_FORCE  # and it is not planned again


def test_a_lane_that_only_vehicles_without_agents_miss_joins_no_formations() -> None:
    cells: Cells = {A: (0, 0), B: (-1, 1)} | NEXT
    desk = leading(cells, {A: 2, B: 0, F: 0}, scenario=JOINING)
    desk.observe(cells)
    mine = {name: cells[name] for name in (A, B)}
    (job,) = jobs(desk.promise(mine, unattended=[A]))
    effects = desk.give(run_job(job))
    assert plan_of(effects).blocks == (0,)
    (note,) = notes(effects, "lane-out-of-reach")
    assert (note["vehicles"], note["reasons"]) == ([A], {A: "no-agent"})
