"""SUMO's edges for a road: one per part of the road in which the same lanes are open.

A road without closures has one edge. If vehicles have preferred lanes, each lane that reaches the
end of the road leads to its own exit edge; if they have none, the last edge continues beyond the
end by the margin.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from attrs import frozen

from laneweave.protocol.scenario.fields import Scenario

EDGE = "road"
MIN_MARGIN_M = 30.0
_SL2015_LATERAL_MPS = 1.0
"""SUMO's default lateral speed (maxSpeedLat)."""


@frozen
class Edge:
    """A part of the road, or an exit."""

    name: str
    origin: str
    destination: str
    """Junctions at both ends."""
    from_m: float
    to_m: float
    lanes: tuple[int, ...]
    """Lanes of the road that the edge has. SUMO numbers them from 0 and lets vehicles change
    between successive numbers, so there are no gaps: closed lanes between open ones belong to
    the edge."""
    open_lanes: frozenset[int]
    """Lanes in which vehicles are allowed."""

    def index(self, lane: int) -> int:
        """Return SUMO's number of a lane."""
        return lane - self.lanes[0]


def margin_m(scenario: Scenario) -> float:
    """Return the length by which SUMO's edges exceed the road at each end [m].

    Vehicles are removed up to one tick's travel beyond the end of the road.
    """
    vehicle = scenario.vehicle
    tick_m = vehicle.max_speed_mps * scenario.runtime.tick_s
    return max(MIN_MARGIN_M, tick_m + vehicle.length_m)


def road_edges(scenario: Scenario, *, exits: bool) -> tuple[Edge, ...]:
    """Return all edges in the direction of travel, exits last.

    Args:
        scenario: road, vehicles and lane changes.
        exits: whether SUMO drives the vehicles. If not, there is one edge with all lanes.
    """
    road, margin = scenario.road, margin_m(scenario)
    lanes, end_m = tuple(range(road.lanes)), road.length_m
    if not exits:
        everywhere = (-margin, end_m + margin)
        return (Edge(EDGE, "west", "east", *everywhere, lanes, frozenset(lanes)),)
    has_exits = bool(scenario.lane_shares)
    closed = list(_closed_parts(scenario))
    inner_m = {s_m for _, *parts_m in closed for s_m in parts_m if s_m < end_m}
    bounds_m = [-margin, *sorted(inner_m), end_m if has_exits else end_m + margin]
    last = len(bounds_m) - 2
    edges: list[Edge] = []
    for number, (from_m, to_m) in enumerate(pairwise(bounds_m)):
        shut = {lane for lane, low_m, _, high_m in closed if low_m <= from_m < high_m}
        hidden = {lane for lane, low_m, high_m, _ in closed if low_m <= from_m < high_m}
        shown = [lane for lane in lanes if lane not in hidden]
        destination = f"end{number}" if number < last else "end" if has_exits else "east"
        edge = Edge(
            name=f"{EDGE}{number}" if number else EDGE,
            origin=edges[-1].destination if edges else "west",
            destination=destination,
            from_m=from_m,
            to_m=to_m,
            lanes=lanes[shown[0] : shown[-1] + 1],
            open_lanes=frozenset(lanes) - shut,
        )
        edges.append(edge)
    exit_lanes = sorted(edges[-1].open_lanes) if has_exits else ()
    for lane in exit_lanes:
        ends = ("end", f"east{lane}", end_m, end_m + margin)
        edges.append(Edge(f"exit{lane}", *ends, (lane,), frozenset({lane})))
    return tuple(edges)


def connections(edges: Sequence[Edge]) -> Iterator[tuple[Edge, Edge, int]]:
    """Yield (edge, next edge, lane) for each lane that continues in the next edge.

    A closed lane continues where it opens: SUMO needs to know where the rear of a vehicle is that
    changes into the lane there.
    """
    for edge in edges:
        for following in edges:
            if following.origin == edge.destination:
                for lane in following.lanes:
                    dead_end = lane in edge.open_lanes and lane not in following.open_lanes
                    if lane in edge.lanes and not dead_end:
                        yield edge, following, lane


def lane_end_m(scenario: Scenario, closed_m: float) -> float:
    """Return where SUMO's lane ends before a part that is closed from `closed_m` on [m].

    If a lane change takes time, a part of the body is still in the old lane when SUMO counts the
    vehicle in the new one: for half of the change at most.
    """
    settings, lane_m = scenario.lc2013, scenario.road.lane_width_m
    change_s = settings.lane_change_s
    if settings.model == "SL2015":
        change_s = lane_m / _SL2015_LATERAL_MPS
    return closed_m - 0.5 * change_s * scenario.formation.speed_mps


def _closed_parts(scenario: Scenario) -> Iterator[tuple[int, float, float, float]]:
    """Yield (lane, from, to, opens) [m] of each closed part.

    Vehicles may use a lane again behind its closed part plus the length of their bodies, since
    SUMO's positions are those of fronts.
    """
    for one in scenario.road.closures:
        opens_m = one.to_m + scenario.vehicle.length_m
        yield one.lane, lane_end_m(scenario, one.from_m), one.to_m, opens_m
