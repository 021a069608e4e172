"""The animated road: trajectories as compact data for the player (`templates/player.js`).

All vehicles are sampled at common times, `step_s` apart. A sample has three little-endian integers:
longitudinal and lateral position (16 bits each) and speed (8 bits). Each of these quantities is one
column with its own unit: a base64 string with the samples of all vehicles, one vehicle after
another. The player interpolates between samples.
"""

from __future__ import annotations

import base64
import math
from typing import Any, Final

import numpy as np
from attrs import frozen

from laneweave.launch.drawing.colours import trip_lane
from laneweave.launch.drawing.road_scene import road_scene
from laneweave.launch.formation_columns import Formations
from laneweave.launch.recordings.formations import closed_formations
from laneweave.launch.recordings.runs import Run
from laneweave.launch.recordings.trajectories import Floats, Tracks, read_trips
from laneweave.protocol.wire.messages import CAR

FORMAT: Final = "laneweave.animation/1"
KINDS: Final = {"s_m": "<u2", "y_m": "<u2", "speed_mps": "u1"}
"""Data types of the columns."""
STEPS_S: Final = (0.2, 0.5, 1.0)
MAX_SAMPLES: Final = 600_000
"""Maximum number of samples (4 MB of text); longer runs are sampled more coarsely or truncated."""


def animation_data(run: Run, tracks: Tracks) -> dict[str, Any]:
    """Return the data for the player as a JSON object."""
    scenario, road = run.scenario, run.scenario.road
    formations = closed_formations(run.folder, scenario)
    samples = _sample(run, tracks, formations)
    units = {
        "s_m": max(0.02, float(tracks.s_m.max(initial=0.0)) / 65_000),
        "y_m": road.lanes * road.lane_width_m / 65_000,
        "speed_mps": max(0.1, float(tracks.speed_mps.max(initial=0.0)) / 250),
    }
    return {
        "format": FORMAT,
        "title": run.title,
        "step_s": samples.step_s,
        "end_s": round(samples.end_s, 3),
        # When the first vehicle reaches the end of the road.
        "start_s": round(min(scenario.geometry.free_flow_s, 0.5 * samples.end_s), 3),
        **road_scene(scenario, recorded=True),
        "formations": [[one.number, one.rear, one.front] for one in reversed(formations.listed)],
        "vehicles": samples.vehicles,
        "units": units,
        "columns": {
            name: _packed(samples.columns[name], units[name], kind) for name, kind in KINDS.items()
        },
    }


@frozen
class _Samples:
    """Sampled trajectories of the vehicles in order of entry."""

    step_s: float
    end_s: float
    vehicles: list[dict[str, Any]]
    columns: dict[str, list[Floats]]
    """One array per vehicle, shape (samples of the vehicle,)."""


def _sample(run: Run, tracks: Tracks, formations: Formations) -> _Samples:
    """Sample all vehicles at common times."""
    trips, known = read_trips(run.folder), formations.by_number
    driven_s = len(tracks.t_s) * run.scenario.runtime.tick_s
    step_s = next((step for step in STEPS_S if driven_s / step <= MAX_SAMPLES), STEPS_S[-1])
    end_s = float(tracks.t_s.max(initial=0.0))
    vehicles: list[dict[str, Any]] = []
    columns: dict[str, list[Floats]] = {name: [] for name in KINDS}
    samples = 0
    for number in np.argsort(tracks.t_s[tracks.starts[:-1]], kind="stable").tolist():
        t_s = tracks.t_s[tracks.rows(number)]
        first = math.ceil(t_s[0] / step_s - 1e-6)
        count = math.floor(t_s[-1] / step_s + 1e-6) - first + 1
        if count < 1:
            continue
        if samples + count > MAX_SAMPLES:
            # Vehicles are in order of entry, so the data are complete up to this time.
            end_s = first * step_s
            break
        samples += count
        times_s = step_s * (first + np.arange(count))
        for name, parts in columns.items():
            parts.append(tracks.sampled(number, name, times_s))
        trip = trips.get(tracks.names[number], {})
        vehicles.append(
            {
                "name": tracks.names[number],
                "lane": trip_lane(run.scenario, trip),
                "type": trip.get("vehicle_type", CAR),
                "formation": trip["formation"] if trip.get("formation") in known else None,
                "first": first,
                "count": count,
            }
        )
    return _Samples(step_s, end_s, vehicles, columns)


def _packed(parts: list[Floats], unit: float, kind: str) -> str:
    values = np.concatenate(parts) if parts else np.empty(0)
    limits = np.iinfo(np.dtype(kind))
    whole = np.clip(np.rint(values / unit), limits.min, limits.max).astype(kind)
    return base64.b64encode(whole.tobytes()).decode("ascii")
