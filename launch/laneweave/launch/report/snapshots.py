"""Snapshots of the road: where everybody is at some instants, drawn from a run's Parquet files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import attrs
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from laneweave.launch.drawing.colours import (
    SHADE_STRENGTH,
    SPEED_SPAN_MPS,
    lane_colours,
    lane_names,
)
from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK, new_figure, save
from laneweave.launch.observe.column_owners import Formations, recorded_formations
from laneweave.launch.recordings.runs import scenario_of
from laneweave.protocol.scenario.tables import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_ASPHALT, _PAINT = "#eeeff1", "#ffffff"
_OWNED = ("#e2e4e8", "#d5d8dd")
"""Columns of formations, by turns."""
_ACROSS_SCALE = 1.8
"""Roads are drawn this much wider than they are, or their lanes would be threads."""
_HEADROOM_M = 4.5
"""Room above the road for the numbers of formations."""


@attrs.frozen
class _Track:
    """One vehicle's trajectory; all arrays have shape (ticks,)."""

    t_s: Floats
    s_m: Floats
    y_m: Floats
    speed_mps: Floats

    def at(self, t_s: float) -> tuple[float, float, float, float] | None:
        """Return (s m, y m, heading rad, speed m/s) at a time, None if it is not on the road."""
        if not self.t_s[0] - 1e-6 <= t_s <= self.t_s[-1] + 1e-6:
            return None
        s_m, y_m, speed_mps = (
            float(np.interp(t_s, self.t_s, values))
            for values in (self.s_m, self.y_m, self.speed_mps)
        )
        if len(self.t_s) < 2:
            return s_m, y_m, 0.0, speed_mps
        slope = np.interp(t_s, self.t_s, np.gradient(self.y_m, self.t_s))
        return s_m, y_m, float(np.arctan2(slope, max(speed_mps, 0.1))), speed_mps


def road_snapshots(
    folder: Path,
    out: Path,
    times: Sequence[float] = (),
    *,
    stretch_m: tuple[float, float] | None = None,
    dpi: int = DPI,
) -> None:
    """Draw the same stretch of road at some instants, one strip below the other.

    Vehicles have the colour of the lane that they prefer; the faster, the lighter. Left lanes are
    on top, traffic goes to the right. The columns of formations have alternating shades of grey,
    and the formations' numbers above the road.

    Args:
        folder: a run's folder.
        out: the picture to write; its suffix says the format.
        times: road times in s; none: the four instants, the shortest T_F apart, at which most
            vehicles are between two lanes.
        stretch_m: the stretch of road from and to; none: 20 m before lane sorting begins and the
            300 m behind that point.
        dpi: resolution in dots per inch.
    """
    scenario = scenario_of(folder / "trajectories.parquet")
    road = scenario.road
    if stretch_m is None:
        start_m = max(0.0, road.sorting_start_m - 20.0)
        stretch_m = (start_m, min(road.length_m, start_m + 320.0))
    tracks = _tracks(folder)
    if not times:
        times = _instants(tracks, scenario, stretch_m)
    trips = pq.read_table(folder / "trips.parquet", columns=["vehicle", "preferred_lane"])
    preferred = {trip["vehicle"]: int(trip["preferred_lane"]) for trip in trips.to_pylist()}
    formations = Formations(())
    if not scenario.formation.rolling:  # the stream has none
        formations = recorded_formations(folder, scenario.lattice)
    width_in = 9.6
    strip_in = (
        _ACROSS_SCALE
        * (width_in - 0.9)
        * (road.lanes * road.lane_width_m + _HEADROOM_M)
        / (stretch_m[1] - stretch_m[0])
    )
    figure = new_figure(width_in, 0.9 + len(times) * (strip_in + 0.06))
    strips = figure.subplots(len(times), 1, sharex=True, squeeze=False)[:, 0]
    for axes, t_s in zip(strips, times, strict=True):
        _draw_road(axes, scenario, stretch_m)
        _draw_formations(axes, scenario, stretch_m, formations, t_s)
        axes.set_ylabel(f"{t_s:g} s", rotation=0, ha="right", va="center", color=INK)
        for vehicle, track in tracks.items():
            pose = track.at(t_s)
            if pose is not None and stretch_m[0] <= pose[0] <= stretch_m[1] + 10.0:
                _draw_vehicle(axes, pose, preferred.get(vehicle, 0), scenario)
    strips[-1].tick_params(axis="x", bottom=True, labelbottom=True)
    strips[-1].set_xlabel("position on the road (m)")
    _draw_legend(figure, scenario)
    save(figure, out, dpi)


def _draw_road(axes: Axes, scenario: Scenario, stretch_m: tuple[float, float]) -> None:
    """Draw asphalt and lane markings."""
    road = scenario.road
    width_m = road.lanes * road.lane_width_m
    axes.set_xlim(*stretch_m)
    axes.set_ylim(-0.5, width_m + _HEADROOM_M - 0.5)
    axes.fill_between(stretch_m, 0.0, width_m, color=_ASPHALT, linewidth=0.0, zorder=0)
    for border in range(road.lanes + 1):
        edge = border in (0, road.lanes)
        axes.axhline(
            border * road.lane_width_m,
            color="#9aa0a8" if edge else _PAINT,
            linewidth=1.2 if edge else 1.6,
            linestyle="-" if edge else (0, (7, 6)),
            zorder=1,
        )
    if stretch_m[0] < road.sorting_start_m < stretch_m[1]:
        place = ([road.sorting_start_m] * 2, [0.0, width_m])
        axes.plot(*place, color=INK, linewidth=1.0, linestyle=":", zorder=2)
    axes.set_yticks([])
    axes.tick_params(axis="x", bottom=False, labelbottom=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_formations(
    axes: Axes,
    scenario: Scenario,
    stretch_m: tuple[float, float],
    formations: Formations,
    t_s: float,
) -> None:
    """Shade the columns of formations, and write their numbers above."""
    lattice = scenario.lattice
    width_m = lattice.lanes * lattice.lane_width_m
    margin_m = 0.5 * (lattice.pitch_m - scenario.vehicle.length_m)
    for place, formation in enumerate(formations.listed):
        rear_m = lattice.cell_s_m(formation.rear, t_s) - scenario.vehicle.length_m - margin_m
        front_m = lattice.cell_s_m(formation.front, t_s) + margin_m
        shown = (max(rear_m, stretch_m[0]), min(front_m, stretch_m[1]))
        if shown[0] >= shown[1]:
            continue
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


def _draw_vehicle(
    axes: Axes, pose: tuple[float, float, float, float], preferred: int, scenario: Scenario
) -> None:
    """Draw a vehicle's body and a pale windscreen that shows where its front is."""
    from matplotlib.patches import Polygon  # noqa: PLC0415 - lazily, see above

    s_m, y_m, heading, speed_mps = pose
    length_m, width_m = scenario.vehicle.length_m, scenario.vehicle.width_m
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    centre = np.array([s_m - 0.5 * length_m * np.cos(heading), y_m])

    def shape(rear: float, front: float, half: float) -> Floats:
        """Return corners of a part of the body, shape (4, 2); shares of length and width."""
        box = np.array([[rear, -half], [front, -half], [front, half], [rear, half]])
        return np.asarray((box * [length_m, width_m]) @ turn + centre, dtype=np.float64)

    colours = lane_colours(scenario.road.lanes)
    colour = _shade(colours[preferred % len(colours)], speed_mps - scenario.formation.speed_mps)
    axes.add_patch(
        Polygon(shape(-0.5, 0.5, 0.5), facecolor=colour, edgecolor=INK, linewidth=0.5, zorder=3)
    )
    axes.add_patch(Polygon(shape(0.12, 0.3, 0.36), facecolor="#ffffffb0", linewidth=0.0, zorder=4))


def _draw_legend(figure: Figure, scenario: Scenario) -> None:
    """Say what the colours mean, above the strips."""
    from matplotlib.patches import Patch  # noqa: PLC0415 - lazily, see above

    speed_mps = scenario.formation.speed_mps
    colours = lane_colours(scenario.road.lanes)
    names = lane_names(scenario.road.lanes)
    handles = [
        Patch(facecolor=colours[lane], edgecolor=INK, linewidth=0.5, label=f"prefers {names[lane]}")
        for lane in reversed(range(scenario.road.lanes))
    ]
    for sign, word in ((-1, "slower"), (1, "faster")):
        handles.append(
            Patch(
                facecolor=_shade("#8a8f96", sign * SPEED_SPAN_MPS),
                edgecolor=INK,
                linewidth=0.5,
                label=f"{word} than {speed_mps:g} m/s",
            )
        )
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        handlelength=1.6,
        columnspacing=1.6,
    )


def _shade(colour: str, over_mps: float) -> tuple[float, float, float]:
    """Return a colour, darker below the lattice's speed and lighter above it."""
    from matplotlib.colors import to_rgb  # noqa: PLC0415 - lazily, see above

    share = float(np.clip(over_mps / SPEED_SPAN_MPS, -1.0, 1.0))
    end = 1.0 if share > 0.0 else 0.0
    strength = SHADE_STRENGTH * abs(share)
    mixed = [(1.0 - strength) * part + strength * end for part in to_rgb(colour)]
    return (mixed[0], mixed[1], mixed[2])


def _tracks(folder: Path) -> dict[str, _Track]:
    """Return the trajectory of each vehicle."""
    columns = ["t_s", "s_m", "y_m", "speed_mps"]
    table = pq.read_table(
        folder / "trajectories.parquet",
        columns=[*columns, "vehicle"],
        read_dictionary=["vehicle"],
    )
    names = np.asarray(table["vehicle"].to_pylist(), dtype=object).astype(str)
    values = {name: table[name].to_numpy().astype(np.float64) for name in columns}
    order = np.lexsort((values["t_s"], names))
    vehicles, starts = np.unique(names[order], return_index=True)
    parts = np.split(order, starts[1:]) if len(vehicles) else []
    return {
        str(vehicle): _Track(**{name: values[name][part] for name in columns})
        for vehicle, part in zip(vehicles, parts, strict=True)
    }


def _instants(
    tracks: Mapping[str, _Track], scenario: Scenario, stretch_m: tuple[float, float]
) -> list[float]:
    """Return four times, the shortest T_F apart, at which most vehicles are between two lanes.

    There are fewer if the recording ends earlier. A vehicle counts by its distance from the nearest
    lane centre, and a little for being on the stretch.
    """
    if not tracks:
        return [0.0]
    t_s, s_m, y_m = (
        np.concatenate([getattr(track, name) for track in tracks.values()])
        for name in ("t_s", "s_m", "y_m")
    )
    tick_s, width_m = scenario.runtime.tick_s, scenario.road.lane_width_m
    off_centre = np.abs(y_m / width_m - np.floor(y_m / width_m) - 0.5)
    inside = (s_m >= stretch_m[0]) & (s_m <= stretch_m[1])
    ticks = np.rint(t_s / tick_s).astype(np.int64)
    seen = np.bincount(ticks, weights=inside * (off_centre + 1e-3))
    slot = round(scenario.cycles_s[0] / tick_s)
    padded = np.pad(seen, (0, 3 * slot))
    sums = sum(padded[number * slot : number * slot + len(seen)] for number in range(4))
    start = int(np.argmax(sums))
    times = (start + number * slot for number in range(4))
    return [round(tick * tick_s, 3) for tick in times if tick < len(seen)]
