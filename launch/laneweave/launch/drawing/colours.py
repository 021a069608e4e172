"""Colours and names of lanes and vehicles, for figures and the live page.

The colours are those of Okabe and Ito (Color Universal Design, 2008), which readers with a colour
vision deficiency can tell apart. Lanes also have their numbers wherever they have colours.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario

_THREE_LANES = ("#0072b2", "#f0e442", "#d55e00")
"""From right to left: blue, yellow, vermilion. These three differ most: at least 34 CIELAB units
for each kind of dichromat, the paper's blue, green and red at least 13."""
_MORE_LANES = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#cc79a7",
    "#d55e00",
    "#56b4e9",
    "#f0e442",
    "#3b3b3b",
)
NEUTRAL = "#8a8f96"
"""Colour of vehicles whose preferred lane is unknown; `web/road.js` uses the same."""
CLOSED_FILL, CLOSED_HATCH = "#d3d7dc", "#9aa2ac"
"""Colours of closed parts of lanes in figures."""
SPEED_SPAN_MPS = 5.0
"""Difference from the lattice speed at which the shade is darkest or lightest."""
SHADE_STRENGTH = 0.45
BRIGHT = 127.5
"""Brightness, of 255, above which text on a colour is black."""


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


def _in_words(name: str) -> str:
    """Return the name of a lane in a sentence."""
    return name if "lane" in name else f"the {name} lane"


def vehicle_colour(lanes: int, preferred_lane: int) -> str:
    """Return the colour of vehicles with a preferred lane; `ANY_LANE`: without one."""
    if preferred_lane == ANY_LANE:
        return NEUTRAL
    colours = lane_colours(lanes)
    return colours[preferred_lane % len(colours)]


def text_colour(colour: str) -> str:
    """Return black or white, whichever is legible on a colour; `web/road.js` does the same."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return "#000000" if 0.3 * red + 0.59 * green + 0.11 * blue > BRIGHT else "#ffffff"


def has_preferences(scenario: Scenario) -> bool:
    """Return whether vehicles have preferred lanes or exits, which colours then show."""
    return bool(scenario.flow.lane_shares or scenario.exit)


def trip_lane(scenario: Scenario, trip: Mapping[str, Any]) -> int:
    """Return the lane whose colour a recorded vehicle has, or `ANY_LANE`.

    This is its preferred lane or that of its exit; in a scenario without both, the lane in which it
    arrived.
    """
    if not has_preferences(scenario):
        return int(trip.get("arrival_lane", ANY_LANE))
    preferred = int(trip.get("preferred_lane", ANY_LANE))
    if preferred == ANY_LANE and trip.get("destination") in {one.name for one in scenario.exit}:
        return scenario.geometry.exit_lane(trip["destination"])
    return preferred


def sorting_start(scenario: Scenario) -> str:
    """Return the meaning of the position from which vehicles change lanes (`moves_from_m`)."""
    return "lane sorting begins" if has_preferences(scenario) else "lane changes begin"


def exit_in_words(name: str) -> str:
    """Return the name of an exit in a sentence; SUMO's names may be numbers."""
    return name if any(map(str.isalpha, name)) else f"exit {name}"


def vehicle_legend(scenario: Scenario, *, recorded: bool = False) -> tuple[tuple[str, str], ...]:
    """Return the colours of vehicles and their meanings, from the left lane.

    The meaning begins with the number that is written on the vehicles, if there is one. The lanes
    of arrival are known of `recorded` vehicles only.
    """
    lanes = scenario.road.lanes
    if recorded and not has_preferences(scenario):
        names = [_in_words(name) for name in lane_names(lanes)]
        names[0] += " (rightmost)" * ("right" not in names[0])
        arrived = (f"arrived in {name}" for name in names)
        return tuple(zip(lane_colours(lanes), arrived, strict=True))[::-1]
    if not scenario.flow.lane_shares:
        exits = tuple(
            (vehicle_colour(lanes, lane), f"{lane}: leaves by {exit_in_words(one.name)}")
            for one in scenario.exit
            for lane in (scenario.geometry.exit_lane(one.name),)
        )
        return (*exits, (NEUTRAL, "leaves at the end" if exits else "no preferred lane"))
    words = (f"{lane}: prefers {name}" for lane, name in enumerate(lane_names(lanes)))
    return tuple(zip(lane_colours(lanes), words, strict=True))[::-1]
