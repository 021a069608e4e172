"""The network of a SUMO simulation: edges, their lanes, and the links between these."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cached_property

from attrs import define, field, frozen

CARS = "passenger"
"""Class of vehicles that must be allowed in a lane of a corridor."""
IGNORING = "ignoring"
"""Class of vehicles that may drive anywhere."""
_HAS_PRIORITY = "M"
"""State of a link whose vehicles give way to nobody."""
Point = tuple[float, float]


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

    @property
    def allows_cars(self) -> bool:
        """Whether cars may drive in it."""
        return self.allows(CARS)

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
        return tuple(lane for lane in self.lanes if lane.allows_cars)


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
        """Whether vehicles give way to nobody."""
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
    def _from(self) -> Mapping[str, tuple[Link, ...]]:
        return _grouped((link.origin.name, link) for link in self.links)

    @cached_property
    def _to(self) -> Mapping[str, tuple[Link, ...]]:
        return _grouped((link.target.name, link) for link in self.links)

    def links_from(self, lane: Lane) -> tuple[Link, ...]:
        """Return the links that begin at the end of a lane."""
        return self._from.get(lane.name, ())

    def links_to(self, lane: Lane) -> tuple[Link, ...]:
        """Return the links that end at the beginning of a lane."""
        return self._to.get(lane.name, ())

    def between(self, before: Edge, after: Edge) -> tuple[Link, ...]:
        """Return the links from an edge to another."""
        links = (link for lane in before.lanes for link in self.links_from(lane))
        return tuple(link for link in links if link.target.edge == after.name)

    def following(self, edge: Edge) -> tuple[Edge, ...]:
        """Return the edges to which an edge has links."""
        names = {link.target.edge: None for lane in edge.lanes for link in self.links_from(lane)}
        return tuple(self.edges[name] for name in names)


def _grouped(pairs: Iterable[tuple[str, Link]]) -> Mapping[str, tuple[Link, ...]]:
    groups: dict[str, list[Link]] = {}
    for name, link in pairs:
        groups.setdefault(name, []).append(link)
    return {name: tuple(links) for name, links in groups.items()}
