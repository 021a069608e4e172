"""Travel-time boxes and speed heat maps of finished runs, drawn from their Parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
from attrs import frozen
from numpy.typing import NDArray

from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK, new_figure, save, scenario_of
from laneweave.protocol.scenario.tables import Scenario

Floats = NDArray[np.float64]


def travel_time_boxplot(folders: Sequence[Path], out: Path, *, dpi: int = DPI) -> None:
    """Draw the travel times of the counted vehicles, one box per run.

    Boxes are labelled with the run's volume, and with its folder's name where volumes repeat. Runs
    without a counted vehicle keep their place, empty.

    Args:
        folders: folders of runs, drawn from left to right.
        out: the picture to write; its suffix says the format.
        dpi: resolution in dots per inch.
    """
    times, volumes, free_flow = [], [], set()
    for folder in folders:
        trips = pq.read_table(folder / "trips.parquet", columns=["travel_time_s", "counted"])
        counted = trips.filter(pc.field("counted"))["travel_time_s"]
        times.append(counted.drop_null().to_numpy().astype(np.float64))
        scenario = scenario_of(folder / "trips.parquet")
        volumes.append(f"{scenario.demand.volume_veh_per_lane_h:g}")
        free_flow.add(scenario.road.length_m / scenario.formation.speed_mps)
    repeated = len(set(volumes)) < len(volumes)
    labels = [
        f"{volume}\n{folder.name}" if repeated else volume
        for volume, folder in zip(volumes, folders, strict=True)
    ]
    figure = new_figure(max(4.5, 1.5 + 0.9 * len(folders)), 3.6)
    axes = figure.subplots()
    for t_s in sorted(free_flow):
        axes.axhline(t_s, color="#8a9099", linewidth=1.0, linestyle="--", zorder=0)
        axes.annotate(
            f"free\nflow\n{t_s:.1f} s",
            (1.01, t_s),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=7.5,
            color=FAINT_INK,
        )
    axes.boxplot(
        times,
        tick_labels=labels,
        widths=0.55,
        patch_artist=True,
        boxprops={"facecolor": "#cfe0f5", "edgecolor": INK},
        medianprops={"color": "#cf3f3a", "linewidth": 1.6},
        flierprops={"marker": ".", "markersize": 3, "markeredgecolor": "#8a9099"},
    )
    for place, values in enumerate(times, start=1):
        if not len(values):
            axes.annotate(
                "no counted\nvehicle",
                (place, 0.5),
                xycoords=("data", "axes fraction"),
                ha="center",
                va="center",
                fontsize=7.5,
                color=FAINT_INK,
            )
    axes.set_xlabel("traffic volume (veh/(lane·h))")
    axes.set_ylabel("travel time (s)")
    axes.grid(axis="y", color="#e4e6e9")
    axes.set_axisbelow(True)
    save(figure, out, dpi)


def speed_heatmap(
    folder: Path,
    out: Path,
    *,
    bin_m: float = 20.0,
    bin_s: float = 5.0,
    dpi: int = DPI,
) -> None:
    """Draw the mean speed over road and time; bins that no vehicle was in stay blank.

    Args:
        folder: a run's folder.
        out: the picture to write; its suffix says the format.
        bin_m: length of a bin along the road.
        bin_s: length of a bin in time.
        dpi: resolution in dots per inch.
    """
    scenario = scenario_of(folder / "trajectories.parquet")
    speeds = mean_speeds(folder, bin_m=bin_m, bin_s=bin_s)
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots()
    mesh = axes.pcolormesh(
        speeds.edges_s,
        speeds.edges_m,
        speeds.speed_mps,
        cmap="inferno",
        vmin=0.0,
        vmax=speed_ceiling_mps(scenario, speeds),
        rasterized=True,
    )
    axes.axhline(scenario.road.sorting_start_m, color="white", linewidth=0.8, linestyle="--")
    axes.annotate(
        "lane sorting begins",
        (0.99, scenario.road.sorting_start_m),
        xycoords=("axes fraction", "data"),
        xytext=(0, 6),
        textcoords="offset points",
        ha="right",
        fontsize=7.5,
        color=INK,
        bbox={"boxstyle": "round,pad=0.25", "facecolor": "#ffffffc0", "edgecolor": "none"},
    )
    axes.set_facecolor("#f2f3f5")
    axes.set_xlabel("time (s)")
    axes.set_ylabel("position on the road (m)")
    figure.colorbar(mesh, ax=axes, label="mean speed (m/s)", pad=0.015)
    save(figure, out, dpi)


@frozen
class MeanSpeeds:
    """Mean speeds over road and time."""

    edges_m: Floats
    """Of the bins along the road."""
    edges_s: Floats
    """Of the bins in time."""
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
