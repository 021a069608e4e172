"""What is recorded comes back from the files, and the summary counts the right vehicles."""

from __future__ import annotations

import json
import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording import recorder as recorder_module
from laneweave.sim_bridge.recording.recorder import SCENARIO_KEY, Recorder, Sample
from laneweave.sim_bridge.road.demand import Arrival

SCENARIO = parse_scenario({"seed": 5, "demand": {"volume_veh_per_lane_h": 1600.0}})


def trip(
    recorder: Recorder,
    number: int,
    demanded_s: float,
    entered_s: float | None = None,
    left_s: float | None = None,
    lanes: tuple[int, int, int] = (0, 1, 1),
) -> None:
    """Record one vehicle's trip; lanes: arrival, preferred, final."""
    vehicle = f"v{number:04d}"
    recorder.demanded(Arrival(vehicle, lanes[0], lanes[1], demanded_s))
    if entered_s is not None:
        recorder.entered(vehicle, entered_s, number // 6)
    if left_s is not None:
        recorder.left(vehicle, left_s, lanes[2])


def test_trajectories_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    expected = []
    monkeypatch.setattr(recorder_module, "ROWS_PER_GROUP", 25)
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        for tick in range(40):
            samples: list[Sample] = []
            for n in range(tick % 5):
                s_m, y_m, speed, accel = map(float, rng.uniform(0, 10, 4))
                samples.append((f"v{n}", s_m, y_m, speed, accel, -n if n else None, n % 3))
            recorder.tick(0.1 * tick, samples)
            expected += [(0.1 * tick, *sample) for sample in samples]
    file = pq.ParquetFile(tmp_path / "trajectories.parquet")
    assert file.num_row_groups > 2
    table = file.read()
    names = ["t_s", "vehicle", "s_m", "y_m", "speed_mps", "accel_mps2", "column", "lane"]
    assert table.column_names == names
    rows = list(zip(*(table[name].to_pylist() for name in names), strict=True))
    for row, wanted in zip(rows, expected, strict=True):
        assert row[:2] == wanted[:2]
        assert row[2:6] == pytest.approx(wanted[2:6], rel=1e-6)
        assert row[6:] == wanted[6:]


def test_the_files_carry_the_scenario(tmp_path: Path) -> None:
    Recorder(tmp_path, SCENARIO).close()
    for name in ("trajectories.parquet", "trips.parquet"):
        metadata = pq.read_schema(tmp_path / name).metadata
        assert metadata is not None
        assert parse_scenario(json.loads(metadata[SCENARIO_KEY])) == SCENARIO


def test_trips_come_back_in_every_state(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        trip(recorder, 1, 1.0, 3.0, 70.0)
        trip(recorder, 2, 62.0, 64.5, 131.5, lanes=(2, 0, 1))
        trip(recorder, 3, 70.0, 71.0)
        trip(recorder, 4, 80.0)
    rows = pq.read_table(tmp_path / "trips.parquet").to_pylist()
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
    }
    assert [row["counted"] for row in rows] == [False, True, False, False]
    assert [row["on_preferred_lane"] for row in rows] == [True, False, None, None]
    assert [row["left_s"] for row in rows] == [70.0, 131.5, None, None]
    assert [row["entered_s"] for row in rows] == [3.0, 64.5, 71.0, None]


def test_only_vehicles_between_warm_up_and_last_arrival_count(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        trip(recorder, 1, 58.0, 59.9, 900.0)  # enters during the warm-up
        for number in range(2, 12):
            entered_s = 60.0 + 10.0 * (number - 2)
            trip(recorder, number, entered_s - 1.0, entered_s, entered_s + 60.0 + number)
        trip(recorder, 12, 150.0, 150.5, 800.0)  # enters after the last arrival
        trip(recorder, 13, 149.0, 149.5)  # still on the road
        summary = recorder.summarise("formation", 400.0)
    times = [61.0 + number for number in range(2, 12)]
    assert summary["travel_time_s"] == {
        "mean": pytest.approx(np.mean(times)),
        "p50": pytest.approx(np.median(times)),
        "p95": pytest.approx(np.percentile(times, 95)),
        "max": pytest.approx(72.0),
    }
    # Ten counted vehicles leave at 122, 133, ... 221 s: one in 11 s, over three lanes.
    assert summary["throughput_veh_per_lane_h"] == pytest.approx(3600 / 11 / 3, abs=1e-3)
    assert summary["vehicles"] == {
        "demanded": 13,
        "entered": 13,
        "left": 12,
        "on_preferred_lane": 12,
        "peak": 0,
    }


def test_a_short_run_has_null_results(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        trip(recorder, 1, 1.0, 2.0, 70.0)
        summary = recorder.summarise("rule", 70.0)
    assert summary["travel_time_s"] == {"mean": None, "p50": None, "p95": None, "max": None}
    assert summary["throughput_veh_per_lane_h"] is None
    assert summary["safety"]["min_gap_m"] is None
    assert summary["safety"]["max_jerk_mps3"] is None
    assert summary["vehicles"]["left"] == 1
    assert "NaN" not in json.dumps(summary)
    assert "Infinity" not in json.dumps(summary)


def test_the_summary_has_the_agreed_fields(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        summary = recorder.summarise("lc2013", 12.0)
    world = ["schema", "method", "seed", "volume_veh_per_lane_h", "lanes", "road_m", "simulated_s"]
    parts = ["vehicles", "travel_time_s", "throughput_veh_per_lane_h", "safety"]
    assert list(summary) == world + parts
    assert [summary[name] for name in world] == [
        *("laneweave.summary/1", "lc2013", 5, 1600.0, 3, 1000.0, 12.0),
    ]
    assert list(summary["safety"]) == [
        "overlaps",
        "sumo_collisions",
        "min_gap_m",
        "min_headway_s",
        "emergency_brakes",
        "max_accel_mps2",
        "min_accel_mps2",
        "max_jerk_mps3",
    ]


def test_safety_is_the_worst_of_the_run(tmp_path: Path) -> None:
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        recorder.safety([("a", "b")], [], MinGaps(4.0, 1.2))
        recorder.safety([("a", "b"), ("a", "c")], [("a", "b")], MinGaps(3.25, 1.5))
        recorder.safety([], [], MinGaps(math.inf, math.inf))
        safety = recorder.summarise("formation", 1.0)["safety"]
    assert (safety["overlaps"], safety["sumo_collisions"]) == (2, 1)
    assert (safety["min_gap_m"], safety["min_headway_s"]) == (3.25, 1.2)


def test_emergency_brakes_are_counted_by_episode(tmp_path: Path) -> None:
    accels = {"a": [0.0, -9.5, -10.0, -8.0, -9.1, 0.0], "b": [0.0, 1.0, 1.5, 1.5, -8.9, -9.0]}
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        for tick in range(6):
            recorder.tick(
                0.1 * tick, [(v, 0.0, 1.0, 15.0, accels[v][tick], None, 0) for v in accels]
            )
        summary = recorder.summarise("formation", 0.6)
    assert summary["vehicles"]["peak"] == 2
    assert summary["safety"]["emergency_brakes"] == 2
    assert summary["safety"]["min_accel_mps2"] == -10.0
    assert summary["safety"]["max_accel_mps2"] == 1.5
    assert summary["safety"]["max_jerk_mps3"] == pytest.approx(104.0)


def test_events_are_there_at_once_and_begin_with_the_time(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    with closing(Recorder(tmp_path, SCENARIO)) as recorder:
        recorder.event(1.5, "agent-missing", vehicle="v1", path=tmp_path)
        (line,) = path.read_text().splitlines()
        assert list(json.loads(line)) == ["t_s", "kind", "vehicle", "path"]
        recorder.event(2.0, "odd", t_s=99, kind="other", more=[1, 2])
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[1] == {"t_s": 2.0, "kind": "odd", "more": [1, 2]}


def test_closing_twice_keeps_everything_and_ends_recording(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, Scenario())
    trip(recorder, 1, 0.0, 1.0)
    recorder.tick(1.0, [("v0001", 0.0, 1.75, 15.0, 0.0, -1, 0)])
    recorder.close()
    recorder.close()
    assert pq.read_table(tmp_path / "trajectories.parquet").num_rows == 1
    assert pq.read_table(tmp_path / "trips.parquet").num_rows == 1
    assert recorder.summarise("formation", 1.0)["vehicles"]["entered"] == 1
    with pytest.raises(RuntimeError, match="closed"):
        recorder.tick(1.1, [])
    with pytest.raises(RuntimeError, match="closed"):
        recorder.event(1.1, "late")


def test_an_exception_keeps_what_was_recorded(tmp_path: Path) -> None:
    def fail() -> None:
        with closing(Recorder(tmp_path, Scenario())) as recorder:
            recorder.tick(0.0, [("v0001", 0.0, 1.75, 15.0, 0.0, -1, 0)])
            recorder.entered("nobody", 0.0)

    with pytest.raises(KeyError):
        fail()
    assert pq.read_table(tmp_path / "trajectories.parquet").num_rows == 1
    assert pq.read_table(tmp_path / "trips.parquet").num_rows == 0
