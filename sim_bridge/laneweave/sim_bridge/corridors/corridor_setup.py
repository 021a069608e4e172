"""A corridor with everything that a run on it needs, read from the files of a SUMO simulation."""

from __future__ import annotations

from pathlib import Path

from attrs import evolve, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.corridor import OPTION, Corridor, corridor_of
from laneweave.sim_bridge.corridors.corridor_arrivals import CorridorSetup, corridor_arrivals
from laneweave.sim_bridge.corridors.sumo_config import SumoConfig, read_config
from laneweave.sim_bridge.corridors.sumo_demand import CorridorDemand, demand_on, read_demand
from laneweave.sim_bridge.corridors.sumo_network import Network, read_network


@frozen
class SumoCorridor:
    """A corridor of a SUMO simulation, and the vehicles that drive through it."""

    config: SumoConfig
    network: Network
    corridor: Corridor
    demand: CorridorDemand

    def setup(self, scenario: Scenario) -> CorridorSetup:
        """Return the setup of a run, with the vehicles that depart in its time."""
        duration_s = min(self.demand.duration_s, scenario.demand.duration_s)
        latest_s = self.demand.begin_s + duration_s
        passes = tuple(one for one in self.demand.passes if one.vehicle.depart_s <= latest_s)
        demand = evolve(self.demand, passes=passes)
        later = {one.vehicle.name for one in self.demand.passes[len(passes) :]}
        return CorridorSetup(
            self.config,
            self.network,
            self.corridor,
            corridor_arrivals(scenario, demand),
            duration_s,
            self.demand.left_out | later,
        )


def read_corridor(file: Path, name: str, folder: Path, seed: int = 1) -> SumoCorridor:
    """Read the files of a simulation, and derive a corridor.

    Args:
        file: SUMO's configuration file.
        name: the first and the last edge, FIRST_EDGE:LAST_EDGE.
        folder: folder for temporary files.
        seed: seed of SUMO, from which it draws flows and types.

    Raises:
        BadInputError: a file cannot be read, or the edges are not a corridor.
    """
    config = read_config(file)
    network = read_network(config.net_file)
    corridor = corridor_of(network, *_edges_of(name, network))
    demand = demand_on(corridor, read_demand(config, folder, seed))
    return SumoCorridor(config, network, corridor, demand)


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
