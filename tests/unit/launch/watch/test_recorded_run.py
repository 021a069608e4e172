"""A recorded run as frames: vehicles are at the positions in its files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from attrs import evolve

from laneweave.launch.recordings.closed_parts import ClosedForATime, closed_for_a_time
from laneweave.launch.recordings.runs import single_run
from laneweave.launch.recordings.trajectories import read_tracks
from laneweave.launch.watch.frames import MOVING
from laneweave.launch.watch.recorded_run import RecordedFrames
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from support.commands import Here
from support.older_recordings import older_recording
from support.tables import for_each

pytestmark = pytest.mark.slow


def frames(recording: RecordedFrames) -> list[dict[str, Any]]:
    return [json.loads(text) for text in recording.frames(0, recording.last)]


@pytest.mark.more
def test_vehicles_are_at_their_recorded_positions(recorded: Path) -> None:
    recording, tracks = RecordedFrames(recorded), read_tracks(recorded)
    shown = frames(recording)
    assert [frame["n"] for frame in shown] == list(range(recording.last + 1))
    assert {frame["status"] for frame in shown} == {"recorded"}
    seen = 0
    for frame in shown:
        there = np.flatnonzero(np.abs(tracks.t_s - frame["t"]) < 1e-6)
        places = {tracks.names[tracks.vehicle[row]]: row for row in there}
        assert places.keys() == {row[0] for row in frame["vehicles"]}
        for name, s_m, y_m, speed_mps, *_ in frame["vehicles"]:
            row = places[name]
            assert s_m == pytest.approx(tracks.s_m[row], abs=0.006)
            assert y_m == pytest.approx(tracks.y_m[row], abs=0.006)
            assert speed_mps == pytest.approx(tracks.speed_mps[row], abs=0.006)
            seen += 1
    assert seen > 1000
    assert any(row[8] & MOVING for frame in shown for row in frame["vehicles"])
    assert recording.scene["step_s"] == pytest.approx(0.2)
    assert shown[-1]["t"] == pytest.approx(tracks.t_s.max(), abs=0.4)


def test_counts_lanes_and_leaders_are_those_of_the_run(recorded: Path) -> None:
    recording, summary = RecordedFrames(recorded), single_run(recorded).summary
    last = frames(recording)[-1]
    assert summary is not None
    vehicles = summary.vehicles
    assert last["counts"] == [vehicles.demanded, vehicles.entered, 0, vehicles.left]
    assert last["leader"] == ["c1", 1]
    assert last["plan"] is not None
    assert [event[2] for event in last["news"]][:2] == ["leader-elected", "leader"]
    assert frames(recording)[0]["leader"] is None
    lanes = {row[0]: row[4] for frame in frames(recording) for row in frame["vehicles"]}
    assert set(lanes.values()) == {0, 1, 2}


def test_formations_are_shown_from_their_closing_on(recorded: Path) -> None:
    closed = [
        event for event in map(json.loads, (recorded / "events.jsonl").read_text().splitlines())
        if event["kind"] == "formation-closed"
    ]  # fmt: skip
    assert len({rear - front for event in closed for rear, front in [event["columns"]]}) > 1
    seen: set[int] = set()
    for frame in frames(RecordedFrames(recorded)):
        there = {row[0] for row in frame["vehicles"]}
        known = [event for event in closed if event["t_s"] <= frame["t"]]
        assert sorted(frame["formations"], key=lambda one: one[0]) == [
            [event["formation"], *event["columns"]]
            for event in known
            if there.intersection(event["vehicles"])
        ]
        number = {name: event["formation"] for event in known for name in event["vehicles"]}
        assert {row[0]: row[5] for row in frame["vehicles"]} == {
            name: number.get(name, -1) for name in there
        }
        seen.update(one[0] for one in frame["formations"])
    assert seen == {event["formation"] for event in closed}


def test_an_older_recording_has_formations_of_equal_length(recorded: Path, tmp_path: Path) -> None:
    folder = older_recording(recorded, tmp_path / "run")
    shown = frames(RecordedFrames(folder))
    assert {one[2] - one[1] for frame in shown for one in frame["formations"]} == {3}
    assert all(one[2] == -4 * one[0] for frame in shown for one in frame["formations"])
    # The time at which a block was closed is not known: it contains its vehicles from the start.
    assert all(row[5] >= 0 for frame in shown for row in frame["vehicles"])


def test_formations_that_plan_together(recorded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(recorded, folder)
    first, second = RecordedFrames(folder).frame(100)["formations"][::-1][:2]
    event = {"t_s": 15.0, "kind": "formations-joined", "role": "coordinator", "name": "c1"}
    blocks = list(range(-first[2], -second[1] + 1))
    with (folder / "events.jsonl").open("a") as events:
        events.write(json.dumps(event | {"formations": blocks}) + "\n")
        events.write(json.dumps(event | {"role": "agent", "formations": "all"}) + "\n")
    recording = RecordedFrames(folder)
    assert recording.frame(70)["joined"] == []
    assert recording.frame(100)["joined"] == [[first[0], second[0]]]


def test_cells_beyond_a_stop_line_are_not_shown(recorded: Path) -> None:
    recording, scenario = RecordedFrames(recorded), single_run(recorded).scenario
    rolling = evolve(scenario.formation, operation="rolling")
    road = evolve(scenario.road, closures=(Closure(0, 300.0),))
    ends = LaneEnds(evolve(scenario, formation=rolling, road=road))
    recording._lane_ends = ends
    (end,) = ends
    seen = [0, 0]
    for frame in frames(recording):
        for row in frame["vehicles"]:
            if row[6]:
                assert not ends.has_passed(tuple(row[6]), frame["t"])
            seen[not row[6]] += 1
            assert row[6] or row[1] > end.line_m - scenario.lattice.pitch_m
    assert min(seen) > 50


def closing(t_s: float, kind: str, to_m: float = 450.0, cause: str = "closed") -> str:
    event = {"t_s": t_s, "kind": kind, "role": "bridge", "lane": 1, "from_m": 400.0, "to_m": to_m}
    return json.dumps(event | {"cause": cause}) + "\n"


def test_parts_are_shown_while_they_are_closed(recorded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(recorded, folder)
    with (folder / "events.jsonl").open("a") as events:
        events.write(closing(2.0, "part-closed") + closing(3.0, "part-closed", 440.0))
        events.write(closing(2.5, "part-closed", 300.0, "passing") + closing(6.0, "part-opened"))
    recording = RecordedFrames(folder)
    parts = [recording.frame(number)["parts"] for number in (5, 12, 20, 40)]
    assert parts == [[], [[1, 400.0, 450.0, 1]], [[1, 400.0, 440.0, 1]], []]
    assert closed_for_a_time(folder) == [ClosedForATime(1, 400.0, 450.0, 2.0, 6.0)]


def test_there_are_no_frames_before_and_after(recorded: Path) -> None:
    recording = RecordedFrames(recorded)
    assert recording.frames(recording.last + 1, recording.last + 9) == []
    assert len(recording.frames(recording.last - 1, recording.last + 9)) == 2


@pytest.mark.parametrize("lost", ["trajectories.parquet", "summary.json", "trips.parquet"])
def test_an_incomplete_run_is_refused(recorded: Path, tmp_path: Path, lost: str) -> None:
    folder = tmp_path / "run"
    shutil.copytree(recorded, folder)
    (folder / lost).unlink()
    with pytest.raises(BadInputError, match=r"the folder of a|a run that kept this file"):
        RecordedFrames(folder)


def test_a_run_with_damaged_events_is_refused(recorded: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(recorded, folder)
    (folder / "events.jsonl").write_text('{"t_s": 1.0}\n')
    with pytest.raises(BadInputError, match=r"events\.jsonl"):
        RecordedFrames(folder)


@for_each(
    ("arguments", "words"),
    [
        (["/nowhere"], "folder"),
        (["/nowhere", "--endpoint", "tcp/127.0.0.1:1"], "--endpoint"),
        (["/nowhere", "--config", "scenarios/paper.toml"], "--config"),
        ([], "network.endpoint"),
        (["--endpoint", "udp/127.0.0.1:1"], "network.endpoint"),
    ],
)
def test_bad_input_of_the_command(laneweave: Here, arguments: list[str], words: str) -> None:
    assert words in laneweave.refused("watch", *arguments, "--listen", "127.0.0.1:0")
