"""Reads the network of a simulation from SUMO, which has loaded it."""

from __future__ import annotations

import gzip
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from laneweave.sim_bridge.corridors.sumo_network import Edge, Lane, Link, Network
from laneweave.sim_bridge.sumo.simulation import SumoProcess

_SIDES = {"left": 1, "right": -1}
"""SUMO's numbers for the sides to which vehicles change lanes."""


def read_network(sumo: SumoProcess) -> Network:
    """Return the network of a simulation."""
    edges = {
        name: Edge(
            name, tuple(_lane(sumo, f"{name}_{n}") for n in range(sumo.edge.getLaneNumber(name)))
        )
        for name in sumo.edge.getIDList()
        if not name.startswith(":")  # inside a junction
    }
    # libsumo does not say it.
    file = Path(sumo.simulation.getOption("net-file"))
    with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
        _, root = next(ET.iterparse(stream, events=("start",)))  # noqa: S314 (SUMO has read it)
    return Network(edges, tuple(_links(sumo, edges)), root.get("lefthand") == "true")


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
    while via:
        yield _lane(sumo, via)
        via = next((after[4] for after in sumo.lane.getLinks(via)), "")
