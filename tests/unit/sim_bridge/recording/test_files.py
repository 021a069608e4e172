"""Trips and trajectories come back from their files; figures count the right vehicles."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Safety, TravelTime
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording import trajectories as trajectories_module
from laneweave.sim_bridge.recording import trips as trips_module
from laneweave.sim_bridge.recording.columns import (
    ROAD,
    SCHEMA_KEY,
    TICKS,
    TRAJECTORIES,
    TRIPS,
    Table,
)
from laneweave.sim_bridge.recording.driving_measures import DrivingMeasures
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet
from laneweave.sim_bridge.recording.trajectories import Sample, Trajectories
from laneweave.sim_bridge.recording.trips import (
    Trip,
    Trips,
    metadata_of,
    throughput,
    travel_time,
)
from laneweave.sim_bridge.road.demand import Arrival
from support.recorded_trips import trips_table

METADATA = metadata_of(Scenario())
LATTICE = Scenario().lattice


def trip(
    number: int,
    demanded_s: float,
    entered_s: float | None = None,
    left_s: float | None = None,
    lanes: tuple[int, int, int] = (0, 1, 1),
) -> Trip:
    """Return one vehicle's trip; lanes: arrival, preferred, final."""
    arrival = Arrival(f"v{number:04d}", lanes[0], lanes[1], demanded_s)
    formation = None if entered_s is None else number // 6
    if left_s is None:
        return Trip(arrival, entered_s, None, formation)
    at_destination = lanes[2] == lanes[1]
    return Trip(arrival, entered_s, left_s, formation, lanes[2], "end", at_destination)


def table(*trips: Trip) -> pa.Table:
    last_arrival_s = max((each.arrival.t_s for each in trips), default=0.0)
    return trips_table(trips, last_arrival_s, METADATA)


@pytest.fixture
def trajectories(tmp_path: Path) -> Trajectories:
    return Trajectories(
        tmp_path / "trajectories.parquet", METADATA, LATTICE, DrivingMeasures(Scenario())
    )


def test_trajectories_come_back(
    trajectories: Trajectories, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    expected = []
    monkeypatch.setattr(trajectories_module, "ROWS_PER_GROUP", 25)
    with closing(trajectories):
        for tick in range(40):
            samples: list[Sample] = []
            for n in range(tick % 5):
                s_m, y_m, speed, across, accel = map(float, rng.uniform(0, 10, 5))
                cell = (-n, n % 3) if n else (None, None)
                samples.append((f"v{n}", s_m, y_m, speed, across, accel, *cell, 2 - n % 3))
            trajectories.tick(0.1 * tick, samples)
            expected += [(round(0.1 * tick, 6), *sample) for sample in samples]
    file = pq.ParquetFile(tmp_path / "trajectories.parquet")
    assert file.num_row_groups > 2
    found = file.read()
    floats = ["s_m", "y_m", "speed_mps", "lateral_speed_mps", "accel_mps2"]
    names = ["t_s", "vehicle", *floats, "reserved_column", "reserved_lane", "preferred_lane"]
    assert {*found.column_names} == {*names, "column", "lane"}
    rows = list(zip(*(found[name].to_pylist() for name in names), strict=True))
    for row, wanted in zip(rows, expected, strict=True):
        assert row[:2] == wanted[:2]
        assert row[2:7] == pytest.approx(wanted[2:7], rel=1e-6)
        assert row[7:] == wanted[7:]


@pytest.mark.parametrize("passed", [0.45, 0.55])
def test_column_and_lane_are_those_of_the_body_during_a_move(
    trajectories: Trajectories, tmp_path: Path, passed: float
) -> None:
    """A vehicle moves from cell (-2, 1) to (-3, 2); each coordinate changes half-way."""
    s_m = LATTICE.cell_s_m(-2, 40.0) - passed * LATTICE.pitch_m
    y_m = LATTICE.cell_y_m(1) + passed * LATTICE.lane_width_m
    with closing(trajectories):
        trajectories.tick(40.0, [("a", s_m, y_m, 14.0, 1.2, 0.0, -3, 2, 0)])
    (row,) = pq.read_table(tmp_path / "trajectories.parquet").to_pylist()
    assert (row["column"], row["lane"]) == ((-2, 1) if passed < 0.5 else (-3, 2))
    assert (row["reserved_column"], row["reserved_lane"]) == (-3, 2)
    assert row["lateral_speed_mps"] == pytest.approx(1.2)


def test_without_a_lattice_there_are_no_columns(trajectories: Trajectories, tmp_path: Path) -> None:
    with closing(trajectories):
        trajectories.tick(40.0, [("a", 100.0, 5.0, 14.0, 0.0, 0.0, None, None, 0)])
    (row,) = pq.read_table(tmp_path / "trajectories.parquet").to_pylist()
    assert (row["column"], row["reserved_column"]) == (None, None)
    assert (row["lane"], row["reserved_lane"]) == (1, None)


@pytest.mark.parametrize("declared", [TRAJECTORIES, TRIPS, TICKS], ids=lambda one: one.schema)
def test_files_describe_their_columns(declared: Table, tmp_path: Path) -> None:
    path = tmp_path / "file.parquet"
    GrowingParquet(path, declared.arrow_schema({"other": "kept"})).close()
    found = pq.read_schema(path)
    metadata = found.metadata or {}
    assert metadata[SCHEMA_KEY].decode() == declared.schema
    assert metadata[b"other"] == b"kept"
    for column, field in zip(declared.columns, found, strict=True):
        assert (field.name, field.type, field.nullable) == (
            column.name,
            column.type,
            column.nullable,
        )
        assert (field.metadata or {})[b"meaning"].decode() == column.meaning
        assert (field.metadata or {}).get(b"unit", b"").decode() == column.unit
        unit = {"s": "s", "ms": "ms", "m": "m", "mps": "m/s", "mps2": "m/s2"}
        assert column.unit == unit.get(column.name.rpartition("_")[2], "")
        assert ("position" in column.meaning) <= (column.frame == ROAD)


def test_trips_have_every_state() -> None:
    rows = table(
        trip(1, 1.0, 3.0, 70.0),
        trip(2, 62.0, 64.5, 131.5, lanes=(2, 0, 1)),
        trip(3, 70.0, 71.0),
        trip(4, 80.0),
    ).to_pylist()
    assert rows[1] == {
        "vehicle": "v0002",
        "arrival_lane": 2,
        "preferred_lane": 0,
        "final_lane": 1,
        "on_preferred_lane": False,
        "demanded_s": 62.0,
        "entered_s": 64.5,
        "left_s": 131.5,
        "travel_time_s": 69.5,
        "entry_delay_s": 2.5,
        "formation": 0,
        "counted": True,
        "entrance": "main",
        "destination": "end",
        "exit": "end",
        "free_flow_s": 0.0,
        "vehicle_type": "car",
        "sumo_id": None,
    }
    assert [row["counted"] for row in rows] == [False, True, False, False]
    assert [row["on_preferred_lane"] for row in rows] == [True, False, None, None]
    assert [row["left_s"] for row in rows] == [70.0, 131.5, None, None]
    assert [row["entered_s"] for row in rows] == [3.0, 64.5, 71.0, None]


def test_only_vehicles_between_warm_up_and_last_arrival_count() -> None:
    found = table(
        trip(1, 58.0, 59.9, 900.0),  # enters during the warm-up
        *(trip(n, 10.0 * n + 39.0, 10.0 * n + 40.0, 11.0 * n + 100.0) for n in range(2, 12)),
        trip(12, 150.0, 150.5, 800.0),  # enters after the last arrival
        trip(13, 149.0, 149.5),  # still on the road
    )
    times_s = [61.0 + number for number in range(2, 12)]
    expected = [np.mean(times_s), np.median(times_s), np.percentile(times_s, 95), 72.0]
    times = travel_time(found)
    assert (times.mean, times.p50, times.p95, times.max) == pytest.approx(tuple(expected))
    assert times.n == 10
    # Ten counted vehicles leave at 122, 133, ... 221 s: one in 11 s, over three lanes.
    assert throughput(found, 3) == pytest.approx(3600 / 11 / 3, abs=1e-3)


@pytest.mark.parametrize("trips", [(), (trip(1, 1.0, 2.0, 70.0),)], ids=["empty", "short"])
def test_a_run_without_counted_vehicles_has_no_figures(trips: tuple[Trip, ...]) -> None:
    none = TravelTime(
        mean=None, p50=None, p95=None, max=None, n=0, by_destination={}, by_entrance={}, by_type={}
    )
    assert travel_time(table(*trips)) == none
    assert throughput(table(*trips), 3) is None


def test_trips_are_written_in_order_of_arrival_as_soon_as_they_are_final(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trips_module, "ROWS_PER_GROUP", 3)
    path = tmp_path / "trips.parquet"
    expected = [trip(n, 60.0 + n, 60.5 + n, 130.0 + n if n != 14 else None) for n in range(20)]
    with closing(Trips(path, METADATA)) as trips:
        for number, done in enumerate(expected):
            trips.add(Trip(done.arrival))
            mine = trips[Name(done.arrival.vehicle)]
            mine.entered_s, mine.formation = done.entered_s, done.formation
            if number >= 2:
                gone = expected[number - 2]
                old = trips[Name(gone.arrival.vehicle)]
                old.left_s, old.final_lane = gone.left_s, gone.final_lane
                old.exit, old.at_destination = gone.exit, gone.at_destination
        # The vehicle that is still on the road delays the trips of those behind it.
        assert pq.read_table(path).num_rows == 12
        assert len(trips._trips) == 8
    rows = table(*expected).to_pylist()
    for row in rows[-2:]:
        row.update(dict.fromkeys(("left_s", "final_lane", "on_preferred_lane", "travel_time_s")))
        row["exit"] = None
        row["counted"] = False
    assert trips.table().to_pylist() == rows
    assert rows[12]["counted"]


def test_a_trip_is_final_when_a_vehicle_has_arrived_after_its_entry() -> None:
    done = trip(1, 60.0, 65.0, 130.0)
    assert not done.is_final(64.9)
    assert done.is_final(65.0)
    assert not trip(1, 60.0, 65.0).is_final(200.0)


def test_few_rows_are_written_after_some_time(
    trajectories: Trajectories, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectories_module, "TICKS_PER_GROUP", 4)
    with closing(trajectories):
        for tick in range(6):
            trajectories.tick(0.1 * tick, [("a", 0.0, 1.0, 15.0, 0.0, 0.0, None, None, 0)])
        assert pq.read_table(tmp_path / "trajectories.parquet").num_rows == 4


def test_safety_is_the_worst_of_the_run(trajectories: Trajectories) -> None:
    assert trajectories.safety() == Safety(
        overlaps=0,
        sumo_collisions=0,
        min_gap_m=None,
        min_headway_s=None,
        emergency_brakes=0,
        hard_brakes=0,
        max_accel_mps2=None,
        min_accel_mps2=None,
        max_jerk_mps3=None,
        ttc_below_3_s=0.0,
        ttc_below_1_5_s=0.0,
        drac_max_mps2=0.0,
    )
    trajectories.distances([("a", "b")], [], MinGaps(4.0, 1.2))
    trajectories.distances([("a", "b"), ("a", "c")], [("a", "b")], MinGaps(3.25, 1.5))
    trajectories.distances([], [], MinGaps(math.inf, math.inf))
    safety = trajectories.safety()
    assert (safety.overlaps, safety.sumo_collisions) == (2, 1)
    assert (safety.min_gap_m, safety.min_headway_s) == (3.25, 1.2)
    trajectories.close()


def test_emergency_brakes_are_counted_by_episode(trajectories: Trajectories) -> None:
    accels = {"a": [0.0, -9.5, -10.0, -8.0, -9.1, 0.0], "b": [0.0, 1.0, 1.5, 1.5, -8.9, -9.0]}
    for tick in range(6):
        rows: list[Sample] = [
            (v, 0.0, 1.0, 15.0, 0.0, accels[v][tick], None, None, 0) for v in accels
        ]
        trajectories.tick(0.1 * tick, rows)
    safety = trajectories.safety()
    assert trajectories.peak == 2
    assert safety.emergency_brakes == 2
    assert safety.min_accel_mps2 == -10.0
    assert safety.max_accel_mps2 == 1.5
    assert safety.max_jerk_mps3 == pytest.approx(104.0)
    trajectories.close()
