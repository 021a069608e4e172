"""Finds what can be a corridor in a network: chains of edges with priority.

These are long ones, and those that end at an intersection, where lanes lead to different edges
(*approaches*).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.corridor import lanes_by_edge
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, corridor_in
from laneweave.sim_bridge.corridors.sumo_network import Edge, Link, Network, through_links
from laneweave.sim_bridge.corridors.sumo_simulation import SumoSimulation

MIN_LANES = 2
MIN_SPEED_MPS = 13.0
MIN_LENGTH_M = 500.0
MIN_APPROACH_MPS = 8.0
MIN_APPROACH_M, USUAL_APPROACH_M = 100.0, 300.0
"""Length of an approach: at least, and usually at most."""
SATURATION_VEH_PER_H = 2100.0
"""Vehicles that pass a green light in an hour, by lane: SUMO's default drivers follow each other
every 1.5 s at 14 m/s, and lose a tenth when they start and dawdle."""
MIN_GREEN_SHARE = 0.01
WORTH_SHARE = 0.95
"""Share of the capacity from which lane changes before the stop line cost time for all."""


@frozen
class Candidate:
    """A chain of edges that may be a corridor."""

    name: str
    """The first and the last edge, as in `--corridor`."""
    found: SumoCorridor | None
    problem: str = ""
    """Why it is none."""

    @property
    def volume_veh_per_h(self) -> float:
        """Number of vehicles per hour that drive through a part of it."""
        return 0.0 if self.found is None else self.found.volume_veh_per_h


def find_corridors(simulation: SumoSimulation) -> list[Candidate]:
    """Return the chains of edges of at least `MIN_LENGTH_M`, the busiest first.

    Each edge continues in the one to which most of its lanes lead, if that one has no other
    predecessor with more lanes.
    """
    found = [
        _candidate(simulation, chain[0].name, chain[-1].name)
        for chain in _chains(simulation.network, MIN_SPEED_MPS)
        if sum(edge.length_m for edge in chain) >= MIN_LENGTH_M
    ]
    return sorted(found, key=lambda one: (-one.volume_veh_per_h, one.name))


@frozen
class Turn:
    """A way out of an approach."""

    edge: str
    lanes: tuple[int, ...]
    volume_veh_per_h: float


@frozen
class Approach:
    """A corridor that ends where its lanes lead to different edges."""

    found: SumoCorridor
    control: str
    """`light`, `gives way` or `priority`."""
    turns: tuple[Turn, ...]
    used_share: float
    """Share of the capacity of its busiest lane that the demand uses, if vehicles spread as well as
    possible over the lanes that suit them; without a light, as if it were always green."""

    @property
    def name(self) -> str:
        """Its first and its last edge, as in `--corridor`."""
        return self.found.corridor.name

    @property
    def is_worth_it(self) -> bool:
        """Whether the demand is so near to the capacity that lane changes cost time for all."""
        return self.used_share >= WORTH_SHARE


def find_approaches(simulation: SumoSimulation) -> list[Approach]:
    """Return the approaches on which vehicles drive, the busiest first.

    An approach is as long as its chain of edges, but no longer than the last ones that together
    have `USUAL_APPROACH_M`.
    """
    found = []
    for chain in _chains(simulation.network, MIN_APPROACH_MPS):
        length_m, first = 0.0, len(chain)
        while first and length_m < USUAL_APPROACH_M:
            first -= 1
            length_m += chain[first].length_m
        if length_m < MIN_APPROACH_M:
            continue
        corridor = _candidate(simulation, chain[first].name, chain[-1].name).found
        if corridor is not None and corridor.corridor.lanes_to and corridor.passes:
            found.append(_approach(corridor))
    return sorted(found, key=lambda one: (-one.found.volume_veh_per_h, one.name))


def _approach(found: SumoCorridor) -> Approach:
    corridor, network = found.corridor, found.corridor.network
    last = corridor.edges[-1]
    routes = (one.vehicle.route for one in found.passes if one.lanes)
    counts = Counter(route[route.index(last.name) + 1] for route in routes)
    per_h = 3600.0 / found.simulation.duration_s
    links = [link for lane in last.edge.car_lanes for link in network.links_from(lane)]
    green = dict.fromkeys(last.lanes, MIN_GREEN_SHARE)
    for link in links:
        lane = last.first_lane + link.origin.index
        green[lane] = max(green[lane], link.green_share)
    turns = tuple(
        Turn(edge, tuple(lanes), per_h * counts[edge])
        for edge, lanes in lanes_by_edge(network, last).items()
    )
    control = "light" if any(link.traffic_light for link in links) else "gives way"
    if all(link.has_priority for link in links):
        control = "priority"
    return Approach(found, control, turns, _used_share(turns, green))


def _used_share(turns: Sequence[Turn], green: Mapping[int, float]) -> float:
    """Return the share of the capacity of the busiest lane that is used.

    The busiest lanes are those of some turns whose vehicles have no other lanes (Hall's theorem);
    these turns are among those all of whose lanes are in a set of neighbouring lanes.
    """
    shares = [0.0]
    for first in green:
        for last in range(first, max(green) + 1):
            lanes = {*range(first, last + 1)}
            volume = sum(turn.volume_veh_per_h for turn in turns if lanes.issuperset(turn.lanes))
            used = {lane for turn in turns for lane in turn.lanes}.intersection(lanes)
            if volume:
                shares.append(volume / sum(SATURATION_VEH_PER_H * green[lane] for lane in used))
    return max(shares)


def _candidate(simulation: SumoSimulation, first: str, last: str) -> Candidate:
    name = f"{first}:{last}"
    try:
        return Candidate(name, corridor_in(simulation, first, last))
    except BadInputError as error:
        return Candidate(name, None, str(error))


def _chains(network: Network, min_speed_mps: float) -> Iterator[list[Edge]]:
    """Yield chains of edges that are fast and wide enough."""
    edges = {name: edge for name, edge in network.edges.items() if _is_wide(edge, min_speed_mps)}

    def links(before: str, after: str) -> Sequence[Link]:
        return through_links(network, edges[before], edges[after])

    following: dict[str, str] = {}
    before: dict[str, str] = {}
    for name, edge in edges.items():
        ahead = [
            after.name
            for after in network.following(edge)
            if after.name in edges and not any(map(network.gives_way_at, links(name, after.name)))
        ]
        if not ahead:
            continue
        after = following[name] = max(ahead, key=lambda one: (len(links(name, one)), one))
        if after not in before or len(links(name, after)) > len(links(before[after], after)):
            before[after] = name
    starts = [name for name in edges if name not in before]
    seen = set[str]()
    for start in (*starts, *edges):  # a ring has no start: it begins with any of its edges
        chain, name = list[str](), start
        while name and name not in seen and (not chain or before[name] == chain[-1]):
            chain.append(name)
            seen.add(name)
            name = following.get(name, "")
        if chain:
            yield [edges[one] for one in chain]


def _is_wide(edge: Edge, min_speed_mps: float) -> bool:
    lanes = edge.car_lanes
    return len(lanes) >= MIN_LANES and min(lane.speed_mps for lane in lanes) >= min_speed_mps
