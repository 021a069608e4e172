"""The caretaker promises, accepts plans in which its vehicle holds, and never moves it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from attrs import evolve

from laneweave.protocol.lattice import Cell, PlannedMove, territory
from laneweave.protocol.wire.messages import Ballot, Command, Name, Plan, Prepare, VehicleState
from laneweave.sim_bridge.road.attendance import Caretaker
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.paper import PAPER

SCENARIO = PAPER
A, B = Name("A"), Name("B")
HOME: Cell = (-2, 0)
NEXT: Cell = (-1, 0)
OTHER: Cell = (0, 2)
FORMATION = SCENARIO.lattice.block_of(HOME[0])
AGENT, CARETAKER = 5, 8
"""Incarnations."""
FIRST, SECOND = Ballot(1, Name("c1"), 7, 1), Ballot(1, Name("c1"), 7, 2)


@pytest.fixture
def vehicle() -> RoadVehicle:
    """A vehicle that an agent was in charge of; road time is 0."""
    admission = Admission(Arrival("A", 0, 1, 0.0), HOME, 0.0)
    vehicle = RoadVehicle.entering(admission, 0.0, SCENARIO)
    vehicle.controller.put_in_charge(AGENT)
    return vehicle


@pytest.fixture
def caretaker(vehicle: RoadVehicle) -> Caretaker:
    return Caretaker(vehicle, CARETAKER, 0)


def begin_move(vehicle: RoadVehicle, ticks: int = 38) -> None:
    """Begin a move as an agent does; by the hold law, which takes longer."""
    jerks = np.zeros((1, 2), dtype="<f4").tobytes()
    vehicle.controller.take(Command(A, AGENT, 0, NEXT, ticks, HOME, jerks))


def drive(vehicle: RoadVehicle, ticks: Iterable[int]) -> None:
    for tick in ticks:
        vehicle.step(tick)


def prepare(ballot: Ballot = FIRST, *formations: int) -> Prepare:
    return Prepare(ballot, formations or (FORMATION,), (A, B))


def plan(
    ballot: Ballot = FIRST, *, own_moves: tuple[PlannedMove, ...] = (), start: Cell = HOME
) -> Plan:
    moves: dict[Name, tuple[PlannedMove, ...]] = {A: own_moves, B: ((0, OTHER, (-1, 2)),)}
    starts = {A: start, B: OTHER}
    return Plan(
        ballot=ballot,
        formations=(FORMATION,),
        roster=(A, B),
        incarnations={A: CARETAKER, B: 3},
        start_cells=starts,
        moves=moves,
        t0_s=1.0,
        slot_s=4.0,
        territory=tuple(
            sorted(territory(starts.values(), [m for one in moves.values() for m in one]))
        ),
    )


def answer_of(caretaker: Caretaker, message: Prepare | Plan, tick: int = 0) -> VehicleState:
    state = caretaker.on_message(message, tick)
    assert state is not None
    return state


def test_shows_what_the_vehicle_does(caretaker: Caretaker, vehicle: RoadVehicle) -> None:
    drive(vehicle, range(10))
    assert caretaker.state(10) == VehicleState(
        vehicle=A,
        incarnation=CARETAKER,
        formation=FORMATION,
        joined=(FORMATION,),
        promised=None,
        accepted=False,
        ready=False,
        completed=0,
        hold_cell=HOME,
        moving=False,
        go=False,
        done=False,
        overdue=False,
        attended=False,
        s_m=vehicle.state[0],
        y_m=vehicle.state[3],
        speed_mps=vehicle.state[1],
        t_s=1.0,
    )


def test_takes_charge_with_an_incarnation_above_all_earlier_ones(vehicle: RoadVehicle) -> None:
    with pytest.raises(ValueError, match="not above"):
        Caretaker(vehicle, AGENT, 0)
    Caretaker(vehicle, AGENT + 1, 0)
    assert vehicle.controller.attendant == AGENT + 1


def test_promises_the_highest_ballot(caretaker: Caretaker) -> None:
    assert answer_of(caretaker, prepare(SECOND)).promised == SECOND
    assert answer_of(caretaker, prepare(SECOND)).promised == SECOND
    assert answer_of(caretaker, prepare(FIRST)).promised == SECOND


def test_promises_nothing_that_is_not_for_its_vehicle(caretaker: Caretaker) -> None:
    assert caretaker.on_message(evolve(prepare(), roster=(B,)), 0) is None
    assert caretaker.state(0).promised is None


def test_accepts_a_plan_in_which_its_vehicle_holds(caretaker: Caretaker) -> None:
    answer_of(caretaker, prepare())
    state = answer_of(caretaker, plan())
    assert (state.accepted, state.ready, state.done, state.go) == (True, True, True, False)
    assert caretaker.on_message(plan(), 0) is None
    assert caretaker.state(1).accepted


def test_what_it_accepts_is_noted_as_that_of_an_agent_is(
    caretaker: Caretaker, vehicle: RoadVehicle
) -> None:
    answer_of(caretaker, prepare())
    caretaker.on_message(plan(own_moves=((1, HOME, NEXT),)), 0)
    assert vehicle.controller.accepted is None
    answer_of(caretaker, plan())
    assert vehicle.controller.accepted == FIRST
    answer_of(caretaker, prepare(SECOND))
    answer_of(caretaker, plan(SECOND))
    assert vehicle.controller.accepted == SECOND


def test_what_the_agent_before_it_accepted_is_not_its_own(vehicle: RoadVehicle) -> None:
    vehicle.controller.accept(SECOND)
    caretaker = Caretaker(vehicle, CARETAKER, 0)
    answer_of(caretaker, prepare())
    assert not caretaker.state(0).accepted
    assert answer_of(caretaker, plan()).accepted
    assert vehicle.controller.accepted == FIRST


@pytest.mark.parametrize(
    "refused",
    [
        plan(own_moves=((1, HOME, NEXT),)),
        plan(SECOND),
        plan(start=NEXT),
        evolve(plan(), incarnations={A: AGENT, B: 3}),
        evolve(plan(), formations=(FORMATION, FORMATION + 1)),
        evolve(plan(), territory=((-2, 0),)),
        evolve(plan(), moves={B: ()}),
    ],
    ids=["it moves", "ballot", "cell", "incarnation", "not joined", "territory", "not in it"],
)
def test_accepts_no_other_plan(caretaker: Caretaker, refused: Plan) -> None:
    answer_of(caretaker, prepare())
    assert caretaker.on_message(refused, 0) is None
    assert not caretaker.state(0).accepted
    assert answer_of(caretaker, plan()).accepted  # the right one may still come


def test_a_new_ballot_ends_the_plan(caretaker: Caretaker) -> None:
    answer_of(caretaker, prepare())
    answer_of(caretaker, plan())
    state = answer_of(caretaker, prepare(SECOND))
    assert (state.promised, state.accepted) == (SECOND, False)


def test_joins_formations_for_the_vehicle(caretaker: Caretaker, vehicle: RoadVehicle) -> None:
    both = (FORMATION, FORMATION + 1)
    assert answer_of(caretaker, prepare(FIRST, *both)).joined == both
    assert vehicle.controller.joined == both
    assert answer_of(caretaker, prepare(SECOND)).joined == both
    wide = evolve(plan(SECOND), formations=both)
    assert answer_of(caretaker, wide).accepted


def test_never_moves_whatever_it_has_promised_and_accepted(
    caretaker: Caretaker, vehicle: RoadVehicle
) -> None:
    answer_of(caretaker, prepare())
    answer_of(caretaker, plan())
    for tick in range(200):
        drive(vehicle, (tick,))
        state = caretaker.state(tick + 1)
        assert (state.hold_cell, state.moving, state.go, state.overdue) == (
            HOME,
            False,
            False,
            False,
        )
    assert vehicle.controller.hold_cell == HOME


def test_the_move_of_the_agent_before_it_counts_until_its_end(vehicle: RoadVehicle) -> None:
    begin_move(vehicle)
    drive(vehicle, range(5))
    caretaker = Caretaker(vehicle, CARETAKER, 5)
    state = answer_of(caretaker, prepare(), 5)
    assert (state.hold_cell, state.moving, state.promised) == (NEXT, True, FIRST)
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
    assert vehicle.state[0] == pytest.approx(SCENARIO.lattice.cell_s_m(NEXT[0], 15.0), abs=0.1)


def test_a_body_that_gives_way_does_not_count_as_moving(
    caretaker: Caretaker, vehicle: RoadVehicle
) -> None:
    """It keeps its claim to the cell, and comes back to it."""
    caretaker.state(0)
    state = vehicle.state
    vehicle.controller.plant._state = (state[0] - 3.0, *state[1:])
    assert vehicle.controller.moving(0)
    assert not caretaker.state(0).moving
