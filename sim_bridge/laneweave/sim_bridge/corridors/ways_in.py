"""The lanes on which SUMO drives vehicles to an entrance, as far upstream as they are advised."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from attrs import frozen

from laneweave.sim_bridge.corridors.corridor import Corridor, Ramp
from laneweave.sim_bridge.corridors.sumo_network import Link, Network

APPROACH_M = 200.0
"""Distance before an entrance from which vehicles are advised, at least."""


@frozen
class WayIn:
    """A lane on the way to an entrance."""

    from_m: float
    """Its beginning, as a position on the road, negative before the start."""
    limits: tuple[tuple[float, float], ...]
    """End [m] and speed limit [m/s] of this lane and of all others up to the corridor."""
    upstream: bool
    """Whether vehicles still have to pass a junction where ways join."""


def ways_to_ramp(network: Network, corridor: Corridor, ramp: Ramp) -> Mapping[str, WayIn]:
    """Return the lanes towards a ramp by their names in SUMO, those inside junctions included."""
    links = network.between(network.edges[ramp.edge], network.edges[ramp.to_edge])
    found: dict[str, WayIn] = {}
    _add(
        found,
        network,
        corridor,
        links,
        ramp.merge_m,
        ramp.at_m,
        {one.origin.edge for one in ramp.path},
    )
    return found


def ways_to_start(network: Network, corridor: Corridor) -> Mapping[int, Mapping[str, WayIn]]:
    """Return the lanes towards the start of the road, by lane of the road and name in SUMO."""
    first = corridor.edges[0]
    ways: dict[int, Mapping[str, WayIn]] = {}
    for lane in network.edges[first.name].car_lanes:
        links = network.links_to(lane)
        if links:
            own = {lane.name: WayIn(first.from_m, ((first.to_m, lane.speed_mps),), upstream=False)}
            edges = {link.origin.edge for link in links}
            _add(
                own,
                network,
                corridor,
                links,
                first.from_m,
                first.from_m,
                edges if len(edges) == 1 else set(),
                parallel=True,
            )
            ways[first.first_lane + lane.index] = own
    return ways


def _add(
    found: dict[str, WayIn],
    network: Network,
    corridor: Corridor,
    links: Sequence[Link],
    end_m: float,
    entrance_m: float,
    single: Collection[str],
    *,
    parallel: bool = False,
) -> None:
    """Add the lanes from which links lead on.

    Args:
        found: where they are added.
        network: the network.
        corridor: the corridor, whose edges are left out.
        links: the links into the corridor.
        end_m: where they end.
        entrance_m: position of the entrance.
        single: edges behind all junctions where ways join.
        parallel: whether the other lanes of an edge lead elsewhere.
    """
    inside = corridor.edge_numbers
    limits: tuple[tuple[float, float], ...] = ()
    waiting = [(link, end_m, limits) for link in links]
    while waiting:
        link, to_m, limits = waiting.pop(0)
        edge = network.edges[link.origin.edge]
        upstream = edge.name not in single
        for lane in reversed(link.across):
            limits = ((to_m, link.speed_mps), *limits)
            to_m -= lane.length_m
            found[lane.name] = WayIn(to_m, limits, upstream)
        from_m, limits = to_m - edge.length_m, ((to_m, link.origin.speed_mps), *limits)
        if edge.name in inside or link.origin.name in found:
            continue
        # Elsewhere than on parallel lanes, vehicles change into the lane from which the link leads.
        lanes = (link.origin,) if parallel else edge.car_lanes
        found |= {lane.name: WayIn(from_m, limits, upstream) for lane in lanes}
        if from_m > entrance_m - APPROACH_M:
            waiting += [
                (earlier, from_m, limits) for lane in lanes for earlier in network.links_to(lane)
            ]
