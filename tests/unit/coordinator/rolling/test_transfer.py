"""One cell transfer: promises, the plan, and when it is given up."""

from __future__ import annotations

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES, CellTransfer
from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.plans import ownership_problems, plan_problems
from laneweave.protocol.wire.messages import (
    Name,
    PendingTransfer,
    Plan,
    Prepare,
    VehicleState,
)
from support.rolling_samples import (
    AFTER,
    BEFORE,
    HIGH,
    HOME,
    LOW,
    MID,
    TARGET,
    A,
    B,
    C,
    make_plan,
    state,
)
from support.rule_books import RuleRecorder
from support.states import changed

RESEND_S = 0.2


def make_transfer(moves: dict[Name, tuple[Cell, Cell]] | None = None) -> CellTransfer:
    return CellTransfer(
        ballot=MID,
        roster=(A, B),
        moves=moves or {A: (HOME, TARGET)},
        t0_s=100.0,
        slot_s=4.0,
        resend_s=RESEND_S,
        due_s=1.0,
    )


def hear(transfer: CellTransfer, *states: VehicleState) -> None:
    known: dict[Name, VehicleState] = {}
    for each in states:
        known[each.vehicle] = each
        if each.vehicle in transfer.roster:
            transfer.on_state(each, known, 0.0)


def issued() -> CellTransfer:
    transfer = make_transfer()
    hear(transfer, state(A, MID), state(B, MID))
    assert transfer.phase is BallotPhase.ISSUING
    return transfer


# --- promises ---------------------------------------------------------------------------------


def test_prepares_until_all_have_promised() -> None:
    transfer = make_transfer()
    assert transfer.outgoing(0.9) == []
    assert transfer.wakeup_s == 1.0
    expected = Prepare(MID, (), (A, B))
    assert transfer.outgoing(1.0) == [(A, expected), (B, expected)]
    assert transfer.outgoing(1.1) == []
    assert transfer.wakeup_s == 1.0 + RESEND_S
    hear(transfer, state(A, MID))
    assert transfer.outgoing(1.2) == [(B, expected)]


@pytest.mark.parametrize(
    "no_promise",
    [state(B, LOW), state(B), state(B, MID, owned=()), state(B, MID, accepted=True)],
    ids=["of an older ballot", "none", "not noted", "accepted already"],
)
def test_what_is_no_promise_does_not_count(no_promise: VehicleState) -> None:
    transfer = make_transfer()
    hear(transfer, state(A, MID), no_promise)
    assert (transfer.phase, set(transfer.promises)) == (BallotPhase.PREPARING, {A})


def test_the_plan_is_made_from_the_promises() -> None:
    transfer = issued()
    plan = transfer.plan
    assert plan == replace(
        make_plan(), blocks=plan.blocks if plan else (), incarnations={A: 7, B: 7}
    )
    assert plan is not None
    assert plan_problems(plan) == ownership_problems(plan) == []
    assert transfer.outgoing(1.0) == [(A, plan), (B, plan)]
    assert transfer.outgoing(1.1) == []
    hear(transfer, state(B, MID, accepted=True))
    assert transfer.outgoing(1.2) == [(A, plan)]
    hear(transfer, state(A, MID, accepted=True))
    assert transfer.phase is BallotPhase.IN_FORCE
    assert transfer.wakeup_s is None
    assert transfer.outgoing(9.0) == []


def test_the_newest_promise_counts() -> None:
    """It includes cells that the roadside assigned between two states."""
    transfer = make_transfer()
    hear(transfer, state(A, MID), state(A, MID, owned=(*BEFORE[A], (5, 0))), state(B, MID))
    assert transfer.plan is not None
    assert transfer.plan.before[A] == (*BEFORE[A], (5, 0))
    assert transfer.plan.after[A] == (*AFTER[A], (5, 0))


def test_a_cell_that_is_left_in_a_slot_cannot_be_entered_in_it() -> None:
    """A cell that a vehicle leaves in this slot is still its own in the slot."""
    transfer = make_transfer({A: (HOME, TARGET), B: ((2, 1), (1, 1))})
    hear(transfer, state(A, MID), state(B, MID))
    assert transfer.phase is BallotPhase.ISSUING
    transfer = make_transfer({A: (HOME, (1, 1)), B: ((2, 1), (1, 1))})
    hear(transfer, state(A, MID), state(B, MID))
    assert transfer.phase is BallotPhase.ABORTED
    assert "meet in step 0" in transfer.reason


def test_a_closed_transfer_of_an_older_plan_is_resolved_by_the_others() -> None:
    old = PendingTransfer(LOW, ((2, 1),), BEFORE[B], (A, B))
    transfer = make_transfer()
    hear(
        transfer,
        state(A, MID, PendingTransfer(LOW, open=True)),
        state(B, MID, old, owned=((2, 1),)),
    )
    assert isinstance(transfer.plan, Plan)
    assert transfer.plan.before == BEFORE


# --- giving up --------------------------------------------------------------------------------

WRONG = {
    "A is not in the cell that was planned from": [
        replace(state(A, MID), hold_cell=(1, 0)),
        state(B, MID),
    ],
    "B does not own": [state(A, MID), replace(state(B, MID), hold_cell=TARGET)],
    "no member owned": [state(A, MID), state(B, MID, owned=((2, 1),))],
    "a cell has two owners": [state(A, MID, owned=(*BEFORE[A], (2, 1))), state(B, MID)],
    "the cells of B are not known": [
        state(
            C, LOW, PendingTransfer(LOW, ((9, 2),), ((9, 2),), (A, B, C))
        ),  # it may open its gate yet
        state(A, MID, PendingTransfer(LOW, BEFORE[A], BEFORE[A], (A,))),
        state(B, MID, PendingTransfer(LOW, BEFORE[B], AFTER[B], (A, B, C))),
    ],
    "outbid": [state(A, MID), state(B, HIGH)],
    "A has restarted": [state(A, MID), changed(state(A, LOW), incarnation=8)],
}


@pytest.mark.parametrize("why", WRONG)
def test_is_given_up_when_it_cannot_succeed(why: str) -> None:
    transfer = make_transfer()
    hear(transfer, *WRONG[why])
    assert transfer.phase is BallotPhase.ABORTED
    assert why in transfer.reason
    assert transfer.plan is None
    assert transfer.wakeup_s is None
    assert transfer.outgoing(9.0) == []


def test_a_vehicle_without_agent_is_not_moved() -> None:
    transfer = make_transfer()
    hear(transfer, replace(state(A, MID), attended=False), state(B, MID))
    assert transfer.reason == "A is not in the cell that was planned from"
    transfer = make_transfer()
    hear(transfer, state(A, MID), replace(state(B, MID), attended=False))
    assert (
        transfer.phase is BallotPhase.ISSUING
    )  # a vehicle that only gives cells need not be driven


@pytest.mark.parametrize(
    ("shown", "why"),
    [(changed(state(B, MID), incarnation=8), "B has restarted"), (state(B, HIGH), "outbid")],
)
def test_is_given_up_while_the_plan_is_sent(shown: VehicleState, why: str) -> None:
    transfer = issued()
    hear(transfer, shown)
    assert (transfer.phase, transfer.reason) == (BallotPhase.ABORTED, why)


def test_what_is_in_force_or_given_up_stays_so() -> None:
    transfer = issued()
    hear(transfer, state(A, MID, accepted=True), state(B, MID, accepted=True))
    hear(transfer, state(A, HIGH))
    transfer.on_left(A)
    assert transfer.phase is BallotPhase.IN_FORCE
    transfer = make_transfer()
    transfer.abort("no reason")
    hear(transfer, state(A, MID), state(B, MID))
    assert (transfer.phase, transfer.reason) == (
        BallotPhase.ABORTED,
        "no reason, and A, B did not answer",
    )


# --- the table as a whole ---------------------------------------------------------------------


def test_histories_take_every_row_of_the_table() -> None:
    """No row is hidden behind an earlier one."""
    book = RuleRecorder(TRANSFER_RULES)

    def begun(*states: VehicleState) -> CellTransfer:
        transfer = evolve(make_transfer(), rules=book)
        hear(transfer, *states)
        return transfer

    promised = state(A, MID), state(B, MID)
    begun(*promised, state(A, MID, accepted=True), state(B, MID, accepted=True))  # in force
    begun(state(A, HIGH))  # outbid
    begun(*promised, changed(state(A, MID), incarnation=9))  # restarted
    begun(replace(state(A, MID), attended=False), state(B, MID))  # cannot be planned
    begun(*promised).abort("late")
    begun(*promised).on_left(A)
    assert {*book.taken} == {*range(len(TRANSFER_RULES.table))}


def test_a_vehicle_that_restarts_while_the_ballot_is_outbid_does_not_revive_it() -> None:
    transfer = issued()
    hear(transfer, changed(state(A, HIGH), incarnation=9))
    assert (transfer.phase, transfer.reason) == (BallotPhase.ABORTED, "outbid")
    hear(transfer, changed(state(A, MID), incarnation=9), changed(state(A, MID), incarnation=10))
    assert (transfer.phase, transfer.reason) == (BallotPhase.ABORTED, "outbid")
    assert list(transfer.outgoing(1e6)) == []
