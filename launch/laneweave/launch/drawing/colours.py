"""Colours and names of lanes and vehicles, for figures and the live page."""

from __future__ import annotations

from laneweave.protocol.road_layout import ANY_LANE
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
NEUTRAL = "#8a8f96"
"""Colour of vehicles whose preferred lane is unknown; `web/road.js` uses the same."""
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


def vehicle_colour(lanes: int, preferred_lane: int) -> str:
    """Return the colour of vehicles with a preferred lane; `ANY_LANE`: without one."""
    if preferred_lane == ANY_LANE:
        return NEUTRAL
    colours = lane_colours(lanes)
    return colours[preferred_lane % len(colours)]


def vehicle_legend(scenario: Scenario) -> tuple[tuple[str, str], ...]:
    """Return the colours of vehicles and their meanings, from the left lane."""
    lanes = scenario.road.lanes
    if not scenario.lane_shares:
        exits = tuple(
            (vehicle_colour(lanes, scenario.exit_lane(one.name)), f"leaves by {one.name}")
            for one in scenario.exit
        )
        return (*exits, (NEUTRAL, "leaves at the end" if exits else "no preferred lane"))
    entries = zip(lane_colours(lanes), lane_names(lanes), strict=True)
    return tuple((colour, f"prefers {name}") for colour, name in entries)[::-1]
