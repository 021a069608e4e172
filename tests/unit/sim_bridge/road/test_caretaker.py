"""The caretaker promises, accepts plans in which its vehicle holds, and never moves it."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.wire.messages import (
    Ballot,
    CurrentMotion,
    Name,
    Plan,
    Prepare,
    VehicleState,
)
from laneweave.sim_bridge.road.caretakers import Caretaker
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.paper import PAPER
from support.road_vehicles import vehicle_in
from support.states import command, holding, make_plan

A, B = Name("A"), Name("B")
HOME: Cell = (-2, 0)
NEXT: Cell = (-1, 0)
OTHER: Cell = (0, 2)
FORMATION = PAPER.lattice.block_of(HOME[0])
AGENT, CARETAKER = 5, 8
"""Incarnations."""
FIRST, SECOND = Ballot(1, Name("c1"), 7, 1), Ballot(1, Name("c1"), 7, 2)


@pytest.fixture
def vehicle() -> RoadVehicle:
    """A vehicle that an agent was in charge of; road time is 0."""
    vehicle = vehicle_in(HOME)
    vehicle.controller.store.put_in_charge(AGENT)
    return vehicle


@pytest.fixture
def caretaker(vehicle: RoadVehicle) -> Caretaker:
    return Caretaker(vehicle, CARETAKER, 0)


def drive(vehicle: RoadVehicle, ticks: Iterable[int]) -> None:
    for tick in ticks:
        vehicle.step(tick)


def prepare(ballot: Ballot = FIRST, *formations: int) -> Prepare:
    return Prepare(ballot, formations or (FORMATION,), (A, B))


def plan(
    ballot: Ballot = FIRST, *, own_moves: tuple[PlannedMove, ...] = (), start: Cell = HOME
) -> Plan:
    moves: dict[Name, tuple[PlannedMove, ...]] = {A: own_moves, B: ((0, OTHER, (-1, 2)),)}
    incarnations = {A: CARETAKER, B: 3}
    fields = {"ballot": ballot, "blocks": (FORMATION,), "incarnations": incarnations}
    return make_plan({A: start, B: OTHER}, moves, t0_s=1.0, **fields)


def answer_of(caretaker: Caretaker, message: Prepare | Plan, tick: int = 0) -> VehicleState:
    state = caretaker.on_message(message, tick)
    assert state is not None
    return state


def test_shows_what_the_vehicle_does(caretaker: Caretaker, vehicle: RoadVehicle) -> None:
    drive(vehicle, range(10))
    s_m, speed_mps, _, y_m, *_ = vehicle.state
    state = holding(A, None, HOME, incarnation=CARETAKER, attended=False)
    assert state.block == FORMATION
    assert caretaker.state(10) == replace(state, s_m=s_m, y_m=y_m, speed_mps=speed_mps, t_s=1.0)


def test_takes_charge_with_an_incarnation_above_all_earlier_ones(vehicle: RoadVehicle) -> None:
    with pytest.raises(ValueError, match="not above"):
        Caretaker(vehicle, AGENT, 0)
    Caretaker(vehicle, AGENT + 1, 0)
    assert vehicle.controller.record.incarnation == AGENT + 1


def test_promises_the_highest_ballot_for_its_vehicle(caretaker: Caretaker) -> None:
    assert caretaker.on_message(replace(prepare(), roster=(B,)), 0) is None
    assert caretaker.state(0).record.promised is None
    for ballot in (SECOND, SECOND, FIRST):
        assert answer_of(caretaker, prepare(ballot)).record.promised == SECOND


def test_accepts_a_plan_in_which_its_vehicle_holds_and_the_controller_notes_it(
    caretaker: Caretaker, vehicle: RoadVehicle
) -> None:
    for ballot in (FIRST, SECOND):
        state = answer_of(caretaker, prepare(ballot))
        assert (state.record.promised, state.accepted) == (ballot, False)  # it ends the plan before
        state = answer_of(caretaker, plan(ballot))
        assert (state.accepted, state.ready, state.done, state.go) == (True, True, True, False)
        assert vehicle.controller.record.accepted == ballot
        assert caretaker.on_message(plan(ballot), 0) is None
        assert caretaker.state(1).accepted


def test_what_the_agent_before_it_accepted_is_not_its_own(vehicle: RoadVehicle) -> None:
    vehicle.controller.store.store_acceptance(SECOND)
    caretaker = Caretaker(vehicle, CARETAKER, 0)
    answer_of(caretaker, prepare())
    assert not caretaker.state(0).accepted
    assert answer_of(caretaker, plan()).accepted
    assert vehicle.controller.record.accepted == FIRST


@pytest.mark.parametrize(
    "refused",
    [
        plan(own_moves=((1, HOME, NEXT),)),
        plan(SECOND),
        plan(start=NEXT),
        replace(plan(), incarnations={A: AGENT, B: 3}),
        replace(plan(), blocks=(FORMATION, FORMATION + 1)),
        replace(plan(), territory=((-2, 0),)),
        replace(plan(), moves={B: ()}),
    ],
    ids=["it moves", "ballot", "cell", "incarnation", "not joined", "territory", "not in it"],
)
def test_accepts_no_other_plan(caretaker: Caretaker, vehicle: RoadVehicle, refused: Plan) -> None:
    answer_of(caretaker, prepare())
    assert caretaker.on_message(refused, 0) is None
    assert not caretaker.state(0).accepted
    assert vehicle.controller.record.accepted is None
    assert answer_of(caretaker, plan()).accepted  # the right one may still come


def test_joins_formations_for_the_vehicle(caretaker: Caretaker, vehicle: RoadVehicle) -> None:
    both = (FORMATION, FORMATION + 1)
    assert answer_of(caretaker, prepare(FIRST, *both)).record.joined == both
    assert vehicle.controller.record.joined == both
    assert answer_of(caretaker, prepare(SECOND)).record.joined == both
    wide = replace(plan(SECOND), blocks=both)
    assert answer_of(caretaker, wide).accepted


def test_never_moves_whatever_it_has_promised_and_accepted(
    caretaker: Caretaker, vehicle: RoadVehicle
) -> None:
    answer_of(caretaker, prepare())
    answer_of(caretaker, plan())
    for tick in range(200):
        drive(vehicle, (tick,))
        state = caretaker.state(tick + 1)
        assert state.hold_cell == HOME
        assert not any((state.moving, state.go, state.overdue))
    assert vehicle.controller.hold_cell == HOME


def test_the_move_of_the_agent_before_it_counts_until_its_end(vehicle: RoadVehicle) -> None:
    # By the hold law, which takes longer than the 38 ticks of the command.
    move = command(0, (0.0, 0.0), hold_cell=NEXT, incarnation=AGENT, motion=CurrentMotion(HOME, 38))
    assert vehicle.controller.accept_command(move)
    drive(vehicle, range(5))
    caretaker = Caretaker(vehicle, CARETAKER, 5)
    state = answer_of(caretaker, prepare(), 5)
    assert (state.hold_cell, state.moving, state.record.promised) == (NEXT, True, FIRST)
    state = answer_of(caretaker, plan(start=NEXT), 5)
    assert (state.accepted, state.ready) == (True, False)  # no move begins before it has ended
    ends = []
    for tick in range(5, 150):
        drive(vehicle, (tick,))
        state = caretaker.state(tick + 1)
        assert state.ready != state.moving
        assert state.completed == 0
        if state.moving:
            ends.append(tick + 1)
    assert 38 <= ends[-1] < 120
    assert ends == list(range(6, ends[-1] + 1))  # once
    assert vehicle.state[0] == pytest.approx(PAPER.lattice.cell_s_m(NEXT[0], 15.0), abs=0.1)


@pytest.mark.parametrize(("back_m", "moving"), [(0.8, False), (1.2, True)])
def test_a_body_that_gives_way_counts_as_moving_once_it_is_out_of_its_cell(
    caretaker: Caretaker, vehicle: RoadVehicle, back_m: float, *, moving: bool
) -> None:
    """It keeps its claim to the cell, and comes back to it."""
    caretaker.state(0)
    state = vehicle.state
    vehicle.controller.plant._state = (state[0] - back_m, *state[1:])
    assert vehicle.controller.moving(0)
    assert caretaker.state(0).moving == moving
    vehicle.controller.plant._state = state
    assert not caretaker.state(0).moving
