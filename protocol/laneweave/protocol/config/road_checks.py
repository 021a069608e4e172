"""Checks of the road: closed parts of lanes, rules of lanes, ramps, exits and dead ends."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence

import attrs

from laneweave.protocol.config.motion_checks import limit_name
from laneweave.protocol.config.rules import require
from laneweave.protocol.errors import BadInputError, Described
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, LaneSection, end_exit
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import (
    MAIN_ENTRANCE,
    Entrance,
    LaneRule,
    RoadEvent,
    SolidLine,
    TypeShare,
)
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import (
    LaneEnds,
    dead_ends,
    early_start_m,
    exit_lanes,
    first_step_m,
    lanes_beside,
    sections_to_lines,
)
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.vehicle.sudden_stops import begins_m, room_before_part_m
from laneweave.protocol.wire.messages import CAR

ROUNDED_SHARE = 1e-3
"""Share of a type that may be due to the rounding of others: it needs no lane."""


MAX_PASSING_M = 30.0
"""Maximum length of vehicles of other systems."""


def check_events(scenario: Scenario) -> None:
    """Check parts of lanes that are closed for a time, and vehicles of other systems."""
    events = scenario.road.events
    for number, event in enumerate(events):
        check_event(scenario, f"road.events[{number}].", event)
    require(
        not (events and scenario.sumo.config),
        "road.events",
        Described("a table"),
        "none in a corridor of a SUMO simulation",
    )


def check_event(scenario: Scenario, name: str, event: RoadEvent) -> None:
    """Check one of them.

    Raises:
        BadInputError: it is not possible on this road; `name` precedes the name of the field.
    """
    lanes = scenario.road.lanes
    require(event.lane < lanes, f"{name}lane", event.lane, f"a lane from 0 to {lanes - 1}")
    allowed = f"more than from_m, {event.from_m:g}"
    require(event.to_m > event.from_m, f"{name}to_m", event.to_m, allowed)
    allowed = f"more than at_s, {event.at_s:g}"
    until_s = event.until_s
    require(until_s is None or until_s > event.at_s, f"{name}until_s", until_s, allowed)
    if event.speed_mps:
        _check_passage(scenario, name, event)
    else:
        _check_part(scenario, name, event)


def _check_part(scenario: Scenario, name: str, event: RoadEvent) -> None:
    """Check that a part of a lane may be closed suddenly."""
    from_m, to_m = event.from_m, event.to_m
    sections = [
        (each, _last_m(scenario, each))
        for each in scenario.geometry.sections
        if each.lane == event.lane
    ]
    needed_m = room_before_part_m(scenario, re_entry(scenario).room_m)
    least_m = begins_m(scenario, event.lane, from_m) + needed_m
    places = " or ".join(
        f"{max(one.from_m, 0.0) + needed_m:g} to {last_m:g} m" for one, last_m in sections
    )
    require(
        from_m >= least_m
        and any(one.from_m < from_m and to_m < last_m for one, last_m in sections),
        f"{name}from_m",
        from_m,
        f"a part within {places}, which vehicles that enter the lane can see in time",
    )


def _check_passage(scenario: Scenario, name: str, event: RoadEvent) -> None:
    """Check a vehicle of another system: it drives in a lane that is open from end to end."""
    road = scenario.road
    by_lane = Counter(each.lane for each in scenario.geometry.sections)
    lanes = [lane for lane in road.first_lanes if by_lane[lane] == 1]
    require(event.lane in lanes, f"{name}lane", event.lane, f"a lane without ends: {lanes}")
    require(
        event.to_m - event.from_m <= MAX_PASSING_M,
        f"{name}to_m",
        event.to_m,
        f"at most {MAX_PASSING_M:g} m beyond from_m: the length of a vehicle",
    )
    if event.speed_mps < scenario.formation.speed_mps:
        _check_part(scenario, name, event)
    else:
        require(event.to_m < road.length_m, f"{name}to_m", event.to_m, "a place on the road")


def _last_m(scenario: Scenario, section: LaneSection) -> float:
    """Return up to where a part of a section may be closed suddenly: its stop line, if any."""
    ends = LaneEnds(scenario)
    end = None if section.exit else ends.ahead(section.lane, section.from_m)
    return section.to_m if end is None else end.line_m


def check_closures(scenario: Scenario) -> None:
    """Check that closed parts of lanes are on the road, apart, and can be passed."""
    road = scenario.road
    open_m: dict[int, float] = dict.fromkeys(range(road.lanes), -math.inf)
    step_m = scenario.types.step_m
    for number, closure in enumerate(road.closures):
        name = f"road.closures[{number}]"
        allowed = f"a lane from 0 to {road.lanes - 1}"
        require(closure.lane < road.lanes, f"{name}.lane", closure.lane, allowed)
        allowed = f"more than from_m, {closure.from_m:g}"
        require(closure.to_m > closure.from_m, f"{name}.to_m", closure.to_m, allowed)
        after_m = open_m[closure.lane]
        again = f", and more than {after_m:g}, where lane {closure.lane} is open again"
        require(
            after_m < closure.from_m < road.length_m,
            f"{name}.from_m",
            closure.from_m,
            f"less than the length of the road, {road.length_m:g}"
            + (again if after_m > 0.0 else ""),
        )
        require(
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
        require(bool(lanes), "road.closures", [*map(attrs.astuple, road.closures)], allowed)
    given = [("demand.lane_shares", scenario.demand.lane_shares)]
    given += [
        (f"entrance[{number}].lane_shares", one.lane_shares)
        for number, one in enumerate(scenario.entrance)
    ]
    for name, shares in given:
        require(
            all(lane in reaching or not share for lane, share in enumerate(shares)),
            name,
            list(shares),
            f"shares of lanes that reach the end of the road, {reaching}, and 0 for the others",
        )


def check_lane_rules(scenario: Scenario) -> None:
    """Check restrictions and solid lines: the rolling operation, lanes, positions, types."""
    road, formation = scenario.road, scenario.formation
    rules: dict[str, LaneRule] = {
        f"road.restrictions[{number}]": one for number, one in enumerate(road.restrictions)
    }
    rules |= {f"road.solid_lines[{number}]": one for number, one in enumerate(road.solid_lines)}
    if not rules:
        return
    allowed = '"rolling" with road.restrictions or road.solid_lines'
    ok = "road.restrictions" not in formation.traits.unused
    require(ok, "formation.operation", formation.operation, allowed)
    for name, one in rules.items():
        allowed = f"a lane from 0 to {road.lanes - 1}"
        require(one.lane < road.lanes, f"{name}.lane", one.lane, allowed)
        allowed = f"less than the length of the road, {road.length_m:g}"
        require(one.from_m < road.length_m, f"{name}.from_m", one.from_m, allowed)
        allowed = f"more than from_m, {one.from_m:g}"
        require(one.to_m > one.from_m, f"{name}.to_m", one.to_m, allowed)
        allowed = f"names of types, each once: {', '.join(scenario.types)}"
        given = one.vehicle_types
        ok = set(given) <= scenario.types.keys() and len(set(given)) == len(given)
        require(ok, f"{name}.vehicle_types", list(given), allowed)
        if isinstance(one, SolidLine):
            allowed = f"the side of lane {one.lane} on which there is another lane"
            require(0 <= one.changes[0][1] < road.lanes, f"{name}.to", one.to, allowed)
        else:
            allowed = "at least one type; road.closures close a lane to all"
            require(bool(given), f"{name}.vehicle_types", list(given), allowed)
    _check_permitted_lanes(scenario)


def _check_permitted_lanes(scenario: Scenario) -> None:
    """Check that each type has a lane to enter by, and one to leave by if its demand is drawn."""
    road, demand = scenario.road, scenario.demand
    if not road.restrictions:
        return
    sections = scenario.geometry.sections
    shares = [TypeShare(one.name, one.share) for one in scenario.vehicle_type]
    entrances = [(MAIN_ENTRANCE, 0.0, road.first_lanes, shares, demand.destinations)]
    entrances += [
        (one.name, one.at_m, (one.lane,), list(one.vehicle_types) or shares, one.destinations)
        for one in scenario.entrance
    ]
    for entrance, at_m, lanes, types, destinations in entrances:
        cars = TypeShare(CAR, max(0.0, 1.0 - sum(one.share for one in types)))
        wanted = [one.exit for one in destinations if one.share > 0.0]
        if sum(one.share for one in destinations) < 1.0:
            wanted.append(END_OF_ROAD)
        for name in [one.type for one in (*types, cars) if one.share > ROUNDED_SHARE]:
            enters = any(not road.is_restricted(lane, at_m, name) for lane in lanes)
            _require_lane(enters, scenario, name, lanes, f"at entrance {entrance}")
            for destination in wanted if not scenario.sumo.config else ():
                ends = [one for one in sections if one.serves(ANY_LANE, destination)]
                leaves = not ends or any(road.may_leave_by(one, name) for one in ends)
                where = f"to leave by {destination}"
                _require_lane(leaves, scenario, name, [one.lane for one in ends], where)


def _require_lane(
    ok: bool, scenario: Scenario, vehicle_type: str, lanes: Collection[int], where: str
) -> None:
    """Require a lane for a type; the error names the first restriction of these lanes."""
    if not ok:
        number, one = next(
            (number, one)
            for number, one in enumerate(scenario.road.restrictions)
            if one.lane in lanes and one.applies_to(vehicle_type)
        )
        field = f"road.restrictions[{number}].vehicle_types"
        allowed = f"types other than {vehicle_type}, which has no lane left {where}"
        raise BadInputError(field, list(one.vehicle_types), allowed)


def check_entrances(scenario: Scenario) -> None:
    """Check that ramps are where lanes open, and that they are long enough."""
    road, names = scenario.road, {MAIN_ENTRANCE}
    for number, entrance in enumerate(scenario.entrance):
        name, lane = f"entrance[{number}]", entrance.lane
        allowed = f"a name of its own, other than {MAIN_ENTRANCE}"
        require(entrance.name not in names, f"{name}.name", entrance.name, allowed)
        names.add(entrance.name)
        formation = scenario.formation
        closures = [one for one in road.closures if one.lane == lane]
        opens_m = [one.to_m for one in closures]
        earlier = [(one.lane, one.at_m) for one in scenario.entrance[:number]]
        if formation.change_columns:
            allowed = "a lane that is closed from the start of the road to its only entrance"
            is_closed = any(one.from_m <= 0.0 for one in closures)
            ok = is_closed and lane not in dict(earlier)
        else:
            opens_m = [at_m for at_m in opens_m if at_m < road.length_m]
            allowed = "a lane that opens behind the start of the road (road.closures)"
            ok = bool(opens_m)
        require(ok, f"{name}.lane", lane, allowed)
        _check_opening(scenario, f"{name}.at_m", entrance, opens_m)
        ok = (lane, entrance.at_m) not in earlier
        require(ok, f"{name}.at_m", entrance.at_m, "a position without another entrance")
        low_m = entrance.at_m + formation.speed_mps * formation.settle_s
        sections = [one for one in scenario.geometry.sections if one.lane == lane]
        ends_m = [one.to_m for one in sections if one.to_m > entrance.at_m]
        early_m = early_start_m(scenario) if scenario.sumo.config else 0.0
        high_m = min(ends_m, default=road.length_m) - scenario.types.step_m + early_m
        require(
            low_m <= entrance.merge_m <= high_m,
            f"{name}.merge_m",
            entrance.merge_m,
            f"from {low_m:g}, formation.settle_s after entrance.at_m, to {high_m:g}, so that a "
            "step fits in before the end of the lane",
        )


def _check_opening(
    scenario: Scenario, field: str, entrance: Entrance, opens_m: Sequence[float]
) -> None:
    """Check that the lane of a ramp opens at its beginning; if it was open, far enough behind."""
    where = f"where lane {entrance.lane} opens"
    if scenario.formation.change_columns:
        require(entrance.at_m == opens_m[0], field, entrance.at_m, f"{opens_m[0]:g}, {where}")
        return
    sections = [one for one in scenario.geometry.sections if one.lane == entrance.lane]
    before = [one for one in sections if one.to_m <= entrance.at_m]
    # Bodies that leave by an exit and bodies that enter must not overlap on the road.
    tick_m = scenario.vehicle.max_speed_mps * scenario.runtime.tick_s
    after_m = max((one.to_m for one in before), default=-math.inf)
    after_m += scenario.types.longest_body_m + tick_m
    possible = [one for one in opens_m if one >= after_m]
    allowed = f"{' or '.join(f'{one:g}' for one in possible) or 'no position'}, {where}"
    if before:
        allowed += f" again, and {after_m:g} or more"
    require(entrance.at_m in possible, field, entrance.at_m, allowed)


def check_exits(scenario: Scenario) -> None:
    """Check that exits are at the ends of sections, with room for lane changes before them."""
    names, used = {END_OF_ROAD}, set[tuple[int, float]]()
    ends = {(one.lane, one.from_m) for one in scenario.road.closures}
    for number, exit_ in enumerate(scenario.exit):
        name = f"exit[{number}]"
        ok = exit_.name not in names and not exit_.name.startswith(end_exit(0)[:-1])
        allowed = f"a name of its own, other than {END_OF_ROAD} or lane-N"
        require(ok, f"{name}.name", exit_.name, allowed)
        names.add(exit_.name)
        places = {(lane, exit_.at_m) for lane in exit_.lanes}
        require(
            bool(places) and len(places) == len(exit_.lanes) and places <= ends - used,
            f"{name}.lanes",
            list(exit_.lanes),
            f"lanes that are closed from exit.at_m = {exit_.at_m:g} on, without another exit",
        )
        used |= places
        room = f"{re_entry(scenario).room_m:g} m for completing a change after stopping"
        for end in exit_lanes(scenario):
            if (end.lane, end.end_m) in places:
                _check_room(scenario, f"{name}.at_m", end, room)


def check_dead_ends(scenario: Scenario) -> None:
    """Check that vehicles can change lanes before each dead end, and drive on after stopping."""
    if not scenario.road.closures:
        return
    try:
        needed = re_entry(scenario)
    except ValueError as error:
        limits = {name: one.limits.max_accel_mps2 for name, one in scenario.types.items()}
        weakest = min(limits, key=lambda name: limits[name])
        name = limit_name(scenario, weakest, "max_accel_mps2")
        raise BadInputError(name, limits[weakest], f"more: {error}") from error
    sections = sections_to_lines(scenario)
    for end in dead_ends(scenario):
        name = next(
            f"road.closures[{number}].from_m"
            for number, closure in enumerate(scenario.road.closures)
            if (closure.lane, closure.from_m) == (end.lane, end.end_m)
        )
        _check_room(
            scenario,
            name,
            end,
            f"{needed.room_m:g} m for driving on after stopping at the end of the lane",
        )
        require(
            end.taken_back or bool(lanes_beside(scenario, end.lane, end.line_m, sections)),
            name,
            end.end_m,
            f"the end of a lane beside one that is open from {end.line_m:g} m, its stop line, to "
            f"{needed.distance_m:g} m after it",
        )
        before_m = end.line_m - scenario.formation.longest_m - scenario.types.step_m
        require(
            not scenario.formation.traits.has_formations
            or any(
                max(one.from_m, one.moves_from_m) <= before_m and one.to_m > end.end_m
                for one in scenario.geometry.sections
            ),
            name,
            end.end_m,
            f"the end of a lane beside one that is open from {before_m:g} m on, so that a whole "
            "formation can change lanes",
        )


def _check_room(scenario: Scenario, field: str, end: LaneEnd, room: str) -> None:
    """Check that the first move in a section that ends before the road ends before its line.

    The vehicles of a formation are known once it has passed all entrances, and it moves once all of
    it is in the section.

    Args:
        scenario: the scenario.
        field: name of the position of the end.
        end: the end of the section.
        room: what else has to fit, if vehicles are not taken back.
    """
    what, begins_m = "a step for changing lanes", max(end.from_m, end.moves_from_m)
    if end.taken_back:
        begins_m -= early_start_m(scenario)
        room = "room to stop while the body is in the lane"
    elif scenario.formation.traits.has_formations:
        geometry = scenario.geometry
        begins_m = max(begins_m, geometry.moves_from_m, *geometry.entry_m)
        begins_m += scenario.formation.longest_m
        what = f"a formation that has passed all entrances, and {what}"
    needed_m = first_step_m(scenario, begins_m) + end.end_m - end.line_m
    allowed = f"{what}, in lane {end.lane}, and {room}"
    require(end.end_m >= needed_m, field, end.end_m, allowed, needed_m)
