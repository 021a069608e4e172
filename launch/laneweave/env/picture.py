"""The picture of the road that `render` returns."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from laneweave.launch.drawing.colours import trip_lane, vehicle_colour
from laneweave.launch.drawing.figures import INK, new_figure
from laneweave.launch.drawing.road_picture import (
    draw_body,
    draw_closed_parts,
    draw_lanes,
    draw_position_axis,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import corners, pose_of
from laneweave.sim_bridge.road.vehicle import RoadVehicle

Picture = NDArray[np.uint8]

_DPI = 100
_WIDTH_IN, _TITLE_IN, _AXIS_IN = 10.0, 0.35, 0.4
_STRETCH_M, _MAX_STRETCHES = 300.0, 12
"""Usual length of a stretch, and maximum number of stretches; longer roads have longer ones."""
_ABOVE_M = 2.5
"""Space above and below the lanes, for the names of exits."""
_ACROSS_SCALE = 1.8
"""Scale across the road relative to the scale along it."""


def road_picture(scenario: Scenario, vehicles: Iterable[RoadVehicle], t_s: float) -> Picture:
    """Return a picture of the whole road, cut into stretches, the first one on top.

    Traffic moves to the right, the left lane is on top. Vehicles have the colour of their preferred
    lane or exit, or else of the lane in which they arrived.

    Args:
        scenario: the road.
        vehicles: those on the road.
        t_s: road time, which is written above.

    Returns:
        RGB values (height, width, 3); the size depends on the road only.
    """
    road = scenario.road
    count = min(math.ceil(road.length_m / _STRETCH_M), _MAX_STRETCHES)
    stretch_m = road.length_m / count
    road_m = road.lanes * road.lane_width_m + 2.0 * _ABOVE_M
    strip_in = _ACROSS_SCALE * _WIDTH_IN * road_m / max(stretch_m, _STRETCH_M) + _AXIS_IN
    figure = new_figure(_WIDTH_IN, _TITLE_IN + count * strip_in)
    figure.suptitle(f"{t_s:.1f} s, v_F = {scenario.formation.speed_mps:g} m/s", size=9, color=INK)
    bodies = [(corners(pose_of(one.state), *one.size), _colour(scenario, one)) for one in vehicles]
    strips = figure.subplots(count, 1, squeeze=False)[:, 0]
    for number, axes in enumerate(strips):
        shown_m = number * stretch_m, (number + 1) * stretch_m
        draw_lanes(axes, road.lanes, road.lane_width_m, shown_m, below_m=_ABOVE_M, above_m=_ABOVE_M)
        draw_closed_parts(axes, scenario)
        draw_position_axis(axes)
        if number < count - 1:
            axes.set_xlabel("")
        for body, colour in bodies:
            if body[2][0] <= shown_m[1] and shown_m[0] <= body[1][0]:
                draw_body(axes, body, colour)
    figure.set_dpi(_DPI)
    canvas = figure.canvas
    canvas.draw()
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[attr-defined] # of the Agg canvas
    return np.ascontiguousarray(rgba[:, :, :3])


def _colour(scenario: Scenario, vehicle: RoadVehicle) -> str:
    arrival = vehicle.arrival
    trip = {
        "arrival_lane": arrival.lane,
        "preferred_lane": arrival.preferred_lane,
        "destination": arrival.destination,
    }
    return vehicle_colour(scenario.road.lanes, trip_lane(scenario, trip))
