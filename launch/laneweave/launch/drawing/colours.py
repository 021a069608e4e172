"""Colours and names of lanes, and the scene of a road, for figures and the live page."""

from __future__ import annotations

from typing import Any

from laneweave.protocol.scenario.fields import Scenario

_THREE_LANES = ("#2f6fc4", "#3f9b4f", "#cf3f3a")
"""The paper's colours from right to left: blue, green, red."""
_MORE_LANES = (
    "#2f6fc4",
    "#e08b27",
    "#3f9b4f",
    "#8a5bb5",
    "#cf3f3a",
    "#7a5c4d",
    "#d46fae",
    "#808080",
)
SPEED_SPAN_MPS = 5.0
"""Difference from the lattice speed at which the shade is darkest or lightest."""
SHADE_STRENGTH = 0.45


def lane_colours(lanes: int) -> tuple[str, ...]:
    """Return one colour for each lane, from the right."""
    if lanes <= 3:
        return _THREE_LANES[:1] + _THREE_LANES[3 - lanes + 1 :]
    return tuple(_MORE_LANES[lane % len(_MORE_LANES)] for lane in range(lanes))


def lane_names(lanes: int) -> tuple[str, ...]:
    """Return the names of the lanes, from the right."""
    if lanes == 1:
        return ("the lane",)
    if lanes == 2:
        return ("right", "left")
    if lanes == 3:
        return ("right", "middle", "left")
    return tuple(f"lane {lane}" for lane in range(lanes))


def road_scene(scenario: Scenario) -> dict[str, Any]:
    """Return the road, bodies, lattice and colours in the format that `web/road.js` reads."""
    road, formation = scenario.road, scenario.formation
    return {
        "road": {
            "length_m": road.length_m,
            "lanes": road.lanes,
            "lane_width_m": road.lane_width_m,
            "sorting_start_m": road.sorting_start_m,
        },
        "body_m": [scenario.vehicle.length_m, scenario.vehicle.width_m],
        "lattice": {"speed_mps": formation.speed_mps, "pitch_m": formation.gap_m},
        "shade": {"span_mps": SPEED_SPAN_MPS, "strength": SHADE_STRENGTH},
        "colours": list(lane_colours(road.lanes)),
    }
