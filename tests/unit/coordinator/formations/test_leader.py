"""Rules L2 to L8 for one formation, transition by transition."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from laneweave.coordinator.ballots.ballot_round import (
    FAILED,
    ISSUE_S,
    PROMISED,
    TIME,
    TOO_LATE,
    BallotPhase,
)
from laneweave.coordinator.formations.leader import (
    AWAITED_S,
    BACK_OFF_S,
    LEADER_RULES,
    LONGEST_RETRY_S,
    MAX_BACK_OFFS,
    OBSERVE_S,
    RETRY_S,
    FormationLeader,
)
from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire.messages import Ballot, CensusEntry, Name, Plan, Prepare, VehicleState
from support.rule_books import RuleRecorder
from support.states import changed
from support.states import holding as state

A, B, C = Name("A"), Name("B"), Name("C")
OTHERS = Ballot(1, Name("other"), 1, 1)
RESEND_S = 0.2
RNG = random.Random(1)
Reach = Callable[..., tuple[FormationLeader, Ballot]]


def formation(*names: Name, lane: int = 1, numbers: tuple[int, ...] = (0,)) -> Formation:
    members = tuple(CensusEntry(name, (0, 0), lane, 0.0) for name in names)
    return Formation(numbers, members, goals=(frozenset({lane}),) * len(members))


class Ballots:
    """A source of ballots like a coordinator's."""

    def __init__(self) -> None:
        """Begin with term 1."""
        self.term, self.given = 1, 0

    def __call__(self, above: Ballot | None) -> Ballot:
        if above is not None:
            self.term = max(self.term, above.term + 1)
        self.given += 1
        return Ballot(self.term, Name("me"), 1, self.given)


def control(
    *names: Name,
    numbers: tuple[int, ...] = (0,),
    begin_s: float = 0.0,
    observe: bool = True,
    rules: RuleBook = LEADER_RULES,
    forms: Callable[..., bool] = lambda *_: True,
) -> FormationLeader:
    """Return a leader that has just begun."""
    members = formation(*names, numbers=numbers)
    leader = FormationLeader(members, Ballots(), RNG, forms, resend_s=RESEND_S, rules=rules)
    leader.begin(begin_s, observe=observe)
    return leader


def adopted(*names: Name, incarnation: int = 1, lane: int = 0) -> FormationLeader:
    """Return a leader that has adopted the plan of another one."""
    leader, shown = control(*names), {"accepted": True, "incarnation": incarnation}
    hear(leader, *(state(name, OTHERS, (0, lane), **shown) for name in names))
    assert (leader.phase, leader.ballot, leader.plan) == (BallotPhase.IN_FORCE, OTHERS, None)
    return leader


def prepares_anew(leader: FormationLeader, above: Ballot) -> bool:
    """Return whether a leader prepares a ballot above another one."""
    assert leader.ballot is not None
    return phase(leader) is BallotPhase.PREPARING and leader.ballot > above


def phase(leader: FormationLeader) -> BallotPhase:
    return leader.phase


def hear(leader: FormationLeader, *states: VehicleState, now_s: float = 0.0) -> None:
    for each in states:
        leader.on_state(each, now_s)


def to(sent: Iterable[tuple[Name, Prepare | Plan]]) -> list[Name]:
    return [name for name, _ in sent]


def preparing(*names: Name) -> tuple[FormationLeader, Ballot]:
    leader = control(*names)
    hear(leader, *(state(name) for name in names))
    assert phase(leader) is BallotPhase.PREPARING
    assert leader.ballot is not None
    return leader, leader.ballot


def planning(*names: Name) -> tuple[FormationLeader, Ballot]:
    leader, ballot = preparing(*names)
    hear(leader, *(state(name, ballot) for name in names))
    assert leader.take(PROMISED, 0.0)
    return leader, ballot


def plan_of(leader: FormationLeader) -> Plan:
    return leader.make_plan(leader.formation.numbers, dict.fromkeys(leader.roster, ()), 0.0, 4.0)


def issuing(*names: Name) -> tuple[FormationLeader, Ballot]:
    leader, ballot = planning(*names)
    leader.on_plan(plan_of(leader), 0.0)
    return leader, ballot


def watching(*names: Name) -> tuple[FormationLeader, Ballot]:
    leader, ballot = issuing(*names)
    hear(leader, *(state(name, ballot, accepted=True) for name in names))
    assert phase(leader) is BallotPhase.IN_FORCE
    return leader, ballot


# --- L2 ---------------------------------------------------------------------------------------


def test_l2_adopts_a_plan_that_all_have_accepted_and_sends_nothing() -> None:
    leader = adopted(A, B, incarnation=7)
    assert leader.incarnations == {A: 7, B: 7}  # it is watched by its promises
    leader.take(TIME, 100.0)
    assert list(leader.outgoing(100.0)) == []
    assert not leader.take(PROMISED, 100.0)
    assert leader.wakeup_s is None


def test_a_vehicle_is_missed_only_after_the_plan_was_sent() -> None:
    """Planning may take longer than the time for an answer."""
    leader, _ = planning(A, B)
    leader.on_plan(plan_of(leader), 4.0)
    assert leader.pop_awaited(4.0) == ()
    assert leader.pop_awaited(4.0 + AWAITED_S) == (A, B)
    assert leader.pop_awaited(4.1 + AWAITED_S) == ()


@pytest.mark.parametrize(
    "last",
    [
        state(B),
        state(B, OTHERS),
        state(B, OTHERS._replace(seq=2), accepted=True),
        state(B, OTHERS, accepted=True, overdue=True),
    ],
    ids=["nothing promised", "promised only", "another plan", "overdue"],
)
def test_l2_mixed_states_lead_to_a_new_ballot(last: VehicleState) -> None:
    leader = control(A, B)
    hear(leader, state(A, OTHERS, accepted=True))
    assert phase(leader) is BallotPhase.OBSERVING
    hear(leader, last)
    assert prepares_anew(leader, OTHERS)


@pytest.mark.parametrize("begin_s", [0.0, 100.0])
def test_l2_waits_for_the_states_of_the_roster_for_a_limited_time(begin_s: float) -> None:
    leader = control(A, B, begin_s=begin_s)
    hear(leader, state(A, OTHERS, accepted=True), now_s=begin_s)
    leader.take(TIME, begin_s + OBSERVE_S - 0.01)
    assert phase(leader) is BallotPhase.OBSERVING
    assert leader.wakeup_s == begin_s + OBSERVE_S
    leader.take(TIME, begin_s + OBSERVE_S)
    assert phase(leader) is BallotPhase.PREPARING


def test_states_of_other_vehicles_are_ignored() -> None:
    leader = control(A)
    hear(leader, state(C, OTHERS._replace(term=9)))
    assert phase(leader) is BallotPhase.OBSERVING
    hear(leader, state(A))
    assert leader.ballot == Ballot(1, Name("me"), 1, 1)


def test_without_observing_it_prepares_at_once() -> None:
    """A formation that has closed under this leader has no plan that could be adopted."""
    leader = control(A, B, begin_s=5.0, observe=False)
    assert (leader.phase, leader.wakeup_s) == (BallotPhase.PREPARING, 5.0)
    assert to(leader.outgoing(5.0)) == [A, B]
    hear(leader, state(A, OTHERS._replace(term=0)), now_s=5.0)
    assert phase(leader) is BallotPhase.PREPARING  # a lower ballot is overruled
    hear(leader, state(B, OTHERS._replace(term=3)), now_s=5.0)
    assert phase(leader) is BallotPhase.BACKING_OFF


# --- L3 and L4 --------------------------------------------------------------------------------


def test_l3_a_new_ballot_is_above_everything_seen() -> None:
    leader = control(A, B)
    hear(leader, state(A, OTHERS), state(B, OTHERS._replace(term=5)))
    assert leader.ballot == Ballot(6, Name("me"), 1, 1)


def test_prepare_goes_to_vehicles_that_have_not_promised() -> None:
    leader, ballot = preparing(A, B)
    sent = dict(leader.outgoing(0.0))
    assert sent == dict.fromkeys((A, B), Prepare(ballot, (0,), (A, B)))
    assert list(leader.outgoing(RESEND_S / 2)) == []
    hear(leader, state(A, ballot))
    assert to(leader.outgoing(RESEND_S)) == [B]
    assert leader.wakeup_s == 2 * RESEND_S


def test_l4_only_this_ballot_is_a_promise_and_not_once_accepted() -> None:
    leader, ballot = preparing(A)
    for each in (state(A), state(A, ballot._replace(seq=0)), state(A, ballot, accepted=True)):
        hear(leader, each)
        assert not leader.take(PROMISED, 0.0)


def test_a_promise_that_was_forgotten_is_void() -> None:
    leader, ballot = preparing(A, B)
    hear(leader, state(A, ballot), state(A, incarnation=2), state(B, ballot))
    assert not leader.take(PROMISED, 0.0)
    assert to(leader.outgoing(0.0)) == [A]
    hear(leader, state(A, ballot, incarnation=2, hold_cell=(3, 1)))
    assert leader.take(PROMISED, 0.0)
    assert leader.incarnations == {A: 2, B: 1}
    assert leader.hold_cells == {A: (3, 1), B: (0, 0)}


def test_a_promise_is_void_once_the_vehicle_shows_more_formations() -> None:
    leader, ballot = preparing(A)
    hear(leader, state(A, ballot), state(A, ballot, joined=(0, 1), t_s=1.0))
    assert not leader.take(PROMISED, 0.0)


@pytest.mark.parametrize(
    ("newer", "older"),
    [
        (state(A, Ballot(1, Name("me"), 1, 1), t_s=2.0), state(A, t_s=1.0)),
        (state(A, Ballot(1, Name("me"), 1, 1)), state(A)),
        (state(A, Ballot(1, Name("me"), 1, 1)), state(A, Ballot(0, Name("x"), 1, 1))),
        (state(A, Ballot(1, Name("me"), 1, 1), incarnation=2), state(A, t_s=9.0)),
    ],
    ids=["older time", "no promise yet", "lower promise", "older process"],
)
def test_a_late_state_takes_no_promise_back(newer: VehicleState, older: VehicleState) -> None:
    leader, _ = preparing(A)
    hear(leader, newer, older)
    assert leader.take(PROMISED, 0.0)


# --- joint ballots ----------------------------------------------------------------------------


@pytest.mark.parametrize("joined", [(), (0,), (1,), (0, 2), (0, 1, 2)])
def test_a_promise_counts_once_the_vehicle_has_joined_exactly_the_formations(
    joined: tuple[int, ...],
) -> None:
    """Fewer: its controller could forget them with the agent. More: others may be in its way."""
    leader = control(A, numbers=(0, 1))
    hear(leader, state(A, joined=joined))
    assert leader.ballot is not None
    hear(leader, state(A, leader.ballot, joined=joined, t_s=1.0))
    assert leader.promises == {}
    assert not leader.take(PROMISED, 0.0)
    assert to(leader.outgoing(0.0)) == [A]
    hear(leader, state(A, leader.ballot, joined=(0, 1), t_s=1.1))
    assert leader.take(PROMISED, 0.0)


# --- L5 ---------------------------------------------------------------------------------------


def test_l5_needs_the_whole_roster_and_orders_once() -> None:
    leader, ballot = preparing(A, B, C)
    hear(leader, state(A, ballot), state(B, ballot))
    assert not leader.take(PROMISED, 0.0)
    hear(leader, state(C, ballot))
    assert leader.take(PROMISED, 0.0)
    assert not leader.take(PROMISED, 0.0)
    assert (leader.phase, leader.wakeup_s) == (BallotPhase.PLANNING, None)
    assert list(leader.outgoing(9.0)) == []


def test_l5_failed_planning_keeps_the_ballot_and_retries_after_growing_pauses() -> None:
    leader, ballot = planning(A)
    now_s = 0.0
    for pause_s in (1.0, 2.0, 4.0, *4 * [LONGEST_RETRY_S]):
        leader.take(FAILED, now_s)
        assert leader.wakeup_s == now_s + pause_s
        assert not leader.take(PROMISED, now_s + pause_s - 0.01)
        now_s += pause_s
        leader.take(TIME, now_s)
        assert list(leader.outgoing(now_s)) == []
        assert leader.take(PROMISED, now_s)
        assert leader.ballot == ballot
    leader.on_plan(plan_of(leader), now_s)
    assert leader.failures == 0


def test_a_new_ballot_has_not_failed_yet() -> None:
    leader, _ = planning(A)
    leader.take(FAILED, 0.0)
    leader.on_members(formation(A, lane=2), 0.1)
    assert leader.ballot is not None
    hear(leader, state(A, leader.ballot, t_s=1.0), now_s=0.1)
    assert leader.take(PROMISED, 0.1)


@pytest.mark.parametrize("reach", [preparing, issuing, watching])
def test_results_that_are_not_waited_for_change_nothing(reach: Reach) -> None:
    leader, ballot = reach(A, B)
    before = (leader.phase, leader.plan, leader.failures)
    leader.take(FAILED, 3.0)
    leader.take(TOO_LATE, 3.0)
    assert (leader.phase, leader.plan, leader.failures) == before
    assert leader.ballot == ballot


def test_restart_during_the_pause_after_failed_planning() -> None:
    leader, ballot = planning(A)
    leader.take(FAILED, 0.0)
    hear(leader, state(A, incarnation=2))
    assert not leader.take(PROMISED, RETRY_S)
    assert to(leader.outgoing(RETRY_S)) == [A]
    hear(leader, state(A, ballot, incarnation=2))
    assert leader.take(PROMISED, RETRY_S + RESEND_S)


# --- L6 ---------------------------------------------------------------------------------------


def test_l6_the_plan_goes_to_vehicles_that_have_not_accepted() -> None:
    leader, ballot = issuing(A, B)
    plan = plan_of(leader)
    assert list(leader.outgoing(0.0)) == [(A, plan), (B, plan)]
    hear(leader, state(A, ballot, accepted=True))
    assert list(leader.outgoing(RESEND_S - 0.01)) == []
    assert list(leader.outgoing(RESEND_S)) == [(B, plan)]
    for pending in (state(B, ballot), state(B, ballot._replace(seq=0), accepted=True)):
        hear(leader, pending)
        assert (phase(leader), leader.accepted) == (BallotPhase.ISSUING, {A})
    hear(leader, state(B, ballot, accepted=True))
    assert (leader.phase, leader.ballot) == (BallotPhase.IN_FORCE, ballot)
    assert list(leader.outgoing(99.0)) == []


def test_l8_a_plan_that_a_vehicle_refuses_is_given_up() -> None:
    leader, ballot = issuing(A, B)
    hear(leader, state(A, ballot, accepted=True))
    leader.take(TIME, ISSUE_S - 0.01)
    assert phase(leader) is BallotPhase.ISSUING
    assert to(leader.outgoing(ISSUE_S - 0.01)) == [B]
    leader.take(TIME, ISSUE_S)
    assert prepares_anew(leader, ballot)
    assert to(leader.outgoing(ISSUE_S)) == [A, B]


# --- L7 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("reach", [preparing, planning, issuing, watching])
@pytest.mark.parametrize("higher", [Ballot(2, Name("a"), 1, 1), Ballot(1, Name("z"), 1, 1)])
def test_l7_outbid_backs_off_then_looks_and_takes_a_higher_term(
    reach: Reach, higher: Ballot
) -> None:
    leader, ballot = reach(A, B)
    hear(leader, state(A, higher, t_s=1.0), now_s=5.0)
    assert phase(leader) is BallotPhase.BACKING_OFF
    pause_s = (leader.wakeup_s or 0.0) - 5.0
    assert BACK_OFF_S[0] <= pause_s <= BACK_OFF_S[1]
    assert list(leader.outgoing(9.0)) == []
    assert not leader.take(PROMISED, 9.0)
    leader.take(TIME, 5.0 + pause_s)
    assert phase(leader) is BallotPhase.OBSERVING
    hear(leader, state(A, higher, t_s=2.0), state(B, ballot, t_s=2.0), now_s=6.0)
    assert phase(leader) is BallotPhase.PREPARING
    assert leader.ballot is not None
    assert leader.ballot.term > higher.term


def test_l7_adopts_the_others_plan_if_it_is_in_force_after_the_pause() -> None:
    leader, _ = issuing(A, B)
    higher = Ballot(2, Name("z"), 1, 1)
    hear(leader, state(A, higher, t_s=1.0))
    leader.take(TIME, 1.0)
    for name in (A, B):
        hear(leader, state(name, higher, accepted=True, incarnation=2, t_s=2.0))
    assert (leader.phase, leader.ballot) == (BallotPhase.IN_FORCE, higher)
    # The incarnations that promised this leader's own ballot are history.
    hear(leader, state(A, higher, accepted=True, incarnation=2, t_s=3.0))
    assert phase(leader) is BallotPhase.IN_FORCE


class Longest(random.Random):
    """Every pause is as long as it may be."""

    def uniform(self, a: float, b: float) -> float:
        del a
        return b


def outbid(leader: FormationLeader, now_s: float) -> tuple[float, Ballot]:
    """Show a leader a higher ballot; return how long it pauses, and the new ballot after that."""
    assert leader.ballot is not None
    higher = leader.ballot._replace(term=leader.ballot.term + 1)
    hear(leader, state(A, higher, t_s=now_s), now_s=now_s)
    assert phase(leader) is BallotPhase.BACKING_OFF
    pause_s = (leader.wakeup_s or 0.0) - now_s
    leader.take(TIME, now_s + pause_s - 1e-6)
    assert phase(leader) is BallotPhase.BACKING_OFF
    leader.take(TIME, now_s + pause_s)
    hear(leader, state(A, higher, t_s=now_s), state(B, t_s=now_s), now_s=now_s + pause_s)
    assert phase(leader) is BallotPhase.PREPARING
    assert leader.ballot > higher
    return pause_s, leader.ballot


def promise_and_plan(leader: FormationLeader, ballot: Ballot, now_s: float) -> None:
    hear(leader, state(A, ballot, t_s=now_s), state(B, ballot, t_s=now_s), now_s=now_s)
    assert leader.take(PROMISED, now_s)
    leader.on_plan(plan_of(leader), now_s)


def test_l7_pauses_grow_so_that_one_of_two_leaders_gets_the_time_to_plan() -> None:
    leader, _ = preparing(A, B)
    leader.rng = Longest()
    pauses = []
    for now_s in range(0, 30 * (MAX_BACK_OFFS + 3), 30):
        pause_s, ballot = outbid(leader, float(now_s))
        pauses.append(pause_s / BACK_OFF_S[1])
        promise_and_plan(leader, ballot, now_s + 25.0)  # promises and a plan are no success yet
    growing = [2.0**number for number in range(MAX_BACK_OFFS)]
    assert pauses == pytest.approx([*growing, *[2.0**MAX_BACK_OFFS] * 3])


@pytest.mark.parametrize("success", ["accepted", "adopted"])
def test_l7_after_a_success_the_pauses_are_short_again(success: str) -> None:
    leader, _ = preparing(A, B)
    leader.rng = Longest()
    for now_s in (0.0, 30.0, 60.0):
        pause_s, ballot = outbid(leader, now_s)
    assert pause_s == pytest.approx(4.0 * BACK_OFF_S[1])
    if success == "accepted":
        promise_and_plan(leader, ballot, 80.0)
        hear(leader, state(A, ballot, accepted=True, t_s=81.0), now_s=81.0)
    else:
        theirs = ballot._replace(term=ballot.term + 1)
        hear(leader, state(A, theirs, accepted=True, t_s=80.0), now_s=80.0)
        leader.take(TIME, 100.0)
        for name in (A, B):
            hear(leader, state(name, theirs, accepted=True, t_s=101.0), now_s=101.0)
        assert (phase(leader), leader.ballot) == (BallotPhase.IN_FORCE, theirs)
    pause_s, _ = outbid(leader, 120.0)
    assert pause_s == pytest.approx(BACK_OFF_S[1])


# --- L8 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reach", "changes"),
    [
        *((reach, {"incarnation": 2}) for reach in (planning, issuing, watching)),
        (watching, {"accepted": True, "overdue": True}),
    ],
)
def test_l8_restarted_and_overdue_agents_lead_to_a_new_ballot(
    reach: Reach, changes: dict[str, Any]
) -> None:
    leader, ballot = reach(A, B)
    hear(leader, changed(state(A, ballot), **changes))
    assert prepares_anew(leader, ballot)


@pytest.mark.parametrize("promised", [None, OTHERS])
def test_l8_a_restarted_agent_in_an_adopted_plan(promised: Ballot | None) -> None:
    """A duplicate of the old PREPARE may make it promise the adopted ballot once more."""
    leader = adopted(A, B)
    hear(leader, state(A, promised, incarnation=2))
    assert prepares_anew(leader, OTHERS)


@pytest.mark.parametrize("members", [formation(A, B, lane=2), formation(A, B, C)])
def test_l8_new_targets_and_members_lead_to_a_new_ballot(members: Formation) -> None:
    leader, ballot = watching(A, B)
    leader.on_members(formation(A, B), 1.0)
    assert phase(leader) is BallotPhase.IN_FORCE
    leader.on_members(members, 1.0)
    assert prepares_anew(leader, ballot)
    assert to(leader.outgoing(1.0)) == list(members.roster)


def astray(**changes: object) -> VehicleState:
    """Return what a member shows that is done on lane 2 and prefers lane 1."""
    ballot = Ballot(1, Name("me"), 1, 1)
    done = state(A, ballot, (0, 2), accepted=True, done=True, t_s=1.0)
    return changed(done, **changes)


def test_l8_an_adopted_plan_that_ended_on_the_wrong_lane_was_for_other_targets() -> None:
    leader = adopted(A, lane=2)
    hear(leader, astray(promised=OTHERS, hold_cell=(0, 1)))
    assert phase(leader) is BallotPhase.IN_FORCE
    hear(leader, astray(promised=OTHERS, t_s=2.0))
    assert prepares_anew(leader, OTHERS)


@pytest.mark.parametrize(
    ("shown", "out_of_reach", "then"),
    [
        (astray(), (), BallotPhase.PREPARING),
        (astray(done=False), (), BallotPhase.IN_FORCE),
        (astray(hold_cell=(5, 1)), (), BallotPhase.IN_FORCE),
        (astray(), (A,), BallotPhase.IN_FORCE),
        (astray(), (B,), BallotPhase.PREPARING),
    ],
    ids=["astray", "on its way", "on its lane", "out of reach", "another is out of reach"],
)
def test_l8_a_vehicle_on_the_wrong_lane_needs_a_new_plan_unless_planned_so(
    shown: VehicleState, out_of_reach: tuple[Name, ...], then: BallotPhase
) -> None:
    leader, ballot = planning(A, B)
    leader.on_plan(plan_of(leader), 0.0, out_of_reach)
    hear(leader, *(state(name, ballot, accepted=True) for name in (A, B)))
    assert phase(leader) is BallotPhase.IN_FORCE
    hear(leader, shown)
    assert phase(leader) is then


def test_l8_an_adopted_plan_may_have_formed_the_structure_of_an_earlier_stage() -> None:
    formed = {(0, 2)}
    leader = control(A, B, forms=lambda _, states: {states[A].hold_cell} == formed)
    hear(leader, *(state(name, OTHERS, accepted=True) for name in (A, B)))
    hear(leader, astray(promised=OTHERS, hold_cell=(0, 1)))
    assert phase(leader) is BallotPhase.IN_FORCE  # B is still under way
    hear(leader, state(B, OTHERS, accepted=True, done=True, t_s=1.0))
    assert prepares_anew(leader, OTHERS)


def test_l8_nothing_is_planned_again_once_the_structure_is_formed_or_was_planned() -> None:
    leader = control(A)
    hear(leader, astray(promised=OTHERS, hold_cell=(0, 1)))
    assert phase(leader) is BallotPhase.IN_FORCE
    leader = control(A, forms=lambda *_: False)
    hear(leader, state(A))
    hear(leader, state(A, leader.ballot, t_s=1.0))
    assert leader.take(PROMISED, 0.0)
    leader.on_plan(plan_of(leader), 0.0)
    hear(leader, astray(hold_cell=(0, 1), t_s=2.0))
    assert phase(leader) is BallotPhase.IN_FORCE


def test_l8_out_of_reach_in_an_own_plan_may_be_astray_in_an_adopted_one() -> None:
    leader, ballot = planning(A)
    leader.on_plan(plan_of(leader), 0.0, [A])
    hear(leader, state(A, ballot, accepted=True))
    higher = ballot._replace(term=9)
    hear(leader, state(A, higher, t_s=1.0))
    leader.take(TIME, 1.0)
    hear(leader, state(A, higher, accepted=True, t_s=2.0), now_s=1.0)
    assert phase(leader) is BallotPhase.IN_FORCE
    hear(leader, astray(promised=higher, t_s=3.0))
    assert phase(leader) is BallotPhase.PREPARING


def test_l8_a_vehicle_without_agent_is_not_astray_until_an_agent_takes_over() -> None:
    """Otherwise its formation would be planned again and again."""
    leader, ballot = preparing(A, B)
    hear(leader, state(A, ballot, attended=False), state(B, ballot))
    assert leader.take(PROMISED, 0.0)
    assert leader.unattended == {A}
    leader.on_plan(plan_of(leader), 0.0)
    hear(leader, *(state(name, ballot, accepted=True, attended=name is B) for name in (A, B)))
    hear(leader, astray(attended=False))
    assert phase(leader) is BallotPhase.IN_FORCE
    hear(leader, state(A, incarnation=2))
    assert prepares_anew(leader, ballot)


# --- the roster -------------------------------------------------------------------------------


@pytest.mark.parametrize("reach", [preparing, planning, issuing])
def test_a_leaving_vehicle_ends_an_unfinished_ballot(reach: Reach) -> None:
    leader, ballot = reach(A, B)
    leader.on_members(formation(A), 1.0)
    assert prepares_anew(leader, ballot)
    assert leader.ballot is not None
    assert list(leader.outgoing(1.0)) == [(A, Prepare(leader.ballot, (0,), (A,)))]
    hear(leader, state(B, leader.ballot), state(A, leader.ballot))
    assert leader.take(PROMISED, 1.0)
    assert set(leader.hold_cells) == {A}


def test_a_vehicle_that_leaves_while_observing_is_not_waited_for() -> None:
    leader = control(A, B)
    leader.on_members(formation(A), 0.1)
    hear(leader, state(A, OTHERS, accepted=True))
    assert phase(leader) is BallotPhase.IN_FORCE


@pytest.mark.parametrize("reach", [preparing, planning, issuing, watching])
def test_states_of_vehicles_that_left_are_forgotten(reach: Reach) -> None:
    leader, ballot = reach(A, B)
    leader.on_members(formation(A), 1.0)
    hear(leader, state(B, OTHERS._replace(term=9), t_s=2.0))
    assert set(leader.states) == {A}
    assert prepares_anew(leader, ballot)


def test_l8_one_that_leaves_before_it_has_completed_the_plan_keeps_others_waiting() -> None:
    """It stops before a closed part, so it neither accepts the plan nor completes its moves."""
    for done in (True, False):
        leader, ballot = watching(A, B)
        hear(leader, state(B, ballot, (0, 1), accepted=True, done=done, t_s=1.0))
        leader.on_members(formation(A), 1.0)
        assert prepares_anew(leader, ballot) is not done
    # Others are under way, and need it no more.
    leader, ballot = watching(A, B)
    hear(leader, state(A, ballot, (0, 1), accepted=True, go=True, t_s=1.0))
    leader.on_members(formation(A), 1.0)
    assert (leader.phase, leader.ballot) == (BallotPhase.IN_FORCE, ballot)


def test_a_member_out_of_reach_is_planned_again_when_another_one_has_left() -> None:
    """The cell of that one is free now."""
    leader, ballot = planning(A, B)
    leader.on_plan(plan_of(leader), 0.0, [A])
    hear(leader, *(state(name, ballot, accepted=True, done=name == B) for name in (A, B)))
    hear(leader, astray(t_s=1.0))
    assert phase(leader) is BallotPhase.IN_FORCE
    leader.on_members(formation(A), 1.0)
    assert phase(leader) is BallotPhase.IN_FORCE
    hear(leader, astray(t_s=2.0))
    assert phase(leader) is BallotPhase.PREPARING


def test_a_formation_that_was_given_up_stays_so() -> None:
    leader, ballot = planning(A)
    leader.take(TOO_LATE, 0.0)
    hear(leader, state(A, ballot, incarnation=2, overdue=True))
    leader.take(TIME, 1e6)
    leader.on_members(formation(A, lane=2), 1e6)
    assert (leader.phase, leader.wakeup_s) == (BallotPhase.ABORTED, None)
    assert list(leader.outgoing(1e6)) == []


def test_a_vehicle_that_restarts_while_its_ballot_is_outbid_is_asked_again() -> None:
    leader, ballot = issuing(A, B)
    higher = ballot._replace(term=ballot.term + 5)
    hear(leader, state(A, higher, incarnation=2, t_s=1.0))
    assert phase(leader) is BallotPhase.BACKING_OFF  # outbid comes first
    hear(leader, state(A, incarnation=3, t_s=2.0))
    assert phase(leader) is BallotPhase.BACKING_OFF
    leader.take(TIME, leader.until_s)
    hear(leader, state(A, incarnation=3, t_s=3.0), state(B, ballot, accepted=True, t_s=3.0))
    assert prepares_anew(leader, higher)
    assert leader.promises == {}


# --- ballots ----------------------------------------------------------------------------------


def test_in_random_histories_ballots_only_rise_and_every_rule_is_used() -> None:
    book = RuleRecorder(LEADER_RULES)
    ballots = [
        run_random_history(control(A, B, rules=book, forms=forms), random.Random(seed))
        for seed in range(100)
        for forms in (lambda *_: True, lambda *_: False)
    ]
    assert max(ballots) > 10
    hidden = set(range(len(LEADER_RULES.table))) - {*book.taken}
    assert [LEADER_RULES.table[index] for index in hidden] == []


def run_random_history(leader: FormationLeader, rng: random.Random) -> int:
    """Return the number of ballots; check that they rise, and that a plan needs all promises."""
    now_s, ballots = 0.0, [Ballot(0, Name(""), 0, 0)]
    for _ in range(300):
        now_s += rng.choice((*9 * [0.0, 0.05, 0.3], ISSUE_S))
        known = leader.ballot or OTHERS
        higher = known._replace(term=known.term + 1)
        promised = rng.choice((None, OTHERS, higher, *9 * [known]))
        each = state(
            rng.choice((A, B)),
            promised,
            hold_cell=(0, rng.choice((1, 1, 2))),
            accepted=promised is not None and rng.random() < 0.4,
            incarnation=rng.choice((*9 * [1], 2)),
            t_s=now_s + rng.uniform(-0.3, 0.0),
            overdue=rng.random() < 0.1,
            done=rng.random() < 0.5,
        )
        leader.on_state(each, now_s)
        if rng.random() < 0.05:
            names = rng.choice(((A, B), (A, B), (A,)))
            leader.on_members(formation(*names, lane=rng.choice((1, 2))), now_s)
        leader.take(TIME, now_s)
        if leader.take(PROMISED, now_s):
            assert set(leader.hold_cells) == set(leader.formation.roster)
            if rng.random() < 0.7:
                leader.on_plan(plan_of(leader), now_s)
            else:
                leader.take(rng.choice((FAILED, FAILED, TOO_LATE)), now_s)
        for _, message in leader.outgoing(now_s):
            assert message.ballot == leader.ballot
            if message.ballot != ballots[-1]:
                assert message.ballot > ballots[-1]
                ballots.append(message.ballot)
    return len(ballots)
