"""Checks of the demand: shares, volumes that lanes and formations carry, destinations."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import attrs

from laneweave.protocol.config.rules import compare, require
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import MAX_TARGETS, formation_columns
from laneweave.protocol.scenario.road_tables import EntryPoint
from laneweave.protocol.scenario.traffic_flow import Inflow
from laneweave.protocol.vehicle.re_entry import re_entry

MIN_SIDE_GAP_M = 0.5
"""Minimum lateral gap between bodies side by side; covers rotation and tracking errors."""


def check_lanes(scenario: Scenario) -> None:
    """Check shares of lanes, and that lanes are wide enough and carry their volumes."""
    road, demand = scenario.road, scenario.demand
    every = range(road.lanes)
    _check_shares("demand.lane_shares", demand.lane_shares, every, road.lanes)
    if road.first_lanes:  # otherwise, the closures are reported
        _check_shares("demand.arrival_shares", demand.arrival_shares, road.first_lanes, road.lanes)
    for number, entrance in enumerate(scenario.entrance):
        name, shares = f"entrance[{number}].lane_shares", entrance.lane_shares
        _check_shares(name, shares, every, road.lanes)
        allowed = "none, unless demand.lane_shares is given"
        require(bool(demand.lane_shares) or not shares, name, list(shares), allowed)
    width_m = scenario.types.widest_body_m + MIN_SIDE_GAP_M
    what = f"the largest width_m and {MIN_SIDE_GAP_M:g} between bodies side by side"
    compare(scenario, [("road.lane_width_m", "at least", width_m, what)])
    if not scenario.sumo.config:
        _check_lane_volumes(scenario)


def _check_shares(
    name: str, shares: Sequence[float], possible: Collection[int], lanes: int
) -> None:
    """Check shares of lanes: none, or one for each lane, above 0 only in possible lanes."""
    others = ", ".join(map(str, sorted(possible)))
    for ok, allowed in (
        (
            len(shares) in (0, lanes),
            f"one share for each of the {lanes} lanes of road.lanes, or none",
        ),
        (
            all(share >= 0 for share in shares) and sum(shares) < math.inf,
            "numbers >= 0, not all 0, with a finite sum",
        ),
        (
            not any(share for lane, share in enumerate(shares) if lane not in possible),
            f"0 for all lanes but {others}",
        ),
        (not shares or sum(shares) > 0, "numbers >= 0, not all 0"),
    ):
        require(ok, name, list(shares), allowed)


def check_volumes(scenario: Scenario) -> None:
    """Check that the lanes carry the volumes, whether vehicles are drawn or those of SUMO.

    Vehicles of SUMO that cannot enter wait, so that `check_scenario` allows any volume of them.

    Raises:
        BadInputError: a volume is too high.
    """
    _check_lane_volumes(scenario)
    _check_capacity(scenario)


def _check_lane_volumes(scenario: Scenario) -> None:
    """Check that vehicles can enter each lane as often as its volume says."""
    road, demand = scenario.road, scenario.demand
    points = scenario.geometry.entry_points
    ramps = {
        one.name: (f"entrance[{number}].volume_veh_per_h", one.volume_veh_per_h)
        for number, one in enumerate(scenario.entrance)
    }
    most, because = min(3600.0 / max(demand.min_headway_s, 1e-9), 3600.0), "demand.min_headway_s"
    if road.closures and scenario.formation.bound_veh_per_lane_h < most:
        most, because = scenario.formation.bound_veh_per_lane_h, "one in each cell of the lattice"
    main = ("demand.volume_veh_per_lane_h", demand.volume_veh_per_lane_h)
    for number, inflow in scenario.flow.inflows.items():
        name, value = ramps.get(points[number].entrance, main)
        volume, allowed = inflow.volume_veh_per_h, f"at most {most:g}"
        if points[number].entrance not in ramps and demand.arrival_shares:
            allowed += f" vehicles per hour in each lane; lane {number} has {volume:g}"
        require(volume <= most * (1.0 + 1e-9), name, value, f"{allowed} ({because})")


def check_joined_cells(scenario: Scenario) -> None:
    """Check that the planner takes all cells of joined formations as targets."""
    formation = scenario.formation
    if formation.traits.has_formations:
        cells = formation.max_length * scenario.road.lanes
        most = MAX_TARGETS // cells
        allowed = f"at most {most}, for at most {MAX_TARGETS} cells, {cells} in each formation"
        require(formation.max_joined <= most, "formation.max_joined", formation.max_joined, allowed)


def check_drawn_capacity(scenario: Scenario) -> None:
    """Check that the lanes carry the demand if vehicles are drawn."""
    if not scenario.sumo.config:
        _check_capacity(scenario)


def _check_capacity(scenario: Scenario) -> None:
    """Check that the lanes that are open can carry the demand everywhere."""
    road, bound = scenario.road, scenario.formation.bound_veh_per_lane_h
    if not road.closures:
        return  # the bound of the entrance holds everywhere
    exits_m = {one.name: one.at_m for one in scenario.exit}
    points, flow, formation = scenario.geometry.entry_points, scenario.flow, scenario.formation
    parts = [
        (points[number].at_m, inflow.volume_veh_per_h * share, exits_m.get(name, math.inf))
        for number, inflow in flow.inflows.items()
        for name, share in _shares(inflow)
    ]
    volume = scenario.demand.volume_veh_per_lane_h
    if formation.traits.has_formations:
        columns = formation_columns(formation.max_vehicles, road.narrowest_lanes)
        require(
            not formation.closes_by_vehicles or columns <= formation.max_columns,
            "formation.max_columns",
            formation.max_columns,
            f"at least {columns}, for formation.max_vehicles = {formation.max_vehicles} where "
            f"{road.narrowest_lanes} lanes are open",
        )
        change_columns = scenario.types.all_change_columns
        most = math.floor(flow.formation_bound_veh_per_lane_h(change_columns=change_columns))
        require(
            volume <= most,
            "demand.volume_veh_per_lane_h",
            volume,
            f"at most {most}: where {road.narrowest_lanes} lanes are open, formations of "
            f"{formation.max_vehicles} (formation.max_vehicles) need more columns"
            + ("" if change_columns else ", and those with weaker types one more"),
        )
    for s_m in sorted({0.0, *(one.at_m for one in points), *(one.from_m for one in road.closures)}):
        flows = [(from_m, own) for from_m, own, to_m in parts if from_m <= s_m < to_m]
        from_ramps = sum(own for from_m, own in flows if from_m > 0.0)
        main_lanes = sum(own for from_m, own in flows if from_m <= 0.0) / volume
        count = road.open_lanes_at(s_m)
        room = bound * count - from_ramps
        ramps = f" and {from_ramps:g} vehicles per hour come from ramps" if from_ramps else ""
        require(
            volume * main_lanes <= room,
            "demand.volume_veh_per_lane_h",
            volume,
            f"at most {max(room, 0.0) / main_lanes if main_lanes else 0.0:g}, since {count} of "
            f"{road.lanes} lanes are open at {s_m:g} m{ramps}",
        )


def _shares(inflow: Inflow) -> list[tuple[str, float]]:
    """Return (destination, share) of vehicles that enter in a lane; the end of the road last."""
    shares = [(one.exit, one.share) for one in inflow.destinations]
    return [*shares, (END_OF_ROAD, 1.0 - sum(share for _, share in shares))]


def check_destinations(scenario: Scenario) -> None:
    """Check that destinations exist, and that the vehicles of each entrance can reach theirs."""
    names = [one.name for one in scenario.exit]
    tables = {one.name: f"entrance[{number}]" for number, one in enumerate(scenario.entrance)}
    for number, inflow in scenario.flow.inflows.items():
        point = scenario.geometry.entry_points[number]
        name, shares = f"{tables.get(point.entrance, 'demand')}.destinations", _shares(inflow)
        listed = [*map(attrs.astuple, inflow.destinations)]
        require(shares[-1][1] >= -1e-9, name, listed, "shares whose sum is at most 1")
        for destination, share in shares:
            if destination != END_OF_ROAD:
                allowed = f"an exit: {', '.join(names) or 'there is none'}"
                require(destination in names, f"{name}.exit", destination, allowed)
            if share > 0.0:
                preferred = [lane for lane, share in enumerate(inflow.lane_shares) if share]
                _check_reachable(scenario, name, point, destination, preferred or [ANY_LANE])


def _check_reachable(
    scenario: Scenario, name: str, point: EntryPoint, destination: str, wanted: Sequence[int]
) -> None:
    """Check that a vehicle has room for all lane changes to its destination.

    Args:
        scenario: road and lattice.
        name: field of the destination.
        point: where the vehicle enters.
        destination: its destination.
        wanted: lanes that it may prefer at the end of the road.
    """
    geometry, lane = scenario.geometry, point.lane
    own = next(one for one in geometry.sections if one.lane == lane and point.at_m < one.to_m)
    from_m, room_m = max(own.from_m, own.moves_from_m, geometry.moves_from_m), 0.0
    if scenario.road.closures and scenario.formation.traits.has_formations:
        # At the volumes at which vehicles must cross lanes one after another, formations are full.
        formation = scenario.formation
        vehicles = formation.max_vehicles + scenario.flow.vehicles_from_ramps
        columns = formation_columns(vehicles, scenario.road.narrowest_lanes)
        from_m = max(from_m, *geometry.entry_m) + (columns - 1) * formation.gap_m
        room_m = re_entry(scenario).room_m
    from_m += scenario.types.longest_body_m
    advance_m = scenario.formation.speed_mps * scenario.timing.cycles_s[0]
    for preferred in wanted if destination == END_OF_ROAD else [ANY_LANE]:
        room = [
            (section.to_m - room_m if section.to_m < scenario.road.length_m else section.to_m)
            - (from_m + abs(section.lane - lane) * advance_m)
            for section in geometry.sections
            if section.serves(preferred, destination)
        ]
        require(
            max(room, default=-math.inf) >= 0.0,
            name,
            destination,
            f"destinations with {advance_m:g} m for each lane change: from lane {lane}, where "
            f"moves begin at {from_m:g} m, {destination} is too near",
        )
