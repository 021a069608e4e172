"""Checks of formations and types of vehicles: sizes, slots, braking, settling."""

from __future__ import annotations

import math

from laneweave.protocol.config.rules import compare, require
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import (
    MAX_HORIZON_TICKS,
    PEAK_ACCEL,
    PEAK_JERK,
    Vehicle,
)
from laneweave.protocol.vehicle.emergency_brake import ERROR_SIGMAS, EmergencyBrake, spare_error_m
from laneweave.protocol.wire.messages import CAR, Neighbour

MIN_GAP_M = 1.0
"""Minimum gap between bumpers in neighbouring cells; covers rotation and tracking errors."""


def check_types(scenario: Scenario) -> None:
    """Check that types of vehicles have names of their own, and shares of the demand."""
    types = scenario.vehicle_type
    names = [one.name for one in types]
    for number, name in enumerate(names):
        is_new = name != CAR and name not in names[:number]
        allowed = f"a name that no other type has; {CAR} is the type of table vehicle"
        require(is_new, f"vehicle_type[{number}].name", name, allowed)
    given = [("vehicle_type.share", [one.share for one in types])]
    for number, entrance in enumerate(scenario.entrance):
        name, own = f"entrance[{number}].vehicle_types", entrance.vehicle_types
        for place, one in enumerate(own):
            allowed = f"one of {', '.join(names)}" if names else "none: there is no vehicle_type"
            is_new = one.type not in [other.type for other in own[:place]]
            allowed += "" if is_new else ", each once"
            require(one.type in names and is_new, f"{name}[{place}].type", one.type, allowed)
        given.append((name, [one.share for one in own]))
    for name, shares in given:
        require(sum(shares) <= 1.0 + 1e-9, name, shares, "shares with a sum of at most 1")
    _check_types_of_structures(scenario)


def _check_types_of_structures(scenario: Scenario) -> None:
    """Check that all types drive all moves if structures are given: any vehicle gets any place."""
    formation = scenario.formation
    if not formation.structures or "formation.structures" in formation.traits.unused:
        return
    for name, own in scenario.types.items():
        for limit, needed in scenario.types.column_move_limits.items():
            value = getattr(own.limits, limit)
            shown = math.ceil(100.0 * needed) / 100.0
            require(
                abs(value) >= needed,
                limit_name(scenario, name, limit),
                value,
                (f"at most {-shown:g}" if value < 0.0 else f"at least {shown:g}")
                + " with formation.structures, where each vehicle moves by a column of "
                f"{formation.gap_m:g} m in T_F (formation.cycle_s)",
            )


def check_motion(scenario: Scenario) -> None:
    """Check pitch, speed and length of formations."""
    formation, vehicle = scenario.formation, scenario.vehicle
    gap_m = max(scenario.tracking.min_gap_m, MIN_GAP_M)
    what = f"the longest length_m, and tracking.min_gap_m between bumpers, at least {MIN_GAP_M:g}"
    min_gap_m = scenario.types.longest_body_m + gap_m
    compare(scenario, [("formation.gap_m", "at least", min_gap_m, what)])
    cycle_s, move_s = formation.cycle_s, formation.move_s
    if move_s is not None:
        allowed = "none without" if cycle_s is None else f"at most {cycle_s:g},"
        ok = cycle_s is not None and move_s <= cycle_s
        require(ok, "formation.move_s", move_s, f"{allowed} formation.cycle_s")
    max_mps = vehicle.max_speed_mps
    compare(scenario, [("formation.speed_mps", "less than", max_mps, "vehicle.max_speed_mps")])
    require(
        (formation.weight_oblique or 0) <= formation.oblique_steps,
        "formation.weight_oblique",
        formation.weight_oblique,
        "at most 1 in mode 2 (an oblique edge is one step), at most 2 in mode 1",
    )
    needed_m = scenario.formation.longest_m + scenario.types.step_m
    what = "a whole formation and one step" if formation.max_length > 1 else "one step"
    compare(scenario, [("road.s3_m", "at least", needed_m, what)])
    require(
        formation.executable,
        "formation.conflicts",
        sorted(formation.conflict_kinds),
        "geometric, or in mode 1 node, edge and special-1: moves of one step must have disjoint "
        "footprints to be executed without a timetable",
    )


def check_structures(scenario: Scenario) -> None:
    """Check that structures ascend along the road, begin before S3 and use existing lanes."""
    road, before_m = scenario.road, -1.0
    require(
        not (scenario.formation.structures and road.closures),
        "formation.structures",
        [one.structure for one in scenario.formation.structures],
        "none, on a road with closures: formations change to the open lanes by themselves",
    )
    for number, structure in enumerate(scenario.formation.structures):
        name = f"formation.structures[{number}]"
        require(
            before_m < structure.from_m < road.sorting_start_m,
            f"{name}.from_m",
            structure.from_m,
            f"ascending, and less than road.s1_m + road.s2_m = {road.sorting_start_m:g}",
        )
        before_m = structure.from_m
        lanes = structure.lanes
        require(
            len(set(lanes)) == len(lanes) and set(lanes) <= set(range(road.lanes)),
            f"{name}.lanes",
            list(lanes),
            f"distinct lanes from 0 to {road.lanes - 1}",
        )


def check_timing(scenario: Scenario) -> None:
    """Check the durations of moves."""
    runtime, formation = scenario.runtime, scenario.formation
    shortest_s, longest_s = scenario.timing.cycles_s
    longest_move_s = longest_s - formation.slack_s
    for name, value in (
        ("cycle_s", shortest_s),
        ("cycle_s", longest_s),
        ("move_s", shortest_s - formation.slack_s),
    ):
        allowed = f"a multiple of runtime.tick_s = {runtime.tick_s:g}, at least two ticks"
        require(_in_ticks(scenario, value, 2), f"formation.{name}", value, allowed)
    require(
        scenario.timing.horizon_ticks * runtime.tick_s >= longest_move_s - 1e-6,
        "tracking.horizon_ticks",
        scenario.timing.horizon_ticks,
        f"long enough for a whole move of {longest_move_s:g} s, at most {MAX_HORIZON_TICKS}",
    )
    require(
        scenario.timing.horizon_ticks <= MAX_HORIZON_TICKS,
        "runtime.tick_s",  # an explicit horizon has its own bound
        runtime.tick_s,
        f"long enough for the longest T_F, {longest_s:g} s, to have at most {MAX_HORIZON_TICKS} "
        "ticks",
    )


def _in_ticks(scenario: Scenario, time_s: float, min_ticks: int) -> bool:
    """Return whether a time is a whole number of ticks, at least `min_ticks`."""
    ticks = time_s / scenario.runtime.tick_s
    return ticks >= min_ticks - 1e-6 and abs(ticks - round(ticks)) < 1e-6


def check_braking(scenario: Scenario) -> None:
    """Check that vehicles that hold behind each other need no emergency braking."""
    reaction_s = scenario.braking.reaction_s
    tick_s = scenario.runtime.tick_s
    allowed = f"a multiple of runtime.tick_s = {tick_s:g}: sensors measure each tick"
    require(_in_ticks(scenario, reaction_s, 1), "braking.reaction_s", reaction_s, allowed)
    gap_m = scenario.formation.gap_m
    hardest_mps2 = max(scenario.braking.lead_brake_mps2, -scenario.vehicle.min_accel_mps2)
    for number, vehicle_type in enumerate(scenario.vehicle_type):
        if vehicle_type.min_accel_mps2 is not None:
            require(
                -vehicle_type.min_accel_mps2 <= hardest_mps2,
                f"vehicle_type[{number}].min_accel_mps2",
                vehicle_type.min_accel_mps2,
                f"at least {-hardest_mps2:g}: vehicles behind expect no harder braking "
                "(braking.lead_brake_mps2)",
            )
    for name, own in scenario.types.items():
        min_m = min_pitch_m(scenario, own.limits)
        require(
            gap_m >= min_m,
            "formation.gap_m",
            gap_m,
            f"at least {math.ceil(1000.0 * min_m) / 1000.0:g}: a {name} that holds behind another "
            f"vehicle at formation.speed_mps = {scenario.formation.speed_mps:g} must not need "
            "emergency braking (length_m and min_accel_mps2 of each type, the tables braking and "
            "sensing)",
        )


def check_settling(scenario: Scenario) -> None:
    """Check that a vehicle can settle in its cell within its limits.

    The minimum-jerk motion from rest to rest over d in T has a peak speed of 15/8 d/T, a peak
    acceleration of 10/sqrt(3) d/T^2 and a peak jerk of 60 d/T^3.
    """
    formation = scenario.formation
    # Types that do not change columns enter in their cells.
    limits = [one.limits for one in scenario.types.values() if one.changes_columns]
    if not limits:
        return
    offset_m = formation.entry_spread_s * formation.speed_mps
    max_mps = min(one.max_speed_mps for one in limits)
    speed_mps = min(max_mps - formation.speed_mps, formation.speed_mps)
    accel_mps2 = min(min(one.max_accel_mps2, -one.min_accel_mps2) for one in limits)
    jerk_mps3 = min(one.max_jerk_mps3 for one in limits)
    min_s = max(
        15.0 / 8.0 * offset_m / speed_mps,
        math.sqrt(PEAK_ACCEL * offset_m / accel_mps2),
        math.cbrt(PEAK_JERK * offset_m / jerk_mps3),
    )
    require(
        formation.settle_s >= min_s,
        "formation.settle_s",
        formation.settle_s,
        f"at least {math.ceil(10.0 * min_s) / 10.0:g}: a vehicle that enters up to "
        f"{offset_m:g} m from its cell settles there within its limits",
    )


def limit_name(scenario: Scenario, vehicle_type: str, name: str) -> str:
    """Return the name of the field with a limit of a type of vehicle."""
    if vehicle_type == CAR:
        return f"vehicle.{name}"
    number = [one.name for one in scenario.vehicle_type].index(vehicle_type)
    return f"vehicle_type[{number}].{name}"


def min_pitch_m(scenario: Scenario, limits: Vehicle) -> float:
    """Return the minimum column pitch at which a vehicle that holds behind another does not brake.

    The other is of the longest type. The pitch allows for measurement errors up to `ERROR_SIGMAS`.
    """
    speed_mps, pitch_m = scenario.formation.speed_mps, scenario.formation.gap_m
    assumed = scenario.braking
    ahead = Neighbour(0, pitch_m - scenario.types.longest_body_m, speed_mps)
    holding = (0.0, speed_mps, 0.0, 0.0, 0.0, 0.0)
    brake = EmergencyBrake(limits, assumed, scenario.runtime.tick_s)
    spare_m = brake.spare_m(holding, 0.0, (0.0, 0.0), [ahead])
    error_m = spare_error_m(limits, assumed, scenario.sensing, speed_mps, speed_mps)
    return pitch_m - spare_m + ERROR_SIGMAS * error_m
