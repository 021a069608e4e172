"""The road of a scenario: bodies with real motion controllers, and the processes that act for them.

A body does not move by itself: it is in its cell, or between the cell that it left and the one that
its controller makes for, until the scenario says that it arrives. Everything else is the real code.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count

from attrs import define, evolve, field

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import Drive
from laneweave.launch.fault_search.road.stand_ins import LightDriver
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Arrived, Effect, Send, Started
from laneweave.protocol.scenario.deployment_fields import Network, Runtime
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.road_tables import Road
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.motion import at_rest_in_cell, cell_state
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.wire.messages import (
    Command,
    CurrentMotion,
    Name,
    Plan,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.topics import PLAN, PREPARE, SENSE, STATE, Topic
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.caretakers import Caretakers
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle

SLOT_S = 1.0
TICK_S = 0.01
SCENARIO = Scenario(
    road=Road(s1_m=0.0, s2_m=0.0, s3_m=20_000.0),
    # The bound on nodes ends a search; the clock of a busy machine must not.
    formation=FormationSettings(
        operation="formations",
        entry="interlaced",
        close="columns",
        cycle_s=SLOT_S,
        move_s=0.8,
        max_joined=2,
        planning_deadline_s=3600.0,
    ),
    network=Network(election_s=1.0),
    runtime=Runtime(tick_s=TICK_S),
)


ROLLING = evolve(SCENARIO, formation=evolve(SCENARIO.formation, operation="rolling"))
"""The same with vehicles that own cells."""


class ScenarioDriver(LightDriver):
    """Driver without dynamics: a motion ends when the scenario puts the body at its target."""

    def at_rest(self, sense: Sense) -> bool:
        return at_rest_in_cell(sense.measured, self._lattice, self._goal, sense.t_s)

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        end_tick = sense.tick + 1 if moving else 0
        return Drive(CurrentMotion(self._origin, end_tick, self._ticks), b"")


@define(eq=False)
class Vehicle:
    """A body with its motion controller; both outlive every process that acts for it."""

    road: RoadVehicle
    at: Cell
    """Where the body is, or where its motion began."""
    caretakers: set[int] = field(factory=set)
    """Incarnations that were caretakers."""
    incarnations: Iterator[int] = field(factory=lambda: count(1))
    scenario: Scenario = SCENARIO

    @classmethod
    def entering(
        cls,
        name: str,
        cell: Cell,
        preferred_lane: int,
        t_s: float,
        scenario: Scenario = SCENARIO,
    ) -> Vehicle:
        """Return a vehicle that no process is in charge of yet."""
        arrival = Arrival(Name(name), cell[1], preferred_lane, t_s)
        road = RoadVehicle.entering(Admission(arrival, cell, t_s), t_s, scenario)
        return cls(road, cell, scenario=scenario)

    @property
    def name(self) -> Name:
        return self.road.name

    @property
    def entry_cell(self) -> Cell:
        return self.road.admission.cell

    @property
    def preferred_lane(self) -> int:
        return self.road.admission.arrival.preferred_lane

    @property
    def occupied(self) -> set[Cell]:
        """Every cell between where the body came from and where it will hold."""
        columns, lanes = zip(self.at, self.road.controller.hold_cell, strict=True)
        return {
            (column, lane)
            for column in range(min(columns), max(columns) + 1)
            for lane in range(min(lanes), max(lanes) + 1)
        }

    def sense(self, tick: int) -> Sense:
        """Return what the process in charge of the vehicle senses."""
        controller = self.road.controller
        self.place_body(tick)
        return self.road.sense(tick, caretaker=controller.record.incarnation in self.caretakers)

    def place_body(self, tick: int) -> None:
        """Put the body where the scenario has it: the lattice keeps moving."""
        state = cell_state(SCENARIO.lattice, self.at, tick * TICK_S)
        self.road.controller.plant = Plant(state, SCENARIO.vehicle, TICK_S)


class Agent:
    """An agent process of a vehicle."""

    def __init__(self, name: str, vehicle: Vehicle, rules: RuleBook) -> None:
        """Start a process that has received nothing yet."""
        self.name = name
        self.vehicle = vehicle
        self.shown: VehicleState | None = None
        self.command: Command | None = None
        self.tick = -1
        """The newest tick that it has sensed."""
        self._core = AgentCore(
            vehicle.name,
            lambda: next(vehicle.incarnations),
            vehicle.scenario,
            ScenarioDriver,
            rules,
        )
        self._note(self._core.handle(Started(), 0.0))

    @property
    def execution(self) -> PlanExecution | None:
        return self._core.execution

    @property
    def incarnation(self) -> int | None:
        """Its own; None before the first SENSE."""
        return self.execution.incarnation if self.execution is not None else None

    @property
    def in_charge(self) -> bool:
        """Whether it has sensed that it is."""
        return self._core.in_charge

    def sense(self, tick: int) -> None:
        """Get the SENSE of a tick; `command` is the answer, or none."""
        self.tick, self.command = tick, None
        self._handle(SENSE, self.vehicle.sense(tick))

    def get(self, message: Prepare | Plan, tick: int, *, noted: bool = True) -> None:
        del tick
        topic = PLAN if isinstance(message, Plan) else PREPARE
        before = self.command
        self._handle(topic, message)
        asked = self.command
        # What is to be noted goes to the controller at once, and back: within one vehicle.
        if not noted:
            return
        if (
            asked is not None
            and asked is not before
            and self.vehicle.road.controller.store_requests(asked)
        ):
            sense = self.vehicle.sense(self.tick)
            self._handle(SENSE, sense)

    def hear(self, state: VehicleState) -> None:
        self._handle(STATE, state)

    def _handle(self, topic: Topic, message: object) -> None:
        """Let it handle a message; its clock is the road's."""
        now_s = max(self.tick, 0) * self.vehicle.scenario.runtime.tick_s
        arrived = Arrived(topic, {"vehicle": self.vehicle.name}, message)
        self._note(self._core.handle(arrived, now_s))

    def _note(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Send) and isinstance(effect.message, VehicleState):
                self.shown = effect.message
            elif isinstance(effect, Send) and isinstance(effect.message, Command):
                self.command = effect.message


class CaretakerProcess:
    """The caretaker of a vehicle, in charge from its first moment on."""

    def __init__(self, name: str, vehicle: Vehicle, tick: int) -> None:
        """Take charge."""
        self.name = name
        self.vehicle = vehicle
        self.tick = tick
        self.shown: VehicleState | None = None
        self._caretakers = Caretakers(SCENARIO, lambda: next(vehicle.incarnations))
        vehicle.place_body(tick)
        list(self._caretakers.take_charge(vehicle.road, tick))
        self.execution: PlanExecution = self._caretakers._caretakers[vehicle.name]._execution
        self.incarnation: int = self.execution.incarnation
        vehicle.caretakers.add(self.incarnation)
        self.sense(tick)

    @property
    def in_charge(self) -> bool:
        """Whether no agent has taken charge since."""
        return self.vehicle.name in self._caretakers

    def give_way(self) -> None:
        """An agent has taken charge."""
        list(self._caretakers._end_caretaker(self.vehicle.name))

    def sense(self, tick: int) -> None:
        self.tick = tick
        self.vehicle.place_body(tick)
        self._note(self._caretakers.states(tick))

    def get(self, message: Prepare | Plan, tick: int) -> None:
        self.vehicle.place_body(tick)
        self._note(self._caretakers.on_message(self.vehicle.name, message, tick))

    def hear(self, state: VehicleState) -> None:
        """Ignore states of others: a caretaker never moves its vehicle."""

    def _note(self, effects: Iterable[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Send):
                self.shown = effect.message


Process = Agent | CaretakerProcess
