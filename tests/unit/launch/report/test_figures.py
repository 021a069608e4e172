"""Pictures are drawn from any run's files, short and empty ones included."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from laneweave.launch.drawing.colours import lane_colours
from laneweave.launch.recordings.runs import Comparison, Run, scenario_of
from laneweave.launch.report.figures import draw_speeds, draw_travel_times
from laneweave.launch.report.snapshots import road_snapshots
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.trajectories import Sample, Trajectories
from laneweave.sim_bridge.recording.trips import Trip, metadata_of, trips_table
from laneweave.sim_bridge.road.demand import Arrival
from support.commands import loads


def make_run(folder: Path, lanes: int = 3, vehicles: int = 12, *, lattice: bool = True) -> Path:
    """Record vehicles that drive straight on, one per second, from 55 s on."""
    scenario = parse_scenario({"road": {"lanes": lanes}})
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
    with closing(Trajectories(folder / "trajectories.parquet", metadata, -9.0)) as trajectories:
        for tick in range(1300):
            samples: list[Sample] = []
            for number, trip in enumerate(trips):
                s_m = 15.0 * (0.1 * tick - (trip.entered_s or 0.0))
                if 0.0 <= s_m < 1000.0:
                    y_m, column = (trip.arrival.lane + 0.5) * 3.5, -number
                    in_column = column if trip.formation is not None else None
                    samples.append((f"v{number}", s_m, y_m, 15.0, 0.0, in_column, 0))
            trajectories.tick(0.1 * tick, samples)


def is_picture(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 2000


def comparison(*folders: Path) -> Comparison:
    return Comparison.of(
        Run(folder, folder.name, "formation", scenario_of(folder / "trips.parquet"), None)
        for folder in folders
    )


def draw_all(folder: Path) -> None:
    runs = comparison(folder)
    draw_travel_times(runs, folder / "box.png", dpi=60)
    draw_speeds(runs, folder / "heat.png", dpi=60)
    road_snapshots(folder, folder / "road.png", dpi=60)
    assert all(is_picture(folder / name) for name in ("box.png", "heat.png", "road.png"))


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 2, 3, 5])
def test_pictures_of_any_number_of_lanes(tmp_path: Path, lanes: int) -> None:
    draw_all(make_run(tmp_path, lanes, lattice=lanes != 2))


def test_pictures_of_an_empty_run(tmp_path: Path) -> None:
    record(tmp_path, parse_scenario({}), ())
    draw_all(tmp_path)


def test_given_times_and_stretch_and_resolution(tmp_path: Path) -> None:
    folder = make_run(tmp_path)
    small, large = tmp_path / "small.png", tmp_path / "large.png"
    for out, dpi in ((small, 50), (large, 100)):
        road_snapshots(folder, out, times=[70.0, 500.0], stretch_m=(100.0, 300.0), dpi=dpi)
    assert large.stat().st_size > small.stat().st_size


def test_runs_side_by_side(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / name, vehicles=n) for name, n in (("a", 12), ("b", 8), ("c", 2))]
    draw_travel_times(comparison(*folders), tmp_path / "new folder" / "box.png", dpi=60)
    assert is_picture(tmp_path / "new folder" / "box.png")


def test_lanes_are_coloured_as_in_the_paper() -> None:
    blue, green, red = lane_colours(3)
    assert (lane_colours(1), lane_colours(2)) == ((blue,), (blue, red))
    assert green not in lane_colours(2)
    assert len(set(lane_colours(8))) == 8


@pytest.mark.slow
def test_matplotlib_is_imported_only_to_draw() -> None:
    for module in ("figures", "snapshots"):
        assert not loads(f"laneweave.launch.report.{module}", "matplotlib")
