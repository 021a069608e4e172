"""The vehicles of a SUMO simulation, and those that drive through a corridor.

SUMO itself loads the vehicles, with their routes and the limits of their types, and each is removed
when it is loaded: this takes a fraction of a second, and flows, distributions and trips without
routes mean what they mean to SUMO.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from attrs import frozen

from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.sumo_config import ALL_AT_ONCE, SumoConfig
from laneweave.sim_bridge.sumo.simulation import SumoProcess

STEP_S = 0.1
"""Step with which vehicles are loaded; those of flows depart up to a step earlier."""
MAX_DEMAND_S = 7200.0
"""Maximum time for which vehicles are loaded."""


@frozen
class SumoType:
    """Limits of a type of vehicle."""

    length_m: float
    width_m: float
    max_accel_mps2: float
    min_accel_mps2: float
    """Hardest braking."""
    max_speed_mps: float


@frozen
class SumoVehicle:
    """A vehicle, from its departure on."""

    name: str
    depart_s: float
    """When it is to depart."""
    route: tuple[str, ...]
    """Edges, in order."""
    vehicle_type: SumoType
    vehicle_class: str
    type_name: str = ""
    """Name of its type in SUMO."""


@frozen
class SumoDemand:
    """All vehicles of a simulation."""

    vehicles: tuple[SumoVehicle, ...]
    begin_s: float
    end_s: float
    """Times between which they have been loaded."""


@frozen
class Pass:
    """A vehicle's way through a corridor."""

    vehicle: SumoVehicle
    entrance: str
    """`MAIN_ENTRANCE`, or the last edge of a ramp."""
    destination: str
    """`END_OF_ROAD`, or the first edge of an exit."""
    upstream: str = ""
    """Edge from which it comes to the start; empty: it departs on the first edge, or by a ramp."""


@frozen
class CorridorDemand:
    """The vehicles that drive through a corridor."""

    passes: tuple[Pass, ...]
    """In order of departure."""
    begin_s: float
    duration_s: float
    """Time within which they depart."""
    missing: Mapping[str, int]
    """Number of vehicles that a corridor cannot serve, by reason."""
    left_out: frozenset[str] = frozenset()
    """Their names in SUMO."""


def read_demand(config: SumoConfig, folder: Path, seed: int = 1) -> SumoDemand:
    """Return the vehicles of a simulation, of its first two hours at most.

    Args:
        config: files of the simulation.
        folder: folder for a file with vehicles of additional files.
        seed: SUMO's seed.

    Raises:
        CommandFailedError: libsumo is missing, or SUMO rejects a file.
    """
    files = config.write_demand(folder)
    end_s = min(config.end_s, config.begin_s + MAX_DEMAND_S)
    command = ["sumo", "--net-file", str(config.net_file), "--begin", str(config.begin_s)]
    if files:
        command += ["--route-files", ",".join(map(str, files))]
    command += ["--step-length", f"{STEP_S:g}", "--no-warnings", "true", "--no-step-log", "true"]
    options = {"seed": str(seed % 2**31), **config.options}
    options |= {"ignore-route-errors": "true", "xml-validation": "never", **ALL_AT_ONCE}
    command += [part for name, value in options.items() for part in (f"--{name}", value)]
    vehicles: list[SumoVehicle] = []
    with SumoProcess(command) as sumo:
        while True:
            for name in sumo.simulation.getLoadedIDList():
                vehicles.append(_vehicle(sumo, name))
                sumo.vehicle.remove(name)
            sumo.step()
            loaded, now_s = sumo.simulation.getLoadedIDList(), sumo.simulation.getTime()
            if now_s >= end_s or not (loaded or sumo.simulation.getMinExpectedNumber() > 0):
                break
    vehicles = [one for one in vehicles if one.depart_s < end_s]
    vehicles.sort(key=lambda one: one.depart_s)
    last_s = max((one.depart_s for one in vehicles), default=end_s)
    return SumoDemand(tuple(vehicles), config.begin_s, min(end_s, math.ceil(last_s)))


def _vehicle(sumo: SumoProcess, name: str) -> SumoVehicle:
    api = sumo.vehicle
    # Until they depart, loaded vehicles have a negative delay; those of flows come a step late.
    return SumoVehicle(
        name,
        round(sumo.simulation.getTime() - api.getDepartDelay(name), 3),
        _route(sumo, name),
        SumoType(
            length_m=api.getLength(name),
            width_m=api.getWidth(name),
            max_accel_mps2=api.getAccel(name),
            min_accel_mps2=-max(api.getDecel(name), api.getEmergencyDecel(name)),
            max_speed_mps=api.getMaxSpeed(name),
        ),
        api.getVehicleClass(name),
        api.getTypeID(name),
    )


def _route(sumo: SumoProcess, name: str) -> tuple[str, ...]:
    """Return the route of a loaded vehicle; that of a trip is the one that SUMO would choose."""
    given: tuple[str, ...] = tuple(sumo.vehicle.getRoute(name))
    if sumo.vehicle.isRouteValid(name):
        return given
    found = list(given[:1])
    for before, after in pairwise(given):
        way = sumo.simulation.findRoute(before, after, sumo.vehicle.getTypeID(name)).edges
        if not way:
            return given
        found += way[1:]
    return tuple(found)


def demand_on(corridor: Corridor, demand: SumoDemand) -> CorridorDemand:
    """Return the vehicles whose routes lead through a corridor."""
    passes, missing, left_out = list[Pass](), Counter[str](), set[str]()
    ways_in = {(ramp.edge, ramp.to_edge) for ramp in corridor.ramps}
    ways_out = {(one.from_edge, one.edge) for one in corridor.ways_out}
    numbers = {edge.name: number for number, edge in enumerate(corridor.edges)}
    for vehicle in demand.vehicles:
        found = _pass_of(vehicle, numbers, ways_in, ways_out)
        if isinstance(found, Pass):
            passes.append(found)
        elif found:
            missing[found] += 1
            left_out.add(vehicle.name)
    duration_s = max(demand.end_s - demand.begin_s, 1.0)
    names = frozenset(left_out)
    return CorridorDemand(tuple(passes), demand.begin_s, duration_s, missing, names)


def _pass_of(
    vehicle: SumoVehicle,
    numbers: Mapping[str, int],
    ways_in: Collection[tuple[str, str]],
    ways_out: Collection[tuple[str, str]],
) -> Pass | str:
    """Return a vehicle's way through the corridor, or why it is left out; empty: no contact.

    Args:
        vehicle: the vehicle.
        numbers: number of each edge of the corridor.
        ways_in: (edge before, edge of the corridor) of each ramp.
        ways_out: (edge of the corridor, edge behind) of each exit.
    """
    route = vehicle.route
    inside = [place for place, edge in enumerate(route) if edge in numbers]
    if not inside:
        return ""
    first, last = inside[0], inside[-1]
    if [numbers[route[place]] for place in inside] != [
        *range(numbers[route[first]], numbers[route[first]] + last - first + 1)
    ]:
        return "drive through it twice"
    before = route[first - 1] if first else ""
    after = route[last + 1] if last + 1 < len(route) else ""
    entrance, destination, upstream = MAIN_ENTRANCE, END_OF_ROAD, ""
    if numbers[route[first]] == 0:
        upstream = before
    elif (before, route[first]) in ways_in:
        entrance = before
    else:
        return f"enter from {before}" if before else f"start on {route[first]}"
    if numbers[route[last]] < len(numbers) - 1:
        if (route[last], after) not in ways_out:
            return f"leave to {after}" if after else f"end on {route[last]}"
        destination = after
    return Pass(vehicle, entrance, destination, upstream)


def type_names(passes: Sequence[Pass]) -> dict[SumoType, str]:
    """Return the types with their names, the most frequent first; that is the car.

    Types with equal limits are one. Their names are those of SUMO's classes of vehicles.
    """
    counts = Counter(one.vehicle.vehicle_type for one in passes)
    names: dict[SumoType, str] = {}
    for kind, _ in counts.most_common():
        classes = Counter(
            one.vehicle.vehicle_class for one in passes if one.vehicle.vehicle_type == kind
        )
        name = stem = entrance_name(classes.most_common(1)[0][0])
        number = 2
        while name in names.values():
            name, number = f"{stem}-{number}", number + 1
        names[kind] = name
    return names


def entrance_name(edge: str) -> str:
    """Return the name of an edge as a name of an entrance or exit."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", edge).lstrip("-._") or "edge"
