"""One agent, and the real vehicle that it drives, without a network."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import count

from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import Driver, TrackingDriver
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.runtime.node import Arrived, Effect, Event
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State, cell_state
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    Name,
    Neighbour,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.topics import PLAN, PREPARE, SENSE, Topic
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Neighbours
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.paper import PAPER
from support.road_vehicles import vehicle_in
from support.states import BALLOT, changed, make_plan, sent

MakeDriver = Callable[[Scenario, Vehicle], Driver]

SCENARIO = PAPER
LATTICE, TICK_S = SCENARIO.lattice, SCENARIO.runtime.tick_s
MOVE_TICKS = round(SCENARIO.timing.move_s / TICK_S)
ME, OTHER = Name("me"), Name("other")
HOME: Cell = (-1, 1)


class Rig:
    """A vehicle with exact sensors, and the agent that drives it at the moment."""

    def __init__(self, make_driver: MakeDriver = TrackingDriver) -> None:
        """Put a vehicle into its cell, with an agent that has not met it yet."""
        self.tick = 0
        self.vehicle: RoadVehicle = vehicle_in(HOME, ME)
        self.controller = self.vehicle.controller
        self.played: Command | None = None
        """The newest command that was taken."""
        self.shown: list[VehicleState] = []
        self.ahead: tuple[Neighbour, ...] = ()
        self._incarnations = count(1)
        self._make_driver = make_driver
        self.restart()

    @property
    def state(self) -> State:
        """(s, v, a, y, v_y, a_y) of the body, in m and s."""
        return self.vehicle.state

    def restart(self) -> None:
        """Let another process drive the vehicle; its incarnation is the next number."""
        self.agent = AgentCore(ME, self.new_incarnation, SCENARIO, self._make_driver)

    def new_incarnation(self) -> int:
        return next(self._incarnations)

    def sense(self, *, left: bool = False, off_lattice: bool = False) -> Sense:
        self.controller.perceive(self.state, Neighbours(self.ahead, ()))
        sensed = self.vehicle.sense(self.tick, caretaker=False, left=left)
        self._sensed = replace(sensed, off_lattice=off_lattice)
        return self._sensed

    def hand(self, topic: Topic, message: object) -> list[Effect]:
        return self.handle(Arrived(topic, {"vehicle": ME}, message))

    def handle(self, event: Event) -> list[Effect]:
        effects = list(self.agent.handle(event, 0.0))
        self.shown += sent(effects, VehicleState)
        return effects

    def answer(self) -> list[Effect]:
        """Let one tick pass: sense, answer, drive; return what the agent sent."""
        effects = self.hand(SENSE, self.sense())
        (self.played,) = sent(effects, Command)
        assert self.controller.accept_command(self.played)
        self.coast(1)
        return effects

    def run(self, ticks: int = 1) -> VehicleState:
        """Let ticks pass; return the last state shown."""
        for _ in range(ticks):
            self.answer()
        return self.shown[-1]

    def claim(self) -> Command:
        """Let a new agent meet the vehicle and claim it: one tick, in which it shows nothing."""
        effects = self.answer()
        assert sent(effects, VehicleState) == []
        (command,) = sent(effects, Command)
        return command

    def confirm(self, effects: Iterable[Effect]) -> list[Effect]:
        """Note what the agent asks for between two ticks, and confirm it at once."""
        (command,) = sent(effects, Command)
        self.controller.store_requests(command)
        joined, accepted = self.controller.record.joined, self.controller.record.accepted
        return self.hand(SENSE, changed(self._sensed, joined=joined, accepted=accepted))

    def coast(self, ticks: int) -> None:
        """Drive by the last command, and by the hold law when it runs out."""
        for _ in range(ticks):
            self.vehicle.step(self.tick)
            self.tick += 1

    def off(self, cell: Cell) -> float:
        """Return how far the body is from a cell, along or across."""
        goal = cell_state(LATTICE, cell, self.tick * TICK_S)
        return max(abs(self.state[0] - goal[0]), abs(self.state[3] - goal[3]))

    def accept(
        self, *moves: PlannedMove, ballot: Ballot = BALLOT, t0_tick: int | None = None
    ) -> None:
        """Promise and accept a plan for this vehicle alone."""
        self.hand(PREPARE, Prepare(ballot, (0,), (ME,)))
        plan = make_plan(
            {ME: self.controller.hold_cell},
            {ME: moves},
            ballot=ballot,
            incarnations={ME: self.shown[-1].record.incarnation},
            t0_s=(self.tick if t0_tick is None else t0_tick) * TICK_S,
        )
        self.confirm(self.hand(PLAN, plan))
        assert self.shown[-1].accepted


def up_and_running(make_driver: MakeDriver = TrackingDriver) -> Rig:
    """Return a vehicle whose agent is in charge and has shown its state; two ticks have passed."""
    rig = Rig(make_driver)
    rig.claim()
    rig.run()
    return rig
