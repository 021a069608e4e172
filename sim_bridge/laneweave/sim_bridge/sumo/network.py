"""SUMO's input files: the network of one straight road, and routes.

The road runs along x: s = x, and the centre line of lane i is at y = (i + 1/2) lane width. SUMO's
edge is longer than the road by `margin_m` at both ends, so that it contains the bodies of vehicles
that enter or leave. The files are written without `netconvert`, which needs a much larger package
than `libsumo`.

If SUMO drives the vehicles, the edges end with the road, and each lane leads to its own exit: SUMO
moves a vehicle to the lane of its exit before the end of the road. Without preferred lanes there
are no exits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Lc2013Settings, Scenario
from laneweave.sim_bridge.sumo.road_edges import Edge, connections, road_edges

ROUTE = "road"
VEHICLE_TYPE = "vehicle"
SUBLANE_M = 0.8
"""Lateral resolution of SUMO's sublane model."""


def exit_route(lane: int) -> str:
    """Return the name of the route to the exit of a lane; `ANY_LANE`: the one without exits."""
    return ROUTE if lane == ANY_LANE else f"{ROUTE}-{lane}"


def write_network(scenario: Scenario, folder: Path, *, exits: bool) -> tuple[str, ...]:
    """Write network and route files; return SUMO's command line, program name included.

    Args:
        scenario: road, vehicles and tick.
        folder: target folder, created if necessary.
        exits: whether SUMO drives the vehicles (table `lc2013`) or only displays them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network, routes = folder / "road.net.xml", folder / "road.rou.xml"
    edges = road_edges(scenario, exits=exits)
    network.write_text("\n".join(_network(scenario, edges, exits=exits)), encoding="utf-8")
    routes.write_text("\n".join(_routes(scenario, edges, exits=exits)), encoding="utf-8")
    settings = scenario.lc2013
    change: tuple[str, ...] = ()
    if exits and settings.model == "SL2015":
        # SUMO accepts only one of the two options.
        change = "--lateral-resolution", f"{SUBLANE_M:.6f}"
    elif exits:
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


def _network(scenario: Scenario, edges: Sequence[Edge], *, exits: bool) -> Iterator[str]:
    """Yield the lines of the network file.

    If SUMO drives, the speed limit is the desired speed v_F. Lanes do not cross.
    """
    lane_m, lanes = scenario.road.lane_width_m, scenario.road.lanes
    west_m, east_m, width_m = edges[0].from_m, edges[-1].to_m, lanes * lane_m
    speed_mps = scenario.formation.speed_mps if exits else scenario.vehicle.max_speed_mps
    yield '<net version="1.20">'
    bounds = f"{west_m:.6f},0,{east_m:.6f},{width_m:.6f}"
    yield f'<location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}"'
    yield ' projParameter="!"/>'
    for edge in edges:
        yield f'<edge id="{edge.name}" from="{edge.origin}" to="{edge.destination}" priority="1">'
        for lane in edge.lanes:
            index, centre_m = edge.index(lane), scenario.lattice.cell_y_m(lane)
            closed = "" if lane in edge.open_lanes else ' disallow="all"'
            yield (
                f'<lane id="{edge.name}_{index}" index="{index}"{closed} speed="{speed_mps:.6f}"'
                f' length="{edge.to_m - edge.from_m:.6f}" width="{lane_m:.6f}"'
                f' shape="{edge.from_m:.6f},{centre_m:.6f} {edge.to_m:.6f},{centre_m:.6f}"/>'
            )
        yield "</edge>"
    yield _junction("west", west_m, (width_m, 0.0))
    connected = list(connections(edges))
    for edge in edges:
        incoming = " ".join(f"{edge.name}_{edge.index(lane)}" for lane in edge.lanes)
        sides_m = edge.lanes[0] * lane_m, (edge.lanes[-1] + 1) * lane_m
        count = sum(before is edge for before, _, _ in connected)
        yield _junction(edge.destination, edge.to_m, sides_m, incoming, count)
    for before, after, lane in connected:
        yield (
            f'<connection from="{before.name}" to="{after.name}"'
            f' fromLane="{before.index(lane)}" toLane="{after.index(lane)}"'
        )
        yield ' dir="s" state="M"/>'
    yield "</net>"


def _junction(
    name: str, x_m: float, y_m: tuple[float, float], incoming: str = "", connected: int = 0
) -> str:
    """Return the lines of a junction with its incoming lanes and its number of connections."""
    none = "0" * connected
    requests = "".join(
        f'\n<request index="{number}" response="{none}" foes="{none}" cont="0"/>'
        for number in range(connected)
    )
    return (
        f'<junction id="{name}" type="{"priority" if connected else "dead_end"}"'
        f' x="{x_m:.6f}" y="{max(y_m):.6f}" incLanes="{incoming}" intLanes=""'
        f' shape="{x_m:.6f},{y_m[0]:.6f} {x_m:.6f},{y_m[1]:.6f}">'
        + (f"{requests}\n" if connected else "")
        + "</junction>"
    )


def _routes(scenario: Scenario, edges: Sequence[Edge], *, exits: bool) -> Iterator[str]:
    """Yield the lines of the route file: the vehicle type, and one route or one per exit.

    Drivers have the same desired speed (speedDev). If SUMO does not drive, `tau` and `minGap` are
    close to zero; the defaults would delay insertions.
    """
    limits = scenario.vehicle
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
    if exits:
        kind |= _driver(scenario.lc2013)
    yield "<routes>"
    yield f'<vType id="{VEHICLE_TYPE}"'
    for name, value in kind.items():
        yield f'{name}="{value}"' if isinstance(value, str) else f'{name}="{value:.6f}"'
    yield "/>"
    by_lane = [edge for edge in edges if edge.origin == "end"]
    road = " ".join(edge.name for edge in edges if edge not in by_lane)
    for edge in by_lane:
        yield f'<route id="{exit_route(edge.lanes[0])}" edges="{road} {edge.name}"/>'
    if not by_lane:
        yield f'<route id="{ROUTE}" edges="{road}"/>'
    yield "</routes>"


def _driver(settings: Lc2013Settings) -> dict[str, float | str]:
    """Return the attributes of the vehicle type that describe SUMO's driver."""
    attributes: dict[str, float | str | None] = {
        "carFollowModel": "Krauss",
        "laneChangeModel": settings.model,
        "tau": settings.headway_s,
        "minGap": settings.min_gap_m,
        "sigma": settings.imperfection,
        "accel": settings.accel_mps2,
        "decel": settings.decel_mps2,
        "lcStrategic": settings.strategic,
        "lcCooperative": settings.cooperative,
        "lcAssertive": settings.assertive,
    }
    return {name: value for name, value in attributes.items() if value is not None}
