"""A corridor of a SUMO simulation, the vehicles that drive through it, and their ways to it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors.corridor import OPTION, Corridor, corridor_of
from laneweave.sim_bridge.corridors.sumo_network import Link, Network, unique_name
from laneweave.sim_bridge.corridors.sumo_simulation import (
    WHOLE,
    SumoSimulation,
    SumoType,
    SumoVehicle,
    TimeWindow,
    read_simulation,
)

APPROACH_M = 200.0
"""Distance before an entrance from which vehicles are advised, at least."""
LaneLimits = tuple[tuple[float, float], ...]
"""End [m] and speed limit [m/s] of a lane and of all others up to the corridor."""


@frozen
class LaneBefore:
    """A lane on the way to an entrance."""

    from_m: float
    """Its beginning, as a position on the road, negative before the start."""
    limits: LaneLimits
    upstream: bool
    """Whether vehicles still have to pass a junction where ways join."""


@frozen
class WayIn:
    """The lanes that lead to an entrance."""

    entrance: str
    """`MAIN_ENTRANCE`, or the name of an on-ramp: that of its rightmost lane."""
    lane: int
    """The lane of the road to which they lead."""
    lanes: Mapping[str, LaneBefore]
    """By their names in SUMO, those inside junctions included."""
    ramp: str = ""
    """Name of the entrance in scenarios (`Ramp.name`); empty: the start of the road."""


@frozen
class Pass:
    """A vehicle's way through a corridor."""

    vehicle: SumoVehicle
    entrance: str
    """`MAIN_ENTRANCE`, or the name of a ramp."""
    destination: str
    """`END_OF_ROAD`, or the name of an exit."""
    upstream: str = ""
    """Edge from which it comes to the start; empty: it departs on the first edge, or by a ramp."""
    lanes: tuple[int, ...] = ()
    """Lanes at the end of the corridor from which its route continues; empty: any."""

    @property
    def departs_at_start(self) -> bool:
        """Whether it departs on the first edge of the corridor; others come from outside."""
        return self.entrance == MAIN_ENTRANCE and not self.upstream

    def preferred_lane(self, lane: int) -> int:
        """Return its preferred lane, the one nearest to the lane in which it enters."""
        return min(self.lanes, key=lambda one: abs(one - lane), default=ANY_LANE)


@frozen(slots=False)
class SumoCorridor:
    """A corridor of a SUMO simulation, and the vehicles that drive through it."""

    simulation: SumoSimulation
    corridor: Corridor
    passes: tuple[Pass, ...]
    """In order of departure."""
    left_out: Mapping[str, str]
    """Why it cannot serve vehicles whose routes touch it, by their names in SUMO."""

    @property
    def missing(self) -> Mapping[str, int]:
        """Number of vehicles that it cannot serve, by reason."""
        return Counter(self.left_out.values())

    @property
    def volume_veh_per_h(self) -> float:
        """Number of vehicles per hour that drive through a part of it."""
        return 3600.0 * len(self.passes) / self.simulation.duration_s

    @cached_property
    def ways_in(self) -> tuple[WayIn, ...]:
        """The lanes towards the entrances."""
        return tuple(_ways_in(self.corridor))

    def type_names(self) -> dict[SumoType, str]:
        """Return the types with their names, the most frequent first; that is the car.

        Types with equal limits and classes are one. Their names are those of SUMO's classes.
        """
        counts = Counter(one.vehicle.vehicle_type for one in self.passes)
        names: dict[SumoType, str] = {}
        for kind, _ in counts.most_common():
            names[kind] = unique_name(kind.vehicle_class, names.values())
        return names


def read_corridor(file: Path, name: str, window: TimeWindow = WHOLE, seed: int = 1) -> SumoCorridor:
    """Read the files of a simulation, and derive a corridor; see `read_simulation`.

    `name` consists of the first and the last edge, FIRST_EDGE:LAST_EDGE.

    Raises:
        BadInputError: a file cannot be read, the edges are not a corridor, or no vehicle departs in
            the time window.
        CommandFailedError: libsumo is missing, or SUMO rejects a file.
    """
    simulation = read_simulation(file, window, seed)
    return corridor_in(simulation, *_edges_of(name, simulation.network))


def corridor_in(simulation: SumoSimulation, first: str, last: str) -> SumoCorridor:
    """Return the corridor from one edge to another, with its vehicles; see `corridor_of`."""
    corridor = corridor_of(simulation.network, first, last, simulation.routes)
    passes, left_out = list[Pass](), dict[str, str]()
    for vehicle in simulation.vehicles:
        found = _pass_of(vehicle, corridor)
        if isinstance(found, Pass):
            passes.append(found)
        elif found:
            left_out[vehicle.name] = found
    return SumoCorridor(simulation, corridor, tuple(passes), left_out)


def _edges_of(name: str, network: Network) -> tuple[str, str]:
    """Return the first and the last edge that a name of a corridor consists of.

    Names of edges may contain colons.

    Raises:
        BadInputError: it does not consist of two names.
    """
    colons = [place for place, letter in enumerate(name) if letter == ":"]
    pairs = [(name[:place], name[place + 1 :]) for place in colons]
    pairs = [pair for pair in pairs if all(pair)]
    for pair in pairs:
        if all(edge in network.edges for edge in pair):
            return pair
    if len(pairs) != 1:
        raise BadInputError(OPTION, name, "FIRST_EDGE:LAST_EDGE, two edges of the network")
    return pairs[0]


def _pass_of(vehicle: SumoVehicle, corridor: Corridor) -> Pass | str:
    """Return a vehicle's way through the corridor, or why it is left out; empty: no contact."""
    route, numbers = vehicle.route, corridor.edge_numbers
    inside = [place for place, edge in enumerate(route) if edge in numbers]
    if not inside:
        return ""
    first, last = inside[0], inside[-1]
    begin, end = numbers[route[first]], numbers[route[last]]
    if [numbers[route[place]] for place in inside] != [*range(begin, begin + last - first + 1)]:
        return "drive through it twice"
    if math.isinf(vehicle.depart_s):
        return "wait for passengers"
    if vehicle.stops:
        return "stop on their way"
    before, after = ("", *route)[first], (*route, "")[last + 1]
    entrance, destination, upstream, lanes = MAIN_ENTRANCE, END_OF_ROAD, "", tuple[int, ...]()
    if begin == 0:
        upstream = before
    else:
        ramps = {(one.edge, one.to_edge): one.entrance for one in corridor.ramps}
        if (before, route[first]) not in ramps:
            return f"enter from {before}" if before else f"start on {route[first]}"
        entrance = ramps[before, route[first]]
    if end < len(numbers) - 1:
        exits = {(one.from_edge, one.edge): one.name for one in corridor.ways_out}
        if (route[last], after) not in exits:
            return f"leave to {after}" if after else f"end on {route[last]}"
        destination = exits[route[last], after]
    elif after and corridor.lanes_to:
        if after not in corridor.lanes_to:
            return f"leave to {after}"
        lanes = corridor.lanes_to[after]
    return Pass(vehicle, entrance, destination, upstream, lanes)


def _ways_in(corridor: Corridor) -> Iterator[WayIn]:
    """Yield the ways to the lanes at the start of the road, then those to its ramps."""
    network, first = corridor.network, corridor.edges[0]
    for lane in first.edge.car_lanes:
        links = network.links_to(lane)
        if links:
            end = LaneBefore(first.from_m, ((first.to_m, lane.speed_mps),), upstream=False)
            edges = {link.origin.edge for link in links}
            single = edges if len(edges) == 1 else set()
            lanes = _lanes_before(
                corridor, links, first.from_m, first.from_m, single, parallel=True
            )
            yield WayIn(MAIN_ENTRANCE, first.first_lane + lane.index, {lane.name: end, **lanes})
    for ramp in corridor.ramps:
        links = network.between(network.edges[ramp.edge], network.edges[ramp.to_edge])
        parallel = sum(one.entrance == ramp.entrance for one in corridor.ramps) > 1
        if parallel:
            first_lane = corridor.edges[corridor.edge_numbers[ramp.to_edge]].first_lane
            links = [one for one in links if first_lane + one.target.index == ramp.lane]
        single = {one.origin.edge for one in ramp.path}
        lanes = _lanes_before(corridor, links, ramp.merge_m, ramp.at_m, single, parallel=parallel)
        yield WayIn(ramp.entrance, ramp.lane, lanes, ramp.name)


def _lanes_before(
    corridor: Corridor,
    links: Sequence[Link],
    end_m: float,
    entrance_m: float,
    single: Collection[str],
    *,
    parallel: bool,
) -> Mapping[str, LaneBefore]:
    """Return the lanes from which links into the corridor lead on.

    Args:
        corridor: the corridor, whose edges are left out.
        links: the links into it.
        end_m: where they end.
        entrance_m: position of the entrance.
        single: edges behind all junctions where ways join.
        parallel: whether the other lanes of an edge lead elsewhere. If not, vehicles change into
            the lane from which the link leads.
    """
    network, inside = corridor.network, corridor.edge_numbers
    found: dict[str, LaneBefore] = {}
    limits: LaneLimits = ()
    waiting = [(link, end_m, limits) for link in links]
    while waiting:
        link, to_m, limits = waiting.pop(0)
        edge = network.edges[link.origin.edge]
        upstream = edge.name not in single
        for lane in reversed(link.across):
            limits = ((to_m, link.speed_mps), *limits)
            to_m -= lane.length_m
            found[lane.name] = LaneBefore(to_m, limits, upstream)
        from_m, limits = to_m - edge.length_m, ((to_m, link.origin.speed_mps), *limits)
        if edge.name in inside or link.origin.name in found:
            continue
        lanes = (link.origin,) if parallel else edge.car_lanes
        found |= {lane.name: LaneBefore(from_m, limits, upstream) for lane in lanes}
        if from_m > entrance_m - APPROACH_M:
            waiting += [
                (earlier, from_m, limits) for lane in lanes for earlier in network.links_to(lane)
            ]
    return found
