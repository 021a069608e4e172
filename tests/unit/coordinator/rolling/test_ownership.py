"""Which cells a vehicle owns, as far as its state and those of others tell."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from laneweave.coordinator.rolling.ownership import (
    ReplacedBallots,
    certain_cells,
    owned_cells,
    partners,
)
from laneweave.protocol.wire.messages import Ballot, Name, PendingTransfer, VehicleState
from support.rolling_samples import AFTER, BEFORE, HIGH, LOW, MID, A, B, C, pending, state
from support.states import changed

OWNED_BEFORE, OWNED_AFTER = frozenset(BEFORE[A]), frozenset(AFTER[A])
SURE = OWNED_BEFORE & OWNED_AFTER
BETWEEN = Ballot(2, Name("c1"), 10, 2)
"""Above MID, below HIGH."""
OPEN = PendingTransfer(MID, open=True)
TRANSFER = pending(A, MID, (A, B, C))
TRANSFER_OF_B = pending(B, MID, (A, B, C))
TRANSFER_OF_C = PendingTransfer(MID, ((9, 2),), ((9, 2),), (A, B, C))
STRANDED = (5, 0)
"""A cell that A does not own afterwards."""
CLOSED = state(A, HIGH, TRANSFER)
"""A has promised more, and its gate was closed then."""


def test_without_a_transfer_or_with_an_open_one_the_state_shows_the_owned_cells() -> None:
    assert owned_cells(state(A, HIGH), {}) == OWNED_BEFORE
    taken = state(A, HIGH, OPEN, owned=AFTER[A])
    assert owned_cells(taken, {}) == OWNED_AFTER


def test_one_that_knows_the_open_gate_is_enough() -> None:
    knows = state(C, MID, OPEN)
    assert owned_cells(CLOSED, {C: knows}) == OWNED_AFTER
    # Also while A still could open its own gate.
    assert owned_cells(state(A, MID, TRANSFER), {C: knows}) == OWNED_AFTER


@pytest.mark.parametrize("older", [None, PendingTransfer(LOW, open=True)])
def test_a_higher_promise_without_the_transfer_keeps_the_gate_closed(
    older: PendingTransfer | None,
) -> None:
    assert owned_cells(CLOSED, {C: state(C, BETWEEN, older)}) == OWNED_BEFORE
    assert owned_cells(state(A, MID, TRANSFER), {C: state(C, BETWEEN, older)}) == OWNED_BEFORE


@pytest.mark.parametrize(
    "silent",
    [
        state(C, MID),  # it may accept yet
        state(C, LOW),
        state(C, None),
        state(C, BETWEEN, owned=()),  # its controller has not noted the promise
        state(C, MID, TRANSFER_OF_C),  # it may open its gate yet
    ],
)  # fmt: skip
def test_states_that_may_still_change_tell_nothing(silent: VehicleState) -> None:
    others = {B: state(B, HIGH, TRANSFER_OF_B), C: silent}
    assert owned_cells(CLOSED, others) is None
    assert certain_cells(CLOSED, others) == SURE
    assert partners(CLOSED, others) == {B, C}


def test_when_all_have_promised_more_with_closed_gates_the_old_cells_are_owned() -> None:
    others = {B: state(B, BETWEEN, TRANSFER_OF_B), C: state(C, HIGH, TRANSFER_OF_C)}
    assert owned_cells(CLOSED, others) == certain_cells(CLOSED, others) == OWNED_BEFORE
    assert partners(CLOSED, others) == frozenset()
    assert owned_cells(state(A, MID, TRANSFER), others) is None  # A may open its own gate
    assert owned_cells(changed(CLOSED, owned=()), others) is None


@pytest.mark.parametrize("newer", [None, state(C, HIGH, PendingTransfer(BETWEEN, open=True))])
def test_cells_owned_either_way_are_certain(
    newer: VehicleState | None,
) -> None:
    """A member may have opened the gate; it has left, or has had another plan since."""
    there = {} if newer is None else {C: newer}
    gone = {C} if newer is None else set[Name]()
    assert owned_cells(CLOSED, {B: state(B, HIGH, TRANSFER_OF_B), **there}, gone) == SURE
    assert owned_cells(CLOSED, {B: state(B, MID, TRANSFER_OF_B), **there}, gone) == SURE
    assert owned_cells(CLOSED, {B: state(B, HIGH, OPEN), **there}, gone) == OWNED_AFTER
    assert owned_cells(CLOSED, {B: state(B, HIGH), **there}, gone) == OWNED_BEFORE
    assert partners(CLOSED, {B: state(B, HIGH, TRANSFER_OF_B), **there}) == {B, *there}
    # Under way it may still be in a cell that it is about to give.
    moving = replace(CLOSED, moving=True)
    assert owned_cells(moving, there, gone) is None
    assert certain_cells(moving, there, gone) == SURE


def test_a_vehicle_that_rests_outside_its_start_cell_was_never_ready() -> None:
    """Its controller refused an earlier move; so no gate has opened, even of one that has left."""
    stranded, other = replace(CLOSED, hold_cell=STRANDED), state(B, HIGH, TRANSFER_OF_B)
    assert owned_cells(stranded, {B: other}, {C}) == OWNED_BEFORE
    assert partners(stranded, {B: other}) == frozenset()
    assert owned_cells(other, {A: stranded}, {C}) == frozenset(BEFORE[B])
    assert owned_cells(other, {A: CLOSED}, {C}) == frozenset(BEFORE[B]) & {*AFTER[B]}
    # It may be on its way to its start cell, or become ready yet.
    assert owned_cells(replace(stranded, moving=True), {}, {C}) is None
    assert owned_cells(changed(stranded, promised=MID), {}, {C}) == SURE


def test_states_of_other_vehicles_and_own_older_ones_are_ignored() -> None:
    stranger, others = Name("X"), {B: state(B, MID, TRANSFER_OF_B), C: state(C, MID, TRANSFER_OF_C)}
    assert owned_cells(CLOSED, {stranger: state(stranger, HIGH), **others}) is None
    assert owned_cells(CLOSED, {A: state(A, HIGH, OPEN), **others}) is None


def test_a_single_member_of_a_plan_knows_what_it_owns() -> None:
    alone = pending(A, MID, (A,))
    assert owned_cells(state(A, HIGH, alone), {}) == OWNED_BEFORE
    assert owned_cells(state(A, MID, alone), {}) is None


# --- vehicles that have left the lattice --------------------------------------------------------


@pytest.mark.parametrize("ballot", [MID, BETWEEN, HIGH])
def test_a_vehicle_that_has_left_the_lattice_is_gone_for_all_ballots_so_far(ballot: Ballot) -> None:
    """As if it had left the road: whether it saw the gate open is unknown."""
    withdrawn = state(C, HIGH, PendingTransfer(ballot), owned=())
    others = {B: state(B, HIGH, TRANSFER_OF_B), C: withdrawn}
    assert owned_cells(CLOSED, others) == SURE
    assert partners(CLOSED, others) == {B, C}
    knows = state(B, MID, OPEN)
    assert owned_cells(CLOSED, others | {B: knows}) == OWNED_AFTER


def test_a_vehicle_that_left_before_a_ballot_still_counts_in_it() -> None:
    again = state(C, HIGH, PendingTransfer(LOW), owned=((9, 2),))
    assert owned_cells(CLOSED, {B: state(B, HIGH, TRANSFER_OF_B), C: again}) == OWNED_BEFORE


def test_a_vehicle_that_has_entered_again_owns_what_the_roadside_has_assigned() -> None:
    cells = ((-9, 1), (-8, 1))
    again = state(C, HIGH, PendingTransfer(HIGH), owned=cells)
    assert owned_cells(again, {}) == certain_cells(again, {}) == set(cells)
    assert partners(again, {}) == frozenset()


CLOSED_B, CLOSED_C = state(B, BETWEEN, TRANSFER_OF_B), state(C, HIGH, TRANSFER_OF_C)
MOVED_ON = state(B, HIGH, PendingTransfer(HIGH, open=True))
"""B has a newer transfer, which hides what it has shown before."""


@pytest.mark.parametrize("in_time", [True, False])
def test_what_members_of_a_replaced_ballot_have_shown_stays_true(*, in_time: bool) -> None:
    replaced = ReplacedBallots()
    replaced.replace(MID, (A, B, C), {B: CLOSED_B} if in_time else {})
    replaced.on_state(MOVED_ON)
    replaced.on_state(CLOSED_C)
    states = {A: CLOSED, B: MOVED_ON}
    assert owned_cells(CLOSED, states, {C}) == SURE
    assert replaced.owned_cells(CLOSED, states, {C}) == (OWNED_BEFORE if in_time else SURE)
    assert replaced.copy().owned_cells(CLOSED, states, {C}) == (OWNED_BEFORE if in_time else SURE)


def test_a_gate_of_a_replaced_ballot_that_is_known_to_be_open_counts() -> None:
    replaced = ReplacedBallots()
    replaced.replace(MID, (A, B, C), {})
    waiting = state(A, MID, TRANSFER)
    assert replaced.owned_cells(waiting, {}) is None
    assert replaced.cells_before(waiting, {}, ()) == OWNED_BEFORE
    replaced.on_state(state(C, MID, OPEN))
    assert replaced.cells_before(waiting, {C: state(C, HIGH)}, ()) == OWNED_AFTER


def test_replaced_ballots_are_forgotten_when_no_vehicle_stores_their_transfer() -> None:
    replaced = ReplacedBallots()
    replaced.replace(MID, (A, B, C), {})
    replaced.forget({A: CLOSED, B: MOVED_ON})
    assert MID in replaced
    replaced.forget({B: MOVED_ON})
    assert MID not in replaced
    assert not replaced
    assert replaced.owned_cells(CLOSED, {}, {B, C}) == owned_cells(CLOSED, {}, {B, C})


def test_a_member_that_was_never_ready_says_more_than_that_its_gate_is_closed() -> None:
    replaced = ReplacedBallots()
    moving = replace(state(B, BETWEEN, TRANSFER_OF_B), moving=True)
    replaced.replace(MID, (A, B, C), {B: moving})
    assert replaced.owned_cells(CLOSED, {}, {C}) == SURE
    replaced.on_state(replace(moving, moving=False, hold_cell=STRANDED))
    assert replaced.owned_cells(CLOSED, {B: MOVED_ON}, {C}) == OWNED_BEFORE


def test_members_that_have_promised_no_higher_ballot_are_asked() -> None:
    replaced = ReplacedBallots()
    replaced.replace(MID, (A, B, C), {})
    states = {A: CLOSED, B: state(B, MID, TRANSFER_OF_B), C: state(C, None)}
    assert replaced.to_ask(states) == {B, C}
    assert replaced.to_ask({A: CLOSED}) == set()
