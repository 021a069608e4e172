"""SUMO's input files: the network of one straight road, and routes.

The road runs along x: s = x, and the centre line of lane i is at y = (i + 1/2) lane width. SUMO's
edge is longer than the road by `margin_m` at both ends, so that it contains the bodies of vehicles
that enter or leave. The files are written without `netconvert`, which needs a much larger package
than `libsumo`.

If SUMO drives the vehicles, the edge ends with the road, and each lane leads to its own exit: SUMO
moves a vehicle to the lane of its exit before the end of the road.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from laneweave.protocol.scenario.fields import Lc2013Settings, Scenario

EDGE = "road"
ROUTE = "road"
VEHICLE_TYPE = "vehicle"
MIN_MARGIN_M = 30.0
SUBLANE_M = 0.8
"""Lateral resolution of SUMO's sublane model."""


def margin_m(scenario: Scenario) -> float:
    """Return the length by which SUMO's edge exceeds the road at each end [m].

    Vehicles are removed up to one tick's travel beyond the end of the road.
    """
    vehicle = scenario.vehicle
    tick_m = vehicle.max_speed_mps * scenario.runtime.tick_s
    return max(MIN_MARGIN_M, tick_m + vehicle.length_m)


def exit_route(lane: int) -> str:
    """Return the name of the route to the exit of a lane."""
    return f"{ROUTE}-{lane}"


def write_network(scenario: Scenario, folder: Path, *, exits: bool) -> tuple[str, ...]:
    """Write network and route files; return SUMO's command line, program name included.

    Args:
        scenario: road, vehicles and tick.
        folder: target folder, created if necessary.
        exits: whether SUMO drives the vehicles (table `lc2013`) or only displays them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network, routes = folder / "road.net.xml", folder / "road.rou.xml"
    network.write_text("\n".join(_network(scenario, exits=exits)), encoding="utf-8")
    routes.write_text("\n".join(_routes(scenario, exits=exits)), encoding="utf-8")
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


def _network(scenario: Scenario, *, exits: bool) -> Iterator[str]:
    """Yield the lines of the network file: the road's edge, and the edges of exits.

    If SUMO drives, the speed limit is the desired speed v_F. Lanes do not cross.
    """
    road, margin = scenario.road, margin_m(scenario)
    lanes, lane_m, end_m = range(road.lanes), road.lane_width_m, road.length_m
    west_m, east_m, width_m = -margin, end_m + margin, road.lanes * lane_m
    speed_mps = scenario.formation.speed_mps if exits else scenario.vehicle.max_speed_mps

    def lane_of(edge: str, index: int, lane: int, from_m: float, to_m: float) -> str:
        centre_m = scenario.lattice.cell_y_m(lane)
        return (
            f'<lane id="{edge}_{index}" index="{index}" speed="{speed_mps:.6f}"'
            f' length="{to_m - from_m:.6f}" width="{lane_m:.6f}"'
            f' shape="{from_m:.6f},{centre_m:.6f} {to_m:.6f},{centre_m:.6f}"/>'
        )

    def junction(
        name: str, x_m: float, y_m: tuple[float, float], incoming: str, kind: str = "dead_end"
    ) -> str:
        return (
            f'<junction id="{name}" type="{kind}" x="{x_m:.6f}" y="{max(y_m):.6f}"'
            f' incLanes="{incoming}" intLanes=""'
            f' shape="{x_m:.6f},{y_m[0]:.6f} {x_m:.6f},{y_m[1]:.6f}">'
        )

    yield '<net version="1.20">'
    bounds = f"{west_m:.6f},0,{east_m:.6f},{width_m:.6f}"
    yield f'<location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}"'
    yield ' projParameter="!"/>'
    end, edge_end_m = ("end", end_m) if exits else ("east", east_m)
    yield f'<edge id="{EDGE}" from="west" to="{end}" priority="1">'
    yield from (lane_of(EDGE, lane, lane, west_m, edge_end_m) for lane in lanes)
    yield "</edge>"
    if exits:
        for lane in lanes:
            yield f'<edge id="exit{lane}" from="end" to="east{lane}" priority="1">'
            yield lane_of(f"exit{lane}", 0, lane, end_m, east_m)
            yield "</edge>"
    yield junction("west", west_m, (width_m, 0.0), "") + "</junction>"
    incoming = " ".join(f"{EDGE}_{lane}" for lane in lanes)
    if not exits:
        yield junction("east", east_m, (0.0, width_m), incoming) + "</junction>"
    else:
        yield junction("end", end_m, (0.0, width_m), incoming, "priority")
        none = "0" * road.lanes
        for lane in lanes:
            yield f'<request index="{lane}" response="{none}" foes="{none}" cont="0"/>'
        yield "</junction>"
        for lane in lanes:
            sides_m = lane * lane_m, (lane + 1) * lane_m
            yield junction(f"east{lane}", east_m, sides_m, f"exit{lane}_0") + "</junction>"
        for lane in lanes:
            yield f'<connection from="{EDGE}" to="exit{lane}" fromLane="{lane}" toLane="0"'
            yield ' dir="s" state="M"/>'
    yield "</net>"


def _routes(scenario: Scenario, *, exits: bool) -> Iterator[str]:
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
    if exits:
        for lane in range(scenario.road.lanes):
            yield f'<route id="{exit_route(lane)}" edges="{EDGE} exit{lane}"/>'
    else:
        yield f'<route id="{ROUTE}" edges="{EDGE}"/>'
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
