"""Who is in charge of the vehicles: their agents, or caretakers in place of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from laneweave.protocol.incarnations import above
from laneweave.protocol.messages import Name, Plan, Prepare, VehicleState
from laneweave.protocol.node import Effect, Listen, Send, Unlisten
from laneweave.protocol.topics import PLAN, PREPARE, STATE
from laneweave.sim_bridge.caretaker import Caretaker
from laneweave.sim_bridge.traffic import RoadVehicle


class Attendance:
    """The caretakers of a road, and what goes between them and the network.

    PREPARE and PLAN of a vehicle are subscribed to only while its caretaker is in charge.
    """

    def __init__(self, new_incarnation: Callable[[], int]) -> None:
        """Begin without caretakers.

        Args:
            new_incarnation: returns a number that no process has used before.
        """
        self._new_incarnation = new_incarnation
        self._caretakers: dict[Name, Caretaker] = {}

    def __contains__(self, vehicle: Name) -> bool:
        """Tell whether a vehicle's caretaker is in charge."""
        return vehicle in self._caretakers

    def take_charge(self, vehicle: RoadVehicle, tick: int) -> Iterator[Effect]:
        """Put a caretaker in charge of a vehicle that has none."""
        incarnation = above(self._new_incarnation(), vehicle.controller.attendant)
        self._caretakers[vehicle.name] = Caretaker(vehicle, incarnation, tick)
        yield Listen(PREPARE, {"vehicle": vehicle.name})
        yield Listen(PLAN, {"vehicle": vehicle.name})

    def give_way(self, vehicle: Name) -> Iterator[Effect]:
        """End a vehicle's caretaker, if it has one: an agent is in charge, or the vehicle left."""
        if self._caretakers.pop(vehicle, None) is not None:
            yield Unlisten(PREPARE, {"vehicle": vehicle})
            yield Unlisten(PLAN, {"vehicle": vehicle})

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


def _shown(state: VehicleState) -> Effect:
    return Send(STATE, state, {"formation": state.formation, "vehicle": state.vehicle})
