"""The scenario of a corridor: its road, and a random demand like that of its vehicles."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from laneweave.protocol.config.demand_checks import MIN_SIDE_GAP_M, check_volumes
from laneweave.protocol.config.motion_checks import min_pitch_m
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import SLACK_S
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE, Closure
from laneweave.protocol.scenario.timing import CYCLE_STEP_S, SHORTEST_CYCLE_S
from laneweave.protocol.structuring import structure
from laneweave.protocol.vehicle.re_entry import own_re_entry, re_entry
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.corridors.corridor import (
    MAX_SPEED_MPS,
    OPTION,
    POCKET_M,
    POCKET_S,
    RESERVE_SHARE,
    Corridor,
    Ramp,
    lattice_speed_mps,
)
from laneweave.sim_bridge.corridors.settling import SLOW_ENTRY_S
from laneweave.sim_bridge.corridors.sumo_corridor import Pass, SumoCorridor
from laneweave.sim_bridge.corridors.sumo_simulation import SumoType

MIN_VOLUME_VEH_PER_H = 0.1
MAX_VOLUME_VEH_PER_H = 3600.0
MIN_SETTLE_S = 1.0
SPARE_PITCH_M = 2.0
"""Part of the column pitch that leaves room for moves to a cell ahead."""
HEADWAY_S = 1.0
"""Minimum column pitch as a time, as the paper's 15 m at 15 m/s. A vehicle that has fallen behind
its cell can then catch up without coming so close to the one ahead that it has to brake."""
MAX_SETTLE_S, APPROACH_SETTLE_S = 8.0, 4.0
"""Time in which vehicles settle in their cells, if ramps are long enough; on approaches, where
there is little room before the queue, lane changes begin sooner."""
SPEED_STEP_MPS = 0.5
"""v_F is a multiple of it."""
SLOWEST_MPS = 8.0
"""Lowest v_F of a short approach."""
_WIDE_M = 100.0
"""A column pitch that suits all types."""
Tables = dict[str, Any]


def checked_tables(found: SumoCorridor, sumo: Tables) -> Tables:
    """Return the tables of a scenario file, which laneweave can drive.

    Args:
        found: the corridor with its vehicles.
        sumo: the table `sumo`.

    Raises:
        BadInputError: it cannot; the error names the ramp, exit or edge.
    """
    fastest_mps = _fastest_mps(found)
    spare_mps = lattice_speed_mps(fastest_mps) - (1.0 - RESERVE_SHARE) * fastest_mps
    for step in range(math.ceil(spare_mps / SPEED_STEP_MPS)):
        try:
            return _checked(found, sumo, step * SPEED_STEP_MPS)
        except BadInputError:
            continue  # what is too short for v_F may be long enough for a lower one
    return _checked(found, sumo, spare_mps)


def _checked(found: SumoCorridor, sumo: Tables, slower_mps: float) -> Tables:
    """Return the tables for a v_F that is lower by `slower_mps`; see `checked_tables`."""
    corridor = found.corridor
    tables = scenario_tables(found, slower_mps) | {"sumo": sumo}
    try:
        parse_scenario(tables)
    except BadInputError as error:
        places = _places(tables, corridor)
        where = next((text for field, text in places if error.field.startswith(field)), "")
        field = f"{error.field} of its scenario"
        field = f"{OPTION} {corridor.name}, " + (f"{where} ({field})" if where else field)
        allowed = error.allowed
        if error.at_least is not None and isinstance(error.value, float):
            allowed += f"; {error.at_least - error.value:.0f} m longer are enough"
        raise BadInputError(field, error.value, allowed) from error
    return tables


def _places(tables: Tables, corridor: Corridor) -> Iterator[tuple[str, str]]:
    """Yield beginnings of names of fields, and what is in the network there."""
    yield "road.s", f"{corridor.length_m:.0f} m long"
    for number, out in enumerate(corridor.ways_out):
        open_m = out.at_m - max(corridor.opens_m(out.lanes, out.at_m), 0.0)
        lanes = " and ".join(corridor.lane_name(lane, out.at_m) for lane in out.lanes)
        yield f"exit[{number}]", f"exit to {out.edge} from lane {lanes}, open for {open_m:.0f} m"
    ramps = {ramp.name: ramp for ramp in corridor.ramps}
    for number, entrance in enumerate(tables.get("entrance", ())):
        ramp = ramps[entrance["name"]]
        lane = corridor.lane_name(ramp.lane, ramp.merge_m)
        used_m = ramp.merge_m - ramp.at_m
        open_m = min(corridor.ends_m(ramp.lane, ramp.merge_m), corridor.length_m) - ramp.merge_m
        text = f"on-ramp from {ramp.edge} of {used_m:.0f} m into lane {lane} of {open_m:.0f} m"
        yield f"entrance[{number}]", text
    for number, closure in enumerate(tables["road"].get("closures", ())):
        lane, to_m = closure["lane"], closure.get("to_m", math.inf)
        opening = f"lane {corridor.lane_name(lane, to_m)}, which begins at {to_m:.0f} m"
        yield f"road.closures[{number}].to_m", opening
        end = corridor.lane_name(lane, closure.get("from_m", 0.0))
        yield f"road.closures[{number}]", f"end of lane {end}"


def _fastest_mps(found: SumoCorridor) -> float:
    """Return the lowest speed limit of edges and types."""
    types = found.type_names()
    return min(MAX_SPEED_MPS, found.corridor.speed_mps, *(one.max_speed_mps for one in types))


def scenario_tables(found: SumoCorridor, slower_mps: float = 0.0) -> Tables:
    """Return the tables of a scenario file, not checked against each other.

    Vehicles arrive at random with the mean volumes of the simulation. No vehicle exceeds the lowest
    speed limit of edges and types, and v_F is a little lower (`lattice_speed_mps`). The column
    pitch is the minimum that suits all types, but at least `HEADWAY_S` long, and T_F is long enough
    for moves between lanes.

    Args:
        found: the corridor with its vehicles.
        slower_mps: by how much v_F is lower still.

    Raises:
        BadInputError: no vehicle enters at the start of the corridor, or it is too short.
    """
    corridor = found.corridor
    by_entrance: dict[str, list[Pass]] = {}
    for one in found.passes:
        by_entrance.setdefault(one.entrance, []).append(one)
    main = by_entrance.get(MAIN_ENTRANCE, [])
    if not main:
        allowed = f"a corridor that vehicles enter on {corridor.edges[0].name}"
        left_out = " and ".join(f"{count} {reason}" for reason, count in found.missing.items())
        allowed += f"; of those left out, {left_out}" if left_out else ""
        raise BadInputError(OPTION, corridor.name, allowed)
    names = found.type_names()
    car, *others = names
    own_names = {**names, car: CAR}
    fastest_mps = _fastest_mps(found)
    duration_s = found.simulation.duration_s
    ramps = [ramp for ramp in corridor.ramps if ramp.entrance in by_entrance]
    lanes_of = Counter(ramp.entrance for ramp in ramps)
    first_lanes = corridor.lanes - sum(one.from_m <= 0.0 for one in corridor.closures)
    tables: Tables = {
        "road": {
            "lanes": corridor.lanes,
            "lane_width_m": corridor.lane_width_m,
            "closures": [_closure(one, corridor, ramps) for one in corridor.closures],
            "restrictions": [*_restrictions(corridor, own_names)],
            "solid_lines": [*_solid_lines(corridor, own_names)],
        },
        "entrance": [
            {
                "name": ramp.name,
                "lane": ramp.lane,
                "at_m": _m(ramp.at_m),
                "merge_m": _m(ramp.merge_m),
                "volume_veh_per_h": _volume(
                    len(by_entrance[ramp.entrance]), duration_s, lanes_of[ramp.entrance]
                ),
                "destinations": _destinations(by_entrance[ramp.entrance]),
                "vehicle_types": [
                    {"type": names[one], "share": share}
                    for one, share in _shares_of_types(by_entrance[ramp.entrance]).items()
                    if one != car
                ],
            }
            for ramp in ramps
        ],
        "exit": [
            {"name": one.name, "lanes": list(one.lanes), "at_m": _m(one.at_m)}
            for one in corridor.ways_out
        ],
        "demand": {
            "volume_veh_per_lane_h": _volume(len(main), duration_s, first_lanes),
            "duration_s": float(math.ceil(duration_s)),
            "destinations": _destinations(main),
            "lane_shares": _lane_shares(found.passes, corridor.lanes),
        },
        "vehicle": {**car.limits, "max_speed_mps": round(fastest_mps, 2)},
        "vehicle_type": [
            {"name": names[one], "share": _shares_of_types(main).get(one, 0.0), **one.limits}
            for one in others
        ],
    }
    _check_widths(corridor, names)
    speed_mps = _rounded_mps(lattice_speed_mps(fastest_mps) - slower_mps)
    formation = _motion(tables, corridor, speed_mps)
    body_m = max(one.length_m for one in names)
    if corridor.lanes_to:
        # Where an approach is short, vehicles drive so slowly that they reach their lanes.
        takes_s = SLOW_ENTRY_S + corridor.most_changes * formation["cycle_s"]
        enough_mps = _rounded_mps((corridor.length_m - body_m) / takes_s)
        if enough_mps < speed_mps:
            speed_mps = min(speed_mps, max(enough_mps, SLOWEST_MPS))
            formation = _motion(tables, corridor, speed_mps)
    tables["formation"] = formation
    settled_m = _m(speed_mps * formation["settle_s"])
    if settled_m >= corridor.length_m:
        raise BadInputError(OPTION, corridor.name, f"a corridor longer than {settled_m:g} m")
    tables["road"] |= {"s1_m": settled_m, "s2_m": 0.0, "s3_m": _m(corridor.length_m - settled_m)}
    tables["road"] = {name: value for name, value in tables["road"].items() if value != []}
    filled = {name: table for name, table in tables.items() if table}
    return {"schema": "laneweave.scenario/1", **filled}


def remarks(found: SumoCorridor, tables: Tables) -> list[str]:
    """Return what makes trips longer than the lanes require, in words.

    Args:
        found: the corridor with its vehicles.
        tables: the tables of its scenario file.
    """
    remarks = []
    allowed_mps = found.corridor.speed_mps
    counts = Counter(one.vehicle.vehicle_type for one in found.passes)
    slowest = min(counts, key=lambda kind: kind.max_speed_mps, default=None)
    if slowest is not None and slowest.max_speed_mps < allowed_mps:
        remarks.append(
            f"v_F follows from {slowest.max_speed_mps:.1f} m/s, the maximum speed of class "
            f"{slowest.vehicle_class} ({counts[slowest]} of {len(found.passes)} vehicles); the "
            f"lanes allow {allowed_mps:.1f} m/s"
        )
    try:
        check_volumes(structure(tables, Scenario))
    except BadInputError as error:
        what = f"{error.field} is {error.value:g}, without waiting {error.allowed}"
        remarks.append(f"vehicles wait at the entrances: {what}")
    return remarks


def _check_widths(corridor: Corridor, names: Mapping[SumoType, str]) -> None:
    """Check that vehicles fit between those in the lanes beside theirs.

    Raises:
        BadInputError: a type is too wide for the narrowest lane.
    """
    widest = max(names, key=lambda kind: kind.width_m)
    most_m = corridor.lane_width_m - MIN_SIDE_GAP_M
    if widest.width_m > most_m:
        raise BadInputError(
            f"{OPTION} {corridor.name}, width of vehicles of class {names[widest]}",
            widest.width_m,
            f"at most {most_m:g} m, {MIN_SIDE_GAP_M:g} m less than its narrowest lane is wide",
        )


def _volume(vehicles: int, duration_s: float, lanes: int = 1) -> float:
    """Return a volume [veh/h] as scenarios allow it; it is that of a drawn demand only."""
    volume = round(3600.0 / duration_s * vehicles / lanes, 1)
    return min(max(volume, MIN_VOLUME_VEH_PER_H), MAX_VOLUME_VEH_PER_H)


def _rounded_mps(speed_mps: float) -> float:
    return math.floor(speed_mps / SPEED_STEP_MPS) * SPEED_STEP_MPS


def _m(position_m: float) -> float:
    return round(position_m, 2)


def _closure(closure: Closure, corridor: Corridor, ramps: Sequence[Ramp]) -> dict[str, Any]:
    """Return the table of a closed part.

    A ramp without vehicles is closed; so is its acceleration lane if it begins just before the end.
    """
    to_m = closure.to_m
    late_m = POCKET_M + POCKET_S * lattice_speed_mps(corridor.speed_mps)
    for ramp in corridor.ramps:
        if (ramp.lane, ramp.at_m) == (closure.lane, to_m) and ramp not in ramps:
            to_m = ramp.merge_m if ramp.merge_m <= corridor.length_m - late_m else math.inf
    table: dict[str, Any] = {"lane": closure.lane}
    table |= {"from_m": _m(closure.from_m)} if closure.from_m > 0.0 else {}
    return table | ({"to_m": _m(to_m)} if to_m < corridor.length_m else {})


def _restrictions(corridor: Corridor, names: Mapping[SumoType, str]) -> Iterator[dict[str, Any]]:
    """Yield the tables of the parts of lanes in which some types may not drive."""
    for number, from_m, to_m, lane in corridor.parts():
        banned = [name for kind, name in names.items() if not lane.allows(kind.vehicle_class)]
        if banned:
            yield _part(number, from_m, to_m) | {"vehicle_types": banned}


def _solid_lines(corridor: Corridor, names: Mapping[SumoType, str]) -> Iterator[dict[str, Any]]:
    """Yield the tables of the lines that some types may not cross."""
    for number, from_m, to_m, lane in corridor.parts():
        for side, beside in (("left", number + 1), ("right", number - 1)):
            kept = [
                name
                for kind, name in names.items()
                if not lane.allows_change(kind.vehicle_class, side)
            ]
            if kept and 0 <= beside < corridor.lanes:
                types = {} if len(kept) == len(names) else {"vehicle_types": kept}
                yield _part(number, from_m, to_m) | {"to": side, **types}


def _part(lane: int, from_m: float, to_m: float) -> dict[str, Any]:
    return {"lane": lane, "from_m": _m(max(from_m, 0.0)), "to_m": _m(to_m)}


def _destinations(passes: Sequence[Pass]) -> list[dict[str, Any]]:
    counts = Counter(one.destination for one in passes)
    return [
        {"exit": name, "share": _share(count, len(passes))}
        for name, count in sorted(counts.items())
        if name != END_OF_ROAD
    ]


def _lane_shares(passes: Sequence[Pass], lanes: int) -> list[float]:
    """Return the shares of lanes in which vehicles want to leave at the end; none: no preferences.

    A vehicle whose route continues from several lanes counts for each of them.
    """
    counts = Counter(lane for one in passes for lane in one.lanes)
    return [round(counts[lane] / counts.total(), 4) for lane in range(lanes)] if counts else []


def _shares_of_types(passes: Sequence[Pass]) -> Mapping[SumoType, float]:
    counts = Counter(one.vehicle.vehicle_type for one in passes)
    return {kind: _share(count, len(passes)) for kind, count in counts.items()}


def _share(count: int, total: int) -> float:
    """Return a share, rounded down, so that the sum of all is at most 1."""
    return 10_000 * count // total / 10_000


def _motion(tables: Tables, corridor: Corridor, speed_mps: float) -> dict[str, Any]:
    """Return the table `formation`."""
    formation = {
        "operation": "rolling",
        "speed_mps": speed_mps,
        "change_columns": False,
        "sort_in_s2": True,
    }
    kinds = {name: tables[name] for name in ("road", "vehicle", "vehicle_type")}
    wide = structure({"formation": formation | {"gap_m": _WIDE_M}, **kinds}, Scenario)
    least_m = max(min_pitch_m(wide, own.limits) for own in wide.types.values()) + SPARE_PITCH_M
    pitch_m = math.ceil(max(least_m, HEADWAY_S * speed_mps))
    ramps_m = {one["name"]: one["merge_m"] - one["at_m"] for one in tables["entrance"]}
    longest_s = APPROACH_SETTLE_S if corridor.lanes_to else MAX_SETTLE_S
    settle_s = min([longest_s, *(length_m / speed_mps for length_m in ramps_m.values())])
    if settle_s < MIN_SETTLE_S:
        name = min(ramps_m, key=ramps_m.__getitem__)
        ramp = next(one for one in corridor.ramps if one.name == name)
        if not ramp.path:
            allowed = (
                "on-ramps whose vehicles have priority where their acceleration lanes begin, and "
                "from whose last edges all lanes and all vehicles lead to the corridor"
            )
            raise BadInputError(f"{OPTION} {corridor.name}, on-ramp", ramp.edge, allowed)
        raise BadInputError(
            f"{OPTION} {corridor.name}, length of the on-ramp from {ramp.edge}",
            round(max(ramps_m[name], 0.0), 1),
            f"at least {MIN_SETTLE_S * speed_mps:g} m, for {speed_mps:g} m/s",
        )
    formation |= {"gap_m": float(pitch_m)}
    found = structure({"formation": formation, **kinds}, Scenario)
    for own in found.types.values():
        try:
            own_re_entry(found, own.limits)
        except ValueError as error:
            max_accel_mps2 = own.limits.max_accel_mps2
            field = (
                f"{OPTION} {corridor.name}, vehicles that accelerate with {max_accel_mps2:g} m/s2"
            )
            raise BadInputError(
                field, max_accel_mps2, f"more, for {speed_mps:g} m/s: {error}"
            ) from error
    cycle_s = _cycle_s(found, corridor)
    room_m = _settling_room_m(found, corridor, speed_mps * cycle_s)
    settle_s = max(MIN_SETTLE_S, min(settle_s, room_m / speed_mps))
    settle_s = math.floor(10.0 * settle_s) / 10.0
    return formation | {"settle_s": settle_s, "cycle_s": cycle_s}


def _settling_room_m(scenario: Scenario, corridor: Corridor, advance_m: float) -> float:
    """Return how far vehicles may drive from the start before lane changes have to begin.

    Lanes that are open at the start may end soon, and an approach is short: corridors may begin
    where a ramp joins.

    Args:
        scenario: types, lattice and limits.
        corridor: the corridor.
        advance_m: distance driven in a lane change.
    """
    body_m, stopping_m = scenario.types.longest_body_m, re_entry(scenario).room_m
    rooms_m = [corridor.length_m - max(corridor.most_changes, 1) * advance_m]
    for lane in corridor.edges[0].lanes:
        end_m = corridor.ends_m(lane, 0.0)
        if end_m < corridor.length_m:
            # A slot may begin just before it is possible to begin moves.
            rooms_m.append(end_m - stopping_m - 2.0 * advance_m)
        for out in corridor.ways_out:
            changes = min(abs(one - lane) for one in out.lanes)
            rooms_m.append(out.at_m - stopping_m - (changes + 1) * advance_m)
    return min(rooms_m) - body_m


def _cycle_s(scenario: Scenario, corridor: Corridor) -> float:
    """Return the longest T_F with which vehicles reach all exits, or the shortest possible one.

    The minimum-jerk motion over d in T has a peak acceleration of 10/sqrt(3) d/T^2 and a peak jerk
    of 60 d/T^3; vehicles use at most 90 % of their limits.
    """
    lane_m, limits = scenario.road.lane_width_m, [one.limits for one in scenario.types.values()]
    accel_mps2 = 0.9 * min(one.max_lateral_accel_mps2 for one in limits)
    jerk_mps3 = 0.9 * min(one.max_lateral_jerk_mps3 for one in limits)
    move_s = max(
        math.sqrt(10.0 / math.sqrt(3.0) * lane_m / accel_mps2), math.cbrt(60.0 * lane_m / jerk_mps3)
    )
    shortest_s = CYCLE_STEP_S * math.ceil((move_s + SLACK_S) / CYCLE_STEP_S)
    needed_m = re_entry(scenario).room_m + scenario.types.longest_body_m
    rooms_m = [
        one.at_m - corridor.opens_m(one.lanes, one.at_m) - needed_m for one in corridor.ways_out
    ]
    # At a ramp, a slot shall begin where a move into the next lane is possible.
    rooms_m += [
        0.5 * (corridor.ends_m(ramp.lane, ramp.merge_m) - ramp.merge_m - needed_m)
        for ramp in corridor.ramps
    ]
    if corridor.lanes_to:
        rooms_m.append(0.0)  # the queue may leave little room: the sooner a move ends, the better
    longest_s = min(rooms_m, default=math.inf) / scenario.formation.speed_mps
    steps = math.floor(min(longest_s, SHORTEST_CYCLE_S) / CYCLE_STEP_S + 1e-9)
    return round(max(CYCLE_STEP_S * steps, shortest_s), 1)
