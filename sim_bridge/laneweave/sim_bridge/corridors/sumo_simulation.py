"""A SUMO simulation: its network, and its vehicles as SUMO itself draws them.

SUMO drives the simulation once, with the user's own configuration, and reports each vehicle with
its type, route, stops and departure (`--vehroute-output`). Whatever the configuration describes
(flows, distributions, trips, districts, rerouters, a scale) becomes a list of vehicles, which
laneweave and SUMO alone drive afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

from attrs import field, frozen

from laneweave.protocol.errors import BadInputError, Described
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.sim_bridge.corridors.sumo_config import SumoConfig, read_config
from laneweave.sim_bridge.corridors.sumo_network import Network, read_network
from laneweave.sim_bridge.sumo.simulation import SumoProcess

MAX_DEMAND_S = 7200.0
"""Default length of the time window."""
LATEST_S = 7.0 * 86400.0
"""Time up to which the first departure is looked for."""
LIMITS = ("length_m", "width_m", "max_accel_mps2", "min_accel_mps2")
Attributes = Mapping[str, str]
_NOT_KEPT = frozenset({"id", "type", "depart", "arrival", "fromTaz", "toTaz", "reroute"})
"""Attributes of vehicles in SUMO's output that are written anew, or that routes have replaced."""
_STOP_NOT_KEPT = frozenset(
    {"triggered", "containerTriggered", "expected", "expectedContainers", "permitted"}
    | {"started", "ended", "join", "split", "parkingBadges"}
)
"""Attributes of stops that depend on passengers or other vehicles, or say what has happened."""
_PARKING = 1
"""Flag of stops beside the road."""
_DEFAULT_TYPE = "DEFAULT_VEHTYPE"


@frozen(kw_only=True)
class TimeWindow:
    """When the vehicles of a run depart, and how many of them there are."""

    begin_s: float | None = None
    """None: as the configuration says."""
    duration_s: float = MAX_DEMAND_S
    end_s: float = math.inf
    """Time at which it ends, if the duration does not end before."""
    scale: float | None = None
    """SUMO's factor for the demand; None: as the configuration says."""


WHOLE = TimeWindow()
"""The default time window."""


@frozen
class SumoType:
    """Limits of a type of vehicle, and its class."""

    length_m: float
    width_m: float
    max_accel_mps2: float
    min_accel_mps2: float
    """Hardest braking."""
    max_speed_mps: float
    vehicle_class: str = "passenger"
    """SUMO's class, on which lanes depend in which it may drive."""

    @property
    def limits(self) -> Mapping[str, float]:
        """The limits that a type of a scenario has, too, as it has them."""
        return {name: round(getattr(self, name), 2) for name in LIMITS}


@frozen
class SumoVehicle:
    """A vehicle, from its departure on."""

    name: str
    depart_s: float
    """When it is to depart; infinite: when passengers have come."""
    route: tuple[str, ...]
    """Edges, in order."""
    vehicle_type: SumoType
    type_name: str = ""
    """Name of its type in SUMO."""
    attributes: Attributes = field(factory=dict, eq=False)
    """Further attributes as SUMO has reported them."""
    stops: tuple[Attributes, ...] = ()

    @property
    def speed_factor(self) -> float:
        """Its speed where there is no other vehicle, as a multiple of the limit."""
        return float(self.attributes.get("speedFactor", "1"))

    def element(self, more: Attributes) -> ET.Element:
        """Return the element of a file of routes, with more attributes."""
        depart = f"{self.depart_s:.3f}"
        own = {"id": self.name, "type": self.type_name, "depart": depart}
        found = ET.Element("vehicle", {**self.attributes, **own, **more})
        ET.SubElement(found, "route", {"edges": " ".join(self.route)})
        for stop in self.stops:
            ET.SubElement(found, "stop", dict(stop))
        return found


@frozen
class SumoSimulation:
    """A simulation of the user: its network, and all vehicles that depart in a time window."""

    config: SumoConfig
    network: Network = field(repr=False)
    vehicles: tuple[SumoVehicle, ...]
    """In order of departure."""
    begin_s: float
    end_s: float
    step_s: float = 1.0
    """Length of a step of the configuration."""
    types: str = field(default="", eq=False, repr=False)
    """XML elements of the types."""
    persons: int = 0
    """Number of persons and containers, which are in no run."""

    @property
    def duration_s(self) -> float:
        """Time within which its vehicles depart."""
        return max(self.end_s - self.begin_s, 1.0)

    @property
    def routes(self) -> frozenset[tuple[str, ...]]:
        """The routes of all vehicles: edges, in order."""
        return frozenset(vehicle.route for vehicle in self.vehicles if vehicle.route)

    def write(self, file: Path, departures: Mapping[str, Attributes | None]) -> Mapping[str, str]:
        """Write a file of routes, and return the option that names it.

        Args:
            file: where it is written.
            departures: attributes of vehicles that depart otherwise, by name; None: they do not
                depart.
        """
        with file.open("w", encoding="utf-8") as stream:
            stream.write(f"<routes>\n{self.types}")
            for vehicle in self.vehicles:
                more = departures.get(vehicle.name, {})
                if more is not None and math.isfinite(vehicle.depart_s):
                    stream.write(ET.tostring(vehicle.element(more), encoding="unicode") + "\n")
            stream.write("</routes>\n")
        return {"route-files": str(file)}


_MAX_KEPT = 2
_kept: dict[tuple[Path, TimeWindow, int], tuple[tuple[int, ...], SumoSimulation]] = {}
"""The last simulations, with the times at which their files changed: a command reads one often."""


def read_simulation(file: Path, window: TimeWindow = WHOLE, seed: int = 1) -> SumoSimulation:
    """Read the files of a simulation, and let SUMO draw its vehicles.

    Args:
        file: SUMO's configuration file.
        window: when the vehicles depart.
        seed: seed from which SUMO draws flows and types, unless the configuration has one.

    Raises:
        BadInputError: a file cannot be read, or no vehicle departs in the time window.
        CommandFailedError: libsumo is missing, or SUMO rejects a file.
    """
    key = file.resolve(), window, seed
    changed_ns, simulation = _kept.pop(key, ((), None))
    if simulation is None or simulation.config.changed_ns() != changed_ns:
        with temporary_folder("sumo") as folder:
            config = read_config(file, folder)
            changed_ns, simulation = config.changed_ns(), _draw(config, folder, window, seed)
    _kept[key] = changed_ns, simulation
    for oldest in [*_kept][:-_MAX_KEPT]:
        del _kept[oldest]
    return simulation


def _draw(config: SumoConfig, folder: Path, window: TimeWindow, seed: int) -> SumoSimulation:
    """Let SUMO drive a simulation for the time window, and return it with its vehicles.

    Raises:
        BadInputError: no vehicle departs in the time window.
        CommandFailedError: libsumo is missing, or SUMO rejects a file.
    """
    routes, state = folder / "vehicles.xml", folder / "state.xml"
    options = {
        **config.additional(folder, demand=True),
        "vehroute-output": str(routes),
        "vehroute-output.write-unfinished": "true",
        "vehroute-output.intended-depart": "true",
        "vehroute-output.last-route": "true",
    }
    for name, value in (("begin", window.begin_s), ("scale", window.scale)):
        options |= {} if value is None else {name: f"{value:.10g}"}
    with SumoProcess(config.command(seed, options)) as sumo:
        network = read_network(sumo)
        begin_s, until_s = sumo.simulation.getTime(), sumo.simulation.getEndTime()
        until_s = until_s if until_s > begin_s else math.inf
        end_s = min(begin_s + window.duration_s, window.end_s, until_s)
        # One step more: a vehicle departs in the first step after its time.
        step_s = sumo.simulation.getDeltaT()
        waiting, factors = _drive(sumo, end_s + step_s, min(LATEST_S, until_s))
        sumo.simulation.saveState(str(state))
        types = {name: _type(sumo, name) for name in sumo.vehicletype.getIDList()}
        found = [*_not_departed(sumo, waiting, types)]
        ahead = {name: stops for name in sumo.vehicle.getIDList() if (stops := _stops(sumo, name))}
    persons = 0
    for _, element in ET.iterparse(routes):  # noqa: S314 (SUMO has written it, and closed it)
        persons += element.tag in {"person", "container"}
        if element.tag == "vehicle":
            found.append(_departed(element, types, begin_s, ahead, factors))
            element.clear()
    inside = sorted(
        (one for one in found if one.depart_s < end_s or math.isinf(one.depart_s)),
        key=lambda one: one.depart_s,
    )
    departures_s = [one.depart_s for one in inside if math.isfinite(one.depart_s)]
    if not departures_s:
        first_s = min((one.depart_s for one in found), default=math.inf)
        hint = f"the first one departs at {first_s:.10g} s: --begin {first_s:.10g}"
        raise BadInputError(
            f"demand of {config.file}",
            Described(f"{begin_s:.10g} s to {end_s:.10g} s"),
            "a time in which vehicles depart" + (f"; {hint}" if math.isfinite(first_s) else ""),
        )
    end_s = min(end_s, math.floor(departures_s[-1]) + 1.0)
    elements = _type_elements(state)
    return SumoSimulation(config, network, tuple(inside), begin_s, end_s, step_s, elements, persons)


def _drive(
    sumo: SumoProcess, end_s: float, latest_s: float
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Drive until a time, or until the first vehicle departs if it does so later.

    Returns:
        Vehicles that have been loaded and have not departed, with the times at which they were to
        depart; and the speed factors of those that have departed, which SUMO's output lacks.
    """
    waiting = _due_s(sumo)
    factors: dict[str, float] = {}
    while sumo.simulation.getMinExpectedNumber() > 0:
        if sumo.simulation.getTime() >= (end_s if factors or waiting else latest_s):
            break
        sumo.step()
        waiting |= _due_s(sumo)
        for name in sumo.simulation.getDepartedIDList():
            waiting.pop(name, None)
            factors[name] = sumo.vehicle.getSpeedFactor(name)
    return waiting, factors


def _due_s(sumo: SumoProcess) -> dict[str, float]:
    """Return when the vehicles that have been loaded in the last step are to depart."""
    now_s, loaded = sumo.simulation.getTime(), sumo.simulation.getLoadedIDList()
    # A scale below 1 leaves some of them out at once.
    present = {*sumo.vehicle.getLoadedIDList()} if loaded else ()
    return {name: now_s - sumo.vehicle.getDepartDelay(name) for name in loaded if name in present}


def _type(sumo: SumoProcess, name: str) -> SumoType:
    """Return the limits of a type, and its class."""
    api = sumo.vehicletype
    return SumoType(
        length_m=api.getLength(name),
        width_m=api.getWidth(name),
        max_accel_mps2=api.getAccel(name),
        min_accel_mps2=-max(api.getDecel(name), api.getEmergencyDecel(name)),
        max_speed_mps=api.getMaxSpeed(name),
        vehicle_class=api.getVehicleClass(name),
    )


def _not_departed(
    sumo: SumoProcess, waiting: Mapping[str, float], types: Mapping[str, SumoType]
) -> Iterator[SumoVehicle]:
    """Yield the vehicles that have been loaded and have not departed."""
    present = {*sumo.vehicle.getLoadedIDList()}
    step_s, now_s = sumo.simulation.getDeltaT(), sumo.simulation.getTime()
    pending = {*sumo.simulation.getPendingVehicles()}
    for name, due_s in waiting.items():
        if name not in present:
            continue  # SUMO has given it up
        type_name = sumo.vehicle.getTypeID(name)
        yield SumoVehicle(
            name,
            # Those that wait for passengers are due, but SUMO does not try to insert them.
            round(due_s, 3) if name in pending or due_s > now_s - step_s else math.inf,
            _route(sumo, name),
            types[type_name],
            type_name,
            _with_factor({}, sumo.vehicle.getSpeedFactor(name)),
            _stops(sumo, name),
        )


def _stops(sumo: SumoProcess, name: str) -> tuple[Attributes, ...]:
    """Return the stops that a vehicle has not reached; SUMO's output does not contain them."""
    return tuple(
        {
            "lane": one.lane,
            "startPos": f"{one.startPos:.2f}",
            "endPos": f"{one.endPos:.2f}",
            "duration": f"{max(one.duration, 0.0):g}",
            "parking": f"{bool(one.stopFlags & _PARKING)}".lower(),
        }
        for one in sumo.vehicle.getStops(name)
        if one.arrival < 0.0  # SUMO's time; its output contains those that have been reached
    )


def _route(sumo: SumoProcess, name: str) -> tuple[str, ...]:
    """Return the route of a loaded vehicle; that of a trip is the one that SUMO would choose."""
    given: tuple[str, ...] = tuple(sumo.vehicle.getRoute(name))
    if sumo.vehicle.isRouteValid(name):
        return given
    found = list(given[:1])
    for before, after in pairwise(given):
        path = sumo.simulation.findRoute(before, after, sumo.vehicle.getTypeID(name)).edges
        if not path:
            return given
        found += path[1:]
    return tuple(found)


def _departed(
    element: ET.Element,
    types: Mapping[str, SumoType],
    begin_s: float,
    ahead: Mapping[str, tuple[Attributes, ...]],
    factors: Mapping[str, float],
) -> SumoVehicle:
    """Return a vehicle of SUMO's output.

    Args:
        element: its element.
        types: the types, by name.
        begin_s: when the simulation has begun.
        ahead: stops that vehicles have not reached.
        factors: speed factors, which depend on the vehicle, by its name.
    """
    attributes = {name: value for name, value in element.attrib.items() if name not in _NOT_KEPT}
    if float(attributes.get("departSpeed", "0")) > 0.0:
        # What SUMO has reported is a speed, which may be too high beside other vehicles.
        attributes["departSpeed"] = "max"
    *_, route = element.iter("route")
    name, type_name = element.get("id", ""), element.get("type", _DEFAULT_TYPE)
    return SumoVehicle(
        name,
        _departure_s(element.get("depart", ""), begin_s),
        tuple(route.get("edges", "").split()),
        types[type_name],
        type_name,
        _with_factor(attributes, factors.get(name)),
        (*map(_stop, element.iter("stop")), *ahead.get(name, ())),
    )


def _with_factor(attributes: Attributes, factor: float | None) -> Attributes:
    return attributes if factor is None else {**attributes, "speedFactor": f"{factor:.6g}"}


def _departure_s(text: str, begin_s: float) -> float:
    """Return a time of departure; infinite: it depends on passengers or other vehicles."""
    if text == "begin":
        return begin_s
    try:
        return float(text)
    except ValueError:
        return math.inf


def _stop(element: ET.Element) -> Attributes:
    """Return the attributes of a stop without those that make it wait for passengers."""
    stop = {name: value for name, value in element.attrib.items() if name not in _STOP_NOT_KEPT}
    if not {"duration", "until"} & stop.keys():
        started, ended = (float(element.get(name, "0")) for name in ("started", "ended"))
        stop["duration"] = f"{max(ended - started, 0.0):g}"
    return stop


def _type_elements(state: Path) -> str:
    """Return the XML elements of the types in a state that SUMO has saved."""
    root = ET.parse(state).getroot()  # noqa: S314 (SUMO has written it)
    found = root.findall("vType")
    for kind in found:
        for parameter in kind.findall("param"):
            if parameter.get("key", "").startswith("has.rerouting"):
                kind.remove(parameter)  # routes are those of the first simulation
    return "".join(ET.tostring(kind, encoding="unicode") for kind in found)
