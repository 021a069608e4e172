"""The vehicles of a SUMO simulation as arrivals at the entrances of a corridor.

Vehicles get the names of all vehicles of laneweave, v0001 and so on in order of departure, since
names in SUMO may contain characters that keys of messages must not. Those that depart on the
first edge arrive at the start of the road, in a lane that suits their destination: with an exit,
the lane next to it, and otherwise the one in which they can enter first. Vehicles that come from
other edges arrive at the start or at a ramp; when, and in which lane of the start, is known only
when SUMO has driven them there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

from attrs import frozen

from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.scenario.fields import MAIN_ENTRANCE, Scenario
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.sumo_config import SumoConfig
from laneweave.sim_bridge.corridors.sumo_demand import (
    CorridorDemand,
    Pass,
    entrance_name,
    type_names,
)
from laneweave.sim_bridge.corridors.sumo_network import Network
from laneweave.sim_bridge.road.demand import Arrival

MAX_WAIT_S = 600.0
"""Time after the last departure for which vehicles on their way to a ramp are awaited."""

FIRST_ENTRY_S = 1.0
"""Road time before which no vehicle enters, so that agents can be announced."""


@frozen
class CorridorArrival:
    """A vehicle of SUMO that drives through a corridor."""

    arrival: Arrival
    """At a ramp, its time is that of the departure from its first edge."""
    origin: Pass

    @property
    def departs_at_start(self) -> bool:
        """Whether it departs on the first edge of the corridor; others come from outside."""
        return self.origin.entrance == MAIN_ENTRANCE and not self.origin.upstream


@frozen(slots=False)
class CorridorSetup:
    """Everything that the simulation of a corridor consists of."""

    config: SumoConfig
    network: Network
    corridor: Corridor
    arrivals: tuple[CorridorArrival, ...]
    duration_s: float
    """Time within which vehicles depart."""
    left_out: frozenset[str] = frozenset()
    """Names in SUMO of vehicles with routes through the corridor that are not simulated."""

    @cached_property
    def by_name(self) -> Mapping[str, CorridorArrival]:
        """Its vehicles by their names in SUMO."""
        return {one.origin.vehicle.name: one for one in self.arrivals}

    @property
    def end_s(self) -> float:
        """SUMO's time until which vehicles are awaited."""
        return self.config.begin_s + self.duration_s + MAX_WAIT_S

    def is_left_out(self, name: str, route: Sequence[str]) -> bool:
        """Return whether a vehicle is in the corridor, but not one of its vehicles."""
        # Those that were read are found by name: SUMO computes routes of trips only at departure.
        return name in self.left_out or (
            name not in self.by_name and not self.corridor.edge_names.isdisjoint(route)
        )


def corridor_arrivals(scenario: Scenario, demand: CorridorDemand) -> tuple[CorridorArrival, ...]:
    """Return the vehicles of a corridor in order of departure."""
    names = type_names(demand.passes)
    car = next(iter(names))
    lanes = {entrance.name: entrance.lane for entrance in scenario.entrance}
    choose = _LaneChoice(scenario)
    found = []
    for number, one in enumerate(demand.passes, start=1):
        t_s = one.vehicle.depart_s - demand.begin_s
        destination = one.destination
        if destination != END_OF_ROAD:
            destination = entrance_name(destination)
        if one.upstream:
            lane = scenario.road.first_lanes[0]  # which one it is depends on SUMO
        elif one.entrance == MAIN_ENTRANCE:
            lane = choose.lane(t_s, destination)
        else:
            lane = lanes[entrance_name(one.entrance)]
        kind = one.vehicle.vehicle_type
        arrival = Arrival(
            vehicle_name(number),
            lane,
            ANY_LANE,
            max(t_s, FIRST_ENTRY_S),
            destination,
            CAR if kind == car else names[kind],
            one.vehicle.name,
        )
        found.append(CorridorArrival(arrival, one))
    return tuple(found)


class _LaneChoice:
    """Chooses lanes at the start of the road."""

    def __init__(self, scenario: Scenario) -> None:
        self._spacing_s = scenario.formation.entry_spacing_s
        self._free_s: dict[int, float] = dict.fromkeys(scenario.road.first_lanes, 0.0)
        """When the next vehicle can enter, by lane."""
        self._nearest: Mapping[str, int] = {
            each.name: min(
                scenario.road.first_lanes,
                key=lambda lane: min(abs(lane - own) for own in each.lanes),
            )
            for each in scenario.exit
        }

    def lane(self, t_s: float, destination: str) -> int:
        """Return the lane of the next vehicle."""
        lanes: Sequence[int] = [*self._free_s]
        if destination in self._nearest:
            lanes = [self._nearest[destination]]
        chosen = min(lanes, key=lambda lane: (max(self._free_s[lane], t_s), -lane))
        self._free_s[chosen] = max(self._free_s[chosen], t_s) + self._spacing_s
        return chosen


def main_stream(found: Sequence[CorridorArrival]) -> Iterator[Arrival]:
    """Yield the arrivals at the start of the road, by time."""
    for one in found:
        if one.departs_at_start:
            yield one.arrival
