"""Figures that compare labels: travel times, throughput and shares, speeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from attrs import evolve, frozen

from laneweave.launch.drawing.colours import CLOSED_FILL
from laneweave.launch.drawing.figures import INK
from laneweave.launch.drawing.road_scene import closed_parts
from laneweave.launch.recordings.files import TRIPS_FILE, reading
from laneweave.launch.recordings.runs import Comparison, Run
from laneweave.launch.recordings.trajectories import Floats, read_tracks
from laneweave.launch.report.style import (
    REFERENCE,
    SEPARATOR,
    SMALL_TEXT,
    explain_empty_axes,
    label_colours,
    label_markers,
    label_widths,
    legend_above,
    picture,
    spread_evenly,
    volume_title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import FuncNorm

JAMMED = 1.25
"""Travel times with an upper quartile above this multiple of the lowest median count as jammed."""
MARGIN = 0.04
"""Margin below the shortest travel time, as a share of the range."""
LOWER_SHARE = 0.66
"""Share of the height below the break of the axis, for methods without jams."""
GROUP_WIDTH = 0.8
"""Total width of the boxes at a volume; the distance between volumes is 1."""
CLOSED_WIDTH = 0.025
"""Width of the marks of closed parts, as a share of the width of the axes."""
WIDE_IN = 6.0
"""Width above which panels are drawn below each other, not side by side [in]."""
BIN_M, BIN_S = 20.0, 5.0
"""Bin sizes for mean speeds."""
LIMIT_PERCENT, MIN_LIMIT_MPS = 98.0, 0.5
"""The scale of speeds ends at this percentile of the differences from v_F, at least at the second
value [m/s]."""
NO_VEHICLE = "#c4c8ce"
"""Colour of bins without vehicles; white means v_F."""


def draw_travel_times(comparison: Comparison, out: Path, dpi: int) -> None:
    """Draw box plots of travel times over all seeds, by volume.

    If only some methods jam, the axis is broken, because travel times in jams are much longer.
    """
    labels, volumes = comparison.labels, comparison.volumes
    times = {
        label: [_travel_times(comparison.at(label, volume)) for volume in volumes]
        for label in labels
    }
    break_s = _break(one for found in times.values() for one in found)
    width_in = max(5.6, 1.6 + 0.3 * len(volumes) * (len(labels) + 0.8))
    with picture(width_in, 4.4, out, dpi) as figure:
        shares = [1.0] if break_s is None else [1.0 - LOWER_SHARE, LOWER_SHARE]
        panels = figure.subplots(len(shares), 1, sharex=True, height_ratios=shares, squeeze=False)
        upper, lower = panels[0, 0], panels[-1, 0]
        for axes in panels.flat:
            _draw_boxes(axes, times)
            axes.grid(visible=False, axis="x")
        for t_s in sorted({run.scenario.geometry.free_flow_s for run in comparison.runs}):
            lower.axhline(t_s, zorder=0, **REFERENCE)
            lower.annotate(
                f"free flow\n{t_s:.1f} s",
                (1.0, t_s),
                xycoords=("axes fraction", "data"),
                xytext=(4, 0),
                textcoords="offset points",
                va="center",
                annotation_clip=False,
                **SMALL_TEXT,
            )
        if break_s is not None:
            _break_axis(upper, lower, break_s)
        for label, places in zip(labels, _places(len(labels), len(volumes)), strict=True):
            for place, volume, found in zip(places, volumes, times[label], strict=True):
                if comparison.at(label, volume) and not len(found):
                    where = lower.get_xaxis_transform()
                    style: dict[str, Any] = {
                        "transform": where,
                        "rotation": 90,
                        "ha": "center",
                        "va": "bottom",
                    }
                    lower.text(place, 0.03, "no vehicle", **style, **SMALL_TEXT)
        for axes in panels.flat:
            _label_volumes(axes, volumes)
        lower.set_xlabel("traffic volume (veh/(lane·h))")
        lower.set_ylabel("travel time (s)")
        legend_above(figure)


def _break(times_s: Iterable[Floats]) -> float | None:
    """Return the travel time at which to break the axis; None if all methods jam, or none."""
    shapes = [np.percentile(one, [50.0, 75.0, 99.0]) for one in times_s if len(one)]
    limit_s = JAMMED * min((median_s for median_s, _, _ in shapes), default=0.0)
    ends_s = [end_s for _, upper_s, end_s in shapes if upper_s <= limit_s]
    if len(ends_s) in (0, len(shapes)):
        return None
    return float(min(limit_s, 1.01 * max(ends_s)))


def _break_axis(upper: Axes, lower: Axes, break_s: float) -> None:
    """Show times above the break in the upper axes, on a separate scale, and others below."""
    lowest_s, top_s = lower.dataLim.ymin, lower.get_ylim()[1]
    lower.set_ylim(lowest_s - MARGIN * (break_s - lowest_s), break_s)
    upper.set_ylim(break_s, top_s)
    upper.spines["bottom"].set_visible(False)
    upper.tick_params(axis="x", bottom=False, labelbottom=False)
    upper.set_ylabel("travel time\nin jams (s)", fontsize="small")
    slash: dict[str, Any] = {"marker": [(-1.0, -0.5), (1.0, 0.5)], "markersize": 9, "color": INK}
    upper.plot([0.0], [0.0], transform=upper.transAxes, clip_on=False, **slash)
    lower.plot([0.0], [1.0], transform=lower.transAxes, clip_on=False, **slash)


def _places(labels: int, volumes: int) -> Floats:
    """Return positions along the axis, shape (labels, volumes), with boxes side by side."""
    shifts = (np.arange(labels) - 0.5 * (labels - 1)) * GROUP_WIDTH / max(1, labels)
    return np.asarray(np.arange(volumes) + shifts[:, None])


def _draw_boxes(axes: Axes, times_s: Mapping[str, Sequence[Floats]]) -> None:
    """Draw the boxes of each label by volume, and a line through their means."""
    volumes = len(next(iter(times_s.values())))
    all_places, colours = _places(len(times_s), volumes), label_colours(times_s)
    markers = label_markers(times_s)
    for places, (label, times) in zip(all_places, times_s.items(), strict=True):
        colour = colours[label]
        axes.boxplot(
            times,
            positions=places,
            widths=0.72 * GROUP_WIDTH / len(times_s),
            manage_ticks=False,
            patch_artist=True,
            label=label,
            boxprops={"facecolor": colour + "55", "edgecolor": colour},
            medianprops={"color": INK, "linewidth": 1.2},
            whiskerprops={"color": colour},
            capprops={"color": colour},
            flierprops={"marker": ".", "markersize": 2.5, "markeredgecolor": colour},
        )
        means = [float(np.mean(one)) if len(one) else np.nan for one in times]
        style: dict[str, Any] = {"marker": markers[label], "markersize": 4, "linewidth": 1.3}
        axes.plot(places, means, color=colour, zorder=3, **style)


def _travel_times(runs: Iterable[Run]) -> Floats:
    """Return the travel times [s] of the counted vehicles."""
    found = [np.empty(0)]
    for run in runs:
        with reading(run.folder, TRIPS_FILE):
            table = pq.read_table(run.folder / TRIPS_FILE, columns=["travel_time_s", "counted"])
        found.append(table.filter(pc.field("counted"))["travel_time_s"].drop_null().to_numpy())
    return np.concatenate(found)


def draw_flows(comparison: Comparison, out: Path, dpi: int) -> None:
    """Draw throughput as a share of the demand, and the share of vehicles in the preferred lane.

    The latter is left out if vehicles have no preferred lanes, or all left in theirs.
    """
    volumes = comparison.volumes
    panels = 2 if shares_differ(comparison) else 1
    width_in = max(4.6, 1.4 + 0.07 * len(volumes) * (len(comparison.labels) + 1))
    rows = panels if width_in > WIDE_IN else 1
    with picture(width_in * panels / rows, 0.7 + 3.0 * rows, out, dpi) as figure:
        shown = list(figure.subplots(rows, panels // rows, squeeze=False).flat)
        flow = shown[0]
        flow.axhline(100.0, zorder=1, **(REFERENCE | {"color": INK}))
        flow.set_ylabel("throughput (% of the demand)")
        for axes, value in zip(shown, (_throughput_percent, _preferred_percent), strict=False):
            _draw_seeds(axes, comparison, value)
            axes.set_xlabel("traffic volume (veh/(lane·h))")
            _label_volumes(axes, volumes)
        # Differences of a few vehicles must not look large.
        flow.set_ylim(min(flow.get_ylim()[0], 95.0), max(flow.get_ylim()[1], 105.0))
        for axes in shown[1:]:
            axes.set_ylabel("left in the preferred lane (%)")
            low = min(axes.get_ylim()[0], 99.0)
            axes.set_ylim(low, 100.0 + 0.04 * (100.0 - low))
        legend_above(figure)


def shares_differ(comparison: Comparison) -> bool:
    """Return whether vehicles have preferred lanes, and not all are known to have left in them."""
    percents = [run.preferred_percent for run in comparison.runs if run.scenario.flow.lane_shares]
    return any(percent is None or percent < 100.0 for percent in percents)


def _throughput_percent(run: Run) -> float | None:
    """Return the throughput as a share of the demand."""
    flow = run.summary.throughput_veh_per_lane_h if run.summary else None
    return None if flow is None else 100.0 * flow / run.volume_veh_per_lane_h


def _preferred_percent(run: Run) -> float | None:
    return run.preferred_percent


def _label_volumes(axes: Axes, volumes: Sequence[float]) -> None:
    """Give each volume a place of equal width on the horizontal axis, and name it."""
    for number in range(1, len(volumes)):
        axes.axvline(number - 0.5, **SEPARATOR)
    axes.set_xticks(range(len(volumes)), labels=[f"{volume:g}" for volume in volumes])
    axes.set_xlim(-0.6, len(volumes) - 0.4)


def _draw_seeds(axes: Axes, comparison: Comparison, value: Callable[[Run], float | None]) -> None:
    """Draw each run as a dot, and means over seeds with standard deviations as a line.

    Labels are side by side at each volume, because they may have the same values.
    """
    colours, labels, nothing = label_colours(comparison.labels), comparison.labels, True
    markers, widths = label_markers(labels), label_widths(labels)
    all_places = _places(len(labels), len(comparison.volumes))
    for label, places in zip(labels, all_places, strict=True):
        means, spreads = [], []
        for volume, place in zip(comparison.volumes, places, strict=True):
            values = map(value, comparison.at(label, volume))
            found = [one for one in values if one is not None]
            nothing &= not found
            means.append(float(np.mean(found)) if found else np.nan)
            spreads.append(float(np.std(found, ddof=1)) if len(found) > 1 else 0.0)
            axes.plot(
                [place] * len(found), found, ".", color=colours[label], markersize=4, alpha=0.45
            )
        style: dict[str, Any] = {"markersize": 5, "linewidth": widths[label], "capsize": 3}
        style["elinewidth"] = 1.5
        style["marker"] = markers[label]
        axes.errorbar(places, means, spreads, color=colours[label], label=label, **style)
    if nothing:
        explain_empty_axes(axes, "runs too short to count vehicles")


def draw_speeds(comparison: Comparison, out: Path, dpi: int) -> None:
    """Draw the mean speed over space and time, in a panel per label and volume with trajectories.

    If v_F is not the same in all runs, speeds are relative to it. Colours diverge from v_F, with
    one scale for all panels: the difference from v_F has a square-root scale, so that small waves
    show beside jams. On each side of v_F it ends at the percentile `LIMIT_PERCENT` of the bins on
    that side; the ends of the bar are for bins beyond it.
    """
    labels = comparison.labels
    traced = {run.volume_veh_per_lane_h for run in comparison.runs if run.has_trajectories}
    volumes = spread_evenly(sorted(traced))
    shown = {
        (label, volume): comparison.representative(label, volume)
        for label in labels
        for volume in volumes
    }
    maps = {key: mean_speeds(run) for key, run in shown.items() if run is not None}
    own_mps = {
        key: run.scenario.formation.speed_mps for key, run in shown.items() if run is not None
    }
    set_speed, *others = set(own_mps.values())
    unit, white = "m/s", f" = {set_speed:g} m/s"
    if others:
        set_speed, unit, white = 100.0, "% of $v_F$", ""
        maps = {
            key: evolve(one, speed_mps=one.speed_mps * (100.0 / own_mps[key]))
            for key, one in maps.items()
        }
    norm, ticks = speed_scale(maps.values(), set_speed)
    width_in, height_in = 1.5 + 2.05 * max(2, len(volumes)), 0.75 + 1.75 * len(labels)
    with picture(width_in, height_in, out, dpi) as figure:
        panels = figure.subplots(len(labels), len(volumes), sharex=True, sharey=True, squeeze=False)
        for axes, ((label, volume), run) in zip(panels.flat, shown.items(), strict=True):
            axes.grid(visible=False)
            axes.spines[:].set_visible(True)
            axes.set_facecolor(NO_VEHICLE)
            if label == labels[0]:
                axes.set_title(volume_title(volume))
            if volume == volumes[0]:
                axes.set_ylabel(label, fontweight="bold")
            if run is None:
                recorded = comparison.at(label, volume)
                explain_empty_axes(axes, "no trajectories" if recorded else "not run")
                continue
            one = maps[label, volume]
            mesh = axes.pcolormesh(
                one.edges_s,
                one.edges_m,
                one.speed_mps,
                cmap="RdBu",
                norm=norm,
                rasterized=True,
            )
            start_m = run.scenario.geometry.moves_from_m
            axes.axhline(start_m, color=INK, linewidth=0.7, linestyle="--")
            _mark_closed_parts(axes, run)
        axes.set_xlim(0.0, max(one.edges_s[-1] for one in maps.values()))
        axes.set_ylim(0.0, max(one.edges_m[-1] for one in maps.values()))
        figure.supxlabel("time (s)", fontsize=9)
        figure.supylabel("position on the road (m)", fontsize=9)
        style: dict[str, Any] = {"aspect": 22 * len(labels), "fraction": 0.03}
        # A scale that begins at 0 has no values below it.
        style["extend"] = "both" if (norm.vmin or 0.0) > 0.0 else "max"
        bar = figure.colorbar(mesh, ax=panels, pad=0.012, extendfrac=0.04, **style)
        bar.set_ticks(ticks, labels=[f"{one:.4g}" for one in ticks])
        bar.minorticks_off()
        bar.set_label(f"mean speed ({unit})\nwhite: $v_F${white}")


def speed_scale(maps: Iterable[MeanSpeeds], set_mps: float) -> tuple[FuncNorm, list[float]]:
    """Return the scale of mean speeds around v_F, and the speeds to label on it.

    Each side ends at a difference of 1, 2 or 5 times a power of ten, the slower one at most at 0.
    """
    from matplotlib.colors import FuncNorm  # noqa: PLC0415 - lazily

    off_mps = np.concatenate([one.speed_mps.compressed() - set_mps for one in maps])
    slower_mps = min(_nice_limit(-off_mps[off_mps < 0.0]), set_mps)
    faster_mps = _nice_limit(off_mps[off_mps > 0.0])

    def forward(speed_mps: Floats) -> Floats:
        # Masked bins become NaN, which the scale masks again.
        over_mps = np.ma.filled(speed_mps, np.nan) - set_mps
        share = over_mps / np.where(over_mps < 0.0, slower_mps, faster_mps)
        return np.asarray(np.sign(share) * np.sqrt(np.abs(share)))

    def inverse(place: Floats) -> Floats:
        limit_mps = np.where(np.asarray(place) < 0.0, slower_mps, faster_mps)
        return np.asarray(set_mps + limit_mps * np.sign(place) * np.square(place))

    norm = FuncNorm((forward, inverse), set_mps - slower_mps, set_mps + faster_mps)
    slower = [set_mps - share * slower_mps for share in (1.0, 0.5, 0.1)]
    return norm, [*slower, *(set_mps + share * faster_mps for share in (0.0, 0.1, 0.5, 1.0))]


def _nice_limit(off_mps: Floats) -> float:
    """Return 1, 2 or 5 times a power of ten, not below the percentile of the differences."""
    limit_mps = float(np.percentile(off_mps, LIMIT_PERCENT)) if len(off_mps) else 0.0
    limit_mps = max(MIN_LIMIT_MPS, limit_mps)
    power = 10.0 ** math.floor(math.log10(limit_mps))
    return float(power * next(step for step in (1.0, 2.0, 5.0, 10.0) if limit_mps <= step * power))


def _mark_closed_parts(axes: Axes, run: Run) -> None:
    """Mark the positions at which a lane is closed, on the left edge and by lines."""
    style: dict[str, Any] = {"facecolor": CLOSED_FILL, "edgecolor": INK, "linewidth": 0.0}
    for part in closed_parts(run.scenario):
        axes.axhspan(part.from_m, part.to_m, xmax=CLOSED_WIDTH, hatch="//////", zorder=2.5, **style)
        for s_m in (part.from_m, part.to_m):
            axes.axhline(s_m, color=INK, linewidth=0.7, linestyle=":", zorder=2.4)


@frozen
class MeanSpeeds:
    """Mean speeds over road and time."""

    edges_m: Floats
    """Edges of the bins along the road."""
    edges_s: Floats
    """Edges of the bins in time."""
    speed_mps: np.ma.MaskedArray[Any, np.dtype[np.float64]]
    """Shape (bins along the road, bins in time); bins without vehicles are masked."""


def mean_speeds(run: Run) -> MeanSpeeds:
    """Return the mean speed over road and time."""
    tracks, length_m = read_tracks(run.folder), run.scenario.road.length_m
    edges_s = np.arange(0.0, max(float(tracks.t_s.max(initial=0.0)), BIN_S / 2) + BIN_S, BIN_S)
    edges_m = np.linspace(0.0, length_m, max(1, round(length_m / BIN_M)) + 1)
    bins = [edges_m, edges_s]
    count, _, _ = np.histogram2d(tracks.s_m, tracks.t_s, bins)
    total, _, _ = np.histogram2d(tracks.s_m, tracks.t_s, bins, weights=tracks.speed_mps)
    return MeanSpeeds(edges_m, edges_s, np.ma.masked_array(total, count == 0) / count)
