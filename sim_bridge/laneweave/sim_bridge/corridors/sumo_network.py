"""Reads SUMO's networks; the only module that imports sumolib."""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from attrs import define, field, frozen

from laneweave.protocol.errors import BadInputError

CARS = "passenger"
"""Class of vehicles that must be allowed in a lane of a corridor."""
IGNORING = "ignoring"
"""Class of vehicles that may drive anywhere."""
_HAS_PRIORITY = "M"
"""State of a link whose vehicles give way to nobody."""
_DEFAULT_LANE_M = 3.2
"""SUMO's width of lanes."""
Point = tuple[float, float]
_Changes = Mapping[str, frozenset[str]]


@frozen
class Lane:
    """A lane of an edge."""

    name: str
    edge: str
    index: int
    """Number in its edge, from the side on which vehicles drive."""
    length_m: float
    width_m: float
    speed_mps: float
    """Speed limit."""
    allows_cars: bool
    shape: tuple[Point, ...] = ()
    """Centre line in the network's coordinates [m]."""
    classes: frozenset[str] = frozenset()
    """Classes of vehicles that may drive in it."""
    changing: Mapping[str, frozenset[str]] = field(factory=dict, eq=False)
    """Classes that may change lanes to a side; absent: all."""

    def allows(self, vehicle_class: str) -> bool:
        """Return whether vehicles of a class may drive in it."""
        return vehicle_class in self.classes or vehicle_class == IGNORING

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
    length_m: float = 0.0
    """Length of the way across the junction."""
    state: str = _HAS_PRIORITY
    """SUMO's letter for the right of way."""
    traffic_light: str = ""
    shape: tuple[Point, ...] = ()
    """Centre line of the way across the junction in the network's coordinates [m]."""
    across: tuple[tuple[str, float], ...] = ()
    """Name and length [m] of the lanes inside the junction, in order."""
    speed_mps: float = math.inf
    """Lowest speed limit inside the junction."""

    @property
    def has_priority(self) -> bool:
        """Whether vehicles give way to nobody."""
        return not self.traffic_light and self.state == _HAS_PRIORITY


@define(slots=False)
class Network:
    """Edges and their links, without the lanes inside junctions."""

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


def read_network(file: Path) -> Network:
    """Read a network file.

    Raises:
        BadInputError: it cannot be read.
    """
    from sumolib import net as sumo_net  # noqa: PLC0415 (slow to import)

    try:
        found = sumo_net.readNet(str(file), withInternal=True, lxml=False)
        left_hand, changing = _side_and_changes(file)
        edges = {edge.getID(): _edge(edge, changing) for edge in found.getEdges(withInternal=False)}
        links = tuple(_links(found, edges))
    except OSError as error:
        raise BadInputError("net-file", str(file), f"a readable file ({error})") from error
    except Exception as error:  # sumolib raises whatever its parsers raise
        raise BadInputError("net-file", str(file), f"a network of SUMO ({error!r})") from error
    if not edges:
        raise BadInputError("net-file", str(file), "a network of SUMO with at least one edge")
    return Network({name: edge for name, edge in edges.items() if edge.lanes}, links, left_hand)


def _side_and_changes(file: Path) -> tuple[bool, Mapping[str, _Changes]]:
    """Return whether vehicles drive on the left, and which may change lanes, by lane.

    sumolib reads neither.
    """
    left_hand, changing = False, dict[str, _Changes]()
    with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
        for _, element in ET.iterparse(stream, events=("start",)):  # noqa: S314 (as sumolib does)
            if element.tag == "net":
                left_hand = element.get("lefthand") == "true"
            if element.tag == "lane":
                own = {
                    side: frozenset(element.attrib[f"change{side.title()}"].split())
                    for side in ("left", "right")
                    if element.get(f"change{side.title()}", "all") != "all"
                }
                changing |= {element.get("id", ""): own} if own else {}
            element.clear()
    return left_hand, changing


def _edge(edge: Any, changing: Mapping[str, _Changes]) -> Edge:  # noqa: ANN401 - sumolib has no types
    return Edge(
        edge.getID(),
        tuple(
            Lane(
                name=lane.getID(),
                edge=edge.getID(),
                index=lane.getIndex(),
                length_m=lane.getLength(),
                width_m=lane.getWidth() if lane.getWidth() > 0.0 else _DEFAULT_LANE_M,
                speed_mps=lane.getSpeed(),
                allows_cars=lane.allows(CARS),
                shape=tuple((point[0], point[1]) for point in lane.getShape()),
                classes=frozenset(lane.getPermissions()),
                changing=changing.get(lane.getID(), {}),
            )
            for lane in edge.getLanes()
        ),
    )


def _links(network: Any, edges: Mapping[str, Edge]) -> Iterable[Link]:  # noqa: ANN401
    """Yield the links of all edges that cars may use."""
    for name, edge in edges.items():
        for lane, found in zip(edge.lanes, network.getEdge(name).getLanes(), strict=True):
            for connection in found.getOutgoing():
                to = connection.getToLane()
                after = edges.get(to.getEdge().getID())  # None: a crossing for pedestrians
                if after and lane.allows_cars and after.lanes[to.getIndex()].allows_cars:
                    across = _lanes_across(network, connection.getViaLaneID())
                    yield Link(
                        lane,
                        after.lanes[to.getIndex()],
                        length_m=sum(one.getLength() for one in across),
                        state=connection.getState(),
                        traffic_light=connection.getTLSID(),
                        shape=tuple(
                            (point[0], point[1]) for one in across for point in one.getShape()
                        ),
                        across=tuple((one.getID(), one.getLength()) for one in across),
                        speed_mps=min((one.getSpeed() for one in across), default=math.inf),
                    )


def _lanes_across(network: Any, via: str) -> list[Any]:  # noqa: ANN401
    """Return the lanes inside a junction, from the first one on."""
    lanes: list[Any] = []
    while via and len(lanes) < 8:  # at most two or three in practice; a loop is a broken file
        lanes.append(network.getLane(via))
        via = next((after.getViaLaneID() for after in lanes[-1].getOutgoing()), "")
    return lanes


def _grouped(pairs: Iterable[tuple[str, Link]]) -> Mapping[str, tuple[Link, ...]]:
    groups: dict[str, list[Link]] = {}
    for name, link in pairs:
        groups.setdefault(name, []).append(link)
    return {name: tuple(links) for name, links in groups.items()}
