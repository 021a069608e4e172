"""One vehicle's agent with the real tracker, on a toy plant and a toy motion controller."""

from __future__ import annotations

from itertools import count

import attrs
import pytest
from msgspec.structs import replace

from laneweave.agents.core import MAX_REPEATS, AgentCore
from laneweave.agents.driving.driver import TrackingDriver
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.road_layout import TemporaryClosure, TemporaryParts
from laneweave.protocol.runtime import node
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle, VehicleTypeSettings
from laneweave.protocol.vehicle.execution_rules import drives_its_moves
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.motion import ARRIVED_ACROSS_M, ARRIVED_ALONG_M
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.messages import Command, Name, Neighbour, Prepare
from laneweave.protocol.wire.process_messages import Report
from support.agent_rig import HOME, ME, MOVE_TICKS, OTHER, SCENARIO, TICK_S, Rig, up_and_running
from support.closed_lanes import DROP
from support.states import BALLOT, changed, holding, make_plan, sent

BOTH: dict[Name, Cell] = {ME: HOME, OTHER: (0, 0)}

# --- coming and going -------------------------------------------------------------------------


def test_the_state_contains_measurements_and_the_block_of_entry() -> None:
    rig = Rig()
    sense = changed(rig.sense(), block=5, joined=(5, 6))
    rig.hand(topics.SENSE, sense)
    rig.coast(1)
    sense = changed(rig.sense(), block=5, joined=(5, 6), incarnation=1)
    command, state = (each for each in rig.hand(topics.SENSE, sense) if isinstance(each, node.Send))
    assert (command.topic, command.parameters) == (topics.COMMAND, {"vehicle": ME})
    assert (state.topic, state.parameters) == (topics.STATE, {"block": 5, "vehicle": ME})
    s_m, speed_mps, _, y_m, *_ = sense.measured
    values = {"s_m": s_m, "y_m": y_m, "speed_mps": speed_mps, "t_s": TICK_S}
    assert rig.shown == [holding(ME, None, HOME, block=5, joined=(5, 6), **values)]


def test_a_new_agent_waits_for_its_first_sense() -> None:
    agent = AgentCore(ME, lambda: 1, SCENARIO)
    assert list(agent.handle(node.Started(), 0.0)) == []
    assert agent.wakeup_s is None
    assert agent.wanted_states == ()


def test_an_agent_whose_vehicle_has_left_reports_once() -> None:
    rig = up_and_running()
    effects = rig.hand(topics.SENSE, rig.sense(left=True))
    assert rig.agent.ended
    (report,) = sent(effects, Report)
    assert (report.role, report.name, report.solves, report.unusable) == ("agent", ME, 2, 0)
    assert len(report.solve_ms) == 2 * 4
    assert isinstance(effects[0], node.Send)
    assert effects[0].topic is topics.REPORT
    assert len(effects) == 1
    assert rig.hand(topics.SENSE, rig.sense(left=True)) == []


# --- one answer per tick ----------------------------------------------------------------------


def test_answers_each_tick_once_and_repeats_are_the_same_bytes() -> None:
    rig = up_and_running()
    sense = rig.sense()
    effects = rig.hand(topics.SENSE, sense)
    assert [e.topic for e in effects if isinstance(e, node.Send)] == [topics.COMMAND, topics.STATE]
    (command,) = sent(effects, Command)
    assert (command.tick, command.hold_cell, command.motion.end_tick) == (2, HOME, 0)
    assert (command.record.incarnation, command.record.joined) == (1, (0,))
    for _ in range(3):
        assert rig.hand(topics.SENSE, replace(sense, setpoint=(9.0, 9.0))) == [
            node.Send(topics.COMMAND, command, {"vehicle": ME})
        ]


def test_older_ticks_and_other_vehicles_are_ignored() -> None:
    rig = up_and_running()
    old = rig.sense()
    rig.run(2)
    assert rig.hand(topics.SENSE, old) == []
    assert rig.hand(topics.SENSE, replace(rig.sense(), vehicle=OTHER)) == []
    assert rig.run().t_s == pytest.approx((rig.tick - 1) * TICK_S)


def test_a_body_that_is_pushed_out_of_the_cell_of_its_last_move_drives_back() -> None:
    """V8: the motion back begins in the hold cell, so the motion controller accepts it."""
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    rig.run(2 * MOVE_TICKS)
    assert rig.controller.hold_cell == (-1, 2)
    s, *others = rig.state
    rig.controller.plant._state = (s - 1.5, *others)  # type: ignore[assignment]
    assert rig.run().moving
    assert rig.played is not None
    assert rig.played.motion.origin == (-1, 2)
    rig.run(80)  # each command is accepted
    assert not rig.shown[-1].moving
    assert rig.off((-1, 2)) < ARRIVED_ALONG_M


def test_an_agent_starts_anew_on_the_road_of_a_newer_bridge() -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    rig.run(20)
    late = rig.tick + 50
    old = replace(rig.sense(), tick=late, t_s=late * TICK_S)
    first = Rig().sense()  # of the next road: tick 0, and no process is in charge yet
    (claim,) = sent(rig.hand(topics.SENSE, replace(first, bridge=7)), Command)
    assert (claim.tick, claim.record.incarnation, claim.hold_cell) == (0, 2, HOME)
    assert not rig.agent.in_charge
    # A message of the earlier bridge may still be on its way, and its tick is higher.
    assert rig.hand(topics.SENSE, old) == []
    granted = changed(first, bridge=7, tick=1, t_s=TICK_S, incarnation=2)
    rig.hand(topics.SENSE, granted)
    state = rig.shown[-1]
    assert (state.record.incarnation, state.record.promised, state.accepted) == (2, None, False)
    assert rig.hand(topics.SENSE, replace(old, left=True)) == []
    assert not rig.agent.ended


def test_a_lost_note_is_requested_again_with_each_tick() -> None:
    rig = up_and_running()
    rig.hand(topics.PREPARE, Prepare(BALLOT, (0,), (ME,)))
    plan = make_plan({ME: HOME}, {ME: ((0, HOME, (-1, 2)),)})
    (asked,) = sent(rig.hand(topics.PLAN, plan), Command)  # it is lost
    assert rig.played is not None
    assert asked == changed(rig.played, accepted=BALLOT)  # the same motion
    for _ in range(3):
        effects = rig.hand(topics.SENSE, rig.sense())
        (command,) = sent(effects, Command)
        assert (command.record.accepted, command.hold_cell) == (BALLOT, HOME)
        assert not rig.shown[-1].accepted
        assert rig.hand(topics.PLAN, plan) == []  # it has asked already
        rig.coast(1)
    assert not rig.run().accepted  # now the controller hears of it
    state = rig.run()
    assert (state.accepted, state.moving) == (True, True)


# --- moves ------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [(0, 1), (-2, 1), (-1, 2), (-1, 0), (0, 2), (-2, 0)])
def test_a_move_ends_in_its_cell_on_time(target: Cell) -> None:
    rig = up_and_running()
    rig.accept((0, HOME, target))
    state = rig.run()
    assert (state.moving, state.ready, state.hold_cell, state.completed) == (True, True, target, 0)
    assert rig.controller.motion.end_tick == rig.tick - 1 + MOVE_TICKS
    assert rig.controller.motion.origin == HOME
    state = rig.run(MOVE_TICKS)
    assert (state.moving, state.completed, state.done) == (False, 1, True)
    assert rig.off(target) < 0.12  # what the lag of its actuators leaves
    assert rig.run(20).completed == 1
    assert rig.off(target) < 0.02


def test_a_move_whose_first_commands_are_lost_begins_when_one_arrives() -> None:
    """Otherwise the trajectory would be ahead of the body."""
    rig = up_and_running()
    target = (0, 1)
    rig.accept((0, HOME, target))
    lost = 8
    for _ in range(lost):
        (command,) = sent(rig.hand(topics.SENSE, rig.sense()), Command)
        assert (command.hold_cell, command.motion.end_tick) == (target, rig.tick + MOVE_TICKS)
        rig.coast(1)
    rig.run()
    assert rig.controller.motion.end_tick == rig.tick - 1 + MOVE_TICKS
    assert rig.run(MOVE_TICKS).done
    assert rig.off(target) < 0.12


def test_v7_only_when_the_body_is_there() -> None:
    """A vehicle ahead keeps it back: time is over, but the move is not."""
    rig = kept_back()
    state = rig.shown[-1]
    assert (state.moving, state.completed) == (True, 0)
    assert rig.controller.motion.end_tick == rig.tick
    rig.ahead = ()
    while rig.run().moving:
        assert rig.tick < 400
    assert rig.off((0, 1)) <= max(ARRIVED_ALONG_M, ARRIVED_ACROSS_M) + 0.2
    assert rig.shown[-1].completed == 1


def kept_back() -> Rig:
    """Return a vehicle whose move ahead is late because of a vehicle 4 m ahead."""
    rig = up_and_running()
    rig.accept((0, HOME, (0, 1)))
    rig.run(10)
    rig.ahead = (Neighbour(1, 4.0, SCENARIO.formation.speed_mps),)
    rig.run(60)
    assert rig.off((0, 1)) > ARRIVED_ALONG_M
    return rig


# --- restarts ---------------------------------------------------------------------------------


@pytest.mark.parametrize("silent_ticks", [0, 10, MOVE_TICKS, 3 * MOVE_TICKS])
def test_restart_takes_the_motion_over(silent_ticks: int) -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (0, 2)))
    rig.run(12)
    rig.restart()
    rig.coast(silent_ticks)
    under_way = silent_ticks < MOVE_TICKS - 12
    command = rig.claim()
    assert (command.hold_cell, command.motion.end_tick > rig.tick) == ((0, 2), under_way)
    state = rig.run()
    assert (state.record.incarnation, state.record.promised, state.hold_cell) == (2, None, (0, 2))
    assert state.moving == under_way
    if under_way:
        assert rig.controller.motion.origin == HOME
    state = rig.run(MOVE_TICKS)
    assert (state.moving, state.completed) == (False, 0)
    assert rig.off((0, 2)) < 0.1


def test_restart_of_a_vehicle_that_is_late_still_counts_as_moving() -> None:
    """The time of its motion is over, but the body still occupies the cell that it leaves."""
    rig = kept_back()
    rig.restart()
    rig.claim()
    state = rig.run()
    assert rig.off((0, 1)) > ARRIVED_ALONG_M
    assert state.moving
    rig.accept(ballot=BALLOT._replace(seq=2))
    assert not rig.shown[-1].ready
    rig.ahead = ()
    while rig.run().moving:
        assert rig.tick < 400
    assert rig.shown[-1].ready


# --- off the lattice --------------------------------------------------------------------------


def test_without_a_cell_it_begins_anew_and_only_keeps_its_claim() -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    controller = rig.controller
    controller.leave_lattice()
    for _ in range(4):
        rig.coast(1)
        effects = rig.hand(topics.SENSE, rig.sense(off_lattice=True))
        (command,) = sent(effects, Command)
        assert controller.accept_command(command)
        # What the earlier process has promised and accepted is void for this one.
        assert (command.record.incarnation, command.jerks, command.record.accepted) == (
            2,
            b"",
            None,
        )
        assert rig.agent.wanted_motions == ()
        # Requests for promises and plans have no effect now.
        plan = make_plan({ME: HOME}, {ME: ((0, HOME, (-1, 2)),)})
        assert rig.hand(topics.PREPARE, Prepare(BALLOT, (0,), (ME,))) == []
        assert rig.hand(topics.PLAN, plan) == []
    there: Cell = (-5, 1)
    controller.re_enter(there, (), keeps_distance=False)
    controller.enter_lattice([there])
    rig.coast(1)
    (command,) = sent(rig.hand(topics.SENSE, rig.sense()), Command)
    assert (command.hold_cell, command.record.incarnation) == (there, 2)
    assert rig.shown[-1].hold_cell == there
    assert rig.agent.in_charge


def test_it_begins_anew_if_its_vehicle_has_entered_the_lattice_again_unseen() -> None:
    """No SENSE arrived while the vehicle was off the lattice."""
    rig = up_and_running()
    rig.agent._lane_ends = LaneEnds(DROP)
    rig.accept((0, HOME, (-1, 2)))
    controller, there = rig.controller, (-5, 1)
    controller.leave_lattice()
    controller.re_enter(there, (), keeps_distance=False)
    controller.enter_lattice([there])
    rig.coast(30)
    for _ in range(2):
        (command,) = sent(rig.hand(topics.SENSE, rig.sense()), Command)
        assert controller.accept_command(command)
        assert (command.hold_cell, command.record.incarnation) == (there, 2)
        rig.coast(1)
    assert rig.agent.in_charge
    assert rig.shown[-1].hold_cell == there


@pytest.mark.parametrize(("knows", "took_over"), [(True, False), (False, False), (False, True)])
def test_it_begins_anew_when_its_move_into_a_closed_lane_is_taken_back(
    knows: bool, took_over: bool
) -> None:
    """At once if the agent knows the part; otherwise after `MAX_REPEATS` ticks."""
    rig, target = up_and_running(), (HOME[0], 2)
    rig.accept((0, HOME, target))
    while rig.controller.hold_cell != target:
        rig.answer()
    near_m = rig.state[0] + 220.0
    parts = TemporaryParts((TemporaryClosure(2, near_m, near_m + 10.0),))
    assert rig.vehicle.close(LaneEnds(SCENARIO, parts), rig.tick * TICK_S)
    if knows:
        rig.agent.on_obstacles(parts)
    if took_over:
        rig.agent._begun = None  # in mid-move
    repeats, incarnation = 0, rig.controller.record.incarnation
    while rig.controller.record.incarnation == incarnation:
        (command,) = sent(rig.hand(topics.SENSE, rig.sense()), Command)
        repeats += not rig.controller.accept_command(command)
        # The command counts as an answer in time, and as correct.
        assert rig.controller.command_tick == rig.tick
        assert (rig.controller.hold_cell, rig.controller.refusal) == (HOME, None)
        rig.coast(1)
        assert repeats <= MAX_REPEATS + 2
    assert (repeats == 0) is knows
    # A new plan may lead the vehicle there while the line is far enough ahead.
    state = rig.run(30)
    assert (state.hold_cell, state.moving) == (HOME, False)
    if knows:
        rig.accept((0, HOME, target), ballot=BALLOT._replace(seq=9))
        rig.run()
        assert rig.controller.hold_cell == target


@pytest.mark.parametrize(
    ("ahead_m", "ticks", "back"),
    [
        (150.0, 0, True),
        (60.0, 0, True),
        (450.0, 0, False),
        # The body is in both lanes, and would be at the line.
        (150.0, 20, True),
        (100.0, 20, False),
        # It has left its lane.
        (150.0, 37, False),
    ],
)
def test_only_moves_into_lanes_that_are_closed_soon_are_taken_back(
    ahead_m: float, ticks: int, back: bool
) -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (HOME[0], 2)))
    while rig.controller.hold_cell == HOME:
        rig.answer()
    if ticks:
        rig.run(ticks)
    near_m = rig.state[0] + ahead_m
    parts = TemporaryParts((TemporaryClosure(2, near_m, near_m + 10.0),))
    assert rig.vehicle.close(LaneEnds(SCENARIO, parts), rig.tick * TICK_S) is back
    assert (rig.controller.hold_cell == HOME) is back


def test_a_move_out_of_a_lane_that_ends_soon_is_not_taken_back() -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (HOME[0], 2)))
    while rig.controller.hold_cell == HOME:
        rig.answer()
    near_m = rig.state[0] + 150.0
    parts = (TemporaryClosure(lane, near_m, near_m + 10.0) for lane in (HOME[1], 2))
    lane_ends = LaneEnds(SCENARIO, TemporaryParts(tuple(parts)))
    assert not rig.vehicle.close(lane_ends, rig.tick * TICK_S)


def test_an_agent_drives_its_type_and_takes_no_plan_that_the_type_cannot_drive() -> None:
    truck = VehicleTypeSettings("truck", 0.5, length_m=12.0, max_accel_mps2=1.3)
    scenario = attrs.evolve(
        SCENARIO,
        formation=attrs.evolve(SCENARIO.formation, operation="rolling", gap_m=20.0),
        vehicle_type=(truck,),
    )
    made: list[Vehicle] = []

    def make_driver(scenario: Scenario, limits: Vehicle) -> TrackingDriver:
        made.append(limits)
        return TrackingDriver(scenario, limits)

    agent = AgentCore(ME, count(1).__next__, scenario, make_driver)
    sense = replace(Rig().sense(), vehicle_type=Name("truck"))
    agent.handle(node.Arrived(topics.SENSE, {"vehicle": ME}, sense), 0.0)
    assert [limits.length_m for limits in made] == [5.0, 12.0]
    assert agent.execution is not None
    assert agent.execution.drivable == frozenset({(0, 1), (0, -1)})
    for (dx, dy), taken in (((0, 1), True), ((1, 0), False), ((-1, 0), False)):
        target = HOME[0] + dx, HOME[1] + dy
        plan = make_plan({ME: HOME}, {ME: ((0, HOME, target),)})
        assert drives_its_moves(agent.execution, plan) == taken
    # A type is that of the first SENSE, and a type of the scenario.
    other = replace(sense, tick=1, t_s=TICK_S, vehicle_type=Name("car"))
    agent.handle(node.Arrived(topics.SENSE, {"vehicle": ME}, other), 0.1)
    assert len(made) == 2
    agent = AgentCore(ME, count(1).__next__, scenario, make_driver)
    unknown = replace(sense, vehicle_type=Name("tank"))
    (refused,) = agent.handle(node.Arrived(topics.SENSE, {"vehicle": ME}, unknown), 0.0)
    assert isinstance(refused, node.Refuse)
    assert "vehicle_type: got 'tank'; allowed: one of the scenario's types: car, truck" in str(
        refused.error
    )


def test_an_agent_that_takes_charge_again_resumes_no_move_of_its_earlier_time_in_charge() -> None:
    begun: list[PlannedMove] = []

    class NotingDriver(TrackingDriver):
        def begin(self, move: PlannedMove, tick: int, ticks: int) -> None:
            begun.append(move)
            super().begin(move, tick, ticks)

    rig = up_and_running(NotingDriver)
    first, there = rig.agent, (-1, 2)
    rig.accept((0, HOME, there))
    rig.run(MOVE_TICKS + 30)
    assert ({*begun}, rig.controller.hold_cell) == ({(0, HOME, there)}, there)
    # Another agent begins the next move, and ends.
    rig.restart()
    rig.claim()
    rig.run()
    rig.accept((0, there, HOME), ballot=BALLOT._replace(seq=BALLOT.seq + 1))
    rig.run(3)
    assert begun[-1] == (0, there, HOME)

    begun.clear()
    rig.agent = first
    effects = rig.hand(topics.SENSE, replace(rig.sense(), caretaker=True))
    (command,) = sent(effects, Command)
    assert rig.controller.accept_command(command)
    rig.coast(1)
    rig.run(2)

    assert rig.agent.in_charge
    assert {*begun} == {(0, there, HOME)}
