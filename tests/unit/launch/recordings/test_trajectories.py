"""Trajectories of this and of earlier versions have the same columns."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from laneweave.launch.recordings.trajectories import NO_LATTICE, read_tracks, read_trajectories
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.columns import SCHEMA_KEY, TRAJECTORIES
from laneweave.sim_bridge.recording.driving_measures import DrivingMeasures
from laneweave.sim_bridge.recording.trajectories import Sample, Trajectories
from laneweave.sim_bridge.recording.trips import Trip, metadata_of
from laneweave.sim_bridge.road.demand import Arrival
from support.older_recordings import first_schema
from support.recorded_trips import trips_table
from support.tables import for_each

SCENARIO = Scenario()
LATTICE = SCENARIO.lattice
FILE = "trajectories.parquet"


@pytest.fixture
def newer(tmp_path: Path) -> Path:
    """Return the folder of a recording: a vehicle moves to the left, another one has no lattice."""
    folder, metadata = tmp_path / "newer", metadata_of(SCENARIO)
    folder.mkdir()
    trips = [Trip(Arrival(name, 0, lane, 0.0)) for name, lane in (("a", 1), ("b", -1))]
    pq.write_table(trips_table(trips, 0.0, metadata), folder / "trips.parquet")
    with closing(
        Trajectories(folder / FILE, metadata, LATTICE, DrivingMeasures(Scenario()))
    ) as trajectories:
        for tick in range(40):
            t_s, across_mps = 40.0 + 0.1 * tick, LATTICE.lane_width_m / 4.0
            s_m, y_m = LATTICE.cell_s_m(-2, t_s), LATTICE.cell_y_m(0) + across_mps * 0.1 * tick
            rows: list[Sample] = [("a", s_m, y_m, 15.0, across_mps, 0.0, -2, 1, 1)]
            if tick == 20:
                rows.append(("b", 9.0, 8.0, 15.0, 0.0, 0.0, None, None, -1))
            trajectories.tick(t_s, rows)
    return folder


@pytest.fixture
def older(newer: Path) -> Path:
    """Return the folder of the same recording as an earlier version made it."""
    folder = newer.parent / "older"
    folder.mkdir()
    (folder / "trips.parquet").write_bytes((newer / "trips.parquet").read_bytes())
    pq.write_table(first_schema(pq.read_table(newer / FILE)), folder / FILE)
    return folder


def test_an_earlier_recording_has_all_columns(newer: Path, older: Path) -> None:
    expected, found = read_trajectories(newer), read_trajectories(older)
    assert found.schema.equals(expected.schema, check_metadata=True)
    assert found.schema.metadata[SCHEMA_KEY].decode() == TRAJECTORIES.schema
    for name in TRAJECTORIES.names:
        if name != "lateral_speed_mps":
            assert found[name].equals(expected[name]), name
    speeds = found["lateral_speed_mps"].to_pylist()
    alone = found["vehicle"].to_pylist().index("b")
    assert speeds.pop(alone) is None
    assert speeds == pytest.approx([LATTICE.lane_width_m / 4.0] * 40, abs=1e-4)
    # The body changes lanes half-way through the move, the reservation at once.
    lanes = [row["lane"] for row in found.to_pylist() if row["vehicle"] == "a"]
    assert lanes == [0] * 20 + [1] * 20
    assert set(found["reserved_lane"].to_pylist()) == {1, None}


@for_each("name", TRAJECTORIES.names)
def test_single_columns_are_read(newer: Path, older: Path, name: str) -> None:
    for folder in (newer, older):
        whole, alone = read_trajectories(folder), read_trajectories(folder, [name])
        assert alone.column_names == [name]
        assert alone[name].equals(whole[name])


def test_columns_have_the_order_that_is_asked_for(newer: Path, older: Path) -> None:
    names = ["lane", "vehicle", "t_s"]
    assert read_trajectories(newer, names).column_names == names
    assert read_trajectories(older, names).equals(read_trajectories(newer, names))


def test_vehicles_without_a_trip_have_no_preferred_lane(older: Path) -> None:
    """After SIGKILL the trips of the vehicles on the road are missing."""
    trips = pq.read_table(older / "trips.parquet")
    pq.write_table(trips.slice(0, 1), older / "trips.parquet")
    assert set(read_trajectories(older)["preferred_lane"].to_pylist()) == {1, None}


def test_tracks_are_the_same(newer: Path, older: Path) -> None:
    one, other = read_tracks(newer), read_tracks(older)
    assert one.names == other.names == ("a", "b")
    for name in ("t_s", "s_m", "y_m", "column", "lane", "reserved_column", "reserved_lane"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert one.column[one.rows(1)].tolist() == [NO_LATTICE]
    assert one.reserved_column[one.rows(1)].tolist() == [NO_LATTICE]


def test_unknown_columns_and_schemas_are_refused(newer: Path) -> None:
    with pytest.raises(BadInputError, match="columns: got 'cell'"):
        read_trajectories(newer, ["cell"])
    table = pq.read_table(newer / FILE)
    metadata = table.schema.metadata | {SCHEMA_KEY: b"laneweave.trajectories/3"}
    pq.write_table(table.replace_schema_metadata(metadata), newer / FILE)
    with pytest.raises(BadInputError, match=r"laneweave\.trajectories/2 or an earlier one"):
        read_trajectories(newer)
