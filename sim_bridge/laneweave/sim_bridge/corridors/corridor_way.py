"""The way of a corridor through a network: its edges, and the links between their lanes."""

from __future__ import annotations

from collections import Counter, deque

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.sumo_network import Edge, Link, Network

OPTION = "--corridor"


def shortest_way(network: Network, first: str, last: str) -> tuple[Edge, ...]:
    """Return the way with the fewest edges.

    Raises:
        BadInputError: no way leads from the first edge to the last.
    """
    before: dict[str, str] = {first: ""}
    waiting = deque([first])
    while waiting and last not in before:
        name = waiting.popleft()
        for edge in network.following(network.edges[name]):
            if edge.name not in before:
                before[edge.name] = name
                waiting.append(edge.name)
    if last not in before:
        allowed = "FIRST_EDGE:LAST_EDGE with a way for cars from the first to the last; "
        reached = f"{len(before) - 1} edges can be reached from {first}"
        raise BadInputError(OPTION, f"{first}:{last}", allowed + reached)
    names = [last]
    while before[names[-1]]:
        names.append(before[names[-1]])
    return tuple(network.edges[name] for name in reversed(names))


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


def check_right_of_way(network: Network, before: Edge, after: Edge) -> None:
    """Check that vehicles need not give way between two edges.

    Raises:
        BadInputError: they have to give way.
    """
    for link in through_links(network, before, after):
        reason = f"its state is {link.state!r}"
        if link.traffic_light:
            reason = f"traffic light {link.traffic_light} controls it"
        elif joins := network.joins(link):
            reason = f"{joins} merges like a zipper, and would need an acceleration lane of its own"
        if network.gives_way_at(link):
            allowed = f"a corridor without crossings: the way to {after.name} has to have priority"
            raise BadInputError(OPTION, before.name, f"{allowed}, but {reason}")
