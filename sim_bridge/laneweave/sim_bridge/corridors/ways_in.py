"""The lanes on which SUMO drives vehicles to an entrance, as far upstream as they are advised."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from attrs import frozen

from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.sumo_network import Link

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
    """`MAIN_ENTRANCE`, or the name of a ramp."""
    lane: int
    """The lane of the road to which they lead."""
    lanes: Mapping[str, LaneBefore]
    """By their names in SUMO, those inside junctions included."""


def ways_in(corridor: Corridor) -> Iterator[WayIn]:
    """Yield the ways to the lanes at the start of the road, then those to its ramps."""
    network, first = corridor.network, corridor.edges[0]
    for lane in first.edge.car_lanes:
        links = network.links_to(lane)
        if links:
            end = LaneBefore(first.from_m, ((first.to_m, lane.speed_mps),), upstream=False)
            edges = {link.origin.edge for link in links}
            single = edges if len(edges) == 1 else set()
            lanes = _lanes(corridor, links, first.from_m, first.from_m, single, parallel=True)
            yield WayIn(MAIN_ENTRANCE, first.first_lane + lane.index, {lane.name: end, **lanes})
    for ramp in corridor.ramps:
        links = network.between(network.edges[ramp.edge], network.edges[ramp.to_edge])
        single = {one.origin.edge for one in ramp.path}
        lanes = _lanes(corridor, links, ramp.merge_m, ramp.at_m, single, parallel=False)
        yield WayIn(ramp.name, ramp.lane, lanes)


def _lanes(
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
