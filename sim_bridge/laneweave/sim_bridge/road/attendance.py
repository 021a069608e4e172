"""Who is in charge of the vehicles: their agents, or caretakers in place of these.

These are the rules of every road, whether its bodies are SUMO's or a simulated run's: who counts as
there, who as silent, when a caretaker takes charge and when it gives way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Mapping
from enum import StrEnum

from laneweave.protocol.runtime.node import Effect, Event, Listen, PeerDown, PeerUp, Send, Unlisten
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.wire.identities import above
from laneweave.protocol.wire.messages import Command, Name, Plan, Prepare, VehicleState
from laneweave.protocol.wire.topics import PLAN, PREPARE, STATE, VEHICLE_ALIVE
from laneweave.sim_bridge.road.answers import Answers
from laneweave.sim_bridge.road.caretaker import Caretaker
from laneweave.sim_bridge.road.vehicle import RoadVehicle


class Absence(StrEnum):
    """Why a vehicle needs a caretaker."""

    ABSENT = "absent"
    """Its agent's token is not there."""
    SILENT = "silent"
    """Its agent's token is there, but nothing else is heard of it."""
    LATE = "late"
    """Its agent answers, but always too late."""


class Attendance:
    """Agents and caretakers of a road, and what goes between the latter and the network.

    PREPARE and PLAN of a vehicle are subscribed to only while its caretaker is in charge.
    """

    def __init__(self, scenario: Scenario, new_incarnation: Callable[[], int]) -> None:
        """Begin without agents and without caretakers.

        Args:
            scenario: how long who may be away.
            new_incarnation: returns a number that no process has used before.
        """
        self.answers = Answers(scenario.runtime)
        self.link_up = True
        """Whether the road itself is connected to the network."""
        self._lease_s = scenario.network.lease_s
        self._new_incarnation = new_incarnation
        self._caretakers: dict[Name, Caretaker] = {}
        self._absence_counts_s = -math.inf
        """From when on a token that is not there means that its agent is not there."""

    def __contains__(self, vehicle: Name) -> bool:
        """Tell whether a vehicle's caretaker is in charge."""
        return vehicle in self._caretakers

    @property
    def cared_for(self) -> int:
        """How many vehicles have a caretaker in charge."""
        return len(self._caretakers)

    # --- agents -------------------------------------------------------------------------------

    def on_network(self, event: Event, now_s: float) -> None:
        """Take note of agents' tokens and of the road's own connection; ignore other events."""
        match event:
            case PeerUp(topic, parameters) if topic is VEHICLE_ALIVE:
                self.answers.agent_up(Name(parameters["vehicle"]))
            case PeerDown(topic, parameters) if topic is VEHICLE_ALIVE:
                if self.link_up:
                    self.answers.agent_down(Name(parameters["vehicle"]))
            case LinkUp():
                self.link_up = True
                # The others come back to the network about now, too, and need a moment for it.
                self._absence_counts_s = now_s + self._lease_s
            case LinkDown():
                self.link_up = False
                self.answers.link_down()
            case _:
                pass

    def ask(self, vehicles: Mapping[Name, RoadVehicle], now_s: float) -> None:
        """A tick is sent to all vehicles on the road."""
        self.answers.ask(vehicles, now_s, link_up=self.link_up)

    def hear(self, vehicle: RoadVehicle, command: Command) -> bool:
        """Take note of who a COMMAND comes from, and of what its agent has joined and accepted.

        Returns:
            Whether its agent waits to be told that the vehicle has noted something.
        """
        # Whoever answers late is there: the next tick waits for it, and it catches up. But one that
        # another agent has taken the vehicle from says nothing about that other one.
        if command.incarnation >= vehicle.controller.attendant or vehicle.name in self:
            self.answers.heard(vehicle.name)
        return vehicle.controller.note(command)

    def take(self, vehicle: RoadVehicle, command: Command) -> Generator[Effect, None, bool]:
        """Hand a COMMAND to the vehicle's motion controller; its caretaker gives way to an agent.

        Returns:
            Whether the controller obeys it.

        Raises:
            BadInputError: the command makes no sense.
        """
        controller = vehicle.controller
        attendant = controller.attendant
        if not controller.take(command):
            return False
        self.answers.effective(vehicle.name)
        if controller.attendant != attendant:
            # Who claims a vehicle is there, whether or not its token has been seen.
            self.answers.agent_up(vehicle.name)
            yield from self._give_way(vehicle.name)
        return True

    def forget(self, vehicle: Name) -> Iterator[Effect]:
        """Forget a vehicle that left the road."""
        self.answers.forget(vehicle)
        yield from self._give_way(vehicle)

    # --- caretakers ---------------------------------------------------------------------------

    def unattended(
        self, vehicles: Mapping[Name, RoadVehicle], now_s: float
    ) -> Iterator[tuple[RoadVehicle, Absence]]:
        """Return the vehicles of which nobody is in charge any more, and why."""
        if not self.link_up:
            return  # nobody can be seen or heard: that says nothing about them
        absence_counts = now_s >= self._absence_counts_s
        answers, caretakers = self.answers, self._caretakers
        for name, vehicle in vehicles.items():
            if name in caretakers:
                continue
            if absence_counts and name not in answers.up:
                yield vehicle, Absence.ABSENT
            elif name in answers.silent:
                yield vehicle, Absence.SILENT
            elif answers.ineffective(name):
                yield vehicle, Absence.LATE

    def take_charge(self, vehicle: RoadVehicle, tick: int) -> Iterator[Effect]:
        """Put a caretaker in charge of a vehicle that has none."""
        incarnation = above(self._new_incarnation(), vehicle.controller.attendant)
        self._caretakers[vehicle.name] = Caretaker(vehicle, incarnation, tick)
        yield Listen(PREPARE, {"vehicle": vehicle.name})
        yield Listen(PLAN, {"vehicle": vehicle.name})

    def on_message(self, vehicle: Name, message: Prepare | Plan, tick: int) -> Iterator[Effect]:
        """Hand a message on to the caretaker that it concerns; it answers at once."""
        caretaker = self._caretakers.get(vehicle)
        state = None if caretaker is None else caretaker.on_message(message, tick)
        if state is not None:
            yield _shown(state)

    def show(self, tick: int) -> Iterator[Effect]:
        """Show the states of all vehicles that have caretakers."""
        for caretaker in self._caretakers.values():
            yield _shown(caretaker.show(tick))

    def _give_way(self, vehicle: Name) -> Iterator[Effect]:
        """End a vehicle's caretaker, if it has one: an agent is in charge, or the vehicle left."""
        if self._caretakers.pop(vehicle, None) is not None:
            yield Unlisten(PREPARE, {"vehicle": vehicle})
            yield Unlisten(PLAN, {"vehicle": vehicle})


def _shown(state: VehicleState) -> Effect:
    return Send(STATE, state, {"formation": state.formation, "vehicle": state.vehicle})
