"""Caretakers: the processes in charge of vehicles whose agents are absent, silent or always late.

Rules, shared by the bridge and the fault search, for when an agent is present or silent, when a
caretaker takes charge and is replaced, and how agents are notified that their vehicles have left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from enum import StrEnum

from laneweave.protocol.runtime.node import Effect, Event, Listen, PeerDown, PeerUp, Send, Unlisten
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.wire.identities import above
from laneweave.protocol.wire.messages import Command, Name, Plan, Prepare, VehicleState
from laneweave.protocol.wire.topics import PLAN, PREPARE, STATE, VEHICLE_ALIVE
from laneweave.sim_bridge.road.tick_answers import Answers
from laneweave.sim_bridge.road.vehicle import RoadVehicle

MAX_PROCESSES = 4
"""Maximum number of processes to which messages to a vehicle are addressed, those with the newest
tokens: a token may be forged."""
LEFT_REPEATS = 20
"""Number of ticks at which the agent of a departed vehicle is notified."""


class Absence(StrEnum):
    """Reason why a caretaker takes charge."""

    ABSENT = "absent"
    """The agent has no token."""
    SILENT = "silent"
    """The agent has a token but sends no messages."""
    LATE = "late"
    """The agent always answers too late."""


class Caretaker:
    """Substitute for a vehicle's agent that is absent, silent or always late.

    A caretaker runs the same plan execution as an agent and publishes the same states, but never
    starts a move, and accepts only plans in which its vehicle does not move. The vehicle promises
    to stay in its cell, and the leader plans around it.

    The motion controller finishes its trajectory and holds. The caretaker is removed when an agent
    claims the vehicle with a COMMAND.
    """

    def __init__(self, vehicle: RoadVehicle, incarnation: int, tick: int) -> None:
        """Take charge of a vehicle at the beginning of a tick.

        Raises:
            ValueError: the incarnation is not greater than that of the process in charge.
        """
        controller = vehicle.controller
        controller.store.put_in_charge(incarnation)
        self._vehicle = vehicle
        self._execution = PlanExecution(
            vehicle=vehicle.name,
            incarnation=incarnation,
            hold_cell=controller.hold_cell,
            territory=controller.store.territory,
            stored=controller.record,
            rules=VEHICLE_RULES,
            moving=controller.moving(tick),
        )
        self._execution.on_record(controller.record)

    def on_message(self, message: Prepare | Plan, tick: int) -> VehicleState | None:
        """Promise a ballot (V2), or accept a plan in which this vehicle does not move (V3).

        Returns:
            The state to publish at once; None if the message has no effect.
        """
        execution, store = self._execution, self._vehicle.controller.store
        if not self.has_cells:
            return None
        if isinstance(message, Prepare):
            accepted = execution.on_prepare(message)
        else:
            execution.on_record(store.record)
            accepted = not message.moves.get(execution.vehicle) and execution.on_plan(message)
        if not accepted:
            return None
        store.store(execution.wanted)
        execution.on_record(store.record)
        return self.state(tick)

    @property
    def has_cells(self) -> bool:
        """Whether the vehicle is on the lattice."""
        return self._vehicle.controller.off_lattice is None

    def state(self, tick: int) -> VehicleState:
        """Return the state to publish; end the motion if the controller has completed it (V7)."""
        vehicle, execution = self._vehicle, self._execution
        controller = vehicle.controller
        execution.on_body(arrived=not controller.moving(tick), displaced=controller.displaced(tick))
        return execution.state(vehicle.sense(tick, caretaker=True), attended=False)


class Caretakers:
    """Agents and caretakers of a road.

    The bridge subscribes to PREPARE and PLAN for a vehicle only while a caretaker is in charge.
    """

    def __init__(self, scenario: Scenario, new_incarnation: Callable[[], int]) -> None:
        """Begin without agents; `new_incarnation` returns unused incarnations."""
        self.answers = Answers(scenario.runtime)
        self.link_up = True
        """Whether the bridge is connected to the network."""
        self._lease_s = scenario.network.lease_s
        self._new_incarnation = new_incarnation
        self._caretakers: dict[Name, Caretaker] = {}
        self._processes: dict[Name, dict[Name, None]] = {}
        """Processes with tokens for the agent of each vehicle."""
        self.departed: dict[Name, tuple[RoadVehicle, int]] = {}
        """Vehicles that have left the road, with the number of remaining notifications."""
        self._absence_counts_s = -math.inf
        """Time from which an agent without a token counts as absent."""

    def __contains__(self, vehicle: Name) -> bool:
        """Return whether a caretaker is in charge of a vehicle."""
        return vehicle in self._caretakers

    @property
    def vehicles(self) -> Collection[Name]:
        """Vehicles with a caretaker in charge."""
        return self._caretakers.keys()

    # --- agents -------------------------------------------------------------------------------

    def on_network(self, event: Event, now_s: float) -> None:
        """Handle agents' tokens and the state of the bridge's connection; ignore other events."""
        match event:
            case PeerUp(topic, parameters) if topic is VEHICLE_ALIVE:
                name = Name(parameters["vehicle"])
                self._processes.setdefault(name, {})[Name(parameters["process"])] = None
                self.answers.agent_up(name)
            case PeerDown(topic, parameters) if topic is VEHICLE_ALIVE:
                self._on_token_down(Name(parameters["vehicle"]), Name(parameters["process"]))
            case LinkUp():
                self.link_up = True
                # Other processes reconnect at about the same time.
                self._absence_counts_s = now_s + self._lease_s
            case LinkDown():
                self.link_up = False
                self.answers.link_down()
            case _:
                pass

    def _on_token_down(self, vehicle: Name, process: Name) -> None:
        processes = self._processes.get(vehicle, {})
        processes.pop(process, None)
        if processes:
            return
        self._processes.pop(vehicle, None)
        if self.link_up:
            self.answers.agent_down(vehicle)
            self.departed.pop(vehicle, None)

    def update_processes(self, vehicle: RoadVehicle) -> bool:
        """Address messages to the processes with tokens for a vehicle, if there are any.

        Returns:
            Whether they are others than before.
        """
        before, with_tokens = vehicle.processes, tuple(self._processes.get(vehicle.name, ()))
        if with_tokens:
            # One with the name of the vehicle is not named; see `CensusEntry`.
            newest = with_tokens[-MAX_PROCESSES:]
            vehicle.processes = newest if newest != (vehicle.name,) else ()
        return vehicle.processes != before

    def register_command(self, vehicle: RoadVehicle, command: Command) -> bool:
        """Register a COMMAND as a sign of life, and store its requests in the controller.

        Returns:
            Whether the controller has stored a change that the agent waits for.
        """
        # Late answers also show that an agent is present, but those of a replaced agent say nothing
        # about its successor.
        in_charge = vehicle.controller.record.incarnation
        if command.record.incarnation >= in_charge or vehicle.name in self:
            self.answers.on_message(vehicle.name)
        return vehicle.controller.store_requests(command)

    def accept_command(
        self, vehicle: RoadVehicle, command: Command
    ) -> Generator[Effect, None, bool]:
        """Pass a COMMAND to the vehicle's motion controller; a claim removes the caretaker.

        Returns:
            Whether the controller accepts the command.

        Raises:
            BadInputError: the command is invalid.
        """
        controller = vehicle.controller
        in_charge = controller.record.incarnation
        accepted = controller.accept_command(command)
        if controller.command_tick == command.tick:
            # Also if it is refused: the process in charge has answered.
            self.answers.in_time(vehicle.name)
        if not accepted:
            return False
        if controller.record.incarnation != in_charge:
            # An agent that claims a vehicle is present, even before its token appears.
            self.answers.agent_up(vehicle.name)
            yield from self._end_caretaker(vehicle.name)
        return True

    def leave(self, vehicle: RoadVehicle) -> Iterator[Effect]:
        """Remove a vehicle from the road; later ticks notify its agent."""
        self.answers.remove(vehicle.name)
        self.departed[vehicle.name] = (vehicle, LEFT_REPEATS)
        yield from self._end_caretaker(vehicle.name)

    def notify_departed(self, tick: int) -> Iterator[Effect]:
        """Notify the agents of departed vehicles again if they are still present."""
        for name, (vehicle, repeats) in list(self.departed.items()):
            if name not in self.answers.up or repeats == 0:
                del self.departed[name]
                continue
            self.departed[name] = (vehicle, repeats - 1)
            self.update_processes(vehicle)
            yield from vehicle.send_sense(tick, left=True)

    # --- caretakers ---------------------------------------------------------------------------

    def unattended(
        self, vehicles: Mapping[Name, RoadVehicle], now_s: float
    ) -> Iterator[tuple[RoadVehicle, Absence]]:
        """Yield the vehicles that need a caretaker, with the reason."""
        if not self.link_up:
            return  # without a connection, no message can arrive
        absence_counts = now_s >= self._absence_counts_s
        answers, caretakers = self.answers, self._caretakers
        for name, vehicle in vehicles.items():
            if name in caretakers:
                continue
            if absence_counts and name not in answers.up:
                yield vehicle, Absence.ABSENT
            elif name in answers.silent:
                yield vehicle, Absence.SILENT
            elif answers.always_late(name):
                yield vehicle, Absence.LATE

    def take_charge(self, vehicle: RoadVehicle, tick: int) -> Iterator[Effect]:
        """Put a caretaker in charge of a vehicle."""
        self._put_caretaker(vehicle, tick)
        for topic in (PREPARE, PLAN):
            yield Listen(topic, {"vehicle": vehicle.name})

    def begin_anew(self, vehicle: RoadVehicle, tick: int) -> None:
        """Replace the vehicle's caretaker, if it has one: its cells have changed without a plan."""
        if vehicle.name in self:
            self._put_caretaker(vehicle, tick)

    def _put_caretaker(self, vehicle: RoadVehicle, tick: int) -> None:
        incarnation = above(self._new_incarnation(), vehicle.controller.record.incarnation)
        self._caretakers[vehicle.name] = Caretaker(vehicle, incarnation, tick)

    def on_message(self, vehicle: Name, message: Prepare | Plan, tick: int) -> Iterator[Effect]:
        """Pass a message to the vehicle's caretaker, and publish its answer."""
        caretaker = self._caretakers.get(vehicle)
        state = None if caretaker is None else caretaker.on_message(message, tick)
        if state is not None:
            yield _state_effect(state)

    def states(self, tick: int) -> Iterator[Effect]:
        """Publish the states of all vehicles that have caretakers and cells."""
        for caretaker in self._caretakers.values():
            if caretaker.has_cells:
                yield _state_effect(caretaker.state(tick))

    def _end_caretaker(self, vehicle: Name) -> Iterator[Effect]:
        """Remove a vehicle's caretaker, if it has one."""
        if self._caretakers.pop(vehicle, None) is not None:
            for topic in (PREPARE, PLAN):
                yield Unlisten(topic, {"vehicle": vehicle})


def _state_effect(state: VehicleState) -> Effect:
    return Send(STATE, state, {"block": state.block, "vehicle": state.vehicle})
