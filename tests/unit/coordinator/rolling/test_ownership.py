"""Closed transfers: which cells are certain, which promises are needed, and which vehicles move."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import count

import pytest
from attrs import evolve

from laneweave.coordinator.planning.rolling.problem import StreamPlan, StreamVehicle
from laneweave.coordinator.rolling.operation import RollingOperation
from laneweave.coordinator.rolling.ownership import certain_cells, owned_cells, partners
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Computed
from laneweave.protocol.scenario.fields import FormationSettings, Road, Scenario
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    Name,
    PendingTransfer,
    VehicleState,
)
from support.states import holding

A, B, C = Name("a"), Name("b"), Name("c")
SCENARIO = Scenario(
    road=Road(s1_m=0.0, s2_m=0.0, s3_m=600.0), formation=FormationSettings(operation="rolling")
)


def ballot(seq: int) -> Ballot:
    return Ballot(1, Name("c1"), 1, seq)


def transfer(seq: int, before: tuple[Cell, ...], after: tuple[Cell, ...]) -> PendingTransfer:
    return PendingTransfer(ballot(seq), before, after, (A, B))


def state(vehicle: Name, promised: int, *owned: Cell, **more: object) -> VehicleState:
    return holding(vehicle, ballot(promised), owned[0], owned=owned, **more)


TAKES = transfer(1, ((3, 0),), ((3, 0), (3, 1)))
GIVES = transfer(1, ((4, 1), (3, 1)), ((4, 1),))
TAKER = state(A, 1, (3, 0), transfer=TAKES, accepted=True, ready=True)
GIVER = state(B, 1, (4, 1), (3, 1), transfer=GIVES, accepted=True, ready=True, done=True)


def owned(giver: VehicleState, *others: VehicleState) -> frozenset[Cell] | None:
    return owned_cells(giver, {other.vehicle: other for other in (giver, *others)})


def test_ownership_is_unknown_while_both_may_open_their_gates() -> None:
    assert owned(GIVER, TAKER) is None
    assert certain_cells(GIVER, {A: TAKER, B: GIVER}) == {(4, 1)}
    assert partners(GIVER, {A: TAKER, B: GIVER}) == {A, B}


@pytest.mark.parametrize(
    ("taker", "cells"),
    [
        (state(A, 1, (3, 0), (3, 1), transfer=PendingTransfer(ballot(1), open=True)), {(4, 1)}),
        (state(A, 2, (3, 0)), {(4, 1), (3, 1)}),  # it has never had the transfer
        (evolve(TAKER, promised=ballot(2), accepted=False), {(4, 1), (3, 1)}),
        (
            state(A, 3, (3, 0), transfer=PendingTransfer(ballot(2), open=True)),
            {(4, 1)},
        ),  # it shows a newer one
    ],
)
def test_the_state_of_one_vehicle_tells_what_the_other_owns(
    taker: VehicleState, cells: set[Cell]
) -> None:
    giver = evolve(GIVER, promised=ballot(2), accepted=False)
    assert owned(giver, taker) == frozenset(cells)


def test_a_vehicle_that_has_left_is_not_waited_for() -> None:
    giver = evolve(GIVER, promised=ballot(2), accepted=False)
    assert owned(giver) is None  # it may be there, and was not heard yet
    assert owned_cells(giver, {B: giver}, {A}) == frozenset({(4, 1)})
    assert partners(giver, {B: giver}) == {B}


def test_a_moving_vehicle_may_need_the_cells_that_it_gives() -> None:
    giver = evolve(GIVER, promised=ballot(2), accepted=False, moving=True)
    assert owned(giver) is None


class Orders:
    """A planner with given moves that records which vehicles are held."""

    def __init__(self, moves: dict[Name, Cell]) -> None:
        """Plan these moves in each slot."""
        self.moves = moves
        self.held: set[str] = set()

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
    ) -> StreamPlan:
        del before, blocked
        self.held = {vehicle.vehicle for vehicle in vehicles if vehicle.held}
        ways = {
            vehicle.vehicle: (vehicle.cell, self.moves.get(Name(vehicle.vehicle), vehicle.cell))
            for vehicle in vehicles
        }
        return StreamPlan(slot, ways, ())


def plan_once(planner: Orders, *states: VehicleState) -> RollingOperation:
    """Let a leader receive states and plan one slot."""
    numbers = count(10)
    control = RollingOperation(SCENARIO, lambda _: ballot(next(numbers)), lambda: 1, planner.plan)
    entries = tuple(CensusEntry(each.vehicle, each.hold_cell, 0, 0.0) for each in states)
    control.on_census(Census(0.0, entries, ()))
    for each in states:
        control.on_state(each, 0.0)
    assert not list(control.order(0.0, 0.0))
    (order,) = control.order(9.5, 9.5)
    list(control.finish(Computed(order.job, order.work()), 9.6, 9.6))
    return control


def test_vehicles_that_may_know_what_a_member_owns_are_in_the_roster() -> None:
    other = state(C, 1, (5, 1), (5, 0))
    giver = evolve(GIVER, transfer=transfer(1, ((4, 1), (3, 1), (4, 0)), ((4, 1), (4, 0))))
    giver = evolve(giver, owned=((4, 1), (3, 1), (4, 0)))
    control = plan_once(Orders({B: (4, 0)}), TAKER, giver, other)
    assert [transfer.roster for transfer in control.transfers] == [(A, B)]


def test_a_vehicle_at_a_gate_that_never_opens_is_planned_for() -> None:
    taker = evolve(TAKER, owned=((3, 0), (2, 0)))
    taker = evolve(taker, transfer=transfer(1, ((3, 0), (2, 0)), ((3, 0), (2, 0), (3, 1))))
    planner = Orders({A: (2, 0)})
    control = plan_once(planner, taker, GIVER)
    assert not planner.held
    assert [set(transfer.moves) for transfer in control.transfers] == [{A}]


def test_a_vehicle_that_is_about_to_move_is_held() -> None:
    planner = Orders({})
    plan_once(planner, evolve(TAKER, go=True), GIVER)
    assert planner.held == {A}
