"""Finds what can be a corridor in a network: long chains of edges with priority."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.corridor import through_links
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, corridor_in
from laneweave.sim_bridge.corridors.sumo_network import Edge, Link, Network
from laneweave.sim_bridge.corridors.sumo_simulation import SumoSimulation

MIN_LANES = 2
MIN_SPEED_MPS = 13.0
MIN_LENGTH_M = 500.0


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
        for chain in _chains(simulation.network)
        if sum(edge.length_m for edge in chain) >= MIN_LENGTH_M
    ]
    return sorted(found, key=lambda one: (-one.volume_veh_per_h, one.name))


def _candidate(simulation: SumoSimulation, first: str, last: str) -> Candidate:
    name = f"{first}:{last}"
    try:
        return Candidate(name, corridor_in(simulation, first, last))
    except BadInputError as error:
        return Candidate(name, None, str(error))


def _chains(network: Network) -> Iterator[list[Edge]]:
    """Yield chains of edges that are fast and wide enough."""
    edges = {name: edge for name, edge in network.edges.items() if _is_main(edge)}

    def links(before: str, after: str) -> Sequence[Link]:
        return through_links(network, edges[before], edges[after])

    following: dict[str, str] = {}
    before: dict[str, str] = {}
    for name, edge in edges.items():
        ahead = [
            after.name
            for after in network.following(edge)
            if after.name in edges and all(link.has_priority for link in links(name, after.name))
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


def _is_main(edge: Edge) -> bool:
    lanes = edge.car_lanes
    return len(lanes) >= MIN_LANES and min(lane.speed_mps for lane in lanes) >= MIN_SPEED_MPS
