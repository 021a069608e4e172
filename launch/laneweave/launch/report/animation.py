"""The moving road: a run's trajectories as compact data for the player (`templates/player.js`).

Every vehicle is sampled on a common grid of times, `step_s` apart, from its first to its last
sample. A sample is three whole numbers, little-endian: place along the road and across it (16 bits
each) and speed (8 bits), each in units of its own. The samples of all vehicles follow each other;
each of the three columns is one base64 text. Between samples the player interpolates.
"""

from __future__ import annotations

import base64
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq

from laneweave.launch.report.runs import Run
from laneweave.launch.report.tracks import Floats, Tracks
from laneweave.launch.snapshots import SHADE_STRENGTH, SPEED_SPAN_MPS, lane_colours

FORMAT: Final = "laneweave.animation/1"
STEPS_S: Final = (0.2, 0.5, 1.0)
MOST_SAMPLES: Final = 600_000
"""Makes 4 MB of text. A run with more is sampled more coarsely, or ends earlier."""


def animation_data(run: Run, tracks: Tracks, title: str) -> dict[str, Any]:
    """Return what the player needs to show a run, as JSON has it.

    Args:
        run: the run.
        tracks: its trajectories.
        title: what the run is called on the page.
    """
    scenario, road = run.scenario, run.scenario.road
    trips = pq.read_table(
        run.folder / "trips.parquet", columns=["vehicle", "preferred_lane", "formation"]
    ).to_pylist()
    trip_of = {trip["vehicle"]: trip for trip in trips}
    end_s = float(tracks.t_s.max(initial=0.0))
    step_s = next(
        (step for step in STEPS_S if len(tracks.t_s) * _tick(run) / step <= MOST_SAMPLES), 1.0
    )
    units = {
        "s_m": max(0.02, float(tracks.s_m.max(initial=0.0)) / 65_000),
        "y_m": road.lanes * road.lane_width_m / 65_000,
        "speed_mps": max(0.1, float(tracks.speed_mps.max(initial=0.0)) / 250),
    }
    vehicles: list[dict[str, Any]] = []
    columns: dict[str, list[Floats]] = {name: [] for name in units}
    samples = 0
    for number in np.argsort(tracks.t_s[tracks.starts[:-1]], kind="stable"):
        rows = tracks.rows(int(number))
        t_s = tracks.t_s[rows]
        first = int(np.ceil(t_s[0] / step_s - 1e-6))
        count = int(np.floor(t_s[-1] / step_s + 1e-6)) - first + 1
        if count < 1:
            continue
        if samples + count > MOST_SAMPLES:
            # In order of entry: up to here everybody is there.
            end_s = first * step_s
            break
        samples += count
        times_s = step_s * (first + np.arange(count))
        for name, values in (
            ("s_m", tracks.s_m),
            ("y_m", tracks.y_m),
            ("speed_mps", tracks.speed_mps),
        ):
            columns[name].append(np.interp(times_s, t_s, values[rows]))
        name = tracks.names[int(number)]
        trip = trip_of.get(name, {})
        vehicles.append(
            {
                "name": name,
                "lane": int(trip.get("preferred_lane") or 0),
                "formation": trip.get("formation"),
                "first": first,
                "count": count,
            }
        )
    return {
        "format": FORMAT,
        "title": title,
        "step_s": step_s,
        "end_s": round(end_s, 3),
        "start_s": round(_busy_s(run, end_s), 3),
        "road": {
            "length_m": road.length_m,
            "lanes": road.lanes,
            "lane_width_m": road.lane_width_m,
            "sorting_start_m": road.sorting_start_m,
        },
        "body_m": [scenario.vehicle.length_m, scenario.vehicle.width_m],
        "lattice": {
            "speed_mps": scenario.formation.speed_mps,
            "pitch_m": scenario.formation.gap_m,
            "block_columns": scenario.formation.block_columns,
        },
        "shade": {"span_mps": SPEED_SPAN_MPS, "strength": SHADE_STRENGTH},
        "colours": list(lane_colours(road.lanes)),
        "vehicles": vehicles,
        "units": units,
        "columns": {
            "s_m": _packed(columns["s_m"], units["s_m"], "<u2"),
            "y_m": _packed(columns["y_m"], units["y_m"], "<u2"),
            "speed_mps": _packed(columns["speed_mps"], units["speed_mps"], "u1"),
        },
    }


def _tick(run: Run) -> float:
    return run.scenario.runtime.tick_s


def _busy_s(run: Run, end_s: float) -> float:
    """Return a road time at which the whole road is in use, or the middle of a short run."""
    return min(run.scenario.road.length_m / run.scenario.formation.speed_mps, 0.5 * end_s)


def _packed(parts: list[Floats], unit: float, kind: str) -> str:
    values = np.concatenate(parts) if parts else np.empty(0)
    limits = np.iinfo(np.dtype(kind))
    whole = np.clip(np.rint(values / unit), limits.min, limits.max).astype(kind)
    return base64.b64encode(whole.tobytes()).decode("ascii")
