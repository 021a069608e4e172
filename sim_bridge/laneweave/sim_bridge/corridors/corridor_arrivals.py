"""The vehicles of a SUMO simulation as arrivals at the entrances of a corridor.

Vehicles get the names of all vehicles of laneweave, v0001 and so on in order of departure, since
names in SUMO may contain characters that keys of messages must not. Those that depart on the
first edge arrive at the start of the road, in a lane that suits their destination: with an exit,
the lane next to it, and otherwise the one in which they can enter first. Vehicles that come from
other edges arrive at the start or at a ramp; when, and in which lane of the start, is known only
when SUMO has driven them there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial

from attrs import frozen

from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import MAIN_ENTRANCE, Scenario
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.sumo_demand import (
    LIMITS,
    CorridorDemand,
    Pass,
    SumoType,
    type_names,
)
from laneweave.sim_bridge.road.demand import Arrival

FIRST_ENTRY_S = 1.0
"""Road time before which no vehicle enters, so that agents can be announced."""


@frozen
class CorridorArrival:
    """A vehicle of SUMO that drives through a corridor."""

    arrival: Arrival
    """At a ramp, its time is that of the departure from its first edge."""
    origin: Pass
    on_ramp: bool = False
    """Whether it departs on the ramp itself."""
    near: bool = False
    """Whether it departs near its entrance, on an edge on which vehicles are advised."""

    @property
    def departs_at_start(self) -> bool:
        """Whether it departs on the first edge of the corridor; others come from outside."""
        return self.origin.entrance == MAIN_ENTRANCE and not self.origin.upstream


def corridor_arrivals(
    scenario: Scenario,
    corridor: Corridor,
    demand: CorridorDemand,
    near: Collection[str],
    begin_s: float,
) -> tuple[CorridorArrival, ...]:
    """Return the vehicles of a corridor in order of departure.

    Args:
        scenario: the scenario of the corridor.
        corridor: the corridor.
        demand: its vehicles.
        near: edges on which vehicles are advised before they are taken over.
        begin_s: SUMO's time at which the run begins.

    Raises:
        BadInputError: the scenario lacks an entrance, exit or type of vehicle.
    """
    types = _types_in(scenario, type_names(demand.passes))
    lanes = {entrance.name: entrance.lane for entrance in scenario.entrance}
    on_ramp = {ramp.name: {link.origin.edge for link in ramp.path} for ramp in corridor.ramps}
    choose = _LaneChoice(scenario)
    found = []
    for number, one in enumerate(demand.passes, start=1):
        t_s = one.vehicle.depart_s - begin_s
        if one.upstream:
            lane = scenario.road.first_lanes[0]  # which one it is depends on SUMO
        elif one.entrance == MAIN_ENTRANCE:
            lane = choose.lane(t_s, one.destination, types[one.vehicle.vehicle_type])
        elif one.entrance in lanes:
            lane = lanes[one.entrance]
        else:
            allowed = f"an entrance {one.entrance}: {one.vehicle.name} of the simulation needs it"
            raise BadInputError("entrance", [*lanes], allowed)
        arrival = Arrival(
            vehicle_name(number),
            lane,
            ANY_LANE,
            max(t_s, FIRST_ENTRY_S),
            one.destination,
            types[one.vehicle.vehicle_type],
            one.vehicle.name,
        )
        first = one.vehicle.route[0]
        departs_on_ramp = first in on_ramp.get(one.entrance, ())
        found.append(CorridorArrival(arrival, one, departs_on_ramp, near=first in near))
    return tuple(found)


def _types_in(scenario: Scenario, names: Mapping[SumoType, str]) -> Mapping[SumoType, str]:
    """Return the scenario's type for each type of SUMO: the one with the same limits.

    Which type is the most frequent one, and so has the name `car`, depends on the time window. A
    type with other limits, which the user has changed, is found by its name.

    Raises:
        BadInputError: there is none.
    """
    limits = {
        name: {field: getattr(own.vehicle, field) for field in LIMITS}
        for name, own in scenario.types.items()
    }
    found = {}
    for number, (kind, given) in enumerate(names.items()):
        name, own = given if number else CAR, kind.limits
        equal = [one for one in limits if limits[one] == own]
        if not equal and name not in limits:
            allowed = f"a type with the limits of {name} in the simulation: {own}"
            raise BadInputError("vehicle_type", [*limits], allowed)
        found[kind] = name if name in equal or not equal else equal[0]
    return found


class _LaneChoice:
    """Chooses lanes at the start of the road."""

    def __init__(self, scenario: Scenario) -> None:
        self._spacing_s = scenario.formation.entry_spacing_s
        self._free_s: dict[int, float] = dict.fromkeys(scenario.road.first_lanes, 0.0)
        """When the next vehicle can enter, by lane."""
        self._scenario = scenario
        self._exit_lanes = {each.name: each.lanes for each in scenario.exit}

    def lane(self, t_s: float, destination: str, vehicle_type: str) -> int:
        """Return the lane of the next vehicle, in which its type may drive."""
        is_closed = partial(self._scenario.is_restricted, s_m=0.0, vehicle_type=vehicle_type)
        lanes: Sequence[int] = [lane for lane in self._free_s if not is_closed(lane)]
        lanes = lanes or [*self._free_s]
        if destination in self._exit_lanes:
            nearest = self._exit_lanes[destination]
            lanes = [min(lanes, key=lambda lane: min(abs(lane - own) for own in nearest))]
        chosen = min(lanes, key=lambda lane: (max(self._free_s[lane], t_s), -lane))
        self._free_s[chosen] = max(self._free_s[chosen], t_s) + self._spacing_s
        return chosen
