"""Recorded runs whose vehicles drive straight on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.driving_measures import DrivingMeasures
from laneweave.sim_bridge.recording.trajectories import Sample, Trajectories
from laneweave.sim_bridge.recording.trips import Trip, metadata_of
from laneweave.sim_bridge.road.demand import Arrival
from support.recorded_trips import trips_table


def make_run(
    folder: Path,
    lanes: int = 3,
    vehicles: int = 12,
    *,
    lattice: bool = True,
    **tables: Mapping[str, Any],
) -> Path:
    """Record vehicles that drive straight on at 15 m/s, one per second, from 55 s on.

    Args:
        folder: folder of the run.
        lanes: number of lanes.
        vehicles: number of vehicles.
        lattice: whether they have formations.
        tables: other tables of the scenario.
    """
    scenario = parse_scenario({"road": {"lanes": lanes}, **tables})
    trips = []
    for number in range(vehicles):
        arrival = Arrival(f"v{number}", number % lanes, number % lanes, 55.0 + number)
        entered_s, formation = 55.5 + number, number // 6 if lattice else None
        trips.append(Trip(arrival, entered_s, entered_s + 1000 / 15, formation, arrival.lane))
    record(folder, scenario, trips)
    return folder


def record(folder: Path, scenario: Scenario, trips: Sequence[Trip]) -> None:
    """Write the files of a run whose vehicles drive at 15 m/s on the lanes of their arrival."""
    metadata = metadata_of(scenario)
    folder.mkdir(exist_ok=True)
    last_arrival_s = max((trip.arrival.t_s for trip in trips), default=0.0)
    pq.write_table(trips_table(trips, last_arrival_s, metadata), folder / "trips.parquet")
    path, lattice = folder / "trajectories.parquet", scenario.lattice
    with closing(
        Trajectories(path, metadata, lattice, DrivingMeasures(Scenario()))
    ) as trajectories:
        for tick in range(1300):
            samples: list[Sample] = []
            for number, trip in enumerate(trips):
                s_m = 15.0 * (0.1 * tick - (trip.entered_s or 0.0))
                if 0.0 <= s_m < 1000.0:
                    y_m, preferred = (trip.arrival.lane + 0.5) * 3.5, trip.arrival.preferred_lane
                    cell = (None, None) if trip.formation is None else (-number, 0)
                    samples.append((f"v{number}", s_m, y_m, 15.0, 0.0, 0.0, *cell, preferred))
            trajectories.tick(0.1 * tick, samples)
