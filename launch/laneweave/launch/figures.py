"""Travel-time boxes and speed heat maps of finished runs, drawn from their Parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from laneweave.launch.drawing import DPI, FAINT_INK, INK, new_figure, save, scenario_of


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
    path = folder / "trajectories.parquet"
    scenario = scenario_of(path)
    table = pq.read_table(path, columns=["t_s", "s_m", "speed_mps"])
    t_s, s_m, speed = (table[name].to_numpy().astype(np.float64) for name in table.column_names)
    end_s = float(t_s.max(initial=0.0))
    edges_t = np.arange(0.0, end_s + bin_s, bin_s) if end_s > 0.0 else np.array([0.0, bin_s])
    edges_s = np.linspace(
        0.0, scenario.road.length_m, max(1, round(scenario.road.length_m / bin_m)) + 1
    )
    count, _, _ = np.histogram2d(s_m, t_s, bins=[edges_s, edges_t])
    total, _, _ = np.histogram2d(s_m, t_s, bins=[edges_s, edges_t], weights=speed)
    mean = np.ma.masked_invalid(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    figure = new_figure(7.2, 3.4)
    axes = figure.subplots()
    mesh = axes.pcolormesh(
        edges_t,
        edges_s,
        mean,
        cmap="inferno",
        vmin=0.0,
        vmax=max(1.2 * scenario.formation.speed_mps, float(mean.max()) if mean.count() else 0.0),
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
