"""Checks between the fields of a scenario."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter, ge, gt, le, lt
from typing import Any

import attrs

from laneweave.protocol.config.participants import identities_of, max_vehicles
from laneweave.protocol.errors import BadInputError, raise_all
from laneweave.protocol.field_validators import is_encrypted
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, end_exit
from laneweave.protocol.scenario.fields import (
    MAIN_ENTRANCE,
    MAX_HORIZON_TICKS,
    Entrance,
    Inflow,
    LaneRule,
    Scenario,
    SolidLine,
    TypeShare,
    formation_columns,
)
from laneweave.protocol.vehicle.emergency_brake import min_pitch_m
from laneweave.protocol.vehicle.lane_ends import dead_ends, drive_out, lane_beside
from laneweave.protocol.wire.identities import MAX_COMMON_NAME
from laneweave.protocol.wire.messages import CAR

MIN_GAP_M = 1.0
"""Minimum gap between bumpers in neighbouring cells; covers rotation and tracking errors."""
MIN_SIDE_GAP_M = 0.5
"""Minimum lateral gap between bodies side by side; covers rotation and tracking errors."""
MAX_SECURED_VEHICLES = 5000
"""Maximum number of vehicles for which a router holds access rules."""
ROUNDED_SHARE = 1e-3
"""Share of a type that may be due to the rounding of others: it needs no lane."""

_RELATIONS = {"at least": ge, "at most": le, "more than": gt, "less than": lt}
_Comparison = tuple[str, str, float, str]
"""(field, relation, limit, description of the limit)."""

ROLLING_ONLY = ("sort_in_s2", "reward_drift", "change_columns")
"""Fields of `formation` that only the rolling operation reads."""
FORMATIONS_ONLY = (
    "entry",
    "close",
    "max_vehicles",
    "max_columns",
    "max_joined",
    "join",
    "structures",
    "solver",
    "weight_straight",
    "weight_oblique",
    "planning_deadline_s",
    "max_nodes",
)
"""Fields of `formation` that the rolling operation does not read."""


def check_scenario(scenario: Scenario) -> None:
    """Check the fields against each other.

    Raises:
        BadInputError: fields violate rules.
    """
    raise_all(scenario_problems(scenario))


def scenario_problems(scenario: Scenario) -> Iterator[BadInputError]:
    """Yield errors of fields that contradict each other.

    Checks of the road use what the checks before them have established, so that only the first
    error about the road is found; likewise for the motion of vehicles.
    """
    for group in _CHECKS:
        try:
            for check in group:
                check(scenario)
        except BadInputError as error:
            yield error


def check_volumes(scenario: Scenario) -> None:
    """Check that the lanes carry the volumes, whether vehicles are drawn or those of SUMO.

    Vehicles of SUMO that cannot enter wait, so that `check_scenario` allows any volume of them.

    Raises:
        BadInputError: a volume is too high.
    """
    _check_lane_volumes(scenario)
    _check_capacity(scenario)


def effect_problems(data: Mapping[str, Any], scenario: Scenario) -> Iterator[BadInputError]:
    """Yield an error for each value in a file that has no effect in the resulting scenario."""
    formation, given = scenario.formation, data.get("formation", {})
    by_vehicles = formation.closes_by_vehicles
    for fields, has_effect, allowed in (
        (ROLLING_ONLY, formation.rolling, 'none, unless formation.operation is "rolling"'),
        (FORMATIONS_ONLY, not formation.rolling, 'none where formation.operation is "rolling"'),
        (("max_columns",), by_vehicles, 'none, unless formation.close is "vehicles"'),
        (("join",), formation.max_joined > 1, "none, unless formation.max_joined is above 1"),
        (("block_columns",), not by_vehicles, 'none, unless formation.close is "columns"'),
    ):
        if not has_effect:
            for name in given.keys() & set(fields):
                yield BadInputError(f"formation.{name}", given[name], allowed)


def _require(ok: bool, name: str, value: object, allowed: str) -> None:
    if not ok:
        raise BadInputError(name, value, allowed)


def _compare(scenario: Scenario, comparisons: Iterable[_Comparison]) -> None:
    """Check each field against its limit."""
    values = [(one, attrgetter(one[0])(scenario)) for one in comparisons]
    raise_all(
        BadInputError(name, value, f"{relation} {limit:g}: {meaning}")
        for (name, relation, limit, meaning), value in values
        if not _RELATIONS[relation](value, limit)
    )


def _check_lanes(scenario: Scenario) -> None:
    road, demand = scenario.road, scenario.demand
    every = range(road.lanes)
    _check_shares("demand.lane_shares", demand.lane_shares, every, road.lanes)
    if road.first_lanes:  # otherwise, the closures are reported
        _check_shares("demand.arrival_shares", demand.arrival_shares, road.first_lanes, road.lanes)
    for number, entrance in enumerate(scenario.entrance):
        name, shares = f"entrance[{number}].lane_shares", entrance.lane_shares
        _check_shares(name, shares, every, road.lanes)
        allowed = "none, unless demand.lane_shares is given"
        _require(bool(demand.lane_shares) or not shares, name, list(shares), allowed)
    width_m = scenario.widest_body_m + MIN_SIDE_GAP_M
    what = f"the largest width_m and {MIN_SIDE_GAP_M:g} between bodies side by side"
    _compare(scenario, [("road.lane_width_m", "at least", width_m, what)])
    if scenario.draws_vehicles:
        _check_lane_volumes(scenario)


def _check_lane_volumes(scenario: Scenario) -> None:
    """Check that vehicles can enter each lane as often as its volume says."""
    road, demand = scenario.road, scenario.demand
    ramps = {
        one.lane: (f"entrance[{number}].volume_veh_per_h", one.volume_veh_per_h)
        for number, one in enumerate(scenario.entrance)
    }
    most, because = min(3600.0 / max(demand.min_headway_s, 1e-9), 3600.0), "demand.min_headway_s"
    if road.closures and scenario.formation.bound_veh_per_lane_h < most:
        most, because = scenario.formation.bound_veh_per_lane_h, "one in each cell of the lattice"
    main = ("demand.volume_veh_per_lane_h", demand.volume_veh_per_lane_h)
    for lane, inflow in scenario.inflows.items():
        name, value = ramps.get(lane, main)
        volume, allowed = inflow.volume_veh_per_h, f"at most {most:g}"
        if lane not in ramps and demand.arrival_shares:
            allowed += f" vehicles per hour in each lane; lane {lane} has {volume:g}"
        _require(volume <= most * (1.0 + 1e-9), name, value, f"{allowed} ({because})")


def _check_shares(
    name: str, shares: Sequence[float], possible: Collection[int], lanes: int
) -> None:
    """Check shares of lanes: none, or one for each lane, above 0 only in possible lanes."""
    _require(
        len(shares) in (0, lanes),
        name,
        list(shares),
        f"one share for each of the {lanes} lanes of road.lanes, or none",
    )
    _require(
        all(share >= 0 for share in shares) and sum(shares) < math.inf,
        name,
        list(shares),
        "numbers >= 0, not all 0, with a finite sum",
    )
    _require(
        not any(share for lane, share in enumerate(shares) if lane not in possible),
        name,
        list(shares),
        f"0 for all lanes but {', '.join(map(str, sorted(possible)))}",
    )
    _require(not shares or sum(shares) > 0, name, list(shares), "numbers >= 0, not all 0")


def _check_types(scenario: Scenario) -> None:
    """Check that types of vehicles have names of their own, and shares of the demand."""
    types = scenario.vehicle_type
    names = [one.name for one in types]
    for number, name in enumerate(names):
        is_new = name != CAR and name not in names[:number]
        allowed = f"a name that no other type has; {CAR} is the type of table vehicle"
        _require(is_new, f"vehicle_type[{number}].name", name, allowed)
    given = [("vehicle_type.share", [one.share for one in types])]
    for number, entrance in enumerate(scenario.entrance):
        name, own = f"entrance[{number}].vehicle_types", entrance.vehicle_types
        for place, one in enumerate(own):
            allowed = f"one of {', '.join(names)}" if names else "none: there is no vehicle_type"
            is_new = one.type not in [other.type for other in own[:place]]
            allowed += "" if is_new else ", each once"
            _require(one.type in names and is_new, f"{name}[{place}].type", one.type, allowed)
        given.append((name, [one.share for one in own]))
    for name, shares in given:
        _require(sum(shares) <= 1.0 + 1e-9, name, shares, "shares with a sum of at most 1")
    _check_types_of_structures(scenario)


def _check_types_of_structures(scenario: Scenario) -> None:
    """Check that all types drive all moves if structures are given: any vehicle gets any place."""
    if scenario.formation.rolling or not scenario.formation.structures:
        return
    for name, own in scenario.types.items():
        for limit, needed in scenario.column_move_limits.items():
            value = getattr(own.vehicle, limit)
            shown = math.ceil(100.0 * needed) / 100.0
            _require(
                abs(value) >= needed,
                _limit_of(scenario, name, limit),
                value,
                (f"at most {-shown:g}" if value < 0.0 else f"at least {shown:g}")
                + " with formation.structures, where each vehicle moves by a column of "
                f"{scenario.formation.gap_m:g} m in T_F (formation.cycle_s)",
            )


def _check_motion(scenario: Scenario) -> None:
    formation, vehicle = scenario.formation, scenario.vehicle
    gap_m = max(scenario.tracking.min_gap_m, MIN_GAP_M)
    what = f"the longest length_m, and tracking.min_gap_m between bumpers, at least {MIN_GAP_M:g}"
    min_gap_m = scenario.longest_body_m + gap_m
    _compare(scenario, [("formation.gap_m", "at least", min_gap_m, what)])
    cycle_s, move_s = formation.cycle_s, formation.move_s
    if move_s is not None:
        allowed = "none without" if cycle_s is None else f"at most {cycle_s:g},"
        ok = cycle_s is not None and move_s <= cycle_s
        _require(ok, "formation.move_s", move_s, f"{allowed} formation.cycle_s")
    max_mps = vehicle.max_speed_mps
    _compare(scenario, [("formation.speed_mps", "less than", max_mps, "vehicle.max_speed_mps")])
    _require(
        (formation.weight_oblique or 0) <= formation.oblique_steps,
        "formation.weight_oblique",
        formation.weight_oblique,
        "at most 1 in mode 2 (an oblique edge is one step), at most 2 in mode 1",
    )
    needed_m = scenario.longest_formation_m + scenario.step_m
    _compare(scenario, [("road.s3_m", "at least", needed_m, "a whole formation and one step")])
    _require(
        formation.executable,
        "formation.conflicts",
        sorted(formation.conflict_kinds),
        "geometric, or in mode 1 node, edge and special-1: moves of one step must have disjoint "
        "footprints to be executed without a timetable",
    )


def _check_closures(scenario: Scenario) -> None:
    """Check that closed parts of lanes are on the road, apart, and can be passed."""
    road = scenario.road
    open_m: dict[int, float] = dict.fromkeys(range(road.lanes), -math.inf)
    step_m = scenario.step_m
    for number, closure in enumerate(road.closures):
        name = f"road.closures[{number}]"
        allowed = f"a lane from 0 to {road.lanes - 1}"
        _require(closure.lane < road.lanes, f"{name}.lane", closure.lane, allowed)
        allowed = f"more than from_m, {closure.from_m:g}"
        _require(closure.to_m > closure.from_m, f"{name}.to_m", closure.to_m, allowed)
        after_m = open_m[closure.lane]
        again = f", and more than {after_m:g}, where lane {closure.lane} is open again"
        _require(
            after_m < closure.from_m < road.length_m,
            f"{name}.from_m",
            closure.from_m,
            f"less than the length of the road, {road.length_m:g}"
            + (again if after_m > 0.0 else ""),
        )
        _require(
            closure.to_m >= road.length_m or closure.to_m + step_m <= road.length_m,
            f"{name}.to_m",
            closure.to_m,
            f"at most {road.length_m - step_m:g}, a body and a step before the end of the road, or "
            "none",
        )
        open_m[closure.lane] = closure.to_m
    reaching = sorted(lane for lane, to_m in open_m.items() if to_m < road.length_m)
    for lanes, where in ((road.first_lanes, "start"), (reaching, "end")):
        allowed = f"a lane that is open at the {where} of the road"
        _require(bool(lanes), "road.closures", [*map(attrs.astuple, road.closures)], allowed)
    given = [("demand.lane_shares", scenario.demand.lane_shares)]
    given += [
        (f"entrance[{number}].lane_shares", one.lane_shares)
        for number, one in enumerate(scenario.entrance)
    ]
    for name, shares in given:
        _require(
            all(lane in reaching or not share for lane, share in enumerate(shares)),
            name,
            list(shares),
            f"shares of lanes that reach the end of the road, {reaching}, and 0 for the others",
        )


def _check_lane_rules(scenario: Scenario) -> None:
    """Check restrictions and solid lines: the rolling operation, lanes, positions, types."""
    road, formation = scenario.road, scenario.formation
    rules: dict[str, LaneRule] = {
        f"road.restrictions[{number}]": one for number, one in enumerate(road.restrictions)
    }
    rules |= {f"road.solid_lines[{number}]": one for number, one in enumerate(road.solid_lines)}
    if not rules:
        return
    allowed = '"rolling" with road.restrictions or road.solid_lines'
    _require(formation.rolling, "formation.operation", formation.operation, allowed)
    for name, one in rules.items():
        allowed = f"a lane from 0 to {road.lanes - 1}"
        _require(one.lane < road.lanes, f"{name}.lane", one.lane, allowed)
        allowed = f"less than the length of the road, {road.length_m:g}"
        _require(one.from_m < road.length_m, f"{name}.from_m", one.from_m, allowed)
        allowed = f"more than from_m, {one.from_m:g}"
        _require(one.to_m > one.from_m, f"{name}.to_m", one.to_m, allowed)
        allowed = f"names of types, each once: {', '.join(scenario.types)}"
        given = one.vehicle_types
        ok = set(given) <= scenario.types.keys() and len(set(given)) == len(given)
        _require(ok, f"{name}.vehicle_types", list(given), allowed)
        if isinstance(one, SolidLine):
            allowed = f"the side of lane {one.lane} on which there is another lane"
            _require(0 <= one.changes[0][1] < road.lanes, f"{name}.to", one.to, allowed)
        else:
            allowed = "at least one type; road.closures close a lane to all"
            _require(bool(given), f"{name}.vehicle_types", list(given), allowed)
    _check_permitted_lanes(scenario)


def _check_permitted_lanes(scenario: Scenario) -> None:
    """Check that each type has a lane to enter by, and one to leave by if its demand is drawn."""
    if not scenario.road.restrictions:
        return
    demand = scenario.demand
    shares = [TypeShare(one.name, one.share) for one in scenario.vehicle_type]
    entrances = [(MAIN_ENTRANCE, scenario.road.first_lanes, shares, demand.destinations)]
    entrances += [
        (one.name, (one.lane,), list(one.vehicle_types) or shares, one.destinations)
        for one in scenario.entrance
    ]
    for entrance, lanes, types, destinations in entrances:
        cars = TypeShare(CAR, max(0.0, 1.0 - sum(one.share for one in types)))
        wanted = [one.exit for one in destinations if one.share > 0.0]
        if sum(one.share for one in destinations) < 1.0:
            wanted.append(END_OF_ROAD)
        for name in [one.type for one in (*types, cars) if one.share > ROUNDED_SHARE]:
            enters = any(
                not scenario.is_restricted(lane, scenario.entry_m[lane], name) for lane in lanes
            )
            allowed = f"types other than {name}, which has no lane left at entrance {entrance}"
            _require_lane(enters, scenario, name, lanes, allowed)
            for destination in wanted if scenario.draws_vehicles else ():
                ends = [one for one in scenario.sections if one.serves(ANY_LANE, destination)]
                leaves = not ends or any(scenario.may_leave_by(one, name) for one in ends)
                allowed = (
                    f"types other than {name}, which has no lane left to leave by {destination}"
                )
                _require_lane(leaves, scenario, name, [one.lane for one in ends], allowed)


def _require_lane(
    ok: bool, scenario: Scenario, vehicle_type: str, lanes: Collection[int], allowed: str
) -> None:
    """Require a lane for a type; the error names the first restriction of these lanes."""
    if not ok:
        number, one = next(
            (number, one)
            for number, one in enumerate(scenario.road.restrictions)
            if one.lane in lanes and one.applies_to(vehicle_type)
        )
        field = f"road.restrictions[{number}].vehicle_types"
        raise BadInputError(field, list(one.vehicle_types), allowed)


def _check_entrances(scenario: Scenario) -> None:
    """Check that ramps are where lanes open, and that they are long enough."""
    road, names = scenario.road, {MAIN_ENTRANCE}
    lanes = set[int]()
    for number, entrance in enumerate(scenario.entrance):
        name, lane = f"entrance[{number}]", entrance.lane
        allowed = f"a name of its own, other than {MAIN_ENTRANCE}"
        _require(entrance.name not in names, f"{name}.name", entrance.name, allowed)
        names.add(entrance.name)
        allowed = "a lane that is closed from the start of the road to its only entrance"
        opens_m = [one.to_m for one in road.closures if one.lane == lane]
        is_closed = any(one.lane == lane and one.from_m <= 0.0 for one in road.closures)
        _require(is_closed and lane not in lanes, f"{name}.lane", lane, allowed)
        lanes.add(lane)
        _check_opening(scenario, f"{name}.at_m", entrance, opens_m)
        formation = scenario.formation
        low_m = entrance.at_m + formation.speed_mps * formation.settle_s
        ends_m = [
            one.to_m
            for one in scenario.sections
            if one.lane == entrance.lane and one.to_m > entrance.at_m
        ]
        high_m = min(ends_m, default=road.length_m) - scenario.step_m
        _require(
            low_m <= entrance.merge_m <= high_m,
            f"{name}.merge_m",
            entrance.merge_m,
            f"from {low_m:g}, formation.settle_s after entrance.at_m, to {high_m:g}, a step before "
            "the end of the lane",
        )


def _check_opening(
    scenario: Scenario, field: str, entrance: Entrance, opens_m: Sequence[float]
) -> None:
    """Check that the lane of a ramp opens at its beginning, for the first time or behind exits."""
    where = f"where lane {entrance.lane} opens"
    if scenario.formation.change_columns:
        _require(entrance.at_m == opens_m[0], field, entrance.at_m, f"{opens_m[0]:g}, {where}")
        return
    before = [
        section
        for section in scenario.sections
        if section.lane == entrance.lane and section.to_m <= entrance.at_m
    ]
    after_m = max((section.to_m for section in before), default=-math.inf)
    # The bodies of vehicles that leave and of vehicles that enter must not overlap on the road.
    after_m += scenario.longest_body_m + scenario.vehicle.max_speed_mps * scenario.runtime.tick_s
    possible = [one for one in opens_m if one >= after_m and all(each.exit for each in before)]
    allowed = f"{' or '.join(f'{one:g}' for one in possible) or 'no position'}, {where}"
    if before:
        allowed += f" behind exits, and {after_m:g} or more"
    _require(entrance.at_m in possible, field, entrance.at_m, allowed)


def _check_exits(scenario: Scenario) -> None:
    """Check that exits are at the ends of sections, with room for lane changes before them."""
    names, used = {END_OF_ROAD}, set[tuple[int, float]]()
    ends = {(one.lane, one.from_m) for one in scenario.road.closures}
    for number, exit_ in enumerate(scenario.exit):
        name = f"exit[{number}]"
        ok = exit_.name not in names and not exit_.name.startswith(end_exit(0)[:-1])
        allowed = f"a name of its own, other than {END_OF_ROAD} or lane-N"
        _require(ok, f"{name}.name", exit_.name, allowed)
        names.add(exit_.name)
        places = {(lane, exit_.at_m) for lane in exit_.lanes}
        _require(
            bool(places) and len(places) == len(exit_.lanes) and places <= ends - used,
            f"{name}.lanes",
            list(exit_.lanes),
            f"lanes that are closed from exit.at_m = {exit_.at_m:g} on, without another exit",
        )
        used |= places
        for section in scenario.sections:
            begins_m = max(section.from_m, section.moves_from_m)
            needed_m = _first_step_m(scenario, begins_m) + drive_out(scenario).room_m
            _require(
                section.exit != exit_.name or exit_.at_m >= needed_m,
                f"{name}.at_m",
                exit_.at_m,
                f"at least {needed_m:g}: {_FIRST_STEP[scenario.formation.rolling]}, in lane "
                f"{section.lane}, and "
                f"{drive_out(scenario).room_m:g} m for completing a change after stopping",
            )


def _check_drawn_capacity(scenario: Scenario) -> None:
    if scenario.draws_vehicles:
        _check_capacity(scenario)


def _check_capacity(scenario: Scenario) -> None:
    """Check that the lanes that are open can carry the demand everywhere."""
    road, bound = scenario.road, scenario.formation.bound_veh_per_lane_h
    if not road.closures:
        return  # the bound of the entrance holds everywhere
    exits_m = {one.name: one.at_m for one in scenario.exit}
    parts = [
        (scenario.entry_m[lane], inflow.volume_veh_per_h * share, exits_m.get(name, math.inf))
        for lane, inflow in scenario.inflows.items()
        for name, share in _shares(inflow)
    ]
    volume = scenario.demand.volume_veh_per_lane_h
    if not scenario.formation.rolling:
        formation = scenario.formation
        columns = formation_columns(formation.max_vehicles, scenario.narrowest_lanes)
        _require(
            not formation.closes_by_vehicles or columns <= formation.max_columns,
            "formation.max_columns",
            formation.max_columns,
            f"at least {columns}, for formation.max_vehicles = {formation.max_vehicles} where "
            f"{scenario.narrowest_lanes} lanes are open",
        )
        formations = math.floor(scenario.formation_bound_veh_per_lane_h)
        _require(
            volume <= formations,
            "demand.volume_veh_per_lane_h",
            volume,
            f"at most {formations}: where {scenario.narrowest_lanes} lanes are open, formations of "
            f"{scenario.formation.max_vehicles} (formation.max_vehicles) need more columns"
            + ("" if scenario.all_change_columns else ", and those with weaker types one more"),
        )
    for s_m in sorted({0.0, *scenario.entry_m, *(one.from_m for one in road.closures)}):
        flows = [(from_m, flow) for from_m, flow, to_m in parts if from_m <= s_m < to_m]
        from_ramps = sum(flow for from_m, flow in flows if from_m > 0.0)
        main_lanes = sum(flow for from_m, flow in flows if from_m <= 0.0) / volume
        count = scenario.open_lanes_at(s_m)
        room = bound * count - from_ramps
        ramps = f" and {from_ramps:g} vehicles per hour come from ramps" if from_ramps else ""
        _require(
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


def _check_destinations(scenario: Scenario) -> None:
    """Check that destinations exist, and that the vehicles of each entrance can reach theirs."""
    names = [one.name for one in scenario.exit]
    tables = {one.lane: f"entrance[{number}]" for number, one in enumerate(scenario.entrance)}
    for lane, inflow in scenario.inflows.items():
        name, shares = f"{tables.get(lane, 'demand')}.destinations", _shares(inflow)
        listed = [*map(attrs.astuple, inflow.destinations)]
        _require(shares[-1][1] >= -1e-9, name, listed, "shares whose sum is at most 1")
        for destination, share in shares:
            if destination != END_OF_ROAD:
                allowed = f"an exit: {', '.join(names) or 'there is none'}"
                _require(destination in names, f"{name}.exit", destination, allowed)
            if share > 0.0:
                _check_reachable(scenario, name, lane, destination)


def _check_reachable(scenario: Scenario, name: str, lane: int, destination: str) -> None:
    """Check that a vehicle from a lane has room for all lane changes to its destination."""
    own = min((one for one in scenario.sections if one.lane == lane), key=lambda one: one.from_m)
    from_m, room_m = max(own.from_m, own.moves_from_m, scenario.moves_from_m), 0.0
    if scenario.road.closures and not scenario.formation.rolling:
        # At the volumes at which vehicles must cross lanes one after another, formations are full.
        formation = scenario.formation
        vehicles = formation.max_vehicles + scenario.vehicles_from_ramps
        columns = formation_columns(vehicles, scenario.narrowest_lanes)
        from_m = max(from_m, *scenario.entry_m) + (columns - 1) * formation.gap_m
        room_m = drive_out(scenario).room_m
    from_m += scenario.longest_body_m
    advance_m = scenario.formation.speed_mps * scenario.cycles_s[0]
    preferring = scenario.inflows[lane].lane_shares
    wanted = [lane for lane, share in enumerate(preferring) if share] or [ANY_LANE]
    for preferred in wanted if destination == END_OF_ROAD else [ANY_LANE]:
        room = [
            (section.to_m - room_m if section.to_m < scenario.road.length_m else section.to_m)
            - (from_m + abs(section.lane - lane) * advance_m)
            for section in scenario.sections
            if section.serves(preferred, destination)
        ]
        _require(
            max(room, default=-math.inf) >= 0.0,
            name,
            destination,
            f"destinations with {advance_m:g} m for each lane change: from lane {lane}, where "
            f"moves begin at {from_m:g} m, {destination} is too near",
        )


def _check_dead_ends(scenario: Scenario) -> None:
    """Check that vehicles can change lanes before each dead end, and drive on after stopping."""
    if not scenario.road.closures:
        return
    try:
        needed = drive_out(scenario)
    except ValueError as error:
        limits = {name: one.vehicle.max_accel_mps2 for name, one in scenario.types.items()}
        weakest = min(limits, key=lambda name: limits[name])
        name = _limit_of(scenario, weakest, "max_accel_mps2")
        raise BadInputError(name, limits[weakest], f"more: {error}") from error
    for end in dead_ends(scenario):
        name = next(
            f"road.closures[{number}].from_m"
            for number, closure in enumerate(scenario.road.closures)
            if (closure.lane, closure.from_m) == (end.lane, end.end_m)
        )
        first_m = _first_step_m(scenario, max(end.from_m, end.moves_from_m))
        _require(
            end.line_m >= first_m,
            name,
            end.end_m,
            f"at least {first_m + needed.room_m:g}: {_FIRST_STEP[scenario.formation.rolling]}, and "
            f"{needed.room_m:g} m for driving on after stopping at the end of the lane",
        )
        _require(
            lane_beside(scenario, end) is not None,
            name,
            end.end_m,
            f"the end of a lane beside one that is open from {end.line_m:g} m, its stop line, to "
            f"{needed.distance_m:g} m after it",
        )
        before_m = end.line_m - scenario.longest_formation_m - scenario.step_m
        _require(
            scenario.formation.rolling
            or any(
                max(one.from_m, one.moves_from_m) <= before_m and one.to_m > end.end_m
                for one in scenario.sections
            ),
            name,
            end.end_m,
            f"the end of a lane beside one that is open from {before_m:g} m on, so that a whole "
            "formation can change lanes",
        )


_FIRST_STEP = {
    True: "a step for changing lanes",
    False: "a formation that has passed all entrances, and a step for changing lanes",
}
"""What must fit before the end of a lane, in the rolling operation and with formations."""


def _first_step_m(scenario: Scenario, from_m: float) -> float:
    """Return where the first move ends in a section in which moves may begin at a position.

    The vehicles of a formation are known once it has passed all entrances, and it moves once all of
    it is in the section.
    """
    from_m = max(from_m, scenario.moves_from_m)
    if not scenario.formation.rolling:
        from_m = max(from_m, *scenario.entry_m) + scenario.longest_formation_m
    return from_m + scenario.step_m


def _limit_of(scenario: Scenario, vehicle_type: str, name: str) -> str:
    """Return the name of the field with a limit of a type of vehicle."""
    if vehicle_type == CAR:
        return f"vehicle.{name}"
    number = [one.name for one in scenario.vehicle_type].index(vehicle_type)
    return f"vehicle_type[{number}].{name}"


def _check_structures(scenario: Scenario) -> None:
    """Check that structures ascend along the road, begin before S3 and use existing lanes."""
    road, before_m = scenario.road, -1.0
    _require(
        not (scenario.formation.structures and road.closures),
        "formation.structures",
        [one.structure for one in scenario.formation.structures],
        "none, on a road with closures: formations change to the open lanes by themselves",
    )
    for number, structure in enumerate(scenario.formation.structures):
        name = f"formation.structures[{number}]"
        _require(
            before_m < structure.from_m < road.sorting_start_m,
            f"{name}.from_m",
            structure.from_m,
            f"ascending, and less than road.s1_m + road.s2_m = {road.sorting_start_m:g}",
        )
        before_m = structure.from_m
        lanes = structure.lanes
        _require(
            len(set(lanes)) == len(lanes) and set(lanes) <= set(range(road.lanes)),
            f"{name}.lanes",
            list(lanes),
            f"distinct lanes from 0 to {road.lanes - 1}",
        )


def _check_timing(scenario: Scenario) -> None:
    """Check the durations of moves."""
    runtime, formation = scenario.runtime, scenario.formation
    shortest_s, longest_s = scenario.cycles_s
    longest_move_s = longest_s - formation.slack_s
    for name, value in (
        ("cycle_s", shortest_s),
        ("cycle_s", longest_s),
        ("move_s", shortest_s - formation.slack_s),
    ):
        allowed = f"a multiple of runtime.tick_s = {runtime.tick_s:g}, at least two ticks"
        _require(_in_ticks(scenario, value, 2), f"formation.{name}", value, allowed)
    _require(
        scenario.horizon_ticks * runtime.tick_s >= longest_move_s - 1e-6,
        "tracking.horizon_ticks",
        scenario.horizon_ticks,
        f"long enough for a whole move of {longest_move_s:g} s, at most {MAX_HORIZON_TICKS}",
    )
    _require(
        scenario.horizon_ticks <= MAX_HORIZON_TICKS,
        "runtime.tick_s",  # an explicit horizon has its own bound
        runtime.tick_s,
        f"long enough for the longest T_F, {longest_s:g} s, to have at most {MAX_HORIZON_TICKS} "
        "ticks",
    )


def _check_periods(scenario: Scenario) -> None:
    """Check the periods and timeouts of processes."""
    heartbeat_s, silent_s = scenario.network.heartbeat_s, scenario.runtime.agent_silent_s
    deadline_s = scenario.runtime.tick_deadline_s
    what = "runtime.agent_silent_s, so a lost session is detected before its agent counts as silent"
    _compare(
        scenario,
        [
            ("network.election_s", "more than", 2 * heartbeat_s, "twice network.heartbeat_s"),
            ("network.lease_s", "more than", heartbeat_s, "network.heartbeat_s"),
            ("runtime.tick_resend_s", "less than", deadline_s, "runtime.tick_deadline_s"),
            ("runtime.tick_deadline_s", "at most", silent_s, "runtime.agent_silent_s"),
            ("network.lease_s", "at most", silent_s, what),
        ],
    )


def _in_ticks(scenario: Scenario, time_s: float, min_ticks: int) -> bool:
    """Return whether a time is a whole number of ticks, at least `min_ticks`."""
    ticks = time_s / scenario.runtime.tick_s
    return ticks >= min_ticks - 1e-6 and abs(ticks - round(ticks)) < 1e-6


def _check_braking(scenario: Scenario) -> None:
    reaction_s = scenario.braking.reaction_s
    allowed = (
        f"a multiple of runtime.tick_s = {scenario.runtime.tick_s:g}: sensors measure each tick"
    )
    _require(_in_ticks(scenario, reaction_s, 1), "braking.reaction_s", reaction_s, allowed)
    gap_m = scenario.formation.gap_m
    hardest_mps2 = max(scenario.braking.lead_brake_mps2, -scenario.vehicle.min_accel_mps2)
    for number, vehicle_type in enumerate(scenario.vehicle_type):
        if vehicle_type.min_accel_mps2 is not None:
            _require(
                -vehicle_type.min_accel_mps2 <= hardest_mps2,
                f"vehicle_type[{number}].min_accel_mps2",
                vehicle_type.min_accel_mps2,
                f"at least {-hardest_mps2:g}: vehicles behind expect no harder braking "
                "(braking.lead_brake_mps2)",
            )
    for name, own in scenario.types.items():
        min_m = min_pitch_m(own)
        _require(
            gap_m >= min_m,
            "formation.gap_m",
            gap_m,
            f"at least {math.ceil(1000.0 * min_m) / 1000.0:g}: a {name} that holds behind another "
            f"vehicle at formation.speed_mps = {scenario.formation.speed_mps:g} must not need "
            "emergency braking (length_m and min_accel_mps2 of each type, the tables braking and "
            "sensing)",
        )


def _check_settling(scenario: Scenario) -> None:
    """Check that a vehicle can settle in its cell within its limits.

    The minimum-jerk motion from rest to rest over d in T has a peak speed of 15/8 d/T, a peak
    acceleration of 10/sqrt(3) d/T^2 and a peak jerk of 60 d/T^3.
    """
    formation = scenario.formation
    # Types that do not change columns enter in their cells.
    limits = [one.vehicle for one in scenario.types.values() if one.changes_columns]
    if not limits:
        return
    offset_m = formation.entry_spread_s * formation.speed_mps
    max_mps = min(one.max_speed_mps for one in limits)
    speed_mps = min(max_mps - formation.speed_mps, formation.speed_mps)
    accel_mps2 = min(min(one.max_accel_mps2, -one.min_accel_mps2) for one in limits)
    jerk_mps3 = min(one.max_jerk_mps3 for one in limits)
    min_s = max(
        15.0 / 8.0 * offset_m / speed_mps,
        math.sqrt(10.0 / math.sqrt(3.0) * offset_m / accel_mps2),
        math.cbrt(60.0 * offset_m / jerk_mps3),
    )
    _require(
        formation.settle_s >= min_s,
        "formation.settle_s",
        formation.settle_s,
        f"at least {math.ceil(10.0 * min_s) / 10.0:g}: a vehicle that enters up to "
        f"{offset_m:g} m from its cell settles there within its limits",
    )


def _check_sumo(scenario: Scenario) -> None:
    """Check that a corridor of a SUMO simulation is named, and driven by the operation for it."""
    sumo = scenario.sumo
    first, _, last = sumo.corridor.partition(":")
    if not sumo.config:
        _require(not sumo.corridor, "sumo.corridor", sumo.corridor, "none without sumo.config")
        return
    allowed = "FIRST_EDGE:LAST_EDGE, two edges of the network of sumo.config"
    _require(bool(first and last), "sumo.corridor", sumo.corridor, allowed)
    formation = scenario.formation
    allowed = '"rolling" with sumo.config'
    _require(formation.rolling, "formation.operation", formation.operation, allowed)
    allowed = "false with sumo.config: vehicles from SUMO settle in columns of their own"
    _require(not formation.change_columns, "formation.change_columns", True, allowed)


def _check_security(scenario: Scenario) -> None:
    network, security = scenario.network, scenario.security
    secured = security.mode == "mtls"
    endpoints = [("network.endpoint", network.endpoint)] if network.endpoint else []
    endpoints += [("network.listen", endpoint) for endpoint in network.listen]
    if secured:
        allowed = "tls/HOST:PORT or quic/HOST:PORT, as security.mode is mtls"
        raise_all(
            BadInputError(name, endpoint, allowed)
            for name, endpoint in endpoints
            if not is_encrypted(endpoint)
        )
    for name, endpoint in endpoints:
        allowed = f"mtls, as {name} is {endpoint}"
        _require(secured or not is_encrypted(endpoint), "security.mode", "off", allowed)
    if not secured:
        return
    _require(bool(security.folder), "security.folder", "", "the folder of the certificates")
    count = max_vehicles(scenario)
    _require(
        count <= MAX_SECURED_VEHICLES,
        "demand.duration_s",
        scenario.demand.duration_s,
        f"a demand of at most {MAX_SECURED_VEHICLES} vehicles (now up to {count}) where "
        "security.mode is mtls: the router has rules for each vehicle",
    )
    for identity in identities_of(scenario):
        name = identity.common_name
        _require(
            len(name) <= MAX_COMMON_NAME,
            f"security.{identity.party}s",
            name,
            f"at most {MAX_COMMON_NAME} characters: it is the common name of a certificate",
        )


_CHECKS = (
    (
        _check_types,
        _check_lane_rules,
        _check_lanes,
        _check_motion,
        _check_closures,
        _check_entrances,
        _check_dead_ends,
        _check_exits,
        _check_drawn_capacity,
        _check_destinations,
        _check_structures,
        _check_timing,
        _check_braking,
        _check_settling,
    ),
    (_check_periods,),
    (_check_sumo,),
    (_check_security,),
)
"""Groups of checks, of which none depends on the others."""
