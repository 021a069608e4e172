"""One vehicle on a bench: its body, a toy motion controller, and the agent that drives it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import count
from typing import TypeVar

import numpy as np
from attrs import evolve

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import Driver, TrackingDriver
from laneweave.protocol.lattice import Cell, PlannedMove, territory
from laneweave.protocol.runtime.node import Arrived, Effect, Event, Send
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state, commanded_state, hold_law
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    Name,
    Neighbour,
    Plan,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.topics import PLAN, PREPARE, SENSE, Topic
from laneweave.sim_bridge.bodies.plant import Plant
from support.paper import PAPER

T = TypeVar("T")
MakeDriver = Callable[[Scenario], Driver]

SCENARIO = PAPER
LATTICE, TICK_S = SCENARIO.lattice, SCENARIO.runtime.tick_s
MOVE_TICKS = round(SCENARIO.move_s / TICK_S)
ME, OTHER = Name("me"), Name("other")
HOME: Cell = (-1, 1)
BALLOT = Ballot(1, Name("c1"), 1, 1)


class Rig:
    """A vehicle: plant, motion controller, and whatever agent drives it at the moment.

    Its sensors are exact.
    """

    def __init__(self, make_driver: MakeDriver = TrackingDriver) -> None:
        """Put a vehicle into its cell, with an agent that has not met it yet."""
        self.tick = 0
        self.plant = Plant(cell_state(LATTICE, HOME, 0.0), SCENARIO.vehicle, TICK_S)
        self.hold_cell, self.motion_origin, self.motion_end_tick = HOME, HOME, 0
        self.motion_ticks = 0
        self.attendant, self.caretaker = 0, False
        self.formation, self.joined = 0, tuple[int, ...]((0,))
        self.accepted: Ballot | None = None
        self.played: Command | None = None
        """The newest that has jerks or names another cell."""
        self.shown: list[VehicleState] = []
        self.ahead: tuple[Neighbour, ...] = ()
        self._incarnations = count(1)
        self._make_driver = make_driver
        self._sensed: Sense | None = None
        self.restart()

    @property
    def state(self) -> State:
        """(s, v, a, y, v_y, a_y) of the body, in m and s."""
        return self.plant.state

    def restart(self) -> None:
        """Let another process drive the vehicle; its incarnation is the next number."""
        self.agent = AgentCore(ME, self.new_incarnation, SCENARIO, self._make_driver)

    def new_incarnation(self) -> int:
        return next(self._incarnations)

    def sense(self, *, left: bool = False) -> Sense:
        self._sensed = Sense(
            vehicle=ME,
            tick=self.tick,
            t_s=self.tick * TICK_S,
            state=self.state,
            setpoint=self.plant.setpoint,
            hold_cell=self.hold_cell,
            motion_end_tick=self.motion_end_tick,
            motion_origin=self.motion_origin,
            motion_ticks=self.motion_ticks,
            preferred_lane=0,
            ahead=self.ahead,
            formation=self.formation,
            attendant=self.attendant,
            caretaker=self.caretaker,
            joined=self.joined,
            accepted=self.accepted,
            left=left,
        )
        return self._sensed

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
            self.take(command)
            self.coast(1)
        return self.shown[-1]

    def claim(self) -> Command:
        """Let a new agent meet the vehicle and claim it: one tick, in which it shows nothing."""
        shown = len(self.shown)
        (command,) = sent(self.hand(SENSE, self.sense()), Command)
        assert len(self.shown) == shown
        self.take(command)
        self.coast(1)
        return command

    def take(self, command: Command) -> None:
        """Let the motion controller take a command, from the one in charge or from a newer one."""
        assert command.incarnation >= self.attendant
        if command.incarnation > self.attendant:
            self.caretaker, self.accepted = False, None
        self.attendant = command.incarnation
        self._note(command)
        if command.jerks or command.hold_cell != self.hold_cell:
            self.played = command
            self.hold_cell = command.hold_cell
            self.motion_end_tick = command.motion_end_tick
            self.motion_origin = command.motion_origin
            self.motion_ticks = command.motion_ticks

    def _note(self, command: Command) -> None:
        assert command.incarnation == self.attendant
        self.joined = tuple(sorted({*self.joined, *command.joined}))
        if command.accepted is not None:
            self.accepted = command.accepted

    def confirm(self, effects: Iterable[Effect]) -> list[Effect]:
        """Note what the agent asks for between two ticks, and confirm it at once."""
        (command,) = sent(effects, Command)
        self._note(command)
        assert self._sensed is not None
        assert command.tick == self._sensed.tick
        noted = evolve(self._sensed, joined=self.joined, accepted=self.accepted)
        return self.hand(SENSE, noted)

    def coast(self, ticks: int) -> None:
        """Drive by the last command, and by the hold law when it runs out."""
        for _ in range(ticks):
            jerks = np.frombuffer(self.played.jerks if self.played else b"", "<f4").reshape(-1, 2)
            index = self.tick - (self.played.tick if self.played else 0)
            if index < len(jerks):
                jerk = (float(jerks[index, 0]), float(jerks[index, 1]))
            else:
                goal = cell_state(LATTICE, self.hold_cell, self.tick * TICK_S)
                pursued = commanded_state(
                    self.state, self.plant.setpoint, SCENARIO.vehicle, LATTICE.speed_mps
                )
                jerk = hold_law(pursued, goal, SCENARIO.vehicle, TICK_S)
            self.plant.step(*jerk)
            self.tick += 1

    def off(self, cell: Cell) -> float:
        """Return how far the body is from a cell, along or across."""
        goal = cell_state(LATTICE, cell, self.tick * TICK_S)
        return max(abs(self.state[0] - goal[0]), abs(self.state[3] - goal[3]))

    def accept(
        self, *moves: PlannedMove, ballot: Ballot = BALLOT, t0_tick: int | None = None
    ) -> None:
        """Promise and accept a plan for this vehicle alone."""
        incarnation = self.shown[-1].incarnation
        self.hand(PREPARE, Prepare(ballot, (0,), (ME,)))
        t0_s = (self.tick if t0_tick is None else t0_tick) * TICK_S
        plan = make_plan({ME: moves}, {ME: self.hold_cell}, {ME: incarnation}, ballot, t0_s)
        self.confirm(self.hand(PLAN, plan))
        assert self.shown[-1].accepted


def make_plan(
    moves: dict[Name, tuple[PlannedMove, ...]],
    cells: dict[Name, Cell],
    incarnations: dict[Name, int],
    ballot: Ballot = BALLOT,
    t0_s: float = 0.0,
    formations: tuple[int, ...] = (0,),
) -> Plan:
    every_move = [move for each in moves.values() for move in each]
    return Plan(
        ballot=ballot,
        formations=formations,
        roster=tuple(cells),
        incarnations=incarnations,
        start_cells=cells,
        moves=moves,
        t0_s=t0_s,
        slot_s=SCENARIO.cycles_s[0],
        territory=tuple(territory(cells.values(), every_move)),
    )


def sent(effects: Iterable[Effect], kind: type[T]) -> list[T]:
    return [e.message for e in effects if isinstance(e, Send) and isinstance(e.message, kind)]


def up_and_running(make_driver: MakeDriver = TrackingDriver) -> Rig:
    """Return a vehicle whose agent is in charge and has shown its state; two ticks have passed."""
    rig = Rig(make_driver)
    rig.claim()
    rig.run()
    return rig
