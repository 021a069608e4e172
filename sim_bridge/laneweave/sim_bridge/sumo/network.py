"""SUMO's input files: the network of one straight road with its ramps and exits, and routes.

The road runs along x: s = x, and the centre line of lane i is at y = (i + 1/2) lane width. SUMO's
edge is longer than the road by `margin_m` at both ends, so that it contains the bodies of vehicles
that enter or leave. The files are written without `netconvert`, which needs a much larger package
than `libsumo`.

If SUMO drives the vehicles, each has a route from its entrance to its exit, and SUMO moves it to a
lane that leads there; see `road_edges`. Ramps and exits are drawn beside the road, in line with
their lanes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Lc2013Settings, Vehicle
from laneweave.sim_bridge.sumo.road_edges import (
    Edge,
    RoadEdges,
    connections,
    road_edges,
    single_edge,
)

NETWORK_FILE = "road.net.xml"
_NO_VEHICLES = "authority"
"""A class of vehicles that do not occur, for lanes that no vehicle may enter or leave sideways."""
SUBLANE_M = 0.8
"""Lateral resolution of SUMO's sublane model."""


def write_network(scenario: Scenario, folder: Path, *, sumo_drives: bool) -> tuple[str, ...]:
    """Write network and route files; return SUMO's command line, program name included.

    Args:
        scenario: road, vehicles and tick.
        folder: target folder, created if necessary.
        sumo_drives: whether SUMO drives the vehicles (table `lc2013`). If not, it displays them on
            one edge with all lanes, and there is one route.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network, routes = folder / NETWORK_FILE, folder / "road.rou.xml"
    edges = road_edges(scenario) if sumo_drives else single_edge(scenario)
    for file, lines in (
        (network, _network(scenario, edges, sumo_drives=sumo_drives)),
        (routes, _routes(scenario, edges, sumo_drives=sumo_drives)),
    ):
        file.write_text("\n".join(lines), encoding="utf-8")
    settings = scenario.lc2013
    change: tuple[str, ...] = ()
    if sumo_drives and settings.model == "SL2015":
        # SUMO accepts only one of the two options.
        change = "--lateral-resolution", f"{SUBLANE_M:.6f}"
    elif sumo_drives:
        change = "--lanechange.duration", f"{settings.lane_change_s:.6f}"
    return (
        *("sumo", "--net-file", str(network), "--route-files", str(routes)),
        *("--step-length", f"{scenario.runtime.tick_s:.6f}", "--step-method.ballistic", "true"),
        *("--collision.action", "warn", "--collision.mingap-factor", "0"),
        *("--time-to-teleport", "-1", "--default.speeddev", "0"),
        *("--seed", str(scenario.seed % 2**31)),
        *("--no-step-log", "true", "--no-warnings", "true", "--xml-validation", "never"),
        *("--xml-validation.net", "never", "--xml-validation.routes", "never"),
        *change,
    )


def _network(scenario: Scenario, edges: RoadEdges, *, sumo_drives: bool) -> Iterator[str]:
    """Yield the lines of the network file.

    If SUMO drives, the speed limit is the desired speed v_F. Lanes do not cross.
    """
    lane_m, lanes = scenario.road.lane_width_m, scenario.road.lanes
    west_m, east_m = min(edge.from_m for edge in edges), max(edge.to_m for edge in edges)
    width_m = lanes * lane_m
    speed_mps = scenario.formation.speed_mps if sumo_drives else scenario.vehicle.max_speed_mps
    yield '<net version="1.20">'
    bounds = f"{west_m:.6f},0,{east_m:.6f},{width_m:.6f}"
    yield f'<location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}"'
    yield ' projParameter="!"/>'
    for edge in edges:
        yield f'<edge id="{edge.name}" from="{edge.origin}" to="{edge.destination}" priority="1">'
        for lane in edge.lanes:
            index, centre_m = edge.index(lane), scenario.lattice.cell_y_m(lane)
            rights = "" if lane in edge.open_lanes else ' disallow="all"'
            for side, beside in (("changeRight", lane - 1), ("changeLeft", lane + 1)):
                if edge.separate & {lane, beside}:
                    rights += f' {side}="{_NO_VEHICLES}"'
            yield (
                f'<lane id="{edge.name}_{index}" index="{index}"{rights} speed="{speed_mps:.6f}"'
                f' length="{edge.to_m - edge.from_m:.6f}" width="{lane_m:.6f}"'
                f' shape="{edge.from_m:.6f},{centre_m:.6f} {edge.to_m:.6f},{centre_m:.6f}"/>'
            )
        yield "</edge>"
    connected = [*connections([*edges])]
    yield from _junctions([*edges], connected, lane_m)
    for before, after, lane in connected:
        yield (
            f'<connection from="{before.name}" to="{after.name}"'
            f' fromLane="{before.index(lane)}" toLane="{after.index(lane)}"'
        )
        yield ' dir="s" state="M"/>'
    yield "</net>"


def _junctions(
    edges: Sequence[Edge], connected: Sequence[tuple[Edge, Edge, int]], lane_m: float
) -> Iterator[str]:
    """Yield the lines of all junctions, each with its incoming lanes and its connections."""
    positions_m = {edge.origin: edge.from_m for edge in edges}
    positions_m |= {edge.destination: edge.to_m for edge in edges}
    for name, x_m in positions_m.items():
        before = [edge for edge in edges if edge.destination == name]
        lanes = [
            lane for edge in edges if name in (edge.origin, edge.destination) for lane in edge.lanes
        ]
        right_m, left_m = min(lanes) * lane_m, (max(lanes) + 1) * lane_m
        incoming = " ".join(
            f"{edge.name}_{edge.index(lane)}" for edge in before for lane in edge.lanes
        )
        count = sum(edge in before for edge, _, _ in connected)
        none = "0" * count
        yield (
            f'<junction id="{name}" type="{"priority" if count else "dead_end"}"'
            f' x="{x_m:.6f}" y="{left_m:.6f}" incLanes="{incoming}" intLanes=""'
            f' shape="{x_m:.6f},{right_m:.6f} {x_m:.6f},{left_m:.6f}">'
        )
        for number in range(count):
            yield f'<request index="{number}" response="{none}" foes="{none}" cont="0"/>'
        yield "</junction>"


def _routes(scenario: Scenario, edges: RoadEdges, *, sumo_drives: bool) -> Iterator[str]:
    """Yield the lines of the route file: types of vehicles, and routes from entrances to exits."""
    yield "<routes>"
    for name, own in scenario.types.items():
        yield f'<vType id="{name}"'
        for key, value in _vehicle_type(scenario, own.limits, sumo_drives=sumo_drives).items():
            yield f'{key}="{value}"' if isinstance(value, str) else f'{key}="{value:.6f}"'
        yield "/>"
    for name, route in edges.routes().items():
        yield f'<route id="{name}" edges="{" ".join(edge.name for edge in route)}"/>'
    yield "</routes>"


def _vehicle_type(
    scenario: Scenario, limits: Vehicle, *, sumo_drives: bool
) -> dict[str, float | str]:
    """Return the attributes of a type of vehicle.

    Drivers have the same desired speed (speedDev). If SUMO does not drive, `tau` and `minGap` are
    close to zero; the defaults would delay insertions.
    """
    kind: dict[str, float | str] = {
        "length": limits.length_m,
        "width": limits.width_m,
        "maxSpeed": limits.max_speed_mps,
        "accel": limits.max_accel_mps2,
        "decel": -limits.min_accel_mps2,
        "emergencyDecel": -limits.min_accel_mps2,
        "tau": 0.1,
        "minGap": 0.0,
        "sigma": 0.0,
        "speedDev": 0.0,
    }
    if sumo_drives:
        kind |= _driver(scenario.lc2013)
        # A driver does not exceed the limits of the vehicle.
        kind["accel"] = min(float(kind["accel"]), limits.max_accel_mps2)
        kind["decel"] = min(float(kind["decel"]), -limits.min_accel_mps2)
    return kind


def _driver(settings: Lc2013Settings) -> dict[str, float | str]:
    """Return the attributes of the vehicle type that describe SUMO's driver."""
    attributes: dict[str, float | str | None] = {
        "carFollowModel": "Krauss",
        "laneChangeModel": settings.model,
        "tau": settings.headway_s,
        "minGap": settings.min_gap_m,
        "sigma": settings.imperfection,
        "speedFactor": settings.speed_factor,
        "accel": settings.accel_mps2,
        "decel": settings.decel_mps2,
        "lcStrategic": settings.strategic,
        "lcCooperative": settings.cooperative,
        "lcAssertive": settings.assertive,
    }
    return {name: value for name, value in attributes.items() if value is not None}
