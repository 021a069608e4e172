"""What the motion controller keeps of promises, deeds and estates, however orders arrive."""

from __future__ import annotations

from itertools import permutations, product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    CurrentMotion,
    Name,
    PendingTransfer,
    Prepare,
    VehicleRecord,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.road.caretakers import Caretaker
from support.examples import examples
from support.road_vehicles import controller_in, vehicle_in
from support.rolling_samples import (
    AFTER,
    BEFORE,
    HIGH,
    HOME,
    LOW,
    MID,
    A,
    B,
    controller_of,
    make_plan,
    pending,
)
from support.states import changed

AGENT = 7


@pytest.fixture
def controller() -> MotionController:
    """The controller of A, whose agent is in charge."""
    return make_controller()


def make_controller() -> MotionController:
    controller = controller_of(BEFORE[A])
    controller.store.put_in_charge(AGENT)
    return controller


def order(
    promised: Ballot | None = None,
    transfer: PendingTransfer | None = None,
    accepted: Ballot | None = None,
    incarnation: int = AGENT,
) -> Command:
    return Command(
        A,
        VehicleRecord(
            incarnation=incarnation, promised=promised, transfer=transfer, accepted=accepted
        ),
        0,
        HOME,
        CurrentMotion(HOME),
        b"",
    )


OPEN = PendingTransfer(MID, open=True)
PROMISE = order(MID)
ACCEPTANCE = order(MID, pending(A), MID)
POSSESSION = order(MID, OPEN, MID)
"""Successive commands of an agent, each with everything that it requests."""


def kept(controller: MotionController) -> tuple[object, ...]:
    transfer = controller.record.transfer
    return (
        controller.record.promised,
        controller.record.accepted,
        transfer,
        frozenset(controller.record.owned),
    )


def test_orders_one_after_the_other(controller: MotionController) -> None:
    assert kept(controller) == (None, None, None, frozenset(BEFORE[A]))
    assert controller.store_requests(PROMISE)
    assert not controller.store_requests(PROMISE)
    assert controller.store_requests(ACCEPTANCE)
    assert kept(controller) == (MID, MID, pending(A), frozenset(BEFORE[A]))
    assert controller.store_requests(POSSESSION)
    assert kept(controller) == (MID, MID, OPEN, frozenset(AFTER[A]))
    assert not controller.store_requests(ACCEPTANCE)  # a duplicate opens and closes nothing
    assert kept(controller) == (MID, MID, OPEN, frozenset(AFTER[A]))


def test_without_its_deed_a_plan_is_not_accepted(controller: MotionController) -> None:
    controller.store_requests(order(MID, None, MID))
    assert controller.record.accepted is None
    controller.store_requests(order(MID, pending(A, LOW), MID))
    assert (controller.record.accepted, controller.record.transfer) == (None, None)


def test_only_the_newest_deed_can_be_opened(controller: MotionController) -> None:
    controller.store_requests(ACCEPTANCE)
    newer = PendingTransfer(HIGH, BEFORE[A], BEFORE[A], (A,))
    controller.store_requests(order(HIGH, newer, HIGH))
    controller.store_requests(POSSESSION)
    assert controller.record.transfer == newer
    assert set(controller.record.owned) == set(BEFORE[A])


@pytest.mark.parametrize("process", [AGENT, AGENT + 1])
def test_a_promise_binds_this_process_and_the_next(
    controller: MotionController, process: int
) -> None:
    """No transfer of less than was promised is drawn up."""
    controller.store_requests(order(HIGH))
    if process != AGENT:
        controller.store.put_in_charge(process)
    controller.store_requests(changed(ACCEPTANCE, incarnation=process))
    assert kept(controller) == (HIGH, None, None, frozenset(BEFORE[A]))


def test_a_deed_outlives_the_process_and_its_acceptance_does_not(
    controller: MotionController,
) -> None:
    controller.store_requests(ACCEPTANCE)
    controller.store.put_in_charge(AGENT + 1)
    assert kept(controller) == (MID, None, pending(A), frozenset(BEFORE[A]))
    assert not controller.store_requests(POSSESSION)  # of the process that was replaced
    assert controller.record.transfer == pending(A)


def test_where_formations_own_blocks_acceptance_needs_no_deed() -> None:
    controller = controller_in(HOME, incarnation=AGENT)
    controller.store_requests(order(accepted=MID))
    assert (controller.record.accepted, controller.record.owned) == (MID, ())


# --- any order --------------------------------------------------------------------------------


@pytest.mark.parametrize("orders", list(permutations((PROMISE, ACCEPTANCE, POSSESSION))))
def test_any_order_of_one_plan_ends_sound(orders: tuple[Command, ...]) -> None:
    """Possession is said after the acceptance is known to be noted, so it comes last once."""
    controller = make_controller()
    for each in (*orders, ACCEPTANCE, POSSESSION, *orders):
        controller.store_requests(each)
        check(controller)
    assert kept(controller) == (MID, MID, OPEN, frozenset(AFTER[A]))


def check(controller: MotionController) -> None:
    """Check that what is kept fits together."""
    transfer = controller.record.transfer
    if transfer is not None and not transfer.open:
        assert set(controller.record.owned) == set(transfer.before)
    if controller.record.accepted is not None:
        assert transfer is not None
        assert transfer.ballot >= controller.record.accepted
    if transfer is not None:
        assert controller.record.promised is not None
        assert transfer.ballot <= controller.record.promised


BALLOTS = [Ballot(term, Name("c1"), 1, seq) for term in (1, 2) for seq in (1, 2)]
CELLS: list[Cell] = [(column, lane) for column in (0, 1, 2) for lane in (0, 1)]


@st.composite
def histories(draw: st.DrawFn) -> list[Command | Cell]:
    """Commands of a correct agent over several ballots, in any order, with repetitions."""
    said: list[Command | Cell] = []
    transfer: PendingTransfer | None = None
    owned = set(BEFORE[A])
    for ballot in sorted(draw(st.sets(st.sampled_from(BALLOTS), min_size=1))):
        said.append(order(ballot, transfer))
        how_far = draw(st.integers(0, 2))
        if how_far >= 1:
            after = {HOME, *draw(st.sets(st.sampled_from(CELLS), max_size=3))}
            transfer = PendingTransfer(ballot, tuple(sorted(owned)), tuple(sorted(after)), (A, B))
            said.append(order(ballot, transfer, ballot))
            if how_far == 2:
                transfer = PendingTransfer(ballot, open=True)
                said.append(order(ballot, transfer, ballot))
                owned = after
    late = draw(st.lists(st.sampled_from(said), max_size=6))
    granted: list[Command | Cell] = [(50 + index, 0) for index in range(draw(st.integers(0, 2)))]
    return draw(st.permutations([*said, *late, *granted]))


@pytest.mark.slow
@given(histories(), st.integers(0, 20))
@examples(200)
def test_however_orders_arrive_what_is_kept_is_sound(
    history: list[Command | Cell], restart: int
) -> None:
    controller = make_controller()
    final: dict[Ballot, PendingTransfer | None] = {}
    granted = set()
    for index, each in enumerate(history):
        if index == restart:
            controller.store.put_in_charge(AGENT + 1)
        before = controller.record.promised, controller.record.transfer
        if isinstance(each, Command):
            controller.store_requests(each)
        else:
            controller.store.assign_cell(each)
            granted.add(each)
        check(controller)
        assert granted <= set(controller.record.owned)
        assert before[0] is None or (controller.record.promised or LOW) >= before[0]
        if before[1] is not None:
            assert controller.record.transfer is not None
            assert controller.record.transfer.ballot >= before[1].ballot
        # With a promise, which transfer is the newest of the older ones is final.
        promised, transfer = controller.record.promised, controller.record.transfer
        if promised is not None and (transfer is None or transfer.ballot < promised):
            newest = final.setdefault(promised, transfer)
            assert (newest and newest.ballot) == (transfer and transfer.ballot)


# --- cells from the roadside ------------------------------------------------------------------

GIVEN: Cell = (-1, 0)


@pytest.mark.parametrize("when", range(4))
def test_a_cell_that_comes_at_any_time_is_kept(controller: MotionController, when: int) -> None:
    """The plan was made before the cell was assigned; a closed transfer has it on both sides."""
    for step, each in enumerate((PROMISE, ACCEPTANCE, POSSESSION, POSSESSION)):
        if when == step:
            controller.store.assign_cell(GIVEN)
            if (transfer := controller.record.transfer) is not None and not transfer.open:
                assert GIVEN in transfer.before
                assert GIVEN in transfer.after
        controller.store_requests(each)
    assert set(controller.record.owned) == {*AFTER[A], GIVEN}


@pytest.mark.parametrize(("when", "opened"), list(product(range(2), (False, True))))
def test_a_cell_that_a_plan_knew_is_not_kept_by_force(when: int, *, opened: bool) -> None:
    controller = make_controller()
    controller.store.assign_cell(GIVEN)
    if when:
        controller.store_requests(PROMISE)
    given_away = PendingTransfer(MID, (*BEFORE[A], GIVEN), AFTER[A], (A, B))
    controller.store_requests(order(MID, given_away, MID))
    if opened:
        controller.store_requests(POSSESSION)
    assert (GIVEN in controller.record.owned) is not opened
    later = PendingTransfer(HIGH, AFTER[A], AFTER[A], (A,))
    controller.store_requests(order(HIGH, later, HIGH))
    assert GIVEN not in controller.record.owned


# --- the caretaker ----------------------------------------------------------------------------


def test_the_caretaker_hands_cells_over_and_moves_nothing() -> None:
    controller = controller_of(BEFORE[B][::-1])
    caretaker = Caretaker(vehicle_in((2, 1), B, controller=controller), AGENT, 0)
    plan = make_plan()
    state = caretaker.on_message(Prepare(MID, (), (A, B)), 0)
    assert state is not None
    assert (state.record.promised, state.record.owned) == (MID, controller.record.owned)
    state = caretaker.on_message(plan, 0)
    assert state is not None
    assert state.accepted
    assert state.record.transfer == controller.record.transfer == pending(B)
    assert controller.record.accepted == MID


def test_the_caretaker_is_bound_by_what_the_agent_promised(controller: MotionController) -> None:
    controller.store_requests(order(HIGH))
    shown = Caretaker(vehicle_in(HOME, A, controller=controller), AGENT + 1, 0).state(0)
    assert (shown.record.promised, shown.record.owned) == (HIGH, tuple(sorted(BEFORE[A])))
