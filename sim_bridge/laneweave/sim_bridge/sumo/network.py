"""SUMO's input files: hand-written networks of one straight road, and its routes.

The road runs along x: s = x, and lane i has its centre line at y = (i + 1/2) lane width. SUMO's
edge is longer than the road by `margin_m` at both ends, so that the bodies of vehicles that have
just entered, and vehicles that are about to be removed behind the end, lie on it. Writing the
network directly avoids `netconvert`, which needs a much larger package than `libsumo`.

Where SUMO drives (`write_network_with_exits`) the edge ends with the road, and behind it each lane
has an exit of its own: SUMO chooses the lane of a vehicle's exit before the road ends.
"""

from __future__ import annotations

from pathlib import Path

from laneweave.protocol.scenario.tables import Scenario

EDGE = "road"
ROUTE = "road"
VEHICLE_TYPE = "vehicle"
MIN_MARGIN_M = 30.0


def margin_m(scenario: Scenario) -> float:
    """Return by how much SUMO's edge exceeds the road at each end.

    A vehicle is removed at the first tick after the end: it may have driven one tick beyond it.
    """
    vehicle = scenario.vehicle
    tick_m = vehicle.max_speed_mps * scenario.runtime.tick_s
    return max(MIN_MARGIN_M, tick_m + vehicle.length_m)


def exit_route(lane: int) -> str:
    """Return the name of the route that leaves the road on a lane."""
    return f"{ROUTE}-{lane}"


def write_network(scenario: Scenario, folder: Path) -> tuple[str, ...]:
    """Write network and route file of a road on which SUMO drives no vehicle.

    Args:
        scenario: road, vehicle size and tick.
        folder: target folder; created if missing.

    Returns:
        SUMO's argument list, program name first.
    """
    return _write(scenario, folder, _network_xml(scenario), _routes_xml(scenario))


def write_network_with_exits(scenario: Scenario, folder: Path) -> tuple[str, ...]:
    """Write network and route file of a road on which SUMO drives, with LC2013 and Krauss.

    Args:
        scenario: road, vehicles, tick, and the table `lc2013`.
        folder: target folder; created if missing.

    Returns:
        SUMO's argument list, program name first.
    """
    options = _write(scenario, folder, _exits_network_xml(scenario), _exits_routes_xml(scenario))
    duration = ("--lanechange.duration", f"{scenario.lc2013.lane_change_s:.6f}")
    return (*options, *duration)


def _write(scenario: Scenario, folder: Path, network_xml: str, routes_xml: str) -> tuple[str, ...]:
    folder.mkdir(parents=True, exist_ok=True)
    network, routes = folder / "road.net.xml", folder / "road.rou.xml"
    network.write_text(network_xml, encoding="utf-8")
    routes.write_text(routes_xml, encoding="utf-8")
    return _options(scenario, network, routes)


def _network_xml(scenario: Scenario) -> str:
    """Return the network: one edge between two dead ends."""
    road, margin = scenario.road, margin_m(scenario)
    width_m = road.lanes * road.lane_width_m
    west_m, east_m = -margin, road.length_m + margin
    incoming = " ".join(f"{EDGE}_{lane}" for lane in range(road.lanes))
    return f"""<net version="1.20">
  {_location_xml(scenario)}
  <edge id="{EDGE}" from="west" to="east" priority="1">
{_lanes_xml(scenario, west_m, east_m, scenario.vehicle.max_speed_mps)}
  </edge>
  {_entrance_xml(scenario)}
  <junction id="east" type="dead_end" x="{east_m:.6f}" y="{width_m:.6f}" incLanes="{incoming}"
            intLanes="" shape="{east_m:.6f},0 {east_m:.6f},{width_m:.6f}"/>
</net>
"""


def _exits_network_xml(scenario: Scenario) -> str:
    """Return the network: one edge, and behind it one more for each lane.

    The lanes' speed limit is the desired speed v_F; no lane crosses another.
    """
    road, margin = scenario.road, margin_m(scenario)
    speed_mps = scenario.formation.speed_mps
    width_m, end_m = road.lanes * road.lane_width_m, road.length_m
    west_m, east_m = -margin, end_m + margin
    lanes = range(road.lanes)
    incoming = " ".join(f"{EDGE}_{lane}" for lane in lanes)
    none = "0" * road.lanes
    exits = "".join(
        f"""  <edge id="exit{lane}" from="end" to="east{lane}" priority="1">
{_lane_xml(scenario, f"exit{lane}", 0, lane, end_m, east_m, speed_mps)}
  </edge>
"""
        for lane in lanes
    )
    requests = "\n".join(
        f'    <request index="{lane}" response="{none}" foes="{none}" cont="0"/>' for lane in lanes
    )
    dead_ends = "\n".join(
        f'  <junction id="east{lane}" type="dead_end" x="{east_m:.6f}"'
        f' y="{(lane + 1) * road.lane_width_m:.6f}" incLanes="exit{lane}_0" intLanes=""'
        f' shape="{east_m:.6f},{lane * road.lane_width_m:.6f}'
        f' {east_m:.6f},{(lane + 1) * road.lane_width_m:.6f}"/>'
        for lane in lanes
    )
    connections = "\n".join(
        f'  <connection from="{EDGE}" to="exit{lane}" fromLane="{lane}" toLane="0" dir="s"'
        ' state="M"/>'
        for lane in lanes
    )
    return f"""<net version="1.20">
  {_location_xml(scenario)}
  <edge id="{EDGE}" from="west" to="end" priority="1">
{_lanes_xml(scenario, west_m, end_m, speed_mps)}
  </edge>
{exits}  {_entrance_xml(scenario)}
  <junction id="end" type="priority" x="{end_m:.6f}" y="{width_m:.6f}" incLanes="{incoming}"
            intLanes="" shape="{end_m:.6f},0 {end_m:.6f},{width_m:.6f}">
{requests}
  </junction>
{dead_ends}
{connections}
</net>
"""


def _location_xml(scenario: Scenario) -> str:
    road, margin = scenario.road, margin_m(scenario)
    width_m = road.lanes * road.lane_width_m
    bounds = f"{-margin:.6f},0,{road.length_m + margin:.6f},{width_m:.6f}"
    return (
        f'<location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}"'
        ' projParameter="!"/>'
    )


def _entrance_xml(scenario: Scenario) -> str:
    """Return the dead end where the road begins."""
    west_m, width_m = -margin_m(scenario), scenario.road.lanes * scenario.road.lane_width_m
    return (
        f'<junction id="west" type="dead_end" x="{west_m:.6f}" y="{width_m:.6f}" incLanes=""'
        f' intLanes="" shape="{west_m:.6f},{width_m:.6f} {west_m:.6f},0"/>'
    )


def _lanes_xml(scenario: Scenario, west_m: float, east_m: float, speed_mps: float) -> str:
    """Return the lanes of the road's edge."""
    return "\n".join(
        _lane_xml(scenario, EDGE, lane, lane, west_m, east_m, speed_mps)
        for lane in range(scenario.road.lanes)
    )


def _lane_xml(
    scenario: Scenario,
    edge: str,
    index: int,
    lane: int,
    west_m: float,
    east_m: float,
    speed_mps: float,
) -> str:
    """Return a lane of an edge, at the position of a lane of the road."""
    centre_m = (lane + 0.5) * scenario.road.lane_width_m
    return (
        f'    <lane id="{edge}_{index}" index="{index}" speed="{speed_mps:.6f}"'
        f' length="{east_m - west_m:.6f}" width="{scenario.road.lane_width_m:.6f}"'
        f' shape="{west_m:.6f},{centre_m:.6f} {east_m:.6f},{centre_m:.6f}"/>'
    )


def _routes_xml(scenario: Scenario) -> str:
    """Return the vehicle type and the only route.

    `tau` and `minGap` are close to zero because SUMO does not drive these vehicles; with its
    defaults it would delay their insertion.
    """
    return f"""<routes>
  {_type_xml(scenario, tau_s=0.1, min_gap_m=0.0)}
  <route id="{ROUTE}" edges="{EDGE}"/>
</routes>
"""


def _exits_routes_xml(scenario: Scenario) -> str:
    """Return the vehicle type, and a route to each exit."""
    settings = scenario.lc2013
    models = 'carFollowModel="Krauss" laneChangeModel="LC2013"'
    kind = _type_xml(scenario, settings.headway_s, settings.min_gap_m, models)
    routes = "\n".join(
        f'  <route id="{exit_route(lane)}" edges="{EDGE} exit{lane}"/>'
        for lane in range(scenario.road.lanes)
    )
    return f"""<routes>
  {kind}
{routes}
</routes>
"""


def _type_xml(scenario: Scenario, tau_s: float, min_gap_m: float, models: str = "") -> str:
    """Return the vehicle type: no imperfection (sigma), equal speeds (speedDev)."""
    vehicle = scenario.vehicle
    return f"""<vType id="{VEHICLE_TYPE}"
         length="{vehicle.length_m:.6f}" width="{vehicle.width_m:.6f}"
         minGap="{min_gap_m:.6f}" tau="{tau_s:.6f}" sigma="0" speedDev="0"
         maxSpeed="{vehicle.max_speed_mps:.6f}"
         accel="{vehicle.max_accel_mps2:.6f}" decel="{-vehicle.min_accel_mps2:.6f}"
         emergencyDecel="{-vehicle.min_accel_mps2:.6f}" {models}/>"""


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
