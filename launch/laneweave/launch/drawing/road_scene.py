"""The road as pictures and pages show it: closed parts, ramps, exits, colours.

`road_scene` has all of it for the pages, on which `web/road.js` and its layers draw it.
"""

from __future__ import annotations

from typing import Any, Final

from attrs import frozen

from laneweave.launch.drawing.colours import (
    NEUTRAL,
    SHADE_STRENGTH,
    SPEED_SPAN_MPS,
    has_preferences,
    lane_colours,
    lane_names,
    sorting_start,
    vehicle_legend,
)
from laneweave.launch.web import text_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import dead_ends

_MAX_NAMED: Final = 3
"""Maximum number of lanes on roads whose lanes have names like `right`."""


@frozen
class ClosedPart:
    """A closed part of a lane, as far as it is on the road."""

    lane: int
    from_m: float
    to_m: float
    line_m: float | None
    """The stop line before it; None: the lane begins behind it, or ends at an exit."""


def closed_parts(scenario: Scenario) -> tuple[ClosedPart, ...]:
    """Return the closed parts of a road, by lane and position."""
    road = scenario.road
    line_m = {(end.lane, end.end_m): end.line_m for end in dead_ends(scenario)}
    return tuple(
        ClosedPart(
            part.lane,
            part.from_m,
            min(part.to_m, road.length_m),
            line_m.get((part.lane, part.from_m)),
        )
        for part in sorted(road.closures, key=lambda part: (part.lane, part.from_m))
    )


def ramp_edges(scenario: Scenario) -> tuple[tuple[int, float, float], ...]:
    """Return the line between each ramp and the road: (lane to its left, from [m], to [m])."""
    middle = scenario.road.lanes / 2
    return tuple(
        (one.lane + (one.lane < middle), one.at_m, one.merge_m) for one in scenario.entrance
    )


def describe_closed_parts(scenario: Scenario) -> str:
    """Return a sentence for each closed part of the road; empty: there is none."""
    lanes, length_m = scenario.road.lanes, scenario.road.length_m
    sentences = []
    for part in closed_parts(scenario):
        name = f"Lane {part.lane} (0: rightmost)"
        if lanes <= _MAX_NAMED:
            name = f"The {lane_names(lanes)[part.lane]} lane"
        end = f"{part.to_m:g} m" if part.to_m < length_m else "the end of the road"
        sentences.append(f"{name} is closed from {part.from_m:g} m to {end}.")
    sentences += [
        f"Vehicles enter by {one.name} in lane {one.lane} at {one.at_m:g} m; it joins the road at "
        f"{one.merge_m:g} m."
        for one in scenario.entrance
    ]
    sentences += [
        f"They leave by {one.name} in lane {', '.join(map(str, one.lanes))} at {one.at_m:g} m."
        for one in scenario.exit
    ]
    return " ".join(sentences)


def road_scene(scenario: Scenario, *, recorded: bool = False) -> dict[str, Any]:
    """Return the road, bodies, lattice and colours in the format that the scripts read.

    For `recorded`, see `vehicle_legend`.
    """
    road, formation, closed = scenario.road, scenario.formation, closed_parts(scenario)
    return {
        "road": {
            "length_m": road.length_m,
            "lanes": road.lanes,
            "lane_width_m": road.lane_width_m,
            "sorting_start_m": scenario.geometry.moves_from_m,
            "sorting_start": sorting_start(scenario),
            "ramps": [list(edge) for edge in ramp_edges(scenario)],
            "closed": [[part.lane, part.from_m, part.to_m] for part in closed],
            "stop_lines": [[part.lane, part.line_m] for part in closed if part.line_m is not None],
        },
        "body_m": list(scenario.vehicle.size_m),
        "bodies_m": {name: list(own.limits.size_m) for name, own in scenario.types.items()},
        "lattice": {"speed_mps": formation.speed_mps, "pitch_m": formation.gap_m},
        "shade": {"span_mps": SPEED_SPAN_MPS, "strength": SHADE_STRENGTH},
        "colours": list(lane_colours(road.lanes)),
        "neutral": NEUTRAL,
        "preferences": has_preferences(scenario),
        "legend": [list(entry) for entry in vehicle_legend(scenario, recorded=recorded)],
    }


def closed_parts_script() -> str:
    """Return the script that draws closed parts of lanes and defines `laneweaveClosed`."""
    return text_of("laneweave.launch.drawing", "closed_parts.js")
