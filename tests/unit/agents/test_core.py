"""One vehicle's agent with the real tracker, on a toy plant and a toy motion controller."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import attrs
import numpy as np
import pytest

from laneweave.agents.core import ARRIVED_ACROSS_M, ARRIVED_ALONG_M, OVERDUE_SLOTS, AgentCore
from laneweave.agents.tracker import Tracker, TrackResult
from laneweave.agents.trajectory import Window
from laneweave.protocol.lattice import Cell, Move, territory
from laneweave.protocol.messages import (
    Ballot,
    Command,
    Name,
    Neighbour,
    Plan,
    Prepare,
    Report,
    Sense,
    VehicleState,
)
from laneweave.protocol.motion import State, cell_state, hold_law, integrate, limited_jerk
from laneweave.protocol.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    Send,
    Started,
    Stopping,
    Unlisten,
    Wakeup,
    Withdraw,
)
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.topics import (
    COMMAND,
    PLAN,
    PREPARE,
    REPORT,
    SENSE,
    STATE,
    VEHICLE_ALIVE,
    Topic,
)

T = TypeVar("T")
MakeTracker = Callable[[Scenario], Tracker]

SCENARIO = Scenario()
LATTICE, TICK_S = SCENARIO.lattice, SCENARIO.runtime.tick_s
MOVE_TICKS = round(SCENARIO.formation.move_s / TICK_S)
ME, OTHER = Name("me"), Name("other")
HOME: Cell = (-1, 1)
BALLOT = Ballot(1, Name("c1"), 1, 1)


class Rig:
    """A vehicle: plant, motion controller, and whatever agent drives it at the moment."""

    def __init__(self, make_tracker: MakeTracker = Tracker) -> None:
        """Put a vehicle into its cell, with an agent that has not met it yet."""
        self.tick = 0
        self.state: State = cell_state(LATTICE, HOME, 0.0)
        self.hold_cell, self.motion_origin, self.motion_end_tick = HOME, HOME, 0
        self.command: Command | None = None
        self.shown: list[VehicleState] = []
        self.ahead: tuple[Neighbour, ...] = ()
        self._make_tracker = make_tracker
        self.agent = AgentCore(ME, 1, SCENARIO, make_tracker)

    def restart(self, incarnation: int = 2) -> None:
        self.agent = AgentCore(ME, incarnation, SCENARIO, self._make_tracker)

    def sense(self, *, left: bool = False) -> Sense:
        return Sense(
            vehicle=ME,
            tick=self.tick,
            t_s=self.tick * TICK_S,
            state=self.state,
            hold_cell=self.hold_cell,
            motion_end_tick=self.motion_end_tick,
            motion_origin=self.motion_origin,
            preferred_lane=0,
            ahead=self.ahead,
            left=left,
        )

    def hand(self, topic: Topic, message: object) -> list[Effect]:
        return self.handle(Arrived(topic, {"vehicle": ME}, message))

    def handle(self, event: Event) -> list[Effect]:
        effects = list(self.agent.handle(event, 0.0))
        self.shown += sent(effects, VehicleState)
        return effects

    def run(self, ticks: int = 1) -> VehicleState:
        """Sense, answer, drive; return the last state shown."""
        for _ in range(ticks):
            (command,) = sent(self.hand(SENSE, self.sense()), Command)
            self.command = command
            self.hold_cell = command.hold_cell
            self.motion_end_tick = command.motion_end_tick
            self.motion_origin = command.motion_origin
            self.coast(1)
        return self.shown[-1]

    def coast(self, ticks: int) -> None:
        """Drive by the last command, and by the hold law when it runs out."""
        for _ in range(ticks):
            jerks = np.frombuffer(self.command.jerks if self.command else b"", "<f4").reshape(-1, 2)
            index = self.tick - (self.command.tick if self.command else 0)
            if index < len(jerks):
                jerk = (float(jerks[index, 0]), float(jerks[index, 1]))
            else:
                goal = cell_state(LATTICE, self.hold_cell, self.tick * TICK_S)
                jerk = hold_law(self.state, goal, SCENARIO.vehicle, TICK_S)
            jerk = limited_jerk(self.state, jerk, SCENARIO.vehicle, TICK_S)
            self.state = integrate(self.state, jerk, TICK_S)
            self.tick += 1

    def off(self, cell: Cell) -> float:
        """Return how far the body is from a cell, along or across."""
        goal = cell_state(LATTICE, cell, self.tick * TICK_S)
        return max(abs(self.state[0] - goal[0]), abs(self.state[3] - goal[3]))

    def accept(self, *moves: Move, ballot: Ballot = BALLOT, t0_tick: int | None = None) -> None:
        """Promise and accept a plan for this vehicle alone."""
        incarnation = self.shown[-1].incarnation
        self.hand(PREPARE, Prepare(ballot, 0, (ME,)))
        t0_s = (self.tick if t0_tick is None else t0_tick) * TICK_S
        plan = make_plan({ME: moves}, {ME: self.hold_cell}, {ME: incarnation}, ballot, t0_s)
        self.hand(PLAN, plan)
        assert self.shown[-1].accepted


def make_plan(
    moves: dict[Name, tuple[Move, ...]],
    cells: dict[Name, Cell],
    incarnations: dict[Name, int],
    ballot: Ballot = BALLOT,
    t0_s: float = 0.0,
) -> Plan:
    every_move = [move for each in moves.values() for move in each]
    return Plan(
        ballot=ballot,
        formation=0,
        roster=tuple(cells),
        incarnations=incarnations,
        start_cells=cells,
        moves=moves,
        t0_s=t0_s,
        slot_s=SCENARIO.formation.cycle_s,
        territory=tuple(territory(cells.values(), every_move)),
    )


def sent(effects: Iterable[Effect], kind: type[T]) -> list[T]:
    return [e.message for e in effects if isinstance(e, Send) and isinstance(e.message, kind)]


def up_and_running(make_tracker: MakeTracker = Tracker) -> Rig:
    rig = Rig(make_tracker)
    rig.run()
    return rig


# --- coming and going -------------------------------------------------------------------------


def test_starts_with_its_own_topics_and_the_token_last() -> None:
    agent = AgentCore(ME, 1, SCENARIO)
    own = {"vehicle": ME}
    assert list(agent.handle(Started(), 0.0)) == [
        Listen(SENSE, own),
        Listen(PREPARE, own),
        Listen(PLAN, own),
        Announce(VEHICLE_ALIVE, own),
    ]
    assert agent.formation is None
    assert agent.wakeup_s is None


def test_before_it_has_met_its_vehicle_it_promises_nothing() -> None:
    rig = Rig()
    assert rig.hand(PREPARE, Prepare(BALLOT, 0, (ME,))) == []
    assert rig.hand(PLAN, make_plan({ME: ()}, {ME: HOME}, {ME: 1})) == []
    assert rig.handle(Wakeup()) == []
    assert not rig.agent.needs_states


def test_knows_its_formation_from_its_cell() -> None:
    rig = up_and_running()
    assert rig.agent.formation == LATTICE.block_of(HOME[0]) == 0
    state = rig.shown[-1]
    assert (state.hold_cell, state.promised, state.moving, state.ready) == (
        HOME, None, False, False
    )  # fmt: skip


def test_left_reports_once_and_withdraws_its_token_last() -> None:
    rig = up_and_running()
    effects = rig.hand(SENSE, rig.sense(left=True))
    assert rig.agent.ended
    (report,) = sent(effects, Report)
    assert (report.role, report.name, report.solves, report.unusable) == ("agent", ME, 1, 0)
    assert len(report.solve_ms) == 4
    assert isinstance(effects[0], Send)
    assert effects[0].topic is REPORT
    assert effects[1:-1] == [Unlisten(topic, {"vehicle": ME}) for topic in (SENSE, PREPARE, PLAN)]
    assert effects[-1] == Withdraw(VEHICLE_ALIVE, {"vehicle": ME})
    assert rig.hand(SENSE, rig.sense(left=True)) == []


def test_stopping_reports() -> None:
    rig = up_and_running()
    (report,) = sent(rig.handle(Stopping()), Report)
    assert report.solves == 1


# --- one answer per tick ----------------------------------------------------------------------


def test_answers_each_tick_once_and_repeats_are_the_same_bytes() -> None:
    rig = up_and_running()
    sense = rig.sense()
    effects = rig.hand(SENSE, sense)
    assert [e.topic for e in effects if isinstance(e, Send)] == [COMMAND, STATE]
    (command,) = sent(effects, Command)
    assert (command.tick, command.hold_cell, command.motion_end_tick) == (1, HOME, 0)
    for _ in range(3):
        assert rig.hand(SENSE, attrs.evolve(sense, t_s=99.0)) == [
            Send(COMMAND, command, {"vehicle": ME})
        ]


def test_older_ticks_and_other_vehicles_are_ignored() -> None:
    rig = up_and_running()
    old = rig.sense()
    rig.run(2)
    assert rig.hand(SENSE, old) == []
    assert rig.hand(SENSE, attrs.evolve(rig.sense(), vehicle=OTHER)) == []
    assert rig.run().t_s == pytest.approx((rig.tick - 1) * TICK_S)


def test_promise_and_acceptance_are_shown_at_once() -> None:
    rig = up_and_running()
    rig.hand(PREPARE, Prepare(BALLOT, 0, (ME, OTHER)))
    assert (rig.shown[-1].promised, rig.shown[-1].accepted) == (BALLOT, False)
    plan = make_plan({ME: (), OTHER: ()}, {ME: HOME, OTHER: (0, 0)}, {ME: 1, OTHER: 1})
    rig.hand(PLAN, plan)
    assert rig.shown[-1].accepted
    assert rig.agent.needs_states
    assert rig.hand(PLAN, plan) == []
    assert rig.hand(PREPARE, Prepare(BALLOT, 0, (OTHER,))) == []


@pytest.mark.parametrize("beyond", [(-4, 1), (1, 1), (-1, 3)])
def test_a_plan_beyond_its_own_block_is_not_accepted(beyond: Cell) -> None:
    """Plans of other formations run at the same time; only the blocks keep them apart."""
    rig = up_and_running()
    rig.hand(PREPARE, Prepare(BALLOT, 0, (ME,)))
    plan = make_plan({ME: ()}, {ME: HOME}, {ME: 1})
    assert rig.hand(PLAN, attrs.evolve(plan, territory=(HOME, beyond))) == []
    assert rig.hand(PLAN, plan) != []


# --- moves ------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [(0, 1), (-2, 1), (-1, 2), (-1, 0), (0, 2), (-2, 0)])
def test_a_move_ends_in_its_cell_on_time(target: Cell) -> None:
    rig = up_and_running()
    rig.accept((0, HOME, target))
    state = rig.run()
    assert (state.moving, state.ready, state.hold_cell, state.completed) == (True, True, target, 0)
    assert rig.motion_end_tick == rig.tick - 1 + MOVE_TICKS
    assert rig.motion_origin == HOME
    state = rig.run(MOVE_TICKS)
    assert (state.moving, state.completed, state.done) == (False, 1, True)
    assert rig.off(target) < 0.05
    assert rig.run(20).completed == 1
    assert rig.off(target) < 0.02


def test_two_moves_in_their_slots() -> None:
    rig = up_and_running()
    t0_tick = rig.tick + 5
    rig.accept((0, HOME, (-1, 2)), (1, (-1, 2), (-2, 2)), t0_tick=t0_tick)
    slot = round(SCENARIO.formation.cycle_s / TICK_S)
    begun = []
    for _ in range(2 * slot + 5):
        moving = rig.shown[-1].moving
        if rig.run().moving and not moving:
            begun.append(rig.tick - 1)
    assert begun == [t0_tick, t0_tick + slot]
    assert rig.shown[-1].done
    assert rig.off((-2, 2)) < 0.05


def test_v7_only_when_the_body_is_there() -> None:
    """A vehicle ahead keeps it back: time is over, but the move is not."""
    rig = up_and_running()
    rig.accept((0, HOME, (0, 1)))
    rig.run(10)
    for _ in range(60):  # somebody stays 4 m ahead of the place it has now
        rig.ahead = (Neighbour(1, 4.0, SCENARIO.formation.speed_mps),)
        state = rig.run()
    assert rig.off((0, 1)) > ARRIVED_ALONG_M
    assert (state.moving, state.completed) == (True, 0)
    assert rig.motion_end_tick == rig.tick
    rig.ahead = ()
    while rig.run().moving:
        assert rig.tick < 400
    assert rig.off((0, 1)) <= max(ARRIVED_ALONG_M, ARRIVED_ACROSS_M) + 0.2
    assert rig.shown[-1].completed == 1


def test_overdue_is_shown() -> None:
    rig = up_and_running()
    rig.hand(PREPARE, Prepare(BALLOT, 0, (ME, OTHER)))
    plan = make_plan(
        {ME: ((0, HOME, (-1, 2)),), OTHER: ()}, {ME: HOME, OTHER: (0, 0)}, {ME: 1, OTHER: 1}
    )
    rig.hand(PLAN, plan)
    patience = round(OVERDUE_SLOTS * SCENARIO.formation.cycle_s / TICK_S)
    assert not rig.run(patience - rig.tick).overdue
    assert rig.run().overdue


# --- when tracking fails ----------------------------------------------------------------------


class Fickle(Tracker):
    """Gives usable answers until it is told otherwise."""

    broken = False

    def solve(self, state: State, window: Window, ahead: np.ndarray | None = None) -> TrackResult:
        result = super().solve(state, window, ahead)
        if self.broken:
            return attrs.evolve(result, usable=False, jerk=np.full_like(result.jerk, np.nan))
        return result


def test_unusable_answers_continue_the_last_good_trajectory() -> None:
    trackers: list[Fickle] = []

    def make(scenario: Scenario) -> Tracker:
        trackers.append(Fickle(scenario))
        return trackers[-1]

    rig = up_and_running(make)
    rig.accept((0, HOME, (-1, 2)))
    rig.run(5)
    good, tick = rig.command, rig.tick
    assert good is not None
    trackers[0].broken = True
    rig.run(3)
    assert rig.command is not None
    assert rig.command.jerks == good.jerks[8 * (rig.tick - tick) :]
    # The trajectory lasts until the move is over; then the hold law takes over.
    state = rig.run(150)
    assert np.isfinite(np.frombuffer(rig.command.jerks, "<f4")).all()
    assert (state.completed, state.moving) == (1, False)
    assert rig.off((-1, 2)) < 0.3
    (report,) = sent(rig.hand(SENSE, rig.sense(left=True)), Report)
    assert (report.solves, report.unusable) == (rig.tick, 153)


def test_a_tracker_that_never_works_keeps_the_vehicle_in_its_cell() -> None:
    def make(scenario: Scenario) -> Tracker:
        tracker = Fickle(scenario)
        tracker.broken = True
        return tracker

    rig = Rig(make)
    rig.run(100)
    assert rig.off(HOME) < 1e-6


# --- restarts ---------------------------------------------------------------------------------


@pytest.mark.parametrize("silent_ticks", [0, 10, MOVE_TICKS, 3 * MOVE_TICKS])
def test_restart_takes_the_motion_over(silent_ticks: int) -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (0, 2)))
    rig.run(12)
    rig.restart()
    rig.coast(silent_ticks)
    state = rig.run()
    under_way = silent_ticks < MOVE_TICKS - 12
    assert (state.incarnation, state.promised, state.hold_cell) == (2, None, (0, 2))
    assert state.moving == under_way
    if under_way:
        assert rig.motion_origin == HOME
    state = rig.run(MOVE_TICKS)
    assert (state.moving, state.completed) == (False, 0)
    assert rig.off((0, 2)) < 0.1


def test_restart_while_moving_is_not_ready_before_the_motion_ends() -> None:
    rig = up_and_running()
    rig.accept((0, HOME, (-1, 2)))
    rig.run(10)
    rig.restart()
    rig.run()
    rig.accept((0, (-1, 2), (-1, 1)), ballot=BALLOT._replace(seq=2))
    assert not rig.shown[-1].ready
    while rig.run().hold_cell != (-1, 1):
        assert rig.shown[-1].completed == 0
        assert rig.tick < 100
    assert rig.tick - 1 >= 1 + MOVE_TICKS
    assert rig.run(MOVE_TICKS).completed == 1


def test_restart_of_a_vehicle_that_is_late_still_counts_as_moving() -> None:
    """The time of its motion is over, but the body still occupies the cell that it leaves."""
    rig = up_and_running()
    rig.accept((0, HOME, (0, 1)))
    rig.run(10)
    for _ in range(60):
        rig.ahead = (Neighbour(1, 4.0, SCENARIO.formation.speed_mps),)
        rig.run()
    rig.restart()
    state = rig.run()
    assert rig.off((0, 1)) > ARRIVED_ALONG_M
    assert state.moving
    rig.hand(PREPARE, Prepare(BALLOT._replace(seq=2), 0, (ME,)))
    rig.hand(PLAN, make_plan({ME: ()}, {ME: (0, 1)}, {ME: 2}, BALLOT._replace(seq=2)))
    assert rig.shown[-1].accepted
    assert not rig.shown[-1].ready
    rig.ahead = ()
    while rig.run().moving:
        assert rig.tick < 400
    assert rig.shown[-1].ready
