"""The motion controller executes commands, then brings its vehicle to rest."""

from __future__ import annotations

import struct

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.motion import Jerk, cell_state
from laneweave.protocol.wire.bounds import MAX_COLUMN
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    CurrentMotion,
    Name,
    Neighbour,
    PendingTransfer,
)
from laneweave.sim_bridge.bodies.command_checks import Problem, Refusal
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel, MotionController
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Neighbours
from laneweave.sim_bridge.bodies.record_store import MAX_CELLS
from laneweave.sim_bridge.road.occupied_cells import OccupiedCells
from support import states
from support.convoy import ROLLING
from support.paper import PAPER
from support.road_vehicles import controller_in, known, vehicle_in
from support.states import changed

SCENARIO = PAPER
LATTICE, TICK_S = SCENARIO.lattice, SCENARIO.runtime.tick_s
HOME: Cell = (0, 1)
AGENT = 5
"""Incarnation of the process that drives."""


@pytest.fixture
def controller() -> MotionController:
    return controller_in(HOME, incarnation=AGENT)


def command(
    tick: int, *pairs: tuple[float, float], hold_cell: Cell = HOME, incarnation: int = AGENT
) -> Command:
    return states.command(tick, *pairs, hold_cell=hold_cell, incarnation=incarnation)


def driven(controller: MotionController) -> dict[FallbackLevel, int]:
    """Return for how many ticks it drove by which level."""
    return {level: ticks for level, ticks in controller.level_ticks.items() if ticks}


def plays(controller: MotionController, tick: int) -> Jerk | None:
    """Return the jerk that it would play at a tick; None: it would play nothing."""
    stays = controller._must_stay_in_lane(tick)
    level, jerk = controller._next(tick, (), stays=stays)
    return jerk if level is FallbackLevel.EXECUTE else None


def test_without_a_command_it_holds_its_cell(controller: MotionController) -> None:
    for tick in range(50):
        controller.step(tick)
    assert controller.plant.state == pytest.approx(cell_state(LATTICE, HOME, 50 * TICK_S))
    assert driven(controller) == {FallbackLevel.HOLD: 50}
    assert controller.motion == CurrentMotion(HOME)


def test_plays_jerk_by_jerk_and_from_the_middle_when_ticks_were_missed(
    controller: MotionController,
) -> None:
    assert controller.accept_command(command(10, (1.0, 0.0), (2.0, 0.5), (-4.0, 0.0)))
    controller.step(11)
    assert controller.plant.setpoint == pytest.approx((2.0 * TICK_S, 0.5 * TICK_S))
    controller.step(12)
    assert controller.plant.setpoint == pytest.approx((-2.0 * TICK_S, 0.5 * TICK_S))
    assert driven(controller) == {FallbackLevel.EXECUTE: 2}


def test_comes_to_rest_in_the_last_cell_when_the_trajectory_has_run_out(
    controller: MotionController,
) -> None:
    target: Cell = (1, 2)
    controller.accept_command(command(0, *[(3.0, 0.0)] * 4, hold_cell=target))
    for tick in range(300):
        controller.step(tick)
    assert driven(controller) == {FallbackLevel.EXECUTE: 4, FallbackLevel.HOLD: 296}
    assert controller.plant.state == pytest.approx(cell_state(LATTICE, target, 30.0), abs=0.01)


def test_the_newest_command_counts(controller: MotionController) -> None:
    assert controller.accept_command(command(5, (1.0, 0.0)))
    for tick in (5, 4, -1):
        assert not controller.accept_command(command(tick, (9.0, 0.0), hold_cell=(1, 1)))
    assert (controller.command_tick, controller.hold_cell) == (5, HOME)
    assert controller.accept_command(command(6, (2.0, 0.0), hold_cell=(1, 1)))
    assert (controller.command_tick, controller.hold_cell) == (6, (1, 1))
    assert controller.motion == CurrentMotion(HOME, 7)


def test_a_command_without_jerks_leaves_the_motion_as_it_is_unless_it_names_another_cell(
    controller: MotionController,
) -> None:
    controller.accept_command(command(5, *[(1.0, 0.0)] * 3, hold_cell=(1, 1)))
    controller.step(5)
    assert controller.accept_command(command(6, hold_cell=(1, 1)))
    assert (controller.command_tick, controller.motion.end_tick) == (6, 8)
    controller.step(6)
    assert controller.plant.setpoint[0] == pytest.approx(2.0 * TICK_S)
    assert driven(controller) == {FallbackLevel.EXECUTE: 2}
    for tick in range(7, 200):  # by the hold law
        controller.step(tick)
    assert controller.accept_command(
        replace(command(200, hold_cell=(2, 1)), motion=CurrentMotion((1, 1)))
    )
    controller.step(200)
    assert controller.hold_cell == (2, 1)
    assert driven(controller) == {FallbackLevel.EXECUTE: 3, FallbackLevel.HOLD: 193}
    controller.step(201)
    assert controller.plant.setpoint[0] > 0.0


# --- the process in charge --------------------------------------------------------------------


def test_a_new_vehicle_has_no_process_in_charge() -> None:
    controller = controller_in((-9, 1))
    assert (controller.record.incarnation, controller.record.joined) == (0, (LATTICE.block_of(-9),))
    assert controller.record.accepted is None


def test_an_older_process_is_refused(controller: MotionController) -> None:
    controller.accept_command(command(3, (1.0, 0.0)))
    before = known(controller)
    for cell in (HOME, (1, 1)):
        late = changed(command(4, (9.0, 0.0), hold_cell=cell, incarnation=AGENT - 1), joined=(7,))
        assert not controller.accept_command(late)
        assert known(controller) == before
    assert not controller.accept_command(
        changed(command(4, incarnation=AGENT - 1), jerks=b"nonsense")
    )


def test_a_newer_process_takes_charge_with_its_command(controller: MotionController) -> None:
    controller.accept_command(command(3, (1.0, 0.0)))
    assert controller.accept_command(command(4, (2.0, 0.0), incarnation=AGENT + 1))
    assert controller.record.incarnation == AGENT + 1
    assert plays(controller, 4) == (2.0, 0.0)
    assert not controller.accept_command(command(5, (3.0, 0.0)))
    assert plays(controller, 4) == (2.0, 0.0)


def test_a_claim_cannot_move_the_vehicle(controller: MotionController) -> None:
    """It could not act for the vehicle before, so no plan can allow its move."""
    controller.accept_command(changed(command(3, (1.0, 0.0)), accepted=LOW))
    before = known(controller)
    assert not controller.accept_command(
        command(4, (2.0, 0.0), hold_cell=(1, 1), incarnation=AGENT + 1)
    )
    assert known(controller) == before
    assert controller.accept_command(command(4, (2.0, 0.0), incarnation=AGENT + 1))
    assert controller.accept_command(
        command(5, (2.0, 0.0), hold_cell=(1, 1), incarnation=AGENT + 1)
    )


def test_a_claim_that_came_second_is_tried_again_with_the_next_tick(
    controller: MotionController,
) -> None:
    """The one before has begun to move in this tick, of which the claim does not know."""
    assert controller.accept_command(command(3, (1.0, 0.0), hold_cell=(1, 1)))
    assert not controller.accept_command(command(3, (2.0, 0.0), incarnation=AGENT + 1))
    assert (controller.record.incarnation, controller.hold_cell) == (AGENT, (1, 1))
    claim = command(4, (2.0, 0.0), hold_cell=(1, 1), incarnation=AGENT + 1)
    assert controller.accept_command(claim)
    assert controller.record.incarnation == AGENT + 1


def test_handing_over_leaves_the_motion_as_it_is(controller: MotionController) -> None:
    controller.accept_command(command(3, *[(1.0, 0.0)] * 9, hold_cell=(1, 1)))
    before = known(controller)
    controller.store.put_in_charge(AGENT + 7)
    assert known(controller) == (AGENT + 7, *before[1:])
    for incarnation in (AGENT, AGENT + 7):
        with pytest.raises(ValueError, match="not above"):
            controller.store.put_in_charge(incarnation)


def test_formations_stay_joined_and_only_the_process_in_charge_joins(
    controller: MotionController,
) -> None:
    own = LATTICE.block_of(HOME[0])
    controller.accept_command(changed(command(3), joined=(own + 2,)))
    assert [*controller.record.joined] == [own, own + 2]
    controller.accept_command(changed(command(4), joined=()))
    controller.accept_command(changed(command(5), joined=(own + 1, own + 2)))
    controller.accept_command(changed(command(6, incarnation=AGENT - 1), joined=(own + 5,)))
    controller.accept_command(changed(command(5), joined=(own + 6,)))
    assert [*controller.record.joined] == [own, own + 1, own + 2]


# --- what it notes ----------------------------------------------------------------------------

LOW, HIGH = Ballot(1, Name("c1"), 7, 1), Ballot(1, Name("c1"), 7, 2)


def asking(
    accepted: Ballot | None, *joined: int, tick: int = 3, incarnation: int = AGENT
) -> Command:
    return changed(command(tick, incarnation=incarnation), accepted=accepted, joined=joined)


def test_requests_of_the_process_in_charge_are_noted_whatever_the_tick(
    controller: MotionController,
) -> None:
    controller.accept_command(command(5, (1.0, 0.0)))
    before = known(controller)
    for tick, ballot in ((5, LOW), (4, HIGH)):
        late = changed(command(tick, (9.0, 0.0), hold_cell=(1, 1)), accepted=ballot, joined=(7,))
        assert controller.store_requests(late)
        assert not controller.store_requests(late)  # nothing new
        assert (controller.record.accepted, controller.record.joined[-1]) == (ballot, 7)
    assert known(controller)[3:] == before[3:]  # it is not played


@pytest.mark.parametrize("with_command", [False, True])
def test_the_newest_acceptance_counts(controller: MotionController, *, with_command: bool) -> None:
    for tick, (ballot, noted) in enumerate(((HIGH, True), (LOW, False), (None, False)), start=3):
        request = asking(ballot, tick=tick)
        assert (
            controller.accept_command(request)
            if with_command
            else controller.store_requests(request) is noted
        )
        assert controller.record.accepted == HIGH


@pytest.mark.parametrize("incarnation", [AGENT - 1, AGENT + 1])
def test_nothing_is_noted_for_a_process_that_is_not_in_charge(
    controller: MotionController, incarnation: int
) -> None:
    """Neither for one that has been replaced nor, before its claim, for its successor."""
    before = known(controller)
    assert not controller.store_requests(asking(LOW, 7, incarnation=incarnation))
    assert known(controller) == before


def test_numbers_out_of_range_are_not_noted(controller: MotionController) -> None:
    before = known(controller)
    assert not controller.store_requests(asking(LOW, 0, MAX_COLUMN + 1))
    assert known(controller) == before


@pytest.mark.parametrize("claim", ["command", "hand over"])
def test_an_acceptance_is_forgotten_when_another_takes_charge(
    controller: MotionController, claim: str
) -> None:
    controller.accept_command(asking(LOW, 7))
    joined = controller.record.joined
    if claim == "command":
        assert controller.accept_command(asking(None, tick=4, incarnation=AGENT + 1))
    else:
        controller.store.put_in_charge(AGENT + 1)
    assert (controller.record.accepted, controller.record.joined) == (None, joined)
    assert not controller.store_requests(asking(HIGH, tick=4))  # its time is over
    assert controller.record.accepted is None
    assert controller.store_requests(asking(LOW, tick=4, incarnation=AGENT + 1))


# --- what it refuses --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"jerks": b"1234"},
        {"jerks": struct.pack("<3f", 1.0, 1.0, 1.0)},
        {"jerks": struct.pack("<2f", float("nan"), 0.0)},
        {"jerks": struct.pack("<4f", 0.0, 0.0, 0.0, float("-inf"))},
        {"hold_cell": (0, -1)},
        {"hold_cell": (0, LATTICE.lanes)},
        {"hold_cell": (MAX_COLUMN + 1, 0)},
        {"motion": CurrentMotion((-MAX_COLUMN - 1, 0))},
        {"motion": CurrentMotion((0, 2**62))},
        {"joined": (0, MAX_COLUMN + 1)},
    ],
)
def test_a_bad_command_is_refused_whole(
    controller: MotionController, changes: dict[str, object]
) -> None:
    controller.accept_command(command(3, (1.0, 0.0)))
    before = known(controller)
    for incarnation in (AGENT, AGENT + 1):
        good = command(4, (2.0, 0.0), hold_cell=(1, 1), incarnation=incarnation)
        with pytest.raises(BadInputError):
            controller.accept_command(changed(good, **changes))
        assert known(controller) == before


def test_the_body_has_its_own_limits(controller: MotionController) -> None:
    controller.accept_command(command(0, *[(3e38, -3e38)] * 100))
    for tick in range(100):
        controller.step(tick)
        _, v, a, _, v_y, a_y = controller.plant.state
        assert 0.0 <= v <= SCENARIO.vehicle.max_speed_mps + 1e-9
        assert a <= SCENARIO.vehicle.max_accel_mps2 + 1e-9
        assert abs(a_y) <= SCENARIO.vehicle.max_lateral_accel_mps2 + 1e-9
        assert abs(v_y) <= SCENARIO.vehicle.max_slip_ratio * v + 1e-9


# --- without commands -------------------------------------------------------------------------


def test_a_motion_is_over_when_its_time_is_and_the_body_is_there(
    controller: MotionController,
) -> None:
    assert not controller.moving(0)
    controller.accept_command(command(0, (0.0, 0.0), (0.0, 0.0)))
    for tick, moving in ((0, True), (1, True), (2, False)):
        assert controller.moving(tick) == moving
        controller.step(tick)
    controller.accept_command(command(3, (0.0, 0.0), hold_cell=(1, 1)))
    ends = [tick for tick in range(4, 200) if _moving_after(controller, tick)]
    assert 30 < len(ends) < 120  # one column, by the hold law
    assert ends == list(range(4, 4 + len(ends)))


def _moving_after(controller: MotionController, tick: int) -> bool:
    controller.step(tick - 1)
    return controller.moving(tick)


@pytest.mark.parametrize("side", ["ahead", "behind"])
@pytest.mark.parametrize(
    ("lane", "gap_m", "accepted"),
    [(2, 0.9, False), (2, -4.0, False), (2, 1.1, True), (0, 0.0, True)],
)
def test_no_lane_change_begins_beside_another_body(
    controller: MotionController, side: str, lane: int, gap_m: float, *, accepted: bool
) -> None:
    """Whatever the plan says: the body may have stopped there since."""
    other = (Neighbour(lane, gap_m, 0.0),)
    seen = Neighbours(other, ()) if side == "ahead" else Neighbours((), other)
    controller.perceive(controller.plant.state, seen)
    there: Cell = (HOME[0], 2)
    assert controller.accept_command(command(1, (0.0, 0.1), hold_cell=there)) == accepted
    assert controller.hold_cell == (there if accepted else HOME)
    # A move within the lane may begin.
    controller = controller_in(HOME, incarnation=AGENT)
    controller.perceive(controller.plant.state, seen)
    ahead: Cell = (HOME[0] + 1, HOME[1])
    assert controller.accept_command(command(2, (0.1, 0.0), hold_cell=ahead))


KEEPING = evolve(SCENARIO, formation=evolve(SCENARIO.formation, change_columns=False))
"""Vehicles keep their columns."""


@pytest.mark.parametrize(
    ("gap_m", "faster_mps", "accepted"),
    [
        (SCENARIO.formation.gap_m - SCENARIO.vehicle.length_m, 0.0, True),  # in the next cell
        (5.0, 5.0, False),
        (12.0, 5.0, False),
        (30.0, 5.0, True),
        (5.0, 0.5, True),  # nearly in its cell: it settles
        (5.0, -15.0, True),  # it stands
    ],
)
def test_no_lane_change_begins_before_a_body_that_could_not_brake(
    gap_m: float, faster_mps: float, *, accepted: bool
) -> None:
    """It catches up with a cell farther ahead, and passes the cells of others."""
    controller = controller_in(HOME, KEEPING, incarnation=AGENT)
    speed_mps = controller.plant.state[1] + faster_mps
    behind = (Neighbour(2, gap_m, speed_mps),)
    controller.perceive(controller.plant.state, Neighbours((), behind))
    there: Cell = (HOME[0], 2)
    assert controller.accept_command(command(1, (0.0, 0.1), hold_cell=there)) == accepted
    other_lane = controller_in(HOME, KEEPING, incarnation=AGENT)
    other_lane.perceive(other_lane.plant.state, Neighbours((), behind))
    assert other_lane.accept_command(command(1, (0.0, 0.1), hold_cell=(HOME[0], 0)))


def test_no_lane_change_begins_in_an_emergency(controller: MotionController) -> None:
    controller.level = FallbackLevel.EMERGENCY
    assert not controller.accept_command(command(1, (0.0, 0.1), hold_cell=(HOME[0], 2)))
    controller.level = FallbackLevel.HOLD
    assert controller.accept_command(command(2, (0.0, 0.1), hold_cell=(HOME[0], 2)))


@pytest.mark.parametrize(
    ("behind_m", "slower_mps", "across_m", "origin", "changes"),
    [
        (0.0, 0.0, 0.0, HOME, True),
        (0.9, 0.0, 0.0, HOME, True),
        (1.5, 0.0, 0.0, HOME, False),
        (0.0, 3.0, 0.0, HOME, False),
        (60.0, 0.0, 0.3, HOME, False),
        (60.0, 0.0, 1.2, HOME, True),  # it is in both lanes
        (14.0, 3.0, 0.0, (HOME[0] - 1, HOME[1]), True),  # an oblique move
        (18.0, 3.0, 0.0, (HOME[0] - 1, HOME[1]), False),
    ],
)
def test_a_body_that_had_to_brake_stays_in_its_lane(
    behind_m: float, slower_mps: float, across_m: float, origin: Cell, *, changes: bool
) -> None:
    """Beside it are cells of others; one that is partly in the other lane goes on."""
    s, v, a, y, v_y, a_y = cell_state(LATTICE, HOME, 0.0)
    state = (s - behind_m, v - slower_mps, a, y + across_m, v_y, a_y)
    controller = controller_in(origin, incarnation=AGENT, state=state)
    there: Cell = (HOME[0], HOME[1] + 1)
    # The agent wants to move over, too.
    jerks = [(0.0, 2.0)] * 6 + [(0.0, 0.0)] * 20
    move = command(0, *jerks, hold_cell=there)
    move = replace(move, motion=replace(move.motion, origin=origin))
    assert controller.accept_command(move)
    touched = False
    for tick in range(8):
        controller.step(tick)
        touched |= controller.plant.state[3] > y + across_m + 0.05
    assert touched == changes


def test_a_body_that_has_caught_up_changes_lanes(controller: MotionController) -> None:
    s, v, a, y, v_y, a_y = cell_state(LATTICE, HOME, 0.0)
    controller = controller_in(HOME, state=(s - 40.0, v, a, y, v_y, a_y))
    controller.hold_cell = (HOME[0], HOME[1] + 1)
    for tick in range(300):
        controller.step(tick)
    assert controller.has_settled(300 * TICK_S)


# --- commands that no correct agent sends -----------------------------------------------------


def moved(tick: int, target: Cell, origin: Cell = HOME) -> Command:
    """Return a command for a move."""
    made = command(tick, (0.0, 0.0), hold_cell=target)
    return replace(made, motion=CurrentMotion(origin, tick + 38))


def refused(controller: MotionController, wrong: Command) -> Problem | None:
    """Return why a controller refuses a command; None: it accepts it."""
    before = known(controller)[3:]
    if controller.accept_command(wrong):
        return None
    assert known(controller)[4:] == before[1:]  # but for the tick of the command
    assert controller.refusal is not None
    return controller.refusal.problem


@pytest.mark.parametrize("target", [(2, 1), (0, 3), (1, 3), (-2, 0), (40, 1)])
def test_moves_lead_to_neighbouring_cells(target: Cell) -> None:
    five_lanes = evolve(SCENARIO, road=evolve(SCENARIO.road, lanes=5))
    controller = controller_in(HOME, five_lanes, incarnation=AGENT)
    assert refused(controller, moved(1, target)) is Problem.MOVE


def test_a_move_begins_in_the_cell_of_the_vehicle(controller: MotionController) -> None:
    assert refused(controller, moved(1, (1, 1), origin=(1, 2))) is Problem.MOVE
    assert refused(controller, moved(2, HOME, origin=(3, 1))) is Problem.MOVE
    assert refused(controller, moved(3, (1, 1))) is None


def test_a_move_begins_when_the_last_one_is_complete(controller: MotionController) -> None:
    assert refused(controller, moved(0, (1, 1))) is None
    assert controller.occupied == {HOME, (1, 1)}
    assert refused(controller, moved(1, (2, 1), origin=(1, 1))) is Problem.MOVE
    for tick in range(1, 200):
        controller.step(tick)
    controller.end_move(200 * TICK_S)
    assert controller.occupied == {(1, 1)}
    assert refused(controller, moved(200, (2, 1), origin=(1, 1))) is None


def test_a_type_that_keeps_its_column_changes_lanes_only() -> None:
    controller = controller_in(HOME, KEEPING, incarnation=AGENT)
    assert controller.occupied == {HOME}
    assert refused(controller, moved(1, (1, 1))) is Problem.MOVE
    assert refused(controller, moved(2, (0, 2))) is None


def test_no_move_leads_through_a_cell_that_is_occupied(controller: MotionController) -> None:
    other, gap = vehicle_in((1, 2), "B"), (0, 0)
    vehicles = {Name("B"): other}
    controller.occupancy = OccupiedCells(vehicles, lambda cell: cell == gap)
    for tick, (target, occupant) in enumerate([((1, 2), "B"), ((1, 1), None)], start=1):
        wrong = moved(tick, target)
        assert refused(controller, wrong) is (Problem.OCCUPIED if occupant else None)
        if occupant is not None:
            assert controller.refusal == Refusal(Problem.OCCUPIED, occupant=occupant)
    controller = controller_in(HOME, incarnation=AGENT)
    controller.occupancy = OccupiedCells(vehicles, lambda cell: cell == gap)
    assert refused(controller, moved(1, gap)) is Problem.OCCUPIED
    # An oblique move takes the corners, too.
    assert refused(controller, moved(2, (-1, 0))) is Problem.OCCUPIED
    other.controller.leave_lattice()
    assert refused(controller, moved(3, (1, 2))) is None


@pytest.mark.parametrize(
    ("changes", "allowed"),
    [
        ({"end_tick": 10**6}, False),
        ({"end_tick": 2**62}, False),
        ({"ticks": -1}, False),
        ({"ticks": 2**40}, False),
        ({"end_tick": 400, "ticks": 38}, True),
    ],
)
def test_motions_end(
    controller: MotionController, changes: dict[str, int], *, allowed: bool
) -> None:
    """An agent that takes over plans until their end."""
    made = command(1, (0.0, 0.0))
    made = replace(made, motion=replace(made.motion, **changes))
    if allowed:
        assert controller.accept_command(made)
        return
    with pytest.raises(BadInputError, match="motion"):
        controller.accept_command(made)
    assert controller.refusal == Refusal(Problem.VALUES)


def test_a_trajectory_that_leads_out_of_the_cell_is_dropped(controller: MotionController) -> None:
    controller.accept_command(command(0, *[(0.0, 8.0)] * 30))
    tick = 0
    while controller.refusal is None:
        controller.step(tick)
        tick += 1
    assert controller.refusal.problem is Problem.LEAVES_CELLS
    assert controller.refusal.excess_m > 0.0
    while tick < 100:
        controller.step(tick)
        tick += 1
        assert abs(controller.plant.state[3] - LATTICE.cell_y_m(HOME[1])) < 0.31
    assert controller.level is FallbackLevel.HOLD


def test_no_record_asks_for_cells_that_do_not_exist_or_for_too_many() -> None:
    controller = controller_in(HOME, ROLLING, incarnation=AGENT)
    controller.store.assign_cell(HOME)
    ballot = Ballot(1, Name("c1"), 1, 1)
    for after in (((0, 7),), ((2**40, 1),), tuple((n, 1) for n in range(MAX_CELLS + 1))):
        transfer = PendingTransfer(ballot, (HOME,), after, (Name("me"),))
        controller.store_requests(changed(command(1), promised=ballot, transfer=transfer))
        assert controller.record.transfer is None
    transfer = PendingTransfer(ballot, (HOME,), (HOME, (0, 2)), (Name("me"),))
    controller.store_requests(changed(command(1), promised=ballot, transfer=transfer))
    assert controller.record.transfer is not None
