"""Snapshots of the road at given times, drawn from the Parquet files of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from laneweave.launch.drawing.colours import (
    SHADE_STRENGTH,
    SPEED_SPAN_MPS,
    has_preferences,
    sorting_start,
    text_colour,
    trip_lane,
    vehicle_colour,
    vehicle_legend,
)
from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK
from laneweave.launch.drawing.road_picture import (
    CLOSED,
    draw_body,
    draw_closed_part,
    draw_closed_parts,
    draw_lanes,
    draw_position_axis,
    write_time,
)
from laneweave.launch.drawing.road_scene import closed_parts, ramp_edges
from laneweave.launch.formation_columns import Formations
from laneweave.launch.recordings.closed_parts import ClosedForATime, closed_for_a_time
from laneweave.launch.recordings.files import TRAJECTORIES_FILE
from laneweave.launch.recordings.formations import closed_formations
from laneweave.launch.recordings.runs import scenario_of
from laneweave.launch.recordings.trajectories import (
    JUMP_MPS,
    Floats,
    Tracks,
    read_tracks,
    read_trips,
)
from laneweave.launch.report.style import fitted_legend, picture
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.wire.messages import CAR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_OWNED = ("#e2e4e8", "#d5d8dd")
"""Alternating colours for the columns of formations."""
_ACROSS_SCALE, _LONG_ACROSS_SCALE = 1.8, 2.1
"""Scale across the road relative to the scale along it, because lanes would be too thin otherwise;
the second one is for stretches longer than `_LONG_M`."""
_LONG_M = 450.0
_MIN_LANE_PT, _MAX_LANE_PT = 4.0, 6.5
"""Sizes of the numbers of lanes on vehicles; smaller ones are not written."""
_MAX_HEADING = 0.35
"""Maximum angle between a vehicle and the road in the picture [rad]."""
_BETWEEN = 0.25
"""Distance from the lane centre, in lane widths, from which a vehicle is between two lanes."""
_ABOVE_M, _BELOW_M, _MARGIN_M = 4.0, 4.5, 0.5
"""Space above the road for numbers of formations; below it with, and without, names of exits."""
_MAX_STRETCH_M, _MAX_CLOSED_M, _BEYOND_M = 740.0, 120.0, 50.0
"""On roads with closed parts: maximum length of the stretch, maximum length of a closed part that
is shown to its end, and length shown beyond its beginning or end."""


def road_snapshots(
    folder: Path,
    out: Path,
    times: Sequence[float] = (),
    *,
    stretch_m: tuple[float, float] | None = None,
    dpi: int = DPI,
) -> None:
    """Draw a stretch of road at given times, one strip below another.

    Vehicles have colour and number of their preferred lane, or else the colour of the lane in which
    they arrived; faster vehicles are lighter. Left lanes
    are on top, and traffic moves to the right. The columns of formations are in alternating shades
    of grey, with the formation numbers above the road. Closed parts of lanes are hatched.

    Args:
        folder: folder of the run.
        out: file of the picture; its suffix defines the format.
        times: road times [s]; empty: the four times, spaced by the shortest T_F, at which the most
            vehicles change lanes; or those when a part of a lane is closed for a time.
        stretch_m: (from m, to m); None: around this part, or else `default_stretch_m`.
        dpi: resolution in dots per inch.
    """
    scenario = scenario_of(folder / TRAJECTORIES_FILE)
    road = scenario.road
    tracks, parts = read_tracks(folder), closed_for_a_time(folder)
    if parts and not times and stretch_m is None:
        stretch_m, times = _around(parts[0], scenario)
    if stretch_m is None:
        stretch_m = default_stretch_m(scenario)
    if not times:
        times = _instants(tracks, scenario, stretch_m)
    trips = read_trips(folder)
    formations = closed_formations(folder, scenario)
    beyond_m = 2.0 * scenario.types.longest_body_m
    width_in = 9.6
    road_m = _below_m(scenario) + road.lanes * road.lane_width_m + _ABOVE_M
    length_m = stretch_m[1] - stretch_m[0]
    across = _ACROSS_SCALE if length_m <= _LONG_M else _LONG_ACROSS_SCALE
    strip_in = across * (width_in - 0.9) * road_m / length_m
    scale_pt_per_m = across * 72.0 * (width_in - 0.9) / length_m
    with picture(width_in, 0.9 + len(times) * (strip_in + 0.06), out, dpi) as figure:
        shaded = False
        strips = figure.subplots(len(times), 1, sharex=True, squeeze=False)[:, 0]
        for axes, t_s in zip(strips, times, strict=True):
            _draw_road(axes, scenario, stretch_m)
            for part in parts:
                if part.since_s <= t_s < part.until_s:
                    width_m = road.lane_width_m
                    draw_closed_part(axes, part.lane, part.from_m, part.to_m, width_m)
            shaded |= _draw_formations(axes, scenario, stretch_m, formations, t_s)
            write_time(axes, f"{t_s:g} s")
            for number, name in enumerate(tracks.names):
                pose = _pose(tracks, number, t_s)
                if pose is not None and stretch_m[0] <= pose[0] <= stretch_m[1] + beyond_m:
                    trip = trips.get(name, {})
                    own = scenario.types[trip.get("vehicle_type", CAR)]
                    _draw_vehicle(
                        axes, pose, own.limits, trip_lane(scenario, trip), scenario, scale_pt_per_m
                    )
        draw_position_axis(strips[-1])
        starts = stretch_m[0] < scenario.geometry.moves_from_m < stretch_m[1]
        _draw_legend(figure, scenario, starts=starts, shaded=shaded, closed=bool(parts))


def _around(
    part: ClosedForATime, scenario: Scenario
) -> tuple[tuple[float, float], tuple[float, ...]]:
    """Return the stretch around a part that is closed for a time, and four instants.

    They are when it is closed, while it is, and when the lane is used again.
    """
    road, slot_s = scenario.road, scenario.timing.cycles_s[0]
    stretch_m = max(0.0, part.from_m - 0.7 * _LONG_M), min(road.length_m, part.to_m + 0.3 * _LONG_M)
    until_s = min(part.until_s, part.since_s + 40.0 * slot_s)
    shares = (0.03, 0.3, 0.75)
    instants_s = [part.since_s + share * (until_s - part.since_s) for share in shares]
    instants_s.append(until_s + 3.0 * slot_s)
    return stretch_m, tuple(round(t_s, 1) for t_s in instants_s)


def changes_gradually(tracks: Tracks, scenario: Scenario) -> bool:
    """Return whether lane changes take time; SUMO's own lane changes are instantaneous."""
    return bool(np.any(_off_centre(tracks, scenario) > _BETWEEN))


def default_stretch_m(scenario: Scenario) -> tuple[float, float]:
    """Return the stretch of road that is shown by default.

    It begins 20 m before lane sorting and is 320 m long. If the road has closed parts, it extends
    beyond the beginning of the first one, and, if that is short, beyond its end.
    """
    road = scenario.road
    places_m = [one.merge_m for one in scenario.entrance] + [one.at_m for one in scenario.exit]
    if places_m:
        edges_m = [edge_m for one in road.closures for edge_m in (one.from_m, one.to_m)]
        inner_m = [edge_m for edge_m in edges_m if min(places_m) < edge_m < road.length_m]
        opens_m = [edge_m for edge_m in edges_m if 0.0 < edge_m < min(places_m)]
        # The way to an exit begins where its lane opens; what is before a ramp does not matter.
        exit_first = min(places_m) in [one.at_m for one in scenario.exit]
        first_m = max(opens_m) if exit_first and opens_m else min(places_m)
        start_m, end_m = first_m - _BEYOND_M, max([*places_m, *inner_m]) + _BEYOND_M
        return max(0.0, start_m, end_m - _MAX_STRETCH_M), min(road.length_m, end_m)
    start_m, length_m = max(0.0, scenario.geometry.moves_from_m - 20.0), 320.0
    if closed := closed_parts(scenario):
        first = min(closed, key=lambda part: part.from_m)
        short = first.to_m - first.from_m <= _MAX_CLOSED_M
        end_m = min(road.length_m, (first.to_m if short else first.from_m) + _BEYOND_M)
        start_m = max(start_m, end_m - _MAX_STRETCH_M)
        length_m = max(length_m, end_m - start_m)
    return start_m, min(road.length_m, start_m + length_m)


def _pose(tracks: Tracks, number: int, t_s: float) -> tuple[float, float, float, float] | None:
    """Return (s m, y m, heading rad, speed m/s) of a vehicle; None if it is not on the road."""
    times_s = tracks.t_s[tracks.rows(number)]
    if not times_s[0] - 1e-6 <= t_s <= times_s[-1] + 1e-6:
        return None
    at = np.array([t_s])
    names = ("s_m", "y_m", "speed_mps", "lateral_speed_mps")
    s_m, y_m, speed_mps, lateral_mps = (
        float(tracks.sampled(number, name, at)[0]) for name in names
    )
    lateral_mps = np.nan_to_num(lateral_mps)
    after = int(np.clip(np.searchsorted(times_s, t_s), 1, max(1, len(times_s) - 1)))
    if len(times_s) > 1:
        ys_m, ends_s = tracks.y_m[tracks.rows(number)][after - 1 : after + 1], times_s[after - 1 :]
        if abs(ys_m[1] - ys_m[0]) > JUMP_MPS * (ends_s[1] - ends_s[0]):
            # An instantaneous lane change: before it or after it, and never in between.
            y_m, lateral_mps = float(ys_m[int(t_s - ends_s[0] > ends_s[1] - t_s)]), 0.0
    if abs(lateral_mps) > JUMP_MPS:
        lateral_mps = 0.0
    heading = np.clip(np.arctan2(lateral_mps, max(speed_mps, 0.1)), -_MAX_HEADING, _MAX_HEADING)
    return s_m, y_m, float(heading), speed_mps


def _below_m(scenario: Scenario) -> float:
    """Return the space below the road [m], which contains the names of exits on the right."""
    right = any(min(one.lanes) < scenario.road.lanes / 2 for one in scenario.exit)
    return _BELOW_M if right else _MARGIN_M


def _draw_road(axes: Axes, scenario: Scenario, stretch_m: tuple[float, float]) -> None:
    """Draw the lanes with closed parts and the start of lane sorting."""
    road, space = scenario.road, {"below_m": _below_m(scenario), "above_m": _ABOVE_M}
    width_m = road.lanes * road.lane_width_m
    draw_lanes(axes, road.lanes, road.lane_width_m, stretch_m, **space)
    draw_closed_parts(axes, scenario)
    if stretch_m[0] < scenario.geometry.moves_from_m < stretch_m[1]:
        place = ([scenario.geometry.moves_from_m] * 2, [0.0, width_m])
        axes.plot(*place, color=INK, linewidth=1.0, linestyle=":", zorder=2)


def _draw_formations(
    axes: Axes,
    scenario: Scenario,
    stretch_m: tuple[float, float],
    formations: Formations,
    t_s: float,
) -> bool:
    """Shade the columns of formations, with numbers above the road; return whether any is shown."""
    lattice = scenario.lattice
    width_m = lattice.lanes * lattice.lane_width_m
    margin_m, shaded = 0.5 * (lattice.pitch_m - scenario.vehicle.length_m), False
    for place, formation in enumerate(formations.listed):
        rear_m = lattice.cell_s_m(formation.rear, t_s) - scenario.vehicle.length_m - margin_m
        front_m = lattice.cell_s_m(formation.front, t_s) + margin_m
        shown = (max(rear_m, stretch_m[0]), min(front_m, stretch_m[1]))
        if shown[0] >= shown[1]:
            continue
        shaded = True
        axes.fill_between(shown, 0.0, width_m, color=_OWNED[place % 2], linewidth=0.0, zorder=0.5)
        if shown[1] - shown[0] > 0.3 * (front_m - rear_m):
            axes.text(
                0.5 * (shown[0] + shown[1]),
                width_m + 0.35,
                f"formation {formation.number}",
                ha="center",
                va="bottom",
                fontsize=6.5,
                color=FAINT_INK,
            )
    return shaded


def _draw_vehicle(
    axes: Axes,
    pose: tuple[float, float, float, float],
    limits: Vehicle,
    lane: int,
    scenario: Scenario,
    scale_pt_per_m: float,
) -> None:
    """Draw the body of a vehicle in the colour of a lane, with the number of its preferred lane.

    A small vehicle, or one without a preferred lane, has a pale windscreen instead.

    Args:
        axes: axes of the strip.
        pose: (s m, y m, heading rad, speed m/s).
        limits: size of the vehicle.
        lane: see `trip_lane`.
        scenario: lanes, v_F.
        scale_pt_per_m: scale across the road.
    """
    from matplotlib.patches import Polygon  # noqa: PLC0415 - lazily

    s_m, y_m, heading, speed_mps = pose
    length_m, width_m = limits.size_m
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    centre = np.array([s_m - 0.5 * length_m * np.cos(heading), y_m])

    def shape(rear: float, front: float, half: float) -> Floats:
        """Return the corners (4, 2) of a part of the body, given as fractions of its size."""
        box = np.array([[rear, -half], [front, -half], [front, half], [rear, half]])
        return np.asarray((box * [length_m, width_m]) @ turn + centre, dtype=np.float64)

    own_colour = vehicle_colour(scenario.road.lanes, lane)
    colour = _shade(own_colour, speed_mps - scenario.formation.speed_mps)
    draw_body(axes, shape(-0.5, 0.5, 0.5), colour)
    size_pt = min(_MAX_LANE_PT, 0.95 * width_m * scale_pt_per_m)
    if lane == ANY_LANE or not has_preferences(scenario) or size_pt < _MIN_LANE_PT:
        glass: dict[str, Any] = {"facecolor": "#ffffffb0", "linewidth": 0.0}
        axes.add_patch(Polygon(shape(0.12, 0.3, 0.36), zorder=4, **glass))
        return
    first_m, last_m = axes.get_xlim()
    if not first_m < s_m - length_m or not s_m < last_m:
        return  # the number would be cut off
    shown = text_colour("#" + "".join(f"{round(255 * part):02x}" for part in colour))
    style: dict[str, Any] = {"ha": "center", "va": "center_baseline", "clip_on": True, "zorder": 5}
    axes.text(
        centre[0], centre[1], f"{lane}", fontsize=size_pt, color=shown, weight="bold", **style
    )


def _draw_legend(
    figure: Figure, scenario: Scenario, *, starts: bool, shaded: bool, closed: bool
) -> None:
    """Draw the legend of colours and marks above the strips.

    Args:
        figure: the figure.
        scenario: scenario of the run.
        starts: whether the strips show the start of lane sorting.
        shaded: whether they show columns of formations.
        closed: whether parts of lanes are closed for a time.
    """
    from matplotlib.lines import Line2D  # noqa: PLC0415 - lazily
    from matplotlib.patches import Patch  # noqa: PLC0415 - lazily

    speed_mps = scenario.formation.speed_mps
    handles: list[Patch | Line2D] = [
        Patch(fc=colour, ec=INK, lw=0.5, label=label)
        for colour, label in vehicle_legend(scenario, recorded=True)
    ]
    shades = f"darker: slower than {speed_mps:g} m/s; lighter: faster"
    handles.append(Line2D([], [], linewidth=0.0, label=shades))
    if scenario.road.closures or closed:
        handles.append(Patch(label="closed", **CLOSED))
    if any(part.line_m is not None for part in closed_parts(scenario)):
        style: dict[str, Any] = {"marker": "|", "markersize": 9, "markeredgewidth": 1.6}
        handles.append(Line2D([], [], color=INK, linewidth=0.0, label="stop line", **style))
    if shaded:
        handles.append(Patch(fc=_OWNED[1], label="columns of a formation, in two shades"))
    if starts:
        line: dict[str, Any] = {"marker": "$\u22ee$", "markersize": 9, "markeredgewidth": 0.0}
        handles.append(
            Line2D([], [], color=INK, linewidth=0.0, label=sorting_start(scenario), **line)
        )
    if ramp_edges(scenario):
        handles.append(Line2D([], [], color=INK, linewidth=1.6, label="edge of a ramp"))
    fitted_legend(figure, handles, fontsize=8, handlelength=1.6, columnspacing=1.6)


def _shade(colour: str, over_mps: float) -> tuple[float, float, float]:
    """Return a colour, darkened below the speed of the lattice and lightened above it."""
    from matplotlib.colors import to_rgb  # noqa: PLC0415 - lazily

    share = float(np.clip(over_mps / SPEED_SPAN_MPS, -1.0, 1.0))
    end = 1.0 if share > 0.0 else 0.0
    strength = SHADE_STRENGTH * abs(share)
    mixed = [(1.0 - strength) * part + strength * end for part in to_rgb(colour)]
    return (mixed[0], mixed[1], mixed[2])


def _off_centre(tracks: Tracks, scenario: Scenario) -> Floats:
    """Return the distance of each sample from the nearest lane centre, in lane widths."""
    lanes = tracks.y_m / scenario.road.lane_width_m
    return np.asarray(np.abs(lanes - np.floor(lanes) - 0.5))


def _instants(tracks: Tracks, scenario: Scenario, stretch_m: tuple[float, float]) -> list[float]:
    """Return four times, spaced by the shortest T_F, at which the most vehicles change lanes.

    Fewer are returned if the recording ends earlier. A vehicle on the stretch is weighted by its
    distance from the nearest lane centre, plus a small constant.
    """
    t_s, s_m = tracks.t_s, tracks.s_m
    if not len(t_s):
        return [0.0]
    tick_s, off_centre = scenario.runtime.tick_s, _off_centre(tracks, scenario)
    inside = (s_m >= stretch_m[0]) & (s_m <= stretch_m[1])
    ticks = np.rint(t_s / tick_s).astype(np.int64)
    seen = np.bincount(ticks, weights=inside * (off_centre + 1e-3))
    slot = round(scenario.timing.cycles_s[0] / tick_s)
    padded = np.pad(seen, (0, 3 * slot))
    sums = sum(padded[number * slot : number * slot + len(seen)] for number in range(4))
    start = int(np.argmax(sums))
    times = (start + number * slot for number in range(4))
    return [round(tick * tick_s, 3) for tick in times if tick < len(seen)]
