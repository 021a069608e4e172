"""A corridor with everything that a run on it needs, read from the files of a SUMO simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.corridor import OPTION, Corridor, corridor_of
from laneweave.sim_bridge.corridors.corridor_arrivals import CorridorArrival, corridor_arrivals
from laneweave.sim_bridge.corridors.sumo_config import NO_OPTIONS, SumoConfig, read_config
from laneweave.sim_bridge.corridors.sumo_demand import (
    AT_START,
    Attributes,
    CorridorDemand,
    SumoDemand,
    TimeWindow,
    demand_on,
    read_network_and_demand,
)
from laneweave.sim_bridge.corridors.sumo_network import Network
from laneweave.sim_bridge.corridors.sumo_statistics import output_options
from laneweave.sim_bridge.corridors.ways_in import WayIn, ways_to_ramp, ways_to_start

WHOLE = TimeWindow()
"""The default time window."""
MAX_WAIT_S = 600.0
"""Time after the last departure for which vehicles on their way to a ramp are awaited."""
_FIRST_SIMULATION = ("device.rerouting.", "end", "scale", "begin", "step-length")
"""Options that have determined the vehicles and their routes; they do not apply once more."""


@frozen
class SumoSimulation:
    """A simulation of the user: its network, and its vehicles."""

    config: SumoConfig
    network: Network
    demand: SumoDemand


@frozen(slots=False)
class SumoCorridor:
    """A corridor of a SUMO simulation, and the vehicles that drive through it."""

    simulation: SumoSimulation
    corridor: Corridor
    demand: CorridorDemand

    @cached_property
    def ways_to_start(self) -> Mapping[int, Mapping[str, WayIn]]:
        """The lanes towards the start of the road, by lane of the road and name in SUMO."""
        return ways_to_start(self.simulation.network, self.corridor)

    @cached_property
    def ways_to_ramps(self) -> Mapping[str, Mapping[str, WayIn]]:
        """The lanes towards each ramp, by its name and by their names in SUMO."""
        network, ramps = self.simulation.network, self.corridor.ramps
        return {ramp.name: ways_to_ramp(network, self.corridor, ramp) for ramp in ramps}

    def setup(self, scenario: Scenario) -> CorridorSetup:
        """Return the setup of a run.

        Raises:
            BadInputError: the scenario lacks an entrance, exit or type of vehicle.
        """
        lanes = {
            name
            for ways in (*self.ways_to_start.values(), *self.ways_to_ramps.values())
            for name in ways
        }
        near = {name.rpartition("_")[0] for name in lanes} - self.corridor.edge_numbers.keys()
        begin_s = self.simulation.demand.begin_s
        return CorridorSetup(
            self,
            scenario,
            corridor_arrivals(scenario, self.corridor, self.demand, near, begin_s),
        )


@frozen(slots=False)
class CorridorSetup:
    """A corridor, and its vehicles as arrivals on the road of a scenario."""

    found: SumoCorridor
    scenario: Scenario
    arrivals: tuple[CorridorArrival, ...]

    @cached_property
    def by_name(self) -> Mapping[str, CorridorArrival]:
        """Its vehicles by their names in SUMO."""
        return {one.origin.vehicle.name: one for one in self.arrivals}

    @property
    def end_s(self) -> float:
        """SUMO's time until which vehicles are awaited."""
        return self.found.simulation.demand.end_s + MAX_WAIT_S

    def command_alone(self, folder: Path, results: Path) -> Sequence[str]:
        """Return the command line with which SUMO drives all vehicles; see `command`."""
        departures = {
            name: AT_START if one.on_ramp or one.departs_at_start else NO_OPTIONS
            for name, one in self.by_name.items()
        }
        step_s = self.found.simulation.demand.step_s
        return self._command(step_s, folder, results, departures, NO_OPTIONS)

    def command(self, folder: Path, results: Path | None, more: Mapping[str, str]) -> Sequence[str]:
        """Write the files of a simulation of these vehicles, and return SUMO's command line.

        Those that depart on the first edge are added when they enter.

        Args:
            folder: folder for temporary files.
            results: folder for SUMO's statistics; None: none are written.
            more: further options, by name.
        """
        departures = {
            name: None if one.departs_at_start else self._departure(one)
            for name, one in self.by_name.items()
        }
        return self._command(self.scenario.runtime.tick_s, folder, results, departures, more)

    def _departure(self, one: CorridorArrival) -> Attributes:
        """Return how a vehicle departs outside of the corridor."""
        simulation, vehicle = self.found.simulation, one.origin.vehicle
        depart_s = simulation.demand.begin_s + one.arrival.t_s
        departure = {**(AT_START if one.on_ramp else NO_OPTIONS), "depart": f"{depart_s:.3f}"}
        if one.near:
            # There is no room before the entrance to brake from a higher speed.
            lanes = simulation.network.edges[vehicle.route[0]].car_lanes
            limit_mps = max(lane.speed_mps for lane in lanes)
            factor = min(self.scenario.formation.speed_mps / limit_mps, vehicle.speed_factor)
            departure["speedFactor"] = f"{factor:.4f}"
        return departure

    def _command(
        self,
        step_s: float,
        folder: Path,
        results: Path | None,
        departures: Mapping[str, Attributes | None],
        more: Mapping[str, str],
    ) -> Sequence[str]:
        config, demand = self.found.simulation.config, self.found.simulation.demand
        departures = {**dict.fromkeys(self.found.demand.left_out), **departures}
        return config.command(
            self.scenario.seed,
            {
                "begin": f"{demand.begin_s:.10g}",
                "step-length": f"{step_s:g}",
                "collision.action": "warn",
                **config.additional(folder, demand=False),
                **demand.write(folder / "vehicles.rou.xml", departures),
                **more,
                **output_options(results, folder, self.found.corridor.edge_numbers),
            },
            without=_FIRST_SIMULATION,
        )


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
    with temporary_folder("sumo") as folder:
        return SumoSimulation(config, *read_network_and_demand(config, folder, window, seed))


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
