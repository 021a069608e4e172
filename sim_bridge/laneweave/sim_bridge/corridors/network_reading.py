"""Reads the network of a simulation from SUMO, which has loaded it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.sumo_config import first_element
from laneweave.sim_bridge.corridors.sumo_network import Edge, Lane, Link, Network
from laneweave.sim_bridge.sumo.simulation import SumoProcess

_MOST_ACROSS = 8
"""Most lanes one after another inside a junction; a loop of them is a broken file."""
_SIDES = {"left": 1, "right": -1}
"""SUMO's numbers for the sides to which vehicles change lanes."""


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
    return Lane(
        name,
        edge,
        int(index),
        api.getLength(name),
        api.getWidth(name),
        api.getMaxSpeed(name),
        tuple(api.getShape(name)),
        frozenset(api.getDisallowed(name)),
        {
            side: frozenset(api.getChangePermissions(name, number))
            for side, number in _SIDES.items()
        },
    )


def _links(sumo: SumoProcess, edges: Mapping[str, Edge]) -> Iterator[Link]:
    """Yield the links of all edges that cars may use."""
    lights = {
        (origin, target): light
        for light in sumo.trafficlight.getIDList()
        for links in sumo.trafficlight.getControlledLinks(light)
        for origin, target, _ in links
    }
    for edge in edges.values():
        for origin in edge.car_lanes:
            for to, _, _, _, via, state, _, _ in sumo.lane.getLinks(origin.name):
                name, _, index = to.rpartition("_")
                if name in edges and edges[name].lanes[int(index)].allows_cars:
                    across = tuple(_across(sumo, via))
                    light = lights.get((origin.name, to), "")
                    yield Link(origin, edges[name].lanes[int(index)], across, state, light)


def _across(sumo: SumoProcess, via: str) -> Iterator[Lane]:
    """Yield the lanes inside a junction, from the first one on."""
    for _ in range(_MOST_ACROSS):
        if not via:
            break
        yield _lane(sumo, via)
        via = next((after[4] for after in sumo.lane.getLinks(via)), "")
