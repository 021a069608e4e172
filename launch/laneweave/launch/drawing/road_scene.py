"""The scene of a road, drawn in reports and on the live page by `web/road.js` and a layer."""

from __future__ import annotations

from typing import Any

from laneweave.launch.drawing.closed_parts import closed_parts, ramp_edges
from laneweave.launch.drawing.colours import (
    NEUTRAL,
    SHADE_STRENGTH,
    SPEED_SPAN_MPS,
    has_preferences,
    lane_colours,
    sorting_start,
    vehicle_legend,
)
from laneweave.launch.web import text_of
from laneweave.protocol.scenario.fields import Scenario


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
