"""The files that SUMO starts from: a hand-written network of one straight road, and its route.

The road runs along x: s = x, and lane i has its centre line at y = (i + 1/2) lane width. SUMO's
edge is longer than the road by `margin_m` at both ends, so that the bodies of vehicles that have
just entered, and vehicles that are about to be removed behind the end, lie on it. Writing the
network by hand spares `netconvert`, which comes with a much larger package than `libsumo`.
"""

from __future__ import annotations

from pathlib import Path

from attrs import frozen

from laneweave.protocol.scenario import Scenario

EDGE = "road"
ROUTE = "road"
VEHICLE_TYPE = "vehicle"
LEAST_MARGIN_M = 30.0


@frozen
class NetworkFiles:
    """Where the files are, and the command line that loads them."""

    network: Path
    routes: Path
    options: tuple[str, ...]
    """SUMO's whole argument list, program name first."""


def margin_m(scenario: Scenario) -> float:
    """Return how much further than the road SUMO's edge reaches, at each end.

    A vehicle is removed at the first tick after the end: it may be a tick's way beyond it.
    """
    vehicle = scenario.vehicle
    tick_way_m = vehicle.max_speed_mps * scenario.runtime.tick_s
    return max(LEAST_MARGIN_M, tick_way_m + vehicle.length_m)


def write_network(scenario: Scenario, folder: Path) -> NetworkFiles:
    """Write network and route file of a scenario.

    Args:
        scenario: road, vehicle size and tick.
        folder: where to write; it is made if it is missing.

    Returns:
        The files and SUMO's options.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network, routes = folder / "road.net.xml", folder / "road.rou.xml"
    network.write_text(_network_xml(scenario), encoding="utf-8")
    routes.write_text(_routes_xml(scenario), encoding="utf-8")
    return NetworkFiles(network, routes, _options(scenario, network, routes))


def _network_xml(scenario: Scenario) -> str:
    """Return the network: one edge between two dead ends."""
    road = scenario.road
    width_m = road.lanes * road.lane_width_m
    west_m, east_m = -margin_m(scenario), road.length_m + margin_m(scenario)
    bounds = f"{west_m:.6f},0,{east_m:.6f},{width_m:.6f}"
    lanes = "\n".join(
        f'    <lane id="{EDGE}_{lane}" index="{lane}" speed="{scenario.vehicle.max_speed_mps:.6f}"'
        f' length="{east_m - west_m:.6f}" width="{road.lane_width_m:.6f}"'
        f' shape="{west_m:.6f},{(lane + 0.5) * road.lane_width_m:.6f}'
        f' {east_m:.6f},{(lane + 0.5) * road.lane_width_m:.6f}"/>'
        for lane in range(road.lanes)
    )
    incoming = " ".join(f"{EDGE}_{lane}" for lane in range(road.lanes))
    return f"""<net version="1.20">
  <location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}" projParameter="!"/>
  <edge id="{EDGE}" from="west" to="east" priority="1">
{lanes}
  </edge>
  <junction id="west" type="dead_end" x="{west_m:.6f}" y="{width_m:.6f}" incLanes="" intLanes=""
            shape="{west_m:.6f},{width_m:.6f} {west_m:.6f},0"/>
  <junction id="east" type="dead_end" x="{east_m:.6f}" y="{width_m:.6f}" incLanes="{incoming}"
            intLanes="" shape="{east_m:.6f},0 {east_m:.6f},{width_m:.6f}"/>
</net>
"""


def _routes_xml(scenario: Scenario) -> str:
    """Return the vehicle type and the only route.

    `tau` and `minGap` are next to nothing because SUMO does not drive these vehicles; with its
    defaults it would delay their insertion.
    """
    vehicle = scenario.vehicle
    return f"""<routes>
  <vType id="{VEHICLE_TYPE}" length="{vehicle.length_m:.6f}" width="{vehicle.width_m:.6f}"
         minGap="0" tau="0.1" sigma="0" speedDev="0" maxSpeed="{vehicle.max_speed_mps:.6f}"
         accel="{vehicle.max_accel_mps2:.6f}" decel="{-vehicle.min_accel_mps2:.6f}"
         emergencyDecel="{-vehicle.min_accel_mps2:.6f}"/>
  <route id="{ROUTE}" edges="{EDGE}"/>
</routes>
"""


def _options(scenario: Scenario, network: Path, routes: Path) -> tuple[str, ...]:
    """Return SUMO's argument list."""
    tick_s = scenario.runtime.tick_s
    return (
        *("sumo", "--net-file", str(network), "--route-files", str(routes)),
        *("--step-length", f"{tick_s:.6f}", "--step-method.ballistic", "true"),
        *("--collision.action", "warn", "--collision.mingap-factor", "0"),
        *("--time-to-teleport", "-1", "--default.speeddev", "0"),
        *("--seed", str(scenario.seed % 2**31)),
        *("--no-step-log", "true", "--no-warnings", "true", "--xml-validation", "never"),
        *("--xml-validation.net", "never", "--xml-validation.routes", "never"),
    )
