"""Finds what can be a corridor in a network: long chains of edges with priority."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.corridor import Corridor, corridor_of, through_links
from laneweave.sim_bridge.corridors.sumo_demand import CorridorDemand, SumoDemand, demand_on
from laneweave.sim_bridge.corridors.sumo_network import Edge, Network

MIN_LANES = 2
MIN_SPEED_MPS = 13.0
MIN_LENGTH_M = 500.0


@frozen
class Candidate:
    """A chain of edges that may be a corridor."""

    name: str
    """The first and the last edge, as in `--corridor`."""
    corridor: Corridor | None
    demand: CorridorDemand | None
    problem: str = ""
    """Why it is none."""

    @property
    def volume_veh_per_h(self) -> float:
        """Number of vehicles per hour that drive through a part of it."""
        if self.demand is None:
            return 0.0
        return 3600.0 * len(self.demand.passes) / max(self.demand.duration_s, 1.0)


def find_corridors(network: Network, demand: SumoDemand) -> list[Candidate]:
    """Return the chains of edges of at least `MIN_LENGTH_M`, the busiest first.

    Each edge continues in the one to which most of its lanes lead, if that one has no other
    predecessor with more lanes.
    """
    found = [
        _candidate(network, demand, chain)
        for chain in _chains(network)
        if sum(edge.length_m for edge in chain) >= MIN_LENGTH_M
    ]
    return sorted(found, key=lambda one: (-one.volume_veh_per_h, one.name))


def _candidate(network: Network, demand: SumoDemand, chain: list[Edge]) -> Candidate:
    name = f"{chain[0].name}:{chain[-1].name}"
    try:
        corridor = corridor_of(network, chain[0].name, chain[-1].name, demand.departing)
    except BadInputError as error:
        return Candidate(name, None, None, str(error))
    return Candidate(name, corridor, demand_on(corridor, demand))


def _chains(network: Network) -> Iterator[list[Edge]]:
    """Yield chains of edges that are fast and wide enough."""
    edges = {name: edge for name, edge in network.edges.items() if _is_main(edge)}
    following = {name: _best(network, edges, edge) for name, edge in edges.items()}
    before: dict[str, str] = {}
    for name, after in following.items():
        if after and (
            after not in before
            or _links(network, edges, name, after) > _links(network, edges, before[after], after)
        ):
            before[after] = name
    starts = [name for name in edges if name not in before]
    seen = set[str]()
    for name in (*starts, *edges):  # a ring has no start: it begins with any of its edges
        if name in seen:
            continue
        chain, after = [edges[name]], following[name]
        seen.add(name)
        while after and before[after] == chain[-1].name and after not in seen:
            chain.append(edges[after])
            seen.add(after)
            after = following[after]
        yield chain


def _is_main(edge: Edge) -> bool:
    lanes = edge.car_lanes
    return len(lanes) >= MIN_LANES and min(lane.speed_mps for lane in lanes) >= MIN_SPEED_MPS


def _best(network: Network, edges: Mapping[str, Edge], edge: Edge) -> str:
    """Return the edge in which an edge continues; empty: none."""
    ahead = [after for after in network.following(edge) if after.name in edges]
    ahead = [after for after in ahead if _has_priority(network, edge, after)]
    return max(
        (after.name for after in ahead),
        key=lambda name: (_links(network, edges, edge.name, name), name),
        default="",
    )


def _has_priority(network: Network, before: Edge, after: Edge) -> bool:
    return all(link.has_priority for link in through_links(network, before, after))


def _links(network: Network, edges: Mapping[str, Edge], before: str, after: str) -> int:
    return len(through_links(network, edges[before], edges[after]))
