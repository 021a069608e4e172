"""Reads a corridor from the files of a SUMO simulation."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.sim_bridge.corridors.corridor import OPTION, corridor_of
from laneweave.sim_bridge.corridors.corridor_setup import SumoCorridor, SumoSimulation
from laneweave.sim_bridge.corridors.network_reading import read_network
from laneweave.sim_bridge.corridors.sumo_config import SumoConfig, read_config
from laneweave.sim_bridge.corridors.sumo_demand import (
    TimeWindow,
    demand_on,
    first_simulation,
    read_demand,
)
from laneweave.sim_bridge.corridors.sumo_network import Network

WHOLE = TimeWindow()
"""The default time window."""


def read_simulation(file: Path, window: TimeWindow = WHOLE, seed: int = 1) -> SumoSimulation:
    """Read the files of a simulation, and let SUMO draw its vehicles.

    Args:
        file: SUMO's configuration file.
        window: when the vehicles depart.
        seed: seed of SUMO, from which it draws flows and types.

    Raises:
        BadInputError: a file cannot be read, or no vehicle departs in the time window.
        CommandFailedError: libsumo is missing, or SUMO rejects a file.
    """
    with temporary_folder("sumo") as folder:
        config = read_config(file, folder)
    changed = tuple(one.stat().st_mtime_ns for one in config.files)
    return _simulation(config, window, seed, changed)


@lru_cache(maxsize=2)
def _simulation(
    config: SumoConfig, window: TimeWindow, seed: int, _changed: tuple[int, ...]
) -> SumoSimulation:
    """Read a simulation; a command reads the same one several times."""
    with temporary_folder("sumo") as folder, first_simulation(config, folder, window, seed) as sumo:
        return SumoSimulation(config, read_network(sumo), read_demand(sumo, config, folder, window))


def read_corridor(file: Path, name: str, window: TimeWindow = WHOLE, seed: int = 1) -> SumoCorridor:
    """Read the files of a simulation, and derive a corridor; see `read_simulation`.

    Args:
        file: SUMO's configuration file.
        name: the first and the last edge, FIRST_EDGE:LAST_EDGE.
        window: when the vehicles depart.
        seed: seed of SUMO, from which it draws flows and types.

    Raises:
        BadInputError: a file cannot be read, the edges are not a corridor, or no vehicle departs in
            the time window.
        CommandFailedError: libsumo is missing, or SUMO rejects a file.
    """
    simulation = read_simulation(file, window, seed)
    network = simulation.network
    first, last = _edges_of(name, network)
    corridor = corridor_of(network, first, last, simulation.demand.departing)
    return SumoCorridor(simulation, corridor, demand_on(corridor, simulation.demand))


def _edges_of(name: str, network: Network) -> tuple[str, str]:
    """Return the first and the last edge that a name of a corridor consists of.

    Names of edges may contain colons.

    Raises:
        BadInputError: it does not consist of two names.
    """
    colons = [place for place, letter in enumerate(name) if letter == ":"]
    pairs = [(name[:place], name[place + 1 :]) for place in colons]
    pairs = [pair for pair in pairs if all(pair)]
    for pair in pairs:
        if all(edge in network.edges for edge in pair):
            return pair
    if len(pairs) != 1:
        raise BadInputError(OPTION, name, "FIRST_EDGE:LAST_EDGE, two edges of the network")
    return pairs[0]
