"""SUMO's edges for a road, and the routes on them.

The edges of the road itself follow each other: one per part in which the same lanes are open. An
on-ramp is an edge beside the road until it joins, an exit an edge behind the part that it ends. If
vehicles have preferred lanes, each lane that reaches the end of the road leads to its own exit; if
they have none, the last edge of the road continues beyond the end by the margin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

from attrs import frozen

from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, end_exit
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.sim_bridge.road.demand import Arrival

ROAD = "road"
"""Name of the first edge of the road, and beginning of the names of the others."""
MIN_MARGIN_M = 30.0
_SL2015_LATERAL_MPS = 1.0
"""SUMO's default lateral speed (maxSpeedLat)."""


@frozen
class Edge:
    """A part of the road, a ramp or an exit."""

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
    separate: frozenset[int] = frozenset()
    """Lanes that no vehicle enters or leaves by a lane change."""

    def index(self, lane: int) -> int:
        """Return SUMO's number of a lane."""
        return lane - self.lanes[0]


@frozen
class RoadEdges:
    """All edges of a road."""

    road: tuple[Edge, ...]
    """The road itself, in the direction of travel."""
    ramps: Mapping[str, Edge]
    """Ramps by the name of the entrance."""
    exits: Mapping[str, Edge]
    """Exits by name; those of lanes at the end of the road have the names of `end_exit`."""

    def __iter__(self) -> Iterator[Edge]:
        """Yield all edges, those of the road first."""
        yield from self.road
        yield from self.ramps.values()
        yield from self.exits.values()

    def entry(self, entrance: str) -> Edge:
        """Return the edge on which the vehicles of an entrance begin."""
        return self.road[0] if entrance == MAIN_ENTRANCE else self.ramps[entrance]

    def routes(self) -> dict[str, tuple[Edge, ...]]:
        """Return the edges from each entrance to each exit behind it, by `route_name`."""
        ends = dict(self.exits)
        if self.road[-1].destination not in {edge.origin for edge in ends.values()}:
            ends[END_OF_ROAD] = self.road[-1]
        return {
            route_name(entrance, end): route
            for entrance in (MAIN_ENTRANCE, *self.ramps)
            for end, last in ends.items()
            if (route := self._route(self.entry(entrance), last))
        }

    def _route(self, first: Edge, last: Edge) -> tuple[Edge, ...]:
        """Return the edges of a route; empty: the last edge is not ahead of the first."""
        route = [first]
        while route[-1] is not last:
            here = route[-1].destination
            following = [edge for edge in (last, *self.road) if edge.origin == here]
            if not following:
                return ()
            route.append(following[0])
        return tuple(route)


def route_name(entrance: str, end: str) -> str:
    """Return the name of the route from an entrance to an exit or `END_OF_ROAD`.

    The separator does not occur in names.
    """
    return f"{entrance}/{end}"


def route_of(scenario: Scenario, arrival: Arrival) -> str:
    """Return the name of a vehicle's route."""
    end = arrival.destination
    if end == END_OF_ROAD and arrival.preferred_lane != ANY_LANE:
        end = end_exit(arrival.preferred_lane)
    return route_name(scenario.geometry.entry_points[arrival.entry_point].entrance, end)


def margin_m(scenario: Scenario) -> float:
    """Return the length by which SUMO's edges exceed the road at each end [m].

    Vehicles are removed up to one tick's travel beyond the end of the road.
    """
    tick_m = scenario.vehicle.max_speed_mps * scenario.runtime.tick_s
    return max(MIN_MARGIN_M, tick_m + scenario.types.longest_body_m)


def single_edge(scenario: Scenario) -> RoadEdges:
    """Return one edge with all lanes, in all of which vehicles are allowed, as `RoadEdges`."""
    margin, lanes = margin_m(scenario), tuple(range(scenario.road.lanes))
    from_m, to_m = -margin, scenario.road.length_m + margin
    return RoadEdges((Edge(ROAD, "west", "east", from_m, to_m, lanes, frozenset(lanes)),), {}, {})


def road_edges(scenario: Scenario) -> RoadEdges:
    """Return the edges of a road on which SUMO drives the vehicles."""
    margin, end_m = margin_m(scenario), scenario.road.length_m
    by_lane = bool(scenario.flow.lane_shares)
    closed = [*_closed_parts(scenario)]
    bounds = [at_m for part in closed for at_m in (part.from_m, part.to_m, part.opens_m)]
    bounds += [ramp.merge_m + scenario.types.longest_body_m for ramp in scenario.entrance]
    inner_m = {at_m for at_m in bounds if 0.0 < at_m < end_m}
    bounds_m = [-margin, *sorted(inner_m), end_m if by_lane else end_m + margin]
    road = tuple(_parts_of_road(scenario, bounds_m, closed, "end" if by_lane else "east"))
    junctions = {edge.to_m: edge.destination for edge in road}
    ramps = {
        one.name: Edge(
            name=f"ramp-{one.name}",
            origin=f"ramp-{one.name}-start",
            destination=junctions[one.merge_m],
            from_m=one.at_m - margin,
            to_m=one.merge_m,
            lanes=(one.lane,),
            open_lanes=frozenset({one.lane}),
        )
        for one in scenario.entrance
    }
    ways_out = [(one.name, f"exit-{one.name}", one.lanes, one.at_m) for one in scenario.exit]
    if by_lane:
        reaching = sorted(road[-1].open_lanes)
        ways_out += [(end_exit(lane), f"exit{lane}", (lane,), end_m) for lane in reaching]
    exits = {
        key: Edge(
            name=name,
            origin=junctions[at_m],
            destination=f"{name}-end",
            from_m=at_m,
            to_m=at_m + margin,
            lanes=tuple(range(min(lanes), max(lanes) + 1)),
            open_lanes=frozenset(lanes),
        )
        for key, name, lanes, at_m in ways_out
    }
    return RoadEdges(road, ramps, exits)


def connections(edges: Sequence[Edge]) -> Iterator[tuple[Edge, Edge, int]]:
    """Yield (edge, next edge, lane) for each lane that continues in the next edge.

    A closed lane continues where it opens, unless a ramp leads there: SUMO needs to know where the
    rear of a vehicle is that changes into the lane there.
    """
    pairs = [(one, two) for one in edges for two in edges if two.origin == one.destination]
    for edge, following in pairs:
        for lane in following.lanes:
            if lane not in edge.lanes:
                continue
            if lane in edge.open_lanes:
                continues = lane in following.open_lanes
            else:
                continues = not any(
                    after is following and lane in before.open_lanes for before, after in pairs
                )
            if continues:
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


@frozen
class _ClosedPart:
    """A part of a lane that does not belong to the road, or that vehicles may not use [m]."""

    lane: int
    from_m: float
    to_m: float
    """Where the lane is part of the road again."""
    opens_m: float
    """Where vehicles may use it again."""


def _closed_parts(scenario: Scenario) -> Iterator[_ClosedPart]:
    """Yield the closed parts of lanes, with the ramps behind them.

    Vehicles may use a lane again behind its closed part plus the length of their bodies, since
    SUMO's positions are those of fronts.
    """
    exits = {(lane, one.at_m) for one in scenario.exit for lane in one.lanes}
    merges_m = {(one.lane, one.at_m): one.merge_m for one in scenario.entrance}
    for one in scenario.road.closures:
        from_m, to_m = one.from_m, one.to_m
        if from_m <= 0.0:
            from_m = -math.inf
        elif (one.lane, from_m) not in exits:
            from_m = lane_end_m(scenario, from_m)
        if (one.lane, to_m) in merges_m:
            to_m = opens_m = merges_m[one.lane, to_m]
        else:
            opens_m = to_m + scenario.types.longest_body_m
        yield _ClosedPart(one.lane, from_m, to_m, opens_m)


def _parts_of_road(
    scenario: Scenario, bounds_m: Sequence[float], closed: Sequence[_ClosedPart], end: str
) -> Iterator[Edge]:
    """Yield the edges of the road itself; `end`: the junction at the end of the last one.

    Where a ramp joins, its lane remains separate for the length of a body: SUMO would turn a body
    that changes lanes while its rear is on the ramp, or on the road beside it.
    """
    lanes, last = tuple(range(scenario.road.lanes)), len(bounds_m) - 2
    origin = "west"
    for number, (from_m, to_m) in enumerate(pairwise(bounds_m)):
        hidden = {part.lane for part in closed if part.from_m <= from_m < part.to_m}
        shut = {part.lane for part in closed if part.from_m <= from_m < part.opens_m}
        shown = [lane for lane in lanes if lane not in hidden]
        destination = f"end{number}" if number < last else end
        yield Edge(
            name=f"{ROAD}{number}" if number else ROAD,
            origin=origin,
            destination=destination,
            from_m=from_m,
            to_m=to_m,
            lanes=lanes[shown[0] : shown[-1] + 1],
            open_lanes=frozenset(lanes) - shut,
            separate=frozenset(
                ramp.lane
                for ramp in scenario.entrance
                if ramp.merge_m <= from_m < ramp.merge_m + scenario.types.longest_body_m
            ),
        )
        origin = destination
