"""What a picture of a road has beside the vehicles on it: for reports and the live page."""

from __future__ import annotations

from typing import Any

from laneweave.launch.drawing.colours import SHADE_STRENGTH, SPEED_SPAN_MPS, lane_colours
from laneweave.protocol.scenario.tables import Scenario


def road_scene(scenario: Scenario) -> dict[str, Any]:
    """Return road, bodies, lattice and colours as `web/road.js` takes them."""
    road, formation = scenario.road, scenario.formation
    return {
        "road": {
            "length_m": road.length_m,
            "lanes": road.lanes,
            "lane_width_m": road.lane_width_m,
            "sorting_start_m": road.sorting_start_m,
        },
        "body_m": [scenario.vehicle.length_m, scenario.vehicle.width_m],
        "lattice": {
            "speed_mps": formation.speed_mps,
            "pitch_m": formation.gap_m,
        },
        "shade": {"span_mps": SPEED_SPAN_MPS, "strength": SHADE_STRENGTH},
        "colours": list(lane_colours(road.lanes)),
    }
