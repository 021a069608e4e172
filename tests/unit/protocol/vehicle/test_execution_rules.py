"""A vehicle that owns cells: its promises, the plans that it accepts, when it takes ownership."""

from __future__ import annotations

from typing import Any

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.vehicle.plan_execution import ExecutionPhase, PlanExecution
from laneweave.protocol.vehicle.plans import ownership_problems, plan_problems
from laneweave.protocol.vehicle.territory import BlockTerritory
from laneweave.protocol.wire.messages import PendingTransfer, Plan, Prepare, VehicleRecord
from support.convoy import ROLLING
from support.rolling_samples import (
    AFTER,
    BEFORE,
    HIGH,
    HOME,
    INCARNATION,
    LOW,
    MID,
    T0_S,
    TARGET,
    A,
    B,
    C,
    make_plan,
    pending,
    sense,
    state,
    vehicle,
)
from support.states import changed

PREPARE = Prepare(MID, (), (A, B))


def promised() -> PlanExecution:
    execution = vehicle()
    assert execution.on_prepare(PREPARE)
    assert execution.on_record(sense(promised=MID).record)
    return execution


def accepted() -> PlanExecution:
    """Accept the plan, and let the controller note it with its transfer."""
    execution = promised()
    assert execution.on_plan(make_plan())
    noted = sense(promised=MID, transfer=pending(A), accepted=MID)
    assert execution.on_record(noted.record)
    return execution


# --- which plans are sound --------------------------------------------------------------------


def with_before_of_a(plan: Plan, *cells: Cell) -> Plan:
    return replace(plan, before=BEFORE | {A: cells})


UNSOUND: dict[str, dict[str, Any]] = {
    "before does not cover the roster": {"before": {A: BEFORE[A]}},
    "after does not cover the roster": {"after": {A: AFTER[A]}},
    "a cell has two owners before": {"before": BEFORE | {A: (HOME, (1, 0), TARGET)}},
    "a cell has two owners after": {"after": AFTER | {B: (TARGET, (1, 1), (2, 1))}},
    "A does not own [(0, 1)]": {"after": AFTER | {A: (HOME, (1, 0))}},
    "B does not own [(2, 1)]": {"after": AFTER | {B: ((1, 1),)}},
    "no member owned [(9, 9)]": {"after": AFTER | {B: ((1, 1), (2, 1), (9, 9))}},
}


def test_a_sound_plan_has_no_problems() -> None:
    assert ownership_problems(make_plan()) == plan_problems(make_plan()) == []


@pytest.mark.parametrize("problem", UNSOUND)
def test_an_unsound_plan_is_refused(problem: str) -> None:
    plan = replace(make_plan(), **UNSOUND[problem])
    assert problem in ownership_problems(plan)
    assert plan_problems(plan) == []
    execution = promised()
    assert not execution.on_plan(plan)
    assert execution.plan is None
    assert execution.on_plan(make_plan())


def test_a_plan_that_claims_more_cells_than_the_vehicle_owns_is_refused() -> None:
    plan = make_plan()
    execution = promised()
    assert not execution.on_plan(with_before_of_a(plan, *BEFORE[A], (7, 0)))
    # Fewer cells do no harm: the others then have no owner.
    less = replace(plan, before=BEFORE | {A: (HOME,)}, after=AFTER | {A: (HOME, TARGET)})
    assert execution.on_plan(less)


def test_cells_of_a_closed_transfer_may_be_owned() -> None:
    """Others may know that its gate is open."""
    plan = with_before_of_a(make_plan(HIGH), *BEFORE[A], (7, 0))
    transfer = PendingTransfer(LOW, BEFORE[A], (*BEFORE[A], (7, 0)), (A, C))
    execution = vehicle()
    execution.on_prepare(Prepare(HIGH, (), (A, B)))
    execution.on_record(sense(promised=HIGH).record)
    assert not execution.on_plan(plan)
    execution.on_record(sense(promised=HIGH, transfer=transfer).record)
    assert execution.on_plan(plan)


def test_neither_blocks_nor_joined_formations_matter() -> None:
    plan = replace(make_plan(), blocks=(17,))
    execution = promised()
    assert execution.on_plan(plan)
    assert execution.wanted_joined == ()


# --- promises ---------------------------------------------------------------------------------


def test_a_promise_shows_owned_cells_only_when_the_controller_has_noted_it() -> None:
    execution = vehicle()
    old = sense(transfer=pending(A, LOW))
    assert execution.state(old, attended=True).record.owned == BEFORE[A]
    execution.on_prepare(PREPARE)
    assert execution.wanted.promised == MID
    assert not execution.on_record(old.record)
    assert execution.state(old, attended=True).record.owned == ()
    noted = sense(promised=MID)
    assert execution.on_record(noted.record)
    assert execution.state(noted, attended=True).record.owned == BEFORE[A]
    assert not execution.on_record(noted.record)  # nothing new


def test_what_an_earlier_process_promised_binds_the_next_one() -> None:
    execution = vehicle()
    assert execution.on_record(sense(promised=MID).record)
    assert (execution.promised, execution.phase) == (MID, ExecutionPhase.PROMISED)
    assert execution.on_prepare(Prepare(LOW, (), (A, B)))  # it shows what it has promised
    assert execution.promised == MID
    assert execution.on_prepare(Prepare(HIGH, (), (A, B)))
    assert execution.promised == HIGH


def test_a_later_promise_drops_the_plan_and_keeps_the_gate_closed() -> None:
    execution = accepted()
    assert execution.go is False
    assert execution.on_prepare(Prepare(HIGH, (), (A, B)))
    assert (execution.plan, execution.wanted.accepted) == (None, None)
    execution.on_state(changed(state(B, MID, accepted=True), go=True))
    execution.tick(T0_S)
    assert execution.go is False
    assert execution.transfer == pending(A)  # it says no more than what was accepted


# --- taking ownership -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shown", "t_s", "owns", "move"),
    [
        ({"ready": False}, T0_S, False, None),
        ({}, T0_S, True, (0, HOME, TARGET)),
        ({}, T0_S - 1.0, True, None),
        ({"ready": False, "go": True}, T0_S - 1.0, True, None),
    ],
    ids=["not all are ready", "all are ready", "before the moves are due", "another has go"],
)
def test_takes_ownership_with_the_open_gate(
    shown: dict[str, Any], t_s: float, owns: bool, move: PlannedMove | None
) -> None:
    execution = accepted()
    assert execution.tick(T0_S) is None
    assert execution.transfer == pending(A)
    execution.on_state(changed(state(B, MID, accepted=True), **shown))
    assert execution.tick(t_s) == move
    assert execution.transfer == (PendingTransfer(MID, open=True) if owns else pending(A))
    assert execution.go is owns


def test_where_formations_own_blocks_there_are_no_transfers() -> None:
    stored = VehicleRecord(incarnation=INCARNATION, joined=(-1, 0))
    execution = evolve(vehicle(), territory=BlockTerritory(ROLLING.lattice), stored=stored)
    execution.on_prepare(Prepare(MID, (-1, 0), (A, B)))
    assert execution.wanted.promised is None
    assert not execution.on_record(replace(stored, promised=HIGH))
    assert execution.promised == MID
    assert execution.on_plan(replace(make_plan(), blocks=(-1, 0), before={}, after={}))
    assert execution.transfer is None
