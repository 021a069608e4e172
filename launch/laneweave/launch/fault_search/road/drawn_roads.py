"""Roads whose lanes end, join or leave, drawn at random (at the real roadside).

One lane at an edge of the road is special: it ends, is blocked, comes from a ramp, leads to an
exit, or both. Or it leads to an exit, and then several ramps lead into it, one after another.
"""

from __future__ import annotations

import random

from attrs import frozen

from laneweave.protocol.scenario.road_tables import Closure, Entrance, Exit

KINDS = ("drop", "blocked", "on-ramp", "on-ramp", "off-ramp", "weaving", "weaving")
"""Kinds to draw from."""
RAMP_M = (30.0, 120.0)
"""Range of the lengths of ramps. Bodies enter in their cells, so they need not settle."""
WEAVING_STEPS = (2.0, 6.0)
"""Range of the distances in which vehicles change to or from the special lane, in slots at v_F."""
AFTER_M = 60.0
"""Distance between the last lane change and the end of the lane (`re_entry` needs 50 m)."""
BLOCKED_M = (30.0, 120.0)
VOLUME_VEH_PER_H = 800.0
"""A volume for the fields of ramps; the arrivals are drawn elsewhere."""
EXIT = "off-ramp"
RAMPS = 2
"""Number of ramps behind the exit of an interchange."""
SHORT_RAMP_M, SHORT_STEPS = (30.0, 60.0), (2.0, 3.0)
"""The same as `RAMP_M` and `WEAVING_STEPS` for interchanges: roads are short."""
WIDE, WIDE_SHARE = 2, 0.4
"""Number of lanes of wide exits and ramps, and the share of interchanges with them."""
BEHIND_M = (7.0, 30.0)
"""Range of the distances between the end of a lane and the next ramp into it."""


@frozen
class DrawnRoad:
    """Closed parts, ramps and exits of a road."""

    closures: tuple[Closure, ...] = ()
    entrance: tuple[Entrance, ...] = ()
    exit: tuple[Exit, ...] = ()
    keeps_columns: bool = False
    """Whether vehicles change lanes only."""


STRAIGHT_ROAD = DrawnRoad()


def draw_road(
    lanes: int, moves_from_m: float, step_m: float, rng: random.Random, formation_m: float = 0.0
) -> DrawnRoad:
    """Draw a road.

    Args:
        lanes: number of lanes, at least 2.
        moves_from_m: position from which vehicles move.
        step_m: distance at v_F in a slot.
        rng: source of all draws.
        formation_m: distance between the first and the last vehicle of the longest formation.
    """
    kind, lane = rng.choice(KINDS), rng.choice((0, lanes - 1))
    length_m = rng.uniform(*WEAVING_STEPS) * step_m + AFTER_M + formation_m
    if kind in ("drop", "blocked"):
        end_m = round(moves_from_m + length_m, 1)
        if kind == "drop":
            return DrawnRoad((Closure(lane, end_m),))
        return DrawnRoad((Closure(lane, end_m, round(end_m + rng.uniform(*BLOCKED_M), 1)),))
    if kind == "off-ramp":
        opens_m = round(rng.uniform(0.5, 2.0) * moves_from_m, 1)
        end_m = round(max(opens_m, moves_from_m) + length_m, 1)
        closures = Closure(lane, 0.0, opens_m), Closure(lane, end_m)
        return DrawnRoad(closures, exit=(Exit(EXIT, (lane,), end_m),))
    at_m = round(rng.uniform(*RAMP_M), 1)
    merge_m = round(at_m + rng.uniform(*RAMP_M), 1)
    end_m = round(max(merge_m, moves_from_m) + length_m, 1)
    closures = Closure(lane, 0.0, at_m), Closure(lane, end_m)
    entrance = (Entrance("on-ramp", lane, at_m, merge_m, VOLUME_VEH_PER_H),)
    exits = (Exit(EXIT, (lane,), end_m),) if kind == "weaving" else ()
    return DrawnRoad(closures, entrance, exits)


def draw_interchange(
    lanes: int, moves_from_m: float, step_m: float, rng: random.Random
) -> DrawnRoad:
    """Draw a road with an exit, and ramps behind it, in the same lane; arguments as `draw_road`.

    Or the exit has two lanes, and a ramp of two lanes follows, which go on to the end of the road.
    """
    if lanes > WIDE and rng.random() < WIDE_SHARE:
        return _draw_wide_interchange(lanes, moves_from_m, step_m, rng)
    lane = rng.choice((0, lanes - 1))
    opens_m = rng.choice((0.0, round(rng.uniform(0.5, 1.0) * moves_from_m, 1)))
    closures = [Closure(lane, 0.0, opens_m)] if opens_m else []

    def end_m(from_m: float) -> float:
        return round(from_m + rng.uniform(*SHORT_STEPS) * step_m + AFTER_M, 1)

    ends_m = end_m(max(opens_m, moves_from_m))
    exits = (Exit(EXIT, (lane,), ends_m),)
    ramps = []
    for number in range(RAMPS):
        at_m = round(ends_m + rng.uniform(*BEHIND_M), 1)
        merge_m = round(at_m + rng.uniform(*SHORT_RAMP_M), 1)
        closures.append(Closure(lane, ends_m, at_m))
        ramps.append(Entrance(f"on-ramp-{number}", lane, at_m, merge_m, VOLUME_VEH_PER_H))
        ends_m = end_m(merge_m)
    closures.append(Closure(lane, ends_m))
    return DrawnRoad(tuple(closures), tuple(ramps), exits, keeps_columns=True)


def _draw_wide_interchange(
    lanes: int, moves_from_m: float, step_m: float, rng: random.Random
) -> DrawnRoad:
    special = rng.choice((tuple(range(WIDE)), tuple(range(lanes - WIDE, lanes))))
    exit_m = round(moves_from_m + WIDE * rng.uniform(*SHORT_STEPS) * step_m + AFTER_M, 1)
    at_m = round(exit_m + rng.uniform(*BEHIND_M), 1)
    merge_m = round(at_m + rng.uniform(*SHORT_RAMP_M), 1)
    return DrawnRoad(
        tuple(Closure(lane, exit_m, at_m) for lane in special),
        tuple(
            Entrance(f"on-ramp-{lane}", lane, at_m, merge_m, VOLUME_VEH_PER_H) for lane in special
        ),
        (Exit(EXIT, special, exit_m),),
        keeps_columns=True,
    )
