"""Figures with labels side by side: travel times, throughput and shares, speeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from attrs import frozen

from laneweave.launch.drawing.figures import FAINT_INK, INK, new_figure, save
from laneweave.launch.recordings.runs import Comparison, Run, scenario_of
from laneweave.launch.recordings.trajectories import Floats
from laneweave.launch.report.style import (
    label_colours,
    legend_above,
    note,
    plain,
    spread_evenly,
    volume_title,
)
from laneweave.protocol.scenario.tables import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes


JAMMED = 1.25
"""A box belongs to a jam if its upper quartile exceeds the lowest median by this factor."""
MARGIN = 0.04
"""Part of the scale that is free below the shortest travel time."""
LOWER_SHARE = 0.66
"""Part of the height below the break, for the methods that do not jam."""


def draw_travel_times(comparison: Comparison, out: Path, dpi: int) -> None:
    """Draw boxes of the counted vehicles' travel times, all seeds together, by volume.

    Where a method jams, the axis is broken: jams are much longer than other differences.
    """
    from matplotlib.patches import Patch  # noqa: PLC0415 - lazily

    labels, volumes = comparison.labels, comparison.volumes
    colours = label_colours(labels)
    times = {
        label: [_travel_times(comparison.at(label, volume)) for volume in volumes]
        for label in labels
    }
    figure = new_figure(max(5.6, 1.6 + 0.3 * len(volumes) * (len(labels) + 0.8)), 4.4)
    break_s = _break(one for found in times.values() for one in found)
    if break_s is None:
        lower = figure.subplots()
        panels = [lower]
    else:
        shares = (1.0 - LOWER_SHARE, LOWER_SHARE)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=shares)
        panels = [upper, lower]
    for axes in panels:
        _draw_boxes(axes, times, colours)
        plain(axes, grid="y")
    _draw_free_flow(lower, comparison)
    if break_s is not None:
        _break_axis(upper, lower, break_s)
    for number, label in enumerate(labels):
        places = _places(number, labels, volumes)
        for place, volume, one in zip(places, volumes, times[label], strict=True):
            if comparison.at(label, volume) and not len(one):
                lower.text(
                    place,
                    0.03,
                    "no vehicle",
                    transform=lower.get_xaxis_transform(),
                    rotation=90,
                    ha="center",
                    va="bottom",
                    fontsize=7,
                    color=FAINT_INK,
                )
    lower.set_xticks(range(len(volumes)), labels=[f"{volume:g}" for volume in volumes])
    lower.set_xlim(-0.6, len(volumes) - 0.4)
    lower.set_xlabel("traffic volume (veh/(lane·h))")
    lower.set_ylabel("travel time (s)")
    handles = [Patch(facecolor=colours[one] + "55", edgecolor=colours[one]) for one in labels]
    legend_above(figure, handles, labels)
    save(figure, out, dpi)


def _break(times_s: Iterable[Floats]) -> float | None:
    """Return the travel time at which the axis is broken; None: there is no jam, or only jams."""
    shapes = [np.percentile(one, [50.0, 75.0, 99.0]) for one in times_s if len(one)]
    limit_s = JAMMED * min((median_s for median_s, _, _ in shapes), default=0.0)
    ends_s = [end_s for _, upper_s, end_s in shapes if upper_s <= limit_s]
    if len(ends_s) in (0, len(shapes)):
        return None
    return float(min(limit_s, 1.01 * max(ends_s)))


def _break_axis(upper: Axes, lower: Axes, break_s: float) -> None:
    """Show times above the break on the upper axes, with a scale of its own, the others below."""
    lowest_s, top_s = lower.dataLim.ymin, lower.get_ylim()[1]
    lower.set_ylim(lowest_s - MARGIN * (break_s - lowest_s), break_s)
    upper.set_ylim(break_s, top_s)
    upper.spines["bottom"].set_visible(False)
    upper.tick_params(axis="x", bottom=False, labelbottom=False)
    upper.set_ylabel("jams (s)")
    for axes, y in ((upper, 0.0), (lower, 1.0)):
        axes.plot(
            [0.0],
            [y],
            transform=axes.transAxes,
            color=INK,
            clip_on=False,
            marker=[(-1.0, -0.5), (1.0, 0.5)],
            markersize=9,
            linestyle="none",
        )


def _places(number: int, labels: Sequence[str], volumes: Sequence[float]) -> Floats:
    """Return the places of a label's boxes along the axis."""
    width = 0.8 / len(labels)
    shift = (number - 0.5 * (len(labels) - 1)) * width
    return np.arange(len(volumes), dtype=np.float64) + shift


def _draw_boxes(
    axes: Axes, times_s: Mapping[str, Sequence[Floats]], colours: Mapping[str, str]
) -> None:
    """Draw the boxes of each label, one for each volume, and a line through their means."""
    labels = list(times_s)
    width = 0.8 / len(labels)
    for number, (label, times) in enumerate(times_s.items()):
        places = _places(number, labels, range(len(times)))
        axes.boxplot(
            times,
            positions=places,
            widths=0.72 * width,
            manage_ticks=False,
            patch_artist=True,
            boxprops={"facecolor": colours[label] + "55", "edgecolor": colours[label]},
            medianprops={"color": INK, "linewidth": 1.2},
            whiskerprops={"color": colours[label]},
            capprops={"color": colours[label]},
            flierprops={"marker": ".", "markersize": 2.5, "markeredgecolor": colours[label]},
        )
        means = [float(np.mean(one)) if len(one) else np.nan for one in times]
        axes.plot(
            places, means, color=colours[label], marker="o", markersize=3.5, linewidth=1.3, zorder=3
        )


def _draw_free_flow(axes: Axes, comparison: Comparison) -> None:
    times_s = {
        run.scenario.road.length_m / run.scenario.formation.speed_mps for run in comparison.runs
    }
    for t_s in sorted(times_s):
        axes.axhline(t_s, color="#8a9099", linewidth=1.0, linestyle="--", zorder=0)
        axes.annotate(
            f"free flow\n{t_s:.1f} s",
            (1.0, t_s),
            xycoords=("axes fraction", "data"),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
            color=FAINT_INK,
            annotation_clip=False,
        )


def _travel_times(runs: tuple[Run, ...]) -> Floats:
    """Return the travel times in s of the counted vehicles."""
    found = [np.empty(0)]
    for run in runs:
        table = pq.read_table(run.folder / "trips.parquet", columns=["travel_time_s", "counted"])
        counted = table.filter(pc.field("counted"))["travel_time_s"].drop_null()
        found.append(counted.to_numpy().astype(np.float64))
    return np.concatenate(found)


def draw_flows(comparison: Comparison, out: Path, dpi: int) -> None:
    """Draw throughput and the share on the preferred lane against the demand."""
    figure = new_figure(9.2, 3.7)
    left, right = figure.subplots(1, 2)
    volumes = np.array(comparison.volumes)
    margin = 0.06 * (float(np.ptp(volumes)) or 400.0)
    span = np.array([volumes[0] - margin, volumes[-1] + margin])
    left.plot(span, span, color="#8a9099", linewidth=1.0, linestyle="--", zorder=0)
    left.annotate(
        "dashed: throughput = demand",
        (0.97, 0.04),
        xycoords="axes fraction",
        ha="right",
        fontsize=7.5,
        color=FAINT_INK,
    )
    left.set_ylabel("throughput (veh/(lane·h))")
    _draw_seeds(left, comparison, _throughput)
    right.set_ylabel("left on the preferred lane (%)")
    _draw_seeds(right, comparison, _preferred_percent)
    low = right.get_ylim()[0]
    right.set_ylim(min(low, 95.0), 100.0 + 0.04 * (100.0 - min(low, 95.0)))
    for axes in (left, right):
        axes.set_xlabel("traffic volume (veh/(lane·h))")
        axes.set_xlim(*span)
        axes.set_xticks(volumes if len(volumes) <= 8 else volumes[:: 1 + len(volumes) // 8])
        plain(axes)
    handles, labels = right.get_legend_handles_labels()
    if handles:
        legend_above(figure, handles, labels)
    save(figure, out, dpi)


def _draw_seeds(axes: Axes, comparison: Comparison, value: Callable[[Run], float | None]) -> None:
    """Draw each run as a dot, and the mean over seeds with its standard deviation as a line."""
    colours = label_colours(comparison.labels)
    shown = False
    volumes = np.array(comparison.volumes)
    apart = 0.012 * (float(np.ptp(volumes)) or 400.0)
    for number, label in enumerate(comparison.labels):
        # Side by side, where several labels have the same value.
        places = volumes + (number - 0.5 * (len(comparison.labels) - 1)) * apart
        means, spreads = [], []
        for place, volume in zip(places, comparison.volumes, strict=True):
            found = [value(run) for run in comparison.at(label, volume)]
            values = np.array([one for one in found if one is not None])
            means.append(values.mean() if len(values) else np.nan)
            spreads.append(values.std(ddof=1) if len(values) > 1 else 0.0)
            axes.plot(
                [place] * len(values), values, ".", color=colours[label], markersize=4, alpha=0.45
            )
            shown = shown or len(values) > 0
        axes.errorbar(
            places,
            means,
            yerr=spreads,
            color=colours[label],
            label=label,
            marker="o",
            markersize=4.5,
            linewidth=1.5,
            capsize=3,
        )
    if not shown:
        note(axes, "runs too short to count vehicles")


def _throughput(run: Run) -> float | None:
    return run.summary.throughput_veh_per_lane_h if run.summary else None


def _preferred_percent(run: Run) -> float | None:
    return run.summary.preferred_percent if run.summary else None


def draw_speeds(comparison: Comparison, out: Path, dpi: int) -> None:
    """Draw the mean speed over space and time, a panel for each label and volume."""
    labels, volumes = comparison.labels, spread_evenly(comparison.volumes)
    shown = {
        (label, volume): comparison.shown(label, volume) for label in labels for volume in volumes
    }
    maps = {key: mean_speeds(run.folder) for key, run in shown.items() if run is not None}
    last_s = max(one.edges_s[-1] for one in maps.values())
    last_m = max(one.edges_m[-1] for one in maps.values())
    top_mps = max(speed_ceiling_mps(run.scenario, maps[key]) for key, run in shown.items() if run)
    figure = new_figure(1.5 + 2.05 * max(2, len(volumes)), 0.75 + 1.75 * len(labels))
    panels = figure.subplots(len(labels), len(volumes), sharex=True, sharey=True, squeeze=False)
    mesh = None
    for row, label in enumerate(labels):
        for column, volume in enumerate(volumes):
            axes, run = panels[row, column], shown[label, volume]
            axes.set_xlim(0.0, last_s)
            axes.set_ylim(0.0, last_m)
            axes.set_facecolor("#f2f3f5")
            axes.tick_params(colors=INK, labelsize=7.5, length=2.5)
            if row == 0:
                axes.set_title(volume_title(volume), fontsize=9, color=INK)
            if column == 0:
                axes.set_ylabel(label, fontsize=9, color=INK, fontweight="bold")
            if run is None:
                note(axes, "no trajectories")
                continue
            one = maps[label, volume]
            mesh = axes.pcolormesh(
                one.edges_s,
                one.edges_m,
                one.speed_mps,
                cmap="inferno",
                vmin=0.0,
                vmax=top_mps,
                rasterized=True,
            )
            start_m = run.scenario.road.sorting_start_m
            axes.axhline(start_m, color="white", linewidth=0.7, linestyle="--")
    figure.supxlabel("time (s)", fontsize=9, color=INK)
    figure.supylabel("position on the road (m)", fontsize=9, color=INK)
    if mesh is not None:
        bar = figure.colorbar(mesh, ax=panels, pad=0.012, aspect=22 * len(labels), fraction=0.03)
        bar.set_label("mean speed (m/s)", fontsize=9, color=INK)
        bar.ax.tick_params(labelsize=7.5)
    save(figure, out, dpi)


@frozen
class MeanSpeeds:
    """Mean speeds over road and time."""

    edges_m: Floats
    """Edges of the bins along the road."""
    edges_s: Floats
    """Edges of the bins in time."""
    speed_mps: np.ma.MaskedArray[Any, np.dtype[np.float64]]
    """Shape (bins along the road, bins in time); masked where no vehicle was."""


def mean_speeds(folder: Path, *, bin_m: float = 20.0, bin_s: float = 5.0) -> MeanSpeeds:
    """Return the mean speed over road and time.

    Args:
        folder: a run's folder.
        bin_m: length of a bin along the road.
        bin_s: length of a bin in time.
    """
    path = folder / "trajectories.parquet"
    length_m = scenario_of(path).road.length_m
    table = pq.read_table(path, columns=["t_s", "s_m", "speed_mps"])
    t_s, s_m, speed = (table[name].to_numpy().astype(np.float64) for name in table.column_names)
    end_s = float(t_s.max(initial=0.0))
    edges_s = np.arange(0.0, end_s + bin_s, bin_s) if end_s > 0.0 else np.array([0.0, bin_s])
    edges_m = np.linspace(0.0, length_m, max(1, round(length_m / bin_m)) + 1)
    count, _, _ = np.histogram2d(s_m, t_s, bins=[edges_m, edges_s])
    total, _, _ = np.histogram2d(s_m, t_s, bins=[edges_m, edges_s], weights=speed)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return MeanSpeeds(edges_m, edges_s, np.ma.masked_invalid(mean))


def speed_ceiling_mps(scenario: Scenario, speeds: MeanSpeeds) -> float:
    """Return the upper end of a colour scale for speeds."""
    found = float(speeds.speed_mps.max()) if speeds.speed_mps.count() else 0.0
    return max(1.2 * scenario.formation.speed_mps, found)
