"""The files of a run: reports of the roles, its vehicles, its ending."""

from __future__ import annotations

import errno
import json
import os
import struct
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from attrs import evolve
from structlog.testing import capture_logs

from laneweave import load_run
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.protocol.wire.messages import Heartbeat, Name
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.columns import SCENARIO_KEY
from laneweave.sim_bridge.recording.events import append_event
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.bridge_bench import read_events, read_summary

SCENARIO = Scenario()
NO_GAPS = MinGaps(30.0, 2.0)


@pytest.fixture
def record(tmp_path: Path) -> Iterator[RunRecord]:
    """A record whose stopwatch advances by 2 s between its beginning and its end."""
    record = RunRecord(tmp_path, SCENARIO, "formation", count(100.0, 2.0).__next__)
    yield record
    record.close(0.0, Ending.INTERRUPTED)


def vehicle(name: str = "v0001", *, lane: int = 0, preferred_lane: int = 1) -> RoadVehicle:
    admission = Admission(Arrival(name, lane, preferred_lane, 0.5), (-2, lane), 2.0)
    return RoadVehicle.entering(admission, 2.0, SCENARIO)


def report(
    role: str, name: str, process: str = "1", *, published: int = 0, rejected: int = 0
) -> Report:
    return Report(Name(role), Name(name), Name(process), published, rejected)


def floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


# --- how it ended -----------------------------------------------------------------------------


@pytest.mark.parametrize("ending", Ending)
def test_the_summary_contains_how_the_run_ended(
    record: RunRecord, tmp_path: Path, ending: Ending
) -> None:
    record.close(12.0, ending)
    assert read_summary(tmp_path)["ending"] == ending.value
    assert read_summary(tmp_path)["simulated_s"] == 12.0
    events = [(event["ending"], event["t_s"]) for event in read_events(tmp_path, "run-ended")]
    # A killed process reports no end.
    assert events == [(ending.value, 12.0)] * (ending is not Ending.UNFINISHED)


def test_the_first_ending_counts_and_nothing_follows_it(record: RunRecord, tmp_path: Path) -> None:
    record.close(12.0, Ending.COMPLETE)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    record.close(15.0, Ending.INTERRUPTED)
    record.event(15.0, "leader")
    record.on_event(LogEvent(Name("agent"), Name("A"), 15.0, Name("late")))
    record.on_heartbeat(Heartbeat(Name("c0"), 1, 1, leading=True, plans=0), 15.0, 1.0)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


# --- messages ---------------------------------------------------------------------------------


def test_messages_are_counted_once_per_process(record: RunRecord, tmp_path: Path) -> None:
    """Vehicles that share a process all report what the process has counted so far."""
    for message in (
        report("agent", "A", "1", published=100, rejected=1),
        report("agent", "B", "1", published=140, rejected=3),
        report("agent", "C", "1", published=120, rejected=2),  # in whatever order they arrive
        report("agent", "D", "2", published=10),
        report("bridge", "bridge", "3", published=1000),
        report("coordinator", "c0", "4", published=5),
        report("coordinator", "c0", "4", published=50),
    ):
        record.on_report(message)
    record.close(1.0, Ending.COMPLETE)
    assert read_summary(tmp_path)["messages"] == {
        "published": 140 + 10 + 1000 + 50,
        "rejected": 3,
        "dropped_by_faults": 0,
    }


def test_the_newest_report_of_a_sender_counts(record: RunRecord, tmp_path: Path) -> None:
    record.on_report(Report(Name("agent"), Name("A"), solves=5, solve_ms=floats(9.0)))
    record.on_report(Report(Name("agent"), Name("A"), solves=7, unusable=1, solve_ms=floats(1.0)))
    record.on_report(
        Report(Name("agent"), Name("B"), solves=2, osqp_solves=1, solve_ms=floats(3.0))
    )
    record.close(1.0, Ending.COMPLETE)
    tracking = read_summary(tmp_path)["tracking"]
    assert (tracking["solves"], tracking["unusable"]) == (9, 1)
    assert (tracking["osqp_solves"], tracking["unconstrained_steps"]) == (1, 8)
    assert tracking["solve_ms"]["p50"] == 2.0


@pytest.mark.parametrize("nonsense", [b"123", floats(float("nan"), float("inf"), -1.0), b""])
def test_malformed_durations_are_ignored(
    record: RunRecord, tmp_path: Path, nonsense: bytes
) -> None:
    record.on_report(Report(Name("agent"), Name("A"), solve_ms=nonsense))
    record.on_report(Report(Name("agent"), Name("B"), solve_ms=floats(2.0)))
    record.close(1.0, Ending.COMPLETE)
    assert read_summary(tmp_path)["tracking"]["solve_ms"] == {"p50": 2.0, "p99": 2.0}


def test_plans_are_counted_from_events(record: RunRecord, tmp_path: Path) -> None:
    coordinator = (Name("coordinator"), Name("c0"))
    made: tuple[dict[str, Any], ...] = (
        {"status": "optimal", "vehicles": 4, "solve_ms": 10.0, "solver": "tappa"},
        {"status": "bounded", "vehicles": 6, "solve_ms": 30.0},
        {"status": [], "vehicles": "many", "solve_ms": None, "name": "somebody-else"},
        {"status": "optimal", "solver": "branching", "fallback": True},
        {"status": "optimal", "solver": ["tappa"], "fallback": "yes"},
    )
    kinds = ("plan-made", "stream-planned", *("plan-made",) * 3)
    for kind, data in zip(kinds, made, strict=True):
        record.on_event(LogEvent(*coordinator, 5.0, Name(kind), data))
    record.on_event(LogEvent(*coordinator, 6.0, Name("leader-elected"), {"term": 3}))
    record.close(9.0, Ending.COMPLETE)
    planning = read_summary(tmp_path)["planning"]
    assert (planning["plans"], planning["optimal"], planning["largest_formation"]) == (5, 3, 6)
    assert planning["by_solver"] == {"tappa": 1, "branching": 1, "rolling": 1}
    assert planning["fallbacks"] == 1
    assert planning["solve_ms"]["max"] == 30.0
    assert [event["name"] for event in read_events(tmp_path, "plan-made")] == ["c0"] * 4
    assert read_events(tmp_path, "leader-elected")[0]["term"] == 3


# --- leadership -------------------------------------------------------------------------------


def test_recovery_is_the_time_without_a_heartbeat_of_a_leader(
    record: RunRecord, tmp_path: Path
) -> None:
    def beat(name: str, incarnation: int = 1, *, term: int = 1, leading: bool = True) -> Heartbeat:
        return Heartbeat(Name(name), incarnation, term, leading=leading, plans=0)

    record.on_heartbeat(beat("c1", leading=False), 0.0, 1.0)
    record.on_heartbeat(beat("c0"), 0.1, 2.0)
    record.on_heartbeat(beat("c0"), 0.2, 3.0)
    record.on_heartbeat(beat("c1", leading=False), 0.3, 3.2)
    record.on_heartbeat(beat("c1", term=2), 0.4, 3.5)
    record.on_heartbeat(beat("c1", incarnation=2), 0.5, 5.0)  # the same name, another process
    record.close(1.0, Ending.COMPLETE)
    assert read_summary(tmp_path)["failover"] == {"leader_changes": 2, "recovery_s": [0.5, 1.5]}
    leaders = [event["coordinator"] for event in read_events(tmp_path, "leader")]
    assert leaders == ["c0", "c1", "c1"]


def test_a_leader_that_does_not_know_its_successor_yet_is_no_change(
    record: RunRecord, tmp_path: Path
) -> None:
    """It was paused: it claims to lead until it receives a heartbeat of its successor."""
    beats = [("c0", 1), ("c1", 2), ("c0", 1), ("c1", 2), ("c0", 1), ("c0", 3)]
    for number, (name, term) in enumerate(beats):
        beat = Heartbeat(Name(name), 1, term, leading=True, plans=0)
        record.on_heartbeat(beat, 0.1 * number, 0.1 * number)
    late_s = 0.5 + SCENARIO.network.election_s
    # A partition ended that hid the newer leader; then that leader remains silent.
    record.on_heartbeat(Heartbeat(Name("c2"), 1, 2, leading=True, plans=0), 1.0, late_s)
    record.close(2.0, Ending.COMPLETE)
    leaders = [(event["coordinator"], event["term"]) for event in read_events(tmp_path, "leader")]
    assert leaders == [("c0", 1), ("c1", 2), ("c0", 3), ("c2", 2)]
    assert read_summary(tmp_path)["failover"]["leader_changes"] == 3


# --- the world --------------------------------------------------------------------------------


def test_a_trip_is_recorded(record: RunRecord, tmp_path: Path) -> None:
    traveller = vehicle()
    record.on_demanded(traveller.admission.arrival)
    record.on_entered(traveller)
    plant = traveller.controller.plant
    plant._state = (SCENARIO.road.length_m + 6.0, 15.0, 0.0, 5.25, 0.0, 0.0)
    traveller.controller.level_ticks |= {
        FallbackLevel.EXECUTE: 90,
        FallbackLevel.HOLD: 3,
        FallbackLevel.GIVE_WAY: 1,
    }
    stays = vehicle("v0002")
    record.on_demanded(stays.admission.arrival)
    record.on_entered(stays)
    stays.controller.level_ticks |= {
        FallbackLevel.HOLD: 2,
        FallbackLevel.GIVE_WAY: 1,
        FallbackLevel.EMERGENCY: 5,
    }
    record.on_left(traveller, 70.0, attended=True)
    record.on_still_on_road(stays)
    record.close(70.0, Ending.LIMIT)
    (left,) = read_events(tmp_path, "left")
    assert left["t_s"] == pytest.approx(69.6)  # 6 m beyond the end at 15 m/s
    assert (left["lane"], left["on_preferred_lane"]) == (1, True)
    (entered, _) = read_events(tmp_path, "entered")
    assert (entered["t_s"], entered["lane"], entered["preferred_lane"]) == (2.0, 0, 1)
    summary = read_summary(tmp_path)
    assert (summary["vehicles"]["entered"], summary["vehicles"]["left"]) == (2, 1)
    assert summary["vehicles"]["left_off_lane"] == 0
    assert summary["tracking"]["hold_law_ticks"] == 7
    assert summary["tracking"]["emergency_ticks"] == 5


def test_a_trip_has_the_lanes_with_which_its_vehicle_entered(
    record: RunRecord, tmp_path: Path
) -> None:
    record.on_demanded(vehicle(lane=0, preferred_lane=1).admission.arrival)
    record.on_entered(vehicle(lane=2, preferred_lane=2))
    record.close(70.0, Ending.LIMIT)
    (trip,) = pq.read_table(tmp_path / "trips.parquet").to_pylist()
    assert (trip["arrival_lane"], trip["preferred_lane"], trip["demanded_s"]) == (2, 2, 0.5)


@pytest.mark.parametrize(("lane", "right"), [(0, True), (1, True), (2, False)])
def test_a_vehicle_that_sumo_takes_back_before_the_end_has_left_by_its_lane(
    record: RunRecord, tmp_path: Path, lane: int, *, right: bool
) -> None:
    traveller = vehicle(preferred_lane=1)
    arrival = evolve(traveller.admission.arrival, right_lanes=(0, 1))
    traveller.admission = evolve(traveller.admission, arrival=arrival)
    record.on_demanded(arrival)
    record.on_entered(traveller)
    y_m = SCENARIO.lattice.cell_y_m(lane)
    traveller.controller.plant._state = (400.0, 12.0, 0.0, y_m, 0.0, 0.0)
    record.on_left(traveller, 30.0, attended=True)
    (left,) = read_events(tmp_path, "left")
    assert (left["t_s"], left["exit"], left["on_preferred_lane"]) == (30.0, "end", right)
    record.close(30.0, Ending.LIMIT)
    assert read_summary(tmp_path)["vehicles"]["missed_exits"] == 0


def test_a_vehicle_that_stands_at_the_end_has_left(record: RunRecord, tmp_path: Path) -> None:
    traveller = vehicle()
    record.on_demanded(traveller.admission.arrival)
    record.on_entered(traveller)
    traveller.controller.plant._state = (SCENARIO.road.length_m, 0.0, 0.0, 1.75, 0.0, 0.0)
    record.on_left(traveller, 70.0, attended=False)
    assert read_events(tmp_path, "left")[0]["t_s"] == 70.0
    assert read_events(tmp_path, "left-off-lane")[0]["attended"] is False
    record.close(70.0, Ending.LIMIT)
    vehicles = read_summary(tmp_path)["vehicles"]
    assert (vehicles["left_off_lane"], vehicles["left_unattended"]) == (1, 1)


def test_positions_and_overlaps_are_recorded(record: RunRecord, tmp_path: Path) -> None:
    pair = ("v0001", "v0002")
    for tick in range(3):
        record.on_positions(
            0.1 * tick,
            [vehicle(name) for name in pair],
            overlaps=[pair] if tick == 1 else [],
            collisions=[],
            gaps=NO_GAPS,
        )
    record.close(0.3, Ending.COMPLETE)
    assert read_summary(tmp_path)["safety"]["overlaps"] == 1
    (event,) = read_events(tmp_path, "overlap")
    assert (event["vehicles"], event["t_s"]) == (list(pair), 0.1)
    rows = pq.read_table(tmp_path / "trajectories.parquet").to_pylist()
    cells = [(row["vehicle"], row["reserved_column"], row["reserved_lane"]) for row in rows]
    assert cells == [(name, -2, 0) for _ in range(3) for name in pair]
    assert {(row["lane"], row["preferred_lane"]) for row in rows} == {(0, 1)}


def test_ticks_are_timed(record: RunRecord, tmp_path: Path) -> None:
    for tick in range(4):
        record.on_tick(0.1 * tick, tick, 0.001 * (tick + 1))
    record.close(8.0, Ending.COMPLETE)
    runtime = read_summary(tmp_path)["runtime"]
    assert (runtime["real_time_factor"], runtime["wall_s"]) == (4.0, 2.0)
    assert runtime["tick_ms"]["p50"] == 2.5
    assert runtime["processes"] is None  # the bridge cannot know
    assert runtime["vehicles_per_process"] == 1
    rows = pq.read_table(tmp_path / "ticks.parquet").to_pylist()
    assert [row["on_road"] for row in rows] == [0, 1, 2, 3]


def test_an_empty_run_has_all_files_and_an_agreed_summary(
    record: RunRecord, tmp_path: Path
) -> None:
    record.close(0.0, Ending.INTERRUPTED)
    found = read_summary(tmp_path)
    assert found["runtime"]["real_time_factor"] == 0.0
    assert found["tracking"]["solve_ms"] == {"p50": None, "p99": None}
    assert found["planning"]["largest_formation"] == 0
    assert found["schema"] == "laneweave.summary/1"
    assert pq.read_table(tmp_path / "ticks.parquet").num_rows == 0
    for name in ("trajectories.parquet", "trips.parquet"):
        metadata = pq.read_schema(tmp_path / name).metadata or {}
        assert parse_scenario(json.loads(metadata[SCENARIO_KEY])) == SCENARIO
        assert pq.read_table(tmp_path / name).num_rows == 0


def test_events_are_written_at_once_and_begin_with_the_time(
    record: RunRecord, tmp_path: Path
) -> None:
    record.event(1.5, "agent-missing", vehicle="v1", path=tmp_path)
    (line,) = (tmp_path / "events.jsonl").read_text().splitlines()
    assert list(json.loads(line)) == ["t_s", "kind", "role", "vehicle", "path"]
    record.event(2.0, "odd", t_s=99, kind="other", more=[1, 2])
    (odd,) = read_events(tmp_path, "odd")
    assert odd == {"t_s": 2.0, "kind": "odd", "role": "bridge", "more": [1, 2]}
    record.event(3.0, "not finite", figures={(1, 2): [float("nan"), 1.5, float("-inf")]})
    (last,) = read_events(tmp_path, "not finite")
    assert last["figures"] == {"(1, 2)": ["nan", 1.5, "-inf"]}


def test_the_launcher_adds_events_between_those_of_the_bridge(
    record: RunRecord, tmp_path: Path
) -> None:
    record.event(1.0, "odd")
    append_event(tmp_path / "events.jsonl", 1.5, "fault-injected", {"role": "launcher"})
    record.event(2.0, "odd")
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    found = [(one["t_s"], one["role"]) for one in map(json.loads, lines)]
    assert found == [(1.0, "bridge"), (1.5, "launcher"), (2.0, "bridge")]


# --- while it goes on -------------------------------------------------------------------------


def drive(record: RunRecord, one: RoadVehicle, ticks: range) -> None:
    for tick in ticks:
        t_s = round(0.1 * tick, 6)
        record.on_positions(t_s, [one], overlaps=(), collisions=(), gaps=NO_GAPS)
        record.on_tick(t_s, 1, 0.001)


def test_a_run_that_goes_on_can_be_read(record: RunRecord, tmp_path: Path) -> None:
    one = vehicle()
    record.on_demanded(one.arrival)
    record.on_entered(one)
    for until in (30, 50):
        drive(record, one, range(until - 20, until, 2))
        record.save(0.1 * until)
        run = load_run(tmp_path)
        assert (run.summary.ending, run.summary.simulated_s) == ("unfinished", 0.1 * until)
        assert run.summary.vehicles.entered == 1
        assert run.trips()["vehicle"].to_pylist() == ["v0001"]
        assert run.trajectories().num_rows == run.ticks().num_rows == (until - 10) // 2
    record.close(5.0, Ending.COMPLETE)
    run = load_run(tmp_path)
    assert run.summary.ending == "complete"
    assert (run.trips().num_rows, run.ticks().num_rows, run.trajectories().num_rows) == (1, 20, 20)


def test_a_run_goes_on_when_its_disk_fails(
    record: RunRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = vehicle()
    record.on_demanded(one.arrival)
    record.on_entered(one)
    drive(record, one, range(10))
    record.save(1.0)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, capture_logs() as logs:
        patch.setattr(os, "posix_fallocate", full)
        drive(record, one, range(10, 20))
        record.save(2.0)
        record.save(2.5)
        record.event(2.5, "overlap", vehicles=["A", "B"])
    assert [line["reason"] for line in logs] == ["No space left on device"]
    # There may be room again, but what was missed is not recorded.
    record.close(3.0, Ending.COMPLETE)
    run = load_run(tmp_path)
    assert (run.summary.ending, run.summary.recorded_until_s) == ("complete", 1.0)
    assert run.trajectories().num_rows == 10
    assert not run.events("overlap")
