"""Vehicles that have left the road, whose agents are to hear of it."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from attrs import define, field

from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.topics import SENSE
from laneweave.sim_bridge.road.vehicle import RoadVehicle

LEFT_REPEATS = 20
"""Ticks for which the agent of a vehicle that left is told so."""


@define
class Leaving:
    """Who has left, and how often its agent is still told so."""

    repeats: dict[Name, tuple[RoadVehicle, int]] = field(factory=dict)

    def add(self, vehicle: RoadVehicle) -> None:
        """Take note of a vehicle that left the road."""
        self.repeats[vehicle.name] = (vehicle, LEFT_REPEATS)

    def forget(self, vehicle: Name) -> None:
        """Tell a vehicle's agent no more: it is gone."""
        self.repeats.pop(vehicle, None)

    def tell(self, tick: int, up: Collection[Name]) -> Iterator[Effect]:
        """Tell those agents that are up, once more."""
        for name, (vehicle, repeats) in list(self.repeats.items()):
            if name not in up or repeats == 0:
                del self.repeats[name]
                continue
            self.repeats[name] = (vehicle, repeats - 1)
            yield tell_left(vehicle, tick)


def tell_left(vehicle: RoadVehicle, tick: int) -> Effect:
    """Return the message with which an agent reports and ends."""
    sense = vehicle.sense(tick, caretaker=False, left=True)
    return Send(SENSE, sense, {"vehicle": vehicle.name})
