"""The network of a SUMO simulation: edges, their lanes, and the links between these."""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from attrs import define, field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.sumo.simulation import SumoProcess, first_element

CARS = "passenger"
"""Class of vehicles that must be allowed in a lane of a corridor."""
IGNORING = "ignoring"
"""Class of vehicles that may drive anywhere."""
_HAS_PRIORITY = "M"
"""State of a link whose vehicles have priority over all others."""
ZIPPER = "Z"
"""State of a link whose vehicles pass in turn with those of another one into the same lane."""
_MOST_ACROSS = 8
"""Most lanes one after another inside a junction; a loop of them is a broken file."""
_SIDES = {"left": 1, "right": -1}
"""SUMO's numbers for the sides to which vehicles change lanes."""
Point = tuple[float, float]


_T = TypeVar("_T")


@frozen
class Lane:
    """A lane of an edge, or inside a junction."""

    name: str
    edge: str
    index: int
    """Number in its edge, from the side on which vehicles drive."""
    length_m: float
    width_m: float
    speed_mps: float
    """Speed limit."""
    shape: tuple[Point, ...] = ()
    """Centre line in the network's coordinates [m]."""
    banned: frozenset[str] = frozenset()
    """Classes of vehicles that may not drive in it."""
    changing: Mapping[str, frozenset[str]] = field(factory=dict, eq=False)
    """Classes that may change lanes to a side; absent: all."""

    def allows(self, vehicle_class: str) -> bool:
        """Return whether vehicles of a class may drive in it."""
        return vehicle_class not in self.banned

    def allows_change(self, vehicle_class: str, side: str) -> bool:
        """Return whether vehicles of a class may change lanes to a side, `left` or `right`."""
        classes = self.changing.get(side)
        return classes is None or vehicle_class in classes or vehicle_class == IGNORING


@frozen
class Edge:
    """An edge between two junctions."""

    name: str
    lanes: tuple[Lane, ...]

    @property
    def length_m(self) -> float:
        """Length of each of its lanes."""
        return self.lanes[0].length_m

    @property
    def car_lanes(self) -> tuple[Lane, ...]:
        """Lanes that cars may use."""
        return tuple(lane for lane in self.lanes if lane.allows(CARS))


@frozen
class Link:
    """A connection of lanes of different edges."""

    origin: Lane
    target: Lane
    across: tuple[Lane, ...] = ()
    """The lanes inside the junction, in order."""
    state: str = _HAS_PRIORITY
    """SUMO's letter for the right of way."""
    traffic_light: str = ""
    green_share: float = 1.0
    """Share of the time in which the traffic light is green."""

    @property
    def length_m(self) -> float:
        """Length of the way across the junction."""
        return sum(lane.length_m for lane in self.across)

    @property
    def speed_mps(self) -> float:
        """Lowest speed limit inside the junction."""
        return min((lane.speed_mps for lane in self.across), default=math.inf)

    @property
    def has_priority(self) -> bool:
        """Whether its vehicles have priority over all others, without a traffic light."""
        return not self.traffic_light and self.state == _HAS_PRIORITY


@define(slots=False)
class Network:
    """Edges and their links."""

    edges: Mapping[str, Edge]
    links: tuple[Link, ...] = field(factory=tuple)
    """Links that cars may use."""
    left_hand: bool = False
    """Whether vehicles drive on the left: lanes are numbered from the left."""

    @cached_property
    def _from(self) -> Mapping[str, list[Link]]:
        return grouped((link.origin.name, link) for link in self.links)

    @cached_property
    def _to(self) -> Mapping[str, list[Link]]:
        return grouped((link.target.name, link) for link in self.links)

    def links_from(self, lane: Lane) -> Sequence[Link]:
        """Return the links that begin at the end of a lane."""
        return self._from.get(lane.name, ())

    def links_to(self, lane: Lane) -> Sequence[Link]:
        """Return the links that end at the beginning of a lane."""
        return self._to.get(lane.name, ())

    def between(self, before: Edge, after: Edge) -> tuple[Link, ...]:
        """Return the links from an edge to another."""
        links = (link for lane in before.lanes for link in self.links_from(lane))
        return tuple(link for link in links if link.target.edge == after.name)

    def joins(self, link: Link) -> str:
        """Return the edge whose lane merges like a zipper into the one to which a link leads.

        Empty: there is none, or two lanes of an edge merge, of which one can count as ending there.
        """
        others = {each.origin.edge for each in self.links_to(link.target)} - {link.origin.edge}
        return min(others, default="") if link.state == ZIPPER else ""

    def leads_to(self, edge: Edge, after: str) -> bool:
        """Return whether each lane of an edge leads to another edge."""
        ways = [{link.target.edge for link in self.links_from(one)} for one in edge.car_lanes]
        return all(after in names for names in ways)

    def gives_way_at(self, link: Link) -> bool:
        """Return whether vehicles on a corridor have to give way at a link of it."""
        is_drop = link.state == ZIPPER and not link.traffic_light and not self.joins(link)
        return not (is_drop or link.has_priority)

    def reached_from(self, first: str) -> Mapping[str, str]:
        """Return the edges that can be reached from an edge, each with the one before it.

        The edge before the first one is empty; ways have as few edges as possible.
        """
        before, waiting = {first: ""}, deque([first])
        while waiting:
            name = waiting.popleft()
            for edge in self.following(self.edges[name]):
                if edge.name not in before:
                    before[edge.name] = name
                    waiting.append(edge.name)
        return before

    def following(self, edge: Edge) -> tuple[Edge, ...]:
        """Return the edges to which an edge has links."""
        names = {link.target.edge: None for lane in edge.lanes for link in self.links_from(lane)}
        return tuple(self.edges[name] for name in names)


def through_links(network: Network, before: Edge, after: Edge) -> tuple[Link, ...]:
    """Return the links by which lanes of an edge continue in the next one.

    Their lanes are all shifted by the same number, the most frequent one; of several such numbers,
    the one nearest to 0.
    """
    links = network.between(before, after)
    counts = Counter(lane_shift(link) for link in links)
    shift = min(counts, key=lambda one: (-counts[one], abs(one), one))
    return tuple(link for link in links if lane_shift(link) == shift)


def lane_shift(link: Link) -> int:
    """Return by how many lanes the number of the next lane is higher."""
    return link.target.index - link.origin.index


def grouped(pairs: Iterable[tuple[str, _T]]) -> Mapping[str, list[_T]]:
    """Return the second values of pairs by the first ones."""
    groups: dict[str, list[_T]] = {}
    for name, item in pairs:
        groups.setdefault(name, []).append(item)
    return groups


def unique_name(name: str, taken: Collection[str]) -> str:
    """Return a name in the characters that scenarios allow, different from all that are taken."""
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip("-._") or "edge"
    stem = stem.replace("lane-", "lane_", 1)  # exits at the end of the road have such names
    found, number = stem, 2
    while found in taken:
        found, number = f"{stem}-{number}", number + 1
    return found


def read_network(sumo: SumoProcess) -> Network:
    """Return the network of a simulation.

    Raises:
        BadInputError: it has no edges.
    """
    edges = {
        name: Edge(
            name, tuple(_lane(sumo, f"{name}_{n}") for n in range(sumo.edge.getLaneNumber(name)))
        )
        for name in sumo.edge.getIDList()
        if not name.startswith(":")  # inside a junction
    }
    file = Path(sumo.simulation.getOption("net-file"))
    if not edges:
        raise BadInputError("net-file", str(file), "a network of SUMO with at least one edge")
    # libsumo does not tell on which side vehicles drive.
    left_hand = first_element("net-file", file).get("lefthand") == "true"
    return Network(edges, tuple(_links(sumo, edges)), left_hand)


def _lane(sumo: SumoProcess, name: str) -> Lane:
    edge, _, index = name.rpartition("_")
    api = sumo.lane
    sizes = api.getLength(name), api.getWidth(name), api.getMaxSpeed(name)
    shape, banned = tuple(api.getShape(name)), frozenset(api.getDisallowed(name))
    changing = {
        side: frozenset(api.getChangePermissions(name, number)) for side, number in _SIDES.items()
    }
    return Lane(name, edge, int(index), *sizes, shape, banned, changing)


def _links(sumo: SumoProcess, edges: Mapping[str, Edge]) -> Iterator[Link]:
    """Yield the links of all edges that cars may use."""
    lights = {
        (origin, target): (light, share)
        for light in sumo.trafficlight.getIDList()
        for links, share in zip(
            sumo.trafficlight.getControlledLinks(light), _green_shares(sumo, light), strict=False
        )
        for origin, target, _ in links
    }
    for edge in edges.values():
        for origin in edge.car_lanes:
            for to, _, _, _, via, state, _, _ in sumo.lane.getLinks(origin.name):
                name, _, index = to.rpartition("_")
                if name in edges and edges[name].lanes[int(index)].allows(CARS):
                    across = tuple(_across(sumo, via))
                    light, share = lights.get((origin.name, to), ("", 1.0))
                    target = edges[name].lanes[int(index)]
                    yield Link(origin, target, across, state, light, share)


def _green_shares(sumo: SumoProcess, light: str) -> Sequence[float]:
    """Return for each link of a traffic light how much of the time it is green."""
    api = sumo.trafficlight
    current = api.getProgram(light)
    phases = [
        (phase.duration, phase.state)
        for program in api.getAllProgramLogics(light)
        if program.programID == current
        for phase in program.phases
    ]
    cycle_s = sum(duration_s for duration_s, _ in phases)
    if cycle_s <= 0.0:
        return [1.0] * len(api.getControlledLinks(light))
    states = zip(*(state for _, state in phases), strict=False)
    return [
        sum(duration_s for (duration_s, _), one in zip(phases, link, strict=True) if one in "GgOo")
        / cycle_s
        for link in states
    ]


def _across(sumo: SumoProcess, via: str) -> Iterator[Lane]:
    """Yield the lanes inside a junction, from the first one on."""
    for _ in range(_MOST_ACROSS):
        if not via:
            break
        yield _lane(sumo, via)
        via = next((after[4] for after in sumo.lane.getLinks(via)), "")
