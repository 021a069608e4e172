"""Which lane changes break restrictions and solid lines, point by point along moving bodies.

Nothing here is fast, and nothing is shared with the planner but the tables of the scenario.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from laneweave.protocol.scenario.road_tables import LaneRule, Restriction

Cell = tuple[int, int]

STEP_M = 0.5
"""Distance between the points; parts of lanes are longer."""


def broken_rules(
    path: Sequence[Cell],
    slot: int,
    lattice: tuple[float, float, float],
    vehicle_type: str,
    rules: Sequence[LaneRule],
) -> list[str]:
    """Return what is wrong with the lane changes of a vehicle that moves at the beginning of slots.

    Args:
        path: its cells at the beginning of each slot from `slot` on.
        slot: number of the first slot.
        lattice: length of a cell, travel in a slot, length of the body [m].
        vehicle_type: its type.
        rules: restrictions and solid lines of the road.
    """
    pitch_m, advance_m, body_m = lattice
    found = []
    for s, (here, there) in enumerate(pairwise(path), start=slot):
        if here[1] == there[1]:
            continue
        fronts = (here[0] * pitch_m + s * advance_m, there[0] * pitch_m + (s + 1) * advance_m)
        points = [*_points(fronts[0] - body_m, fronts[1])]
        found += [
            f"{here} to {there} in slot {s}: {rule}"
            for rule in rules
            if _is_about(rule, vehicle_type, here[1], there[1])
            and any(rule.from_m < point < rule.to_m for point in points)
        ]
    return found


def _points(from_m: float, to_m: float) -> Iterator[float]:
    """Yield points of the road that the body passes, except its two ends."""
    count = max(1, int((to_m - from_m) / STEP_M))
    for number in range(1, count):
        yield from_m + (to_m - from_m) * number / count


def _is_about(rule: LaneRule, vehicle_type: str, lane: int, to_lane: int) -> bool:
    if isinstance(rule, Restriction):
        return to_lane == rule.lane and vehicle_type in rule.vehicle_types
    side = "left" if to_lane > lane else "right"
    about = not rule.vehicle_types or vehicle_type in rule.vehicle_types
    return about and lane == rule.lane and side == rule.to
