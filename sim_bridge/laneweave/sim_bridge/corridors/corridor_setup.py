"""The vehicles of a corridor as arrivals on the road of a scenario, and SUMO's command lines.

Vehicles get the names of all vehicles of laneweave, v0001 and so on in order of departure, since
names in SUMO may contain characters that keys of messages must not. Those that depart on the
first edge arrive at the start of the road, in a lane that suits their destination: with an exit,
the lane next to it, and otherwise the one in which they can enter first. Vehicles that come from
other edges arrive at the start or at a ramp; when, and in which lane of the start, is known only
when SUMO has driven them there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

from attrs import frozen

from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.corridors.sumo_config import NO_OPTIONS
from laneweave.sim_bridge.corridors.sumo_corridor import Pass, SumoCorridor
from laneweave.sim_bridge.corridors.sumo_simulation import LIMITS, Attributes, SumoType
from laneweave.sim_bridge.corridors.sumo_statistics import output_options
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.sumo.simulation import SumoProcess

FIRST_ENTRY_S = 1.0
"""Road time before which no vehicle enters, so that agents can be announced."""
MAX_WAIT_S = 600.0
"""Time after the last departure for which vehicles on their way to a ramp are awaited."""
_AT_START = {"departLane": "best", "departPos": "base", "departSpeed": "max"}
"""How vehicles depart at an entrance, whatever their files say: their trips are equally long."""
_FIRST_SIMULATION = ("device.rerouting.", "end", "scale", "begin", "step-length")
"""Options that have determined the vehicles and their routes; they do not apply once more."""


@frozen
class CorridorArrival:
    """A vehicle of SUMO that drives through a corridor."""

    arrival: Arrival
    """At a ramp, its time is that of the departure from its first edge."""
    origin: Pass
    on_ramp: bool
    """Whether it departs on the ramp itself."""
    near: bool
    """Whether it departs near its entrance, on an edge on which vehicles are advised."""


@frozen(slots=False)
class CorridorSetup:
    """A corridor, and its vehicles as arrivals on the road of a scenario."""

    found: SumoCorridor
    scenario: Scenario
    arrivals: tuple[CorridorArrival, ...]
    """In order of departure."""

    @cached_property
    def by_name(self) -> Mapping[str, CorridorArrival]:
        """Its vehicles by their names in SUMO."""
        return {one.origin.vehicle.name: one for one in self.arrivals}

    @property
    def end_s(self) -> float:
        """SUMO's time until which vehicles are awaited."""
        return self.found.simulation.end_s + MAX_WAIT_S

    def drive_alone(
        self, folder: Path, results: Path, progress: Callable[[float], None] = lambda _: None
    ) -> None:
        """Let SUMO drive the same vehicles itself, and write its statistics.

        Those that depart on the corridor's first edge, or on a ramp, do so at its start, in the
        lane that suits them best, whatever their files say: otherwise their trips would not be as
        long as with laneweave.

        Args:
            folder: folder for temporary files.
            results: folder for SUMO's statistics.
            progress: called with the share of the simulated time that has passed.

        Raises:
            SumoUnavailableError: libsumo cannot be loaded.
            SumoFailedError: SUMO rejects a file.
        """
        # After a run of laneweave, SUMO drives on for up to this time (`CorridorWorld.drive_on`).
        begin_s, end_s = self.found.simulation.begin_s, self.end_s + MAX_WAIT_S
        departures = {
            name: _AT_START if one.on_ramp or one.origin.departs_at_start else NO_OPTIONS
            for name, one in self.by_name.items()
        }
        step_s = self.found.simulation.step_s
        awaited = {*self.by_name}
        with SumoProcess(self._command(step_s, folder, results, departures, NO_OPTIONS)) as sumo:
            while awaited and (now_s := sumo.simulation.getTime()) < end_s:
                sumo.step()
                awaited.difference_update(sumo.simulation.getArrivedIDList())
                progress((now_s - begin_s) / (end_s - begin_s))

    def command(self, folder: Path, results: Path | None, more: Mapping[str, str]) -> Sequence[str]:
        """Write the files of a simulation of these vehicles, and return SUMO's command line.

        Those that depart on the first edge are added when they enter.

        Args:
            folder: folder for temporary files.
            results: folder for SUMO's statistics; None: none are written.
            more: further options, by name.
        """
        departures = {
            name: None if one.origin.departs_at_start else self._departure(one)
            for name, one in self.by_name.items()
        }
        return self._command(self.scenario.runtime.tick_s, folder, results, departures, more)

    def _departure(self, one: CorridorArrival) -> Attributes:
        """Return how a vehicle departs outside of the corridor."""
        simulation, vehicle = self.found.simulation, one.origin.vehicle
        depart_s = simulation.begin_s + one.arrival.t_s
        departure = {**(_AT_START if one.on_ramp else NO_OPTIONS), "depart": f"{depart_s:.3f}"}
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
        simulation = self.found.simulation
        departures = {**dict.fromkeys(self.found.left_out), **departures}
        return simulation.config.command(
            self.scenario.seed,
            {
                "begin": f"{simulation.begin_s:.10g}",
                "step-length": f"{step_s:g}",
                "collision.action": "warn",
                **simulation.config.additional(folder, demand=False),
                **simulation.write(folder / "vehicles.rou.xml", departures),
                **more,
                **output_options(results, folder, self.found.corridor.edge_numbers),
            },
            without=_FIRST_SIMULATION,
        )


def setup_of(found: SumoCorridor, scenario: Scenario) -> CorridorSetup:
    """Return the setup of a run.

    Raises:
        BadInputError: the scenario lacks an entrance, exit or type of vehicle.
    """
    return CorridorSetup(found, scenario, tuple(_arrivals(found, scenario)))


def _arrivals(found: SumoCorridor, scenario: Scenario) -> Iterator[CorridorArrival]:
    """Yield the vehicles of a corridor in order of departure."""
    types = _types_in(scenario, found.type_names())
    geometry = scenario.geometry
    entrances = {one.name for one in scenario.entrance}
    corridor, begin_s = found.corridor, found.simulation.begin_s
    on_ramp = {ramp.entrance: {link.origin.edge for link in ramp.path} for ramp in corridor.ramps}
    near = {lane.rpartition("_")[0] for way in found.ways_in for lane in way.lanes}
    near -= corridor.edge_numbers.keys()
    choose = _LaneChoice(scenario)
    for number, one in enumerate(found.passes, start=1):
        vehicle, vehicle_type = one.vehicle, types[one.vehicle.vehicle_type]
        t_s = vehicle.depart_s - begin_s
        if one.upstream:
            point = scenario.road.first_lanes[0]  # which one it is depends on SUMO
        elif one.entrance == MAIN_ENTRANCE:
            point = choose.lane(t_s, one, vehicle_type)
        elif one.entrance in entrances:
            point = geometry.entry_point_of(one.entrance)
        else:
            allowed = f"an entrance {one.entrance}: {vehicle.name} of the simulation needs it"
            raise BadInputError("entrance", sorted(entrances), allowed)
        lane = geometry.entry_points[point].lane
        arrival = Arrival(
            vehicle_name(number),
            lane,
            one.preferred_lane(lane),
            max(t_s, FIRST_ENTRY_S),
            one.destination,
            vehicle_type,
            vehicle.name,
            one.lanes,
            point,
        )
        first = vehicle.route[0]
        departs_on_ramp = first in on_ramp.get(one.entrance, ())
        yield CorridorArrival(arrival, one, departs_on_ramp, near=first in near)


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
        name = given if number else CAR
        equal = [one for one in limits if limits[one] == kind.limits]
        if not equal and name not in limits:
            allowed = f"a type with the limits of {name} in the simulation: {kind.limits}"
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

    def lane(self, t_s: float, way: Pass, vehicle_type: str) -> int:
        """Return the lane of the next vehicle, in which its type may drive."""
        is_closed = partial(self._scenario.road.is_restricted, s_m=0.0, vehicle_type=vehicle_type)
        lanes: Sequence[int] = [lane for lane in self._free_s if not is_closed(lane)]
        lanes = lanes or [*self._free_s]
        if wanted := self._exit_lanes.get(way.destination, way.lanes):
            away = {lane: min(abs(lane - own) for own in wanted) for lane in lanes}
            lanes = [lane for lane in lanes if away[lane] == min(away.values())]
        chosen = min(lanes, key=lambda lane: (max(self._free_s[lane], t_s), -lane))
        self._free_s[chosen] = max(self._free_s[chosen], t_s) + self._spacing_s
        return chosen
