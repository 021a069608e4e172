"""The lanes on which SUMO drives vehicles towards a ramp, as far upstream as they are advised."""

from __future__ import annotations

from collections.abc import Mapping

from attrs import frozen

from laneweave.sim_bridge.corridors.corridor import Corridor, Ramp
from laneweave.sim_bridge.corridors.sumo_network import Network

APPROACH_M = 200.0
"""Distance before a ramp from which vehicles are advised, at least."""


@frozen
class WayIn:
    """A lane on the way to a ramp."""

    from_m: float
    """Its beginning, as a position on the road; before the ramp's, the ramp has not begun."""
    limits: tuple[tuple[float, float], ...]
    """End [m] and speed limit [m/s] of this lane and of all others up to the acceleration lane."""
    upstream: bool
    """Whether vehicles still have to pass a junction where ways join."""


def ways_in(network: Network, corridor: Corridor, ramp: Ramp) -> Mapping[str, WayIn]:
    """Return the lanes towards a ramp by their names in SUMO, those inside junctions included."""
    inside = {edge.name for edge in corridor.edges}
    single = {link.origin.edge for link in ramp.path}
    found: dict[str, WayIn] = {}
    limits: tuple[tuple[float, float], ...] = ()
    waiting = [
        (link, ramp.merge_m, limits)
        for link in network.between(network.edges[ramp.edge], network.edges[ramp.to_edge])
    ]
    while waiting:
        link, to_m, limits = waiting.pop(0)
        edge = network.edges[link.origin.edge]
        upstream = edge.name not in single
        for name, length_m in reversed(link.across):
            limits = ((to_m, link.speed_mps), *limits)
            to_m -= length_m
            found[name] = WayIn(to_m, limits, upstream)
        from_m, limits = to_m - edge.length_m, ((to_m, link.origin.speed_mps), *limits)
        if edge.name in inside or edge.lanes[0].name in found:
            continue
        # Vehicles in the other lanes of the edge change into this one.
        found |= {lane.name: WayIn(from_m, limits, upstream) for lane in edge.lanes}
        if from_m > ramp.at_m - APPROACH_M:
            waiting += [
                (earlier, from_m, limits)
                for lane in edge.car_lanes
                for earlier in network.links_to(lane)
            ]
    return found
