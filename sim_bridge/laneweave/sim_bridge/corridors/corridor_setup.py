"""A corridor of a SUMO simulation with all that a run on it needs, and its vehicles as arrivals.

Vehicles get the names of all vehicles of laneweave, v0001 and so on in order of departure, since
names in SUMO may contain characters that keys of messages must not. Those that depart on the
first edge arrive at the start of the road, in a lane that suits their destination: with an exit,
the lane next to it, and otherwise the one in which they can enter first. Vehicles that come from
other edges arrive at the start or at a ramp; when, and in which lane of the start, is known only
when SUMO has driven them there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

from attrs import frozen

from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.sumo_config import NO_OPTIONS, SumoConfig
from laneweave.sim_bridge.corridors.sumo_demand import (
    AT_START,
    LIMITS,
    Attributes,
    CorridorDemand,
    Pass,
    SumoDemand,
    SumoType,
    type_names,
)
from laneweave.sim_bridge.corridors.sumo_network import Network
from laneweave.sim_bridge.corridors.sumo_statistics import output_options
from laneweave.sim_bridge.corridors.ways_in import WayIn, ways_to_ramp, ways_to_start
from laneweave.sim_bridge.road.demand import Arrival

FIRST_ENTRY_S = 1.0
"""Road time before which no vehicle enters, so that agents can be announced."""
MAX_WAIT_S = 600.0
"""Time after the last departure for which vehicles on their way to a ramp are awaited."""
_FIRST_SIMULATION = ("device.rerouting.", "end", "scale", "begin", "step-length")
"""Options that have determined the vehicles and their routes; they do not apply once more."""


@frozen
class CorridorArrival:
    """A vehicle of SUMO that drives through a corridor."""

    arrival: Arrival
    """At a ramp, its time is that of the departure from its first edge."""
    origin: Pass
    on_ramp: bool = False
    """Whether it departs on the ramp itself."""
    near: bool = False
    """Whether it departs near its entrance, on an edge on which vehicles are advised."""

    @property
    def departs_at_start(self) -> bool:
        """Whether it departs on the first edge of the corridor; others come from outside."""
        return self.origin.entrance == MAIN_ENTRANCE and not self.origin.upstream


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
        return CorridorSetup(self, scenario, _arrivals(self, scenario))


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


def _arrivals(found: SumoCorridor, scenario: Scenario) -> tuple[CorridorArrival, ...]:
    """Return the vehicles of a corridor in order of departure.

    Raises:
        BadInputError: the scenario lacks an entrance, exit or type of vehicle.
    """
    types = _types_in(scenario, type_names(found.demand.passes))
    lanes = {entrance.name: entrance.lane for entrance in scenario.entrance}
    corridor, begin_s = found.corridor, found.simulation.demand.begin_s
    on_ramp = {ramp.name: {link.origin.edge for link in ramp.path} for ramp in corridor.ramps}
    ways = (*found.ways_to_start.values(), *found.ways_to_ramps.values())
    near = {lane.rpartition("_")[0] for way in ways for lane in way} - corridor.edge_numbers.keys()
    choose = _LaneChoice(scenario)
    arrivals = []
    for number, one in enumerate(found.demand.passes, start=1):
        t_s = one.vehicle.depart_s - begin_s
        if one.upstream:
            lane = scenario.road.first_lanes[0]  # which one it is depends on SUMO
        elif one.entrance == MAIN_ENTRANCE:
            lane = choose.lane(t_s, one.destination, types[one.vehicle.vehicle_type])
        elif one.entrance in lanes:
            lane = lanes[one.entrance]
        else:
            allowed = f"an entrance {one.entrance}: {one.vehicle.name} of the simulation needs it"
            raise BadInputError("entrance", [*lanes], allowed)
        arrival = Arrival(
            vehicle_name(number),
            lane,
            ANY_LANE,
            max(t_s, FIRST_ENTRY_S),
            one.destination,
            types[one.vehicle.vehicle_type],
            one.vehicle.name,
        )
        first = one.vehicle.route[0]
        departs_on_ramp = first in on_ramp.get(one.entrance, ())
        arrivals.append(CorridorArrival(arrival, one, departs_on_ramp, near=first in near))
    return tuple(arrivals)


def _types_in(scenario: Scenario, names: Mapping[SumoType, str]) -> Mapping[SumoType, str]:
    """Return the scenario's type for each type of SUMO: the one with the same limits.

    Which type is the most frequent one, and so has the name `car`, depends on the time window. A
    type with other limits, which the user has changed, is found by its name.

    Raises:
        BadInputError: there is none.
    """
    limits = {
        name: {field: getattr(own.limits, field) for field in LIMITS}
        for name, own in scenario.types.items()
    }
    found = {}
    for number, (kind, given) in enumerate(names.items()):
        name, own = given if number else CAR, kind.limits
        equal = [one for one in limits if limits[one] == own]
        if not equal and name not in limits:
            allowed = f"a type with the limits of {name} in the simulation: {own}"
            raise BadInputError("vehicle_type", [*limits], allowed)
        found[kind] = name if name in equal or not equal else equal[0]
    return found


class _LaneChoice:
    """Chooses lanes at the start of the road."""

    def __init__(self, scenario: Scenario) -> None:
        self._spacing_s = scenario.formation.entry_spacing_s
        self._free_s: dict[int, float] = dict.fromkeys(scenario.road.first_lanes, 0.0)
        """When the next vehicle can enter, by lane."""
        self._scenario = scenario
        self._exit_lanes = {each.name: each.lanes for each in scenario.exit}

    def lane(self, t_s: float, destination: str, vehicle_type: str) -> int:
        """Return the lane of the next vehicle, in which its type may drive."""
        is_closed = partial(self._scenario.road.is_restricted, s_m=0.0, vehicle_type=vehicle_type)
        lanes: Sequence[int] = [lane for lane in self._free_s if not is_closed(lane)]
        lanes = lanes or [*self._free_s]
        if destination in self._exit_lanes:
            nearest = self._exit_lanes[destination]
            lanes = [min(lanes, key=lambda lane: min(abs(lane - own) for own in nearest))]
        chosen = min(lanes, key=lambda lane: (max(self._free_s[lane], t_s), -lane))
        self._free_s[chosen] = max(self._free_s[chosen], t_s) + self._spacing_s
        return chosen
