"""Derives the road of a corridor: consecutive edges of a SUMO network.

Lanes of successive edges continue each other if a link leads from one to the other. *Corridor
lanes* are numbered from the right over all edges: the links between two edges determine by how much
the numbers of the second are shifted. A lane that is fed from outside of the corridor is an on-ramp
with its acceleration lane, and a lane whose links lead out of it an exit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from statistics import median
from types import MappingProxyType

from attrs import evolve, field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE, Closure
from laneweave.protocol.vehicle.lane_ends import HANDOVER_M
from laneweave.sim_bridge.corridors.sumo_network import (
    Edge,
    Lane,
    Link,
    Network,
    grouped,
    lane_shift,
    through_links,
    unique_name,
)

MAX_LANES = 8
MAX_RAMP_M = 400.0
"""Length of the part of a ramp before its acceleration lane that is used at most."""
BEHIND_EXIT_M = 15.0
"""Distance between an exit and a ramp in the same lane: their vehicles do not overlap on the road,
though in the world they never meet."""
MIN_AT_M = 1.0
"""Position of ramps that begin before the corridor: their lanes are closed at its start."""
POCKET_S, POCKET_M = 5.0, 15.0
"""Time at v_F, plus a distance, before the end of an approach. Lanes that open later are turn
pockets: no vehicle of laneweave changes into them, but SUMO does."""
RESERVE_MPS, RESERVE_SHARE = 1.0, 0.1
"""Difference between v_F and the speed limit, absolute and as a share; the smaller one applies.
Vehicles that have fallen behind their cells catch up with it. Where ramps or exits are too short,
v_F is lower, by up to the share."""
MAX_SPEED_MPS = 60.0
"""Highest speed of vehicles."""
REACTION_S, DECEL_MPS2 = 1.0, 4.0
"""Reaction time of SUMO's default drivers, and deceleration of its default trucks, with which
vehicles that are given back stop before crossings and traffic lights."""
OPTION = "--corridor"
NO_LANES: Mapping[str, tuple[int, ...]] = MappingProxyType({})


@frozen
class CorridorEdge:
    """An edge of a corridor."""

    edge: Edge
    from_m: float
    """Where it begins along the corridor."""
    first_lane: int
    """Corridor lane of its lane 0."""

    @property
    def name(self) -> str:
        """Its name."""
        return self.edge.name

    @property
    def to_m(self) -> float:
        """Where it ends along the corridor."""
        return self.from_m + self.edge.length_m

    @property
    def lanes(self) -> range:
        """Numbers of its lanes in the corridor."""
        return range(self.first_lane, self.first_lane + len(self.edge.lanes))

    def lane(self, number: int) -> Lane:
        """Return the lane that is part of a corridor lane."""
        return self.edge.lanes[number - self.first_lane]


@frozen
class Ramp:
    """A lane of an on-ramp, with its acceleration lane."""

    name: str
    """Name of its entrance in scenarios."""
    entrance: str
    """Name of the on-ramp: that of the entrance of its rightmost lane."""
    edge: str
    """Name of the last edge before the corridor."""
    to_edge: str
    """Name of the edge with the acceleration lane."""
    lane: int
    at_m: float
    """Where the ramp begins, as a position along the corridor."""
    merge_m: float
    """Where its acceleration lane begins."""
    speed_mps: float
    """Lowest speed limit of the ramp."""
    path: tuple[Link, ...] = ()
    """Links by which vehicles come to the acceleration lane, the last one first."""


@frozen
class WayOut:
    """An exit: lanes that lead out of the corridor."""

    name: str
    """Its name in scenarios."""
    edge: str
    """Name of the first edge behind the corridor."""
    from_edge: str
    """Name of the edge before."""
    lanes: tuple[int, ...]
    at_m: float


@frozen(slots=False)
class Corridor:
    """A road of lanes that are open from here to there, derived from consecutive edges."""

    network: Network = field(repr=False)
    edges: tuple[CorridorEdge, ...]
    lanes: int
    length_m: float
    lane_width_m: float
    """Width of the narrowest lane."""
    speed_mps: float
    """Lowest speed limit of its lanes."""
    closures: tuple[Closure, ...]
    ramps: tuple[Ramp, ...] = ()
    ways_out: tuple[WayOut, ...] = ()
    lanes_to: Mapping[str, tuple[int, ...]] = NO_LANES
    """The lanes at its end that lead to each edge behind it, or that are next to a turn pocket that
    does; empty: every lane leads to all."""
    unused: tuple[str, ...] = ()
    """Ways into the corridor and out of it that vehicles cannot use, in words."""

    @property
    def name(self) -> str:
        """Its first and its last edge, as in `--corridor`."""
        return f"{self.edges[0].name}:{self.edges[-1].name}"

    def parts(self) -> Iterator[tuple[int, float, float, Lane]]:
        """Yield (lane, from, to [m], SUMO's lane), each with the junction behind it."""
        ends_m = [*(edge.from_m for edge in self.edges[1:]), self.edges[-1].to_m]
        for one, end_m in zip(self.edges, ends_m, strict=True):
            for lane in one.edge.car_lanes:
                yield one.first_lane + lane.index, one.from_m, end_m, lane

    def lane_name(self, lane: int, at_m: float) -> str:
        """Return SUMO's name of the lane at a position, or before it."""
        edge = self.edges[0]
        for one in self.edges:
            if one.from_m < at_m + HANDOVER_M and lane in one.lanes:
                edge = one
        return f"{edge.name}_{lane - edge.first_lane}"

    def opens_m(self, lanes: Collection[int], before_m: float) -> float:
        """Return where the last of some lanes opens before a position; -inf: at the start."""
        opens_m = [one.to_m for one in self.closures if one.lane in lanes and one.to_m < before_m]
        return max(opens_m, default=-math.inf)

    def ends_m(self, lane: int, behind_m: float) -> float:
        """Return where a lane ends behind a position; infinite: it does not end."""
        ends_m = [one.from_m for one in self.closures if one.lane == lane]
        return min((end_m for end_m in ends_m if end_m > behind_m), default=math.inf)

    @property
    def most_changes(self) -> int:
        """Largest number of lane changes that a vehicle may need to reach its lane at the end."""
        ends = {lane for lanes in self.lanes_to.values() for lane in lanes}
        return max((abs(end - lane) for end in ends for lane in self.edges[0].lanes), default=0)

    @cached_property
    def edge_numbers(self) -> Mapping[str, int]:
        """The numbers of its edges, by name."""
        return {edge.name: number for number, edge in enumerate(self.edges)}


def braking_m(speed_mps: float, reaction_s: float = REACTION_S) -> float:
    """Return the distance in which vehicles stop that SUMO drives."""
    return speed_mps * reaction_s + speed_mps**2 / (2.0 * DECEL_MPS2)


def lattice_speed_mps(limit_mps: float) -> float:
    """Return v_F at a speed limit."""
    return limit_mps - min(RESERVE_MPS, RESERVE_SHARE * limit_mps)


def lanes_by_edge(network: Network, last: CorridorEdge) -> dict[str, list[int]]:
    """Return which lanes of a corridor's last edge lead to each edge behind it, in order."""
    found: dict[str, list[int]] = {}
    for lane in last.edge.car_lanes:
        for edge in dict.fromkeys(link.target.edge for link in network.links_from(lane)):
            found.setdefault(edge, []).append(last.first_lane + lane.index)
    return found


def corridor_of(
    network: Network, first: str, last: str, routes: Iterable[Sequence[str]] = ()
) -> Corridor:
    """Return the corridor from one edge to another.

    Args:
        network: the network.
        first: name of its first edge.
        last: name of its last edge.
        routes: routes of all vehicles: edges, in order. A ramp begins with the last edge on which
            vehicles depart, since none may depart between vehicles that have been taken over, and
            behind edges from which some vehicles drive elsewhere or end their routes.

    Raises:
        BadInputError: an edge does not exist, no way leads from the first to the last, or vehicles
            have to give way on it.
    """
    for name in (first, last):
        if name not in network.edges:
            raise BadInputError(OPTION, name, "FIRST_EDGE:LAST_EDGE, two edges of the network")
    way = _way(network, first, last)
    for edge in way:
        if not edge.car_lanes:
            raise BadInputError(OPTION, edge.name, "edges with a lane for cars")
    for before, after in pairwise(way):
        _check_right_of_way(network, before, after)
    return _Derivation(network, way, routes).corridor()


def _way(network: Network, first: str, last: str) -> tuple[Edge, ...]:
    """Return the way with the fewest edges."""
    before = network.reached_from(first)
    if last not in before:
        allowed = "FIRST_EDGE:LAST_EDGE with a way for cars from the first to the last; "
        reached = f"{len(before) - 1} edges can be reached from {first}"
        raise BadInputError(OPTION, f"{first}:{last}", allowed + reached)
    names = [last]
    while before[names[-1]]:
        names.append(before[names[-1]])
    return tuple(network.edges[name] for name in reversed(names))


def _check_right_of_way(network: Network, before: Edge, after: Edge) -> None:
    """Check that vehicles need not give way between two edges."""
    for link in through_links(network, before, after):
        reason = f"its state is {link.state!r}"
        if link.traffic_light:
            reason = f"traffic light {link.traffic_light} controls it"
        elif joins := network.joins(link):
            reason = f"{joins} merges like a zipper, and would need an acceleration lane of its own"
        if network.gives_way_at(link):
            allowed = f"a corridor without crossings: the way to {after.name} has to have priority"
            raise BadInputError(OPTION, before.name, f"{allowed}, but {reason}")


@frozen
class _OpenPart:
    """A part of a corridor lane that is open without interruption."""

    lane: int
    edges: tuple[CorridorEdge, ...]

    @property
    def from_m(self) -> float:
        """Where it begins."""
        return self.edges[0].from_m

    @property
    def to_m(self) -> float:
        """Where it ends."""
        return self.edges[-1].to_m


def _nearest_lanes(lanes: Sequence[int], open_lanes: Collection[int]) -> tuple[int, ...]:
    """Return the open ones of some lanes; if there are none, those nearest to them."""
    usable = open_lanes or lanes
    away = {lane: min(abs(lane - one) for one in lanes) for lane in usable}
    return tuple(sorted(lane for lane in usable if away[lane] == min(away.values())))


class _Derivation:
    """The derivation of one corridor."""

    def __init__(
        self, network: Network, way: tuple[Edge, ...], routes: Iterable[Sequence[str]]
    ) -> None:
        self._network = network
        pairs = {pair for one in routes for pair in pairwise(("", *one, ""))}
        self._continuing = grouped((before, after) for before, after in pairs)
        """Next edges of the vehicles on each edge; "" is before and after their routes."""
        self._names = {edge.name for edge in way}
        self._limit_mps = min(lane.speed_mps for edge in way for lane in edge.car_lanes)
        self._links = [through_links(network, *pair) for pair in pairwise(way)]
        edges = [CorridorEdge(way[0], 0.0, 0)]
        for edge, links in zip(way[1:], self._links, strict=True):
            at_m = edges[-1].to_m + median(link.length_m for link in links)
            edges.append(CorridorEdge(edge, at_m, edges[-1].first_lane - lane_shift(links[0])))
        lowest = min(one.first_lane + lane.index for one in edges for lane in one.edge.car_lanes)
        self._edges = tuple(evolve(one, first_lane=one.first_lane - lowest) for one in edges)
        self._unused: list[str] = []
        self._taken = [MAIN_ENTRANCE, END_OF_ROAD]
        self._entrances: dict[tuple[str, str], str] = {}
        """Names of the rightmost lanes of ramps, by last edge of the ramp and first one behind."""

    def corridor(self) -> Corridor:
        """Return the corridor."""
        parts = sorted(self._parts(), key=lambda part: (part.lane, part.from_m))
        lanes = 1 + max(part.lane for part in parts)
        if lanes > MAX_LANES:
            raise BadInputError(OPTION, f"{lanes} lanes", f"at most {MAX_LANES} lanes")
        found = (self._ramp(part, parts[:number]) for number, part in enumerate(parts))
        ramps = tuple(ramp for ramp in found if ramp is not None)
        last = self._edges[-1].edge
        ways_out = tuple(self._ways_out(parts))
        links = [link for lane in last.car_lanes for link in self._network.links_from(lane)]
        length_m = self._given_back_m(self._edges[-1], links)
        latest_m = max(length_m - POCKET_M - POCKET_S * lattice_speed_mps(self._limit_mps), 0.0)
        early = [part for part in parts if part.from_m <= latest_m]
        lanes_to = self._lanes_to({part.lane for part in early if part.edges[-1].edge is last})
        if lanes_to:
            into = {(ramp.lane, ramp.merge_m) for ramp in ramps}
            parts = [part for part in parts if part in early or (part.lane, part.from_m) in into]
        return Corridor(
            network=self._network,
            edges=self._edges,
            lanes=lanes,
            length_m=length_m,
            lane_width_m=min(lane.width_m for one in self._edges for lane in one.edge.car_lanes),
            speed_mps=self._limit_mps,
            closures=tuple(self._closures(parts, lanes, ramps, ways_out)),
            ramps=ramps,
            ways_out=ways_out,
            lanes_to=lanes_to,
            unused=tuple(self._unused),
        )

    def _lanes_to(self, open_lanes: Collection[int]) -> Mapping[str, tuple[int, ...]]:
        """Return which lanes at the end lead to each edge behind it; none if all do.

        For an edge to which turn pockets alone lead, the lanes nearest to them count.
        """
        last = self._edges[-1]
        found = lanes_by_edge(self._network, last)
        if all(len(lanes) == len(last.edge.car_lanes) for lanes in found.values()):
            return NO_LANES
        return {edge: _nearest_lanes(lanes, open_lanes) for edge, lanes in sorted(found.items())}

    def _given_back_m(self, edge: CorridorEdge, links: Sequence[Link]) -> float:
        """Return where vehicles are given back on an edge, before links that lead out of it.

        Raises:
            BadInputError: the edge is too short for SUMO to brake there.
        """
        brakes_m = braking_m(lattice_speed_mps(min(self._limit_mps, MAX_SPEED_MPS)))
        nearest_m = min((self._gives_way_m(link, brakes_m) for link in links), default=math.inf)
        handover_m = max(HANDOVER_M, brakes_m - nearest_m)
        length_m = edge.to_m - edge.from_m
        if handover_m > length_m:
            allowed = (
                f"at least {handover_m:.0f} m, since vehicles have to give way behind it and brake "
                "there: end the corridor before"
            )
            raise BadInputError(f"{OPTION}, length of {edge.name}", round(length_m, 1), allowed)
        return edge.to_m - handover_m

    def _gives_way_m(self, link: Link, until_m: float) -> float:
        """Return how far behind a link vehicles give way next; infinite: not up to a distance."""
        if not link.has_priority:
            return 0.0
        length_m = link.length_m + link.target.length_m
        if length_m >= until_m:
            return math.inf
        following = self._network.links_from(link.target)
        return length_m + min(
            (self._gives_way_m(one, until_m - length_m) for one in following), default=math.inf
        )

    def _parts(self) -> Iterator[_OpenPart]:
        """Yield the open parts of all corridor lanes."""
        continued = {link.target.name for links in self._links for link in links}
        continuing = {link.origin.name for links in self._links for link in links}
        for number, first in enumerate(self._edges):
            for lane in first.edge.car_lanes:
                if lane.name in continued:
                    continue
                here, last = first.first_lane + lane.index, number
                while self._edges[last].lane(here).name in continuing:
                    last += 1
                yield _OpenPart(here, self._edges[number : last + 1])

    def _ramp(self, part: _OpenPart, before: Sequence[_OpenPart]) -> Ramp | None:
        """Return the ramp at the beginning of a part; note others that merge into it."""
        first, feeding = part.edges[0], list[Link]()
        for one in part.edges:
            for link in self._network.links_to(one.lane(part.lane)):
                if link.origin.edge in self._names or one is self._edges[0]:
                    continue
                if one is first and not feeding:
                    feeding.append(link)
                else:
                    self._unused.append(
                        f"{link.origin.edge} merges into lane {part.lane} at {one.from_m:.0f} m "
                        "without an acceleration lane"
                    )
        if not feeding:
            return None
        length_m, speed_mps, path = self._before(feeding[0])
        ends_m = [one.to_m + BEHIND_EXIT_M for one in before if one.lane == part.lane]
        at_m = max(MIN_AT_M, part.from_m - min(length_m, MAX_RAMP_M), *ends_m)
        edge = feeding[0].origin.edge
        name = self._name(edge)
        entrance = self._entrances.setdefault((edge, first.name), name)
        return Ramp(name, entrance, edge, first.name, part.lane, at_m, part.from_m, speed_mps, path)

    def _name(self, edge: str) -> str:
        """Return a name for an entrance or exit that no other one has."""
        self._taken.append(unique_name(edge, self._taken))
        return self._taken[-1]

    def _before(self, link: Link) -> tuple[float, float, tuple[Link, ...]]:
        """Return length, lowest speed limit and links of the way on which vehicles come to a link.

        It begins where others join, where vehicles depart or have to give way, or where it has
        more lanes. Edges from which vehicles drive elsewhere, or from which not every lane leads
        on, are not part of it.
        """
        length_m, speed_mps, path = 0.0, link.origin.speed_mps, list[Link]()
        seen = set[str]()
        while link.has_priority and link.origin.name not in seen and length_m < MAX_RAMP_M:
            lane = link.origin
            edge, onwards = self._network.edges[lane.edge], link.target.edge
            elsewhere = {*self._continuing.get(edge.name, ())} - {onwards}
            if elsewhere or not self._network.leads_to(edge, onwards):
                break
            seen.add(lane.name)
            path.append(link)
            length_m += lane.length_m + link.length_m
            speed_mps = min(speed_mps, lane.speed_mps)
            before = self._network.links_to(lane)
            departing = edge.name in self._continuing.get("", ())
            if len(before) != 1 or len(edge.car_lanes) > 1 or departing:
                break
            link = before[0]
        return length_m, speed_mps, tuple(path)

    def _ways_out(self, parts: Sequence[_OpenPart]) -> Iterator[WayOut]:
        """Yield the exits; note ways out of lanes that go on."""
        found: dict[tuple[str, str], list[tuple[int, Link]]] = {}
        for part in parts:
            for one in part.edges:
                for link in self._network.links_from(one.lane(part.lane)):
                    if link.target.edge in self._names or one is self._edges[-1]:
                        continue
                    if one is part.edges[-1]:
                        own = found.setdefault((one.name, link.target.edge), [])
                        own.append((part.lane, link))
                        break
                    self._unused.append(
                        f"the way to {link.target.edge} leaves lane {part.lane} at {one.to_m:.0f} "
                        "m without a lane of its own"
                    )
        for one in self._edges:
            for (before, edge), own in found.items():
                if before == one.name:
                    at_m = self._given_back_m(one, [link for _, link in own])
                    lanes = tuple(sorted({lane for lane, _ in own}))
                    yield WayOut(self._name(edge), edge, before, lanes, at_m)

    def _closures(
        self,
        parts: Sequence[_OpenPart],
        lanes: int,
        ramps: Sequence[Ramp],
        ways_out: Sequence[WayOut],
    ) -> Iterator[Closure]:
        """Yield the closed parts of all lanes."""
        exits_m = {(lane, one.from_edge): one.at_m for one in ways_out for lane in one.lanes}
        at_m = {(ramp.lane, ramp.merge_m): ramp.at_m for ramp in ramps}
        for lane in range(lanes):
            closed_m = 0.0
            for part in parts:
                if part.lane == lane:
                    opens_m = at_m.get((lane, part.from_m), part.from_m)
                    if opens_m > closed_m:
                        yield Closure(lane, closed_m, opens_m)
                    closed_m = exits_m.get((lane, part.edges[-1].name), part.to_m)
            if closed_m < self._edges[-1].to_m:
                yield Closure(lane, closed_m)
