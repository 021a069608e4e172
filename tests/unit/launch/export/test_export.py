"""Exports of a run are read by the tools for which they are made."""

from __future__ import annotations

import csv
import gzip
import json
import math
import resource
import shutil
import signal
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import sumo
from attrs import evolve
from commonroad.common.file_reader import CommonRoadFileReader
from commonroad.scenario.lanelet import LineMarking
from commonroad_dc import pycrcc
from commonroad_dc.collision.collision_detection.pycrcc_collision_dispatch import (
    create_collision_object,
)
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap.records import Schema

from laneweave.launch.export.commonroad_file import FIRST_OBSTACLE, write_commonroad
from laneweave.launch.export.formats import Format, export
from laneweave.launch.export.recording import Recording
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.road_tables import Closure, SolidLine
from laneweave.sim_bridge.recording.columns import TRAJECTORIES, TRIPS
from support.commands import Here
from support.sharing import made_once

SCENARIOS = Path(__file__).resolve().parents[4] / "scenarios"
TOOLS = Path(sumo.SUMO_HOME) / "tools"


def _drive(folder: Path) -> None:
    scenario = load_scenario(SCENARIOS / "trucks.toml", seed=4, demand__duration_s=15.0)
    assert SimulatedRun(scenario, folder, show_progress=False).run().exit_status == 0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "exported", _drive)


@pytest.fixture(scope="module")
def rows(run: Path) -> list[dict[str, Any]]:
    return pq.read_table(run / "trajectories.parquet").to_pylist()


def test_fcd_has_every_vehicle_at_every_tick(
    run: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    plain, network = export(run, Format.fcd, tmp_path / "fcd.xml")
    (packed, beside) = export(run, Format.fcd, tmp_path / "packed.xml.gz")
    assert gzip.decompress(packed.read_bytes()) == plain.read_bytes()
    assert (network.name, beside.name) == ("fcd.road.net.xml", "packed.road.net.xml")
    assert network.read_bytes() == beside.read_bytes()
    trips = {one["vehicle"]: one for one in pq.read_table(run / "trips.parquet").to_pylist()}
    found = [
        (float(tick.attrib["time"]), vehicle.attrib)
        for tick in ET.parse(plain).getroot()  # noqa: S314
        for vehicle in tick
    ]
    assert len(found) == len(rows)
    for (t_s, vehicle), row in zip(found, rows, strict=True):
        assert vehicle["id"] == row["vehicle"]
        assert t_s == pytest.approx(row["t_s"])
        assert vehicle["type"] == trips[row["vehicle"]]["vehicle_type"]
        assert float(vehicle["x"]) == pytest.approx(row["s_m"], abs=0.006)
        heading = math.atan2(row["lateral_speed_mps"], row["speed_mps"])
        length_m = 12.0 if vehicle["type"] == "truck" else 5.0
        y_m = row["y_m"] + 0.5 * length_m * math.sin(heading)
        assert float(vehicle["y"]) == pytest.approx(y_m, abs=0.02)
        assert float(vehicle["angle"]) == pytest.approx(90.0 - math.degrees(heading), abs=0.1)
        assert vehicle["lane"] == f"road_{row['lane']}"
        assert float(vehicle["speed"]) == pytest.approx(row["speed_mps"], abs=0.006)
    assert {vehicle["type"] for _, vehicle in found} == {"car", "truck"}


@pytest.mark.parametrize("kind", ["td", "ts"])
def test_scripts_of_sumo_draw_the_fcd(run: Path, tmp_path: Path, kind: str) -> None:
    fcd, _ = export(run, Format.fcd, tmp_path / "fcd.xml")
    picture = tmp_path / "picture.png"
    script = str(TOOLS / "plot_trajectories.py")
    command = [sys.executable, script, "-t", kind, "-o", str(picture), "--blind", str(fcd)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    assert picture.stat().st_size > 10_000


def test_csv_has_the_tables_and_their_columns(
    run: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    files = export(run, Format.csv, tmp_path)
    names = ["trajectories.csv", "trips.csv", "ticks.csv", "columns.csv"]
    assert [file.name for file in files] == names
    with (tmp_path / "trajectories.csv").open(encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert len(found) == len(rows)
    assert float(found[77]["s_m"]) == pytest.approx(rows[77]["s_m"], rel=1e-6)
    with (tmp_path / "columns.csv").open(encoding="utf-8") as file:
        described = {(one["file"], one["column"]): one for one in csv.DictReader(file)}
    for table in (TRAJECTORIES, TRIPS):
        name = "trajectories.csv" if table is TRAJECTORIES else "trips.csv"
        for column in table.columns:
            assert described[name, column.name]["unit"] == column.unit
            assert described[name, column.name]["meaning"] == column.meaning


def message_type(schema: Schema) -> Any:  # noqa: ANN401 - generated by protobuf
    """Return the class of a schema's messages; None: they are JSON."""
    if schema.encoding != "protobuf":
        return None
    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    found = pool.FindMessageTypeByName(schema.name)
    return message_factory.MessageFactory(pool).GetPrototype(found)


def test_mcap_is_read_by_its_own_reader(
    run: Path, rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    (path,) = export(run, Format.mcap, tmp_path / "run.mcap")
    events = (run / "events.jsonl").read_text(encoding="utf-8").splitlines()
    ticks = sorted({row["t_s"] for row in rows})
    bodies: list[Any] = []
    points: list[tuple[float, ...]] = []
    messages: list[str] = []
    traffic: list[dict[str, float]] = []
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        schemas = {
            one.topic: summary.schemas[one.schema_id].name for one in summary.channels.values()
        }
        kinds = {one.id: message_type(one) for one in summary.schemas.values()}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            kind = kinds[schema.id]
            if kind is None:
                traffic.append(json.loads(message.data))
                continue
            decoded = kind.FromString(message.data)
            if channel.topic == "/road":
                assert len(decoded.entities[0].lines) == 4
            elif channel.topic == "/vehicles":
                assert message.log_time == pytest.approx(1e9 * ticks[len(bodies)])
                bodies.append(decoded.entities[0].cubes)
            elif channel.topic == "/speeds":
                points += struct.iter_unpack("<5f", decoded.data)
            else:
                messages.append(decoded.message)
    assert schemas == {
        "/road": "foxglove.SceneUpdate",
        "/vehicles": "foxglove.SceneUpdate",
        "/speeds": "foxglove.PointCloud",
        "/events": "foxglove.Log",
        "/traffic": "laneweave.Traffic",
    }
    assert len(bodies) == len(traffic) == len(ticks)
    assert sum(map(len, bodies)) == len(points) == len(rows)
    for point, row in zip(points, rows, strict=True):
        assert point[0] == pytest.approx(row["s_m"], abs=1e-3)
        assert point[3] == pytest.approx(row["speed_mps"], abs=1e-3)
    cubes = [cube for tick in bodies for cube in tick]
    for cube, row in zip(cubes, rows, strict=True):
        assert cube.pose.position.x == pytest.approx(row["s_m"] - 0.5 * cube.size.x, abs=0.1)
        assert cube.pose.position.y == pytest.approx(row["y_m"], abs=1e-3)
    assert {cube.size.x for cube in cubes} == {5.0, 12.0}
    assert sorted(json.loads(message)["kind"] for message in messages) == sorted(
        json.loads(event)["kind"] for event in events
    )
    front_y_m = Recording.read(run).front_y_m
    assert [point[1] for point in points] == pytest.approx(front_y_m.tolist(), abs=1e-3)


def test_commonroad_finds_no_collision_and_a_planted_one(run: Path, tmp_path: Path) -> None:
    (path,) = export(run, Format.commonroad, tmp_path / "run.xml")
    recording = Recording.read(run)
    assert colliding(path) == set()
    numbers = {name: FIRST_OBSTACLE + place for place, name in enumerate(recording.names)}
    # The second vehicle drives where the first one is, 3 m behind its front.
    first, second = recording.vehicle == 0, recording.vehicle == 1
    both = np.intersect1d(recording.t_s[first], recording.t_s[second])
    planted = np.isin(recording.t_s, both[10:20])
    assert np.count_nonzero(planted & first) == np.count_nonzero(planted & second) == 10
    recording.s_m[planted & second] = recording.s_m[planted & first] - 3.0
    recording.y_m[planted & second] = recording.y_m[planted & first]
    write_commonroad(evolve(recording), tmp_path / "planted.xml")  # without its computed values
    names = recording.names[0], recording.names[1]
    assert (numbers[names[0]], numbers[names[1]]) in colliding(tmp_path / "planted.xml")


def test_closed_parts_are_no_lanelets(run: Path, tmp_path: Path) -> None:
    recording = Recording.read(run)
    scenario = recording.scenario
    closures = (Closure(0, 600.0, 700.0), Closure(2, 0.0, 100.0))
    road = evolve(scenario.road, closures=closures)
    write_commonroad(evolve(recording, scenario=evolve(scenario, road=road)), tmp_path / "x.xml")
    network = CommonRoadFileReader(str(tmp_path / "x.xml")).open()[0].lanelet_network
    for s_m in (50.0, 150.0, 550.0, 650.0, 750.0):
        positions = [np.array([s_m, (lane + 0.5) * road.lane_width_m]) for lane in range(3)]
        found = network.find_lanelet_by_position(positions)
        closed = {one.lane for one in closures if one.from_m <= s_m < one.to_m}
        assert [len(one) for one in found] == [lane not in closed for lane in range(3)]
    (begin,), (beyond,) = network.find_lanelet_by_position(
        [np.array([s_m, 1.5 * road.lane_width_m]) for s_m in (50.0, 650.0)]
    )
    ahead = network.find_lanelet_by_id(begin)
    assert (ahead.adj_left, ahead.predecessor) == (None, [])
    while ahead.successor:
        (following,) = ahead.successor
        assert network.find_lanelet_by_id(following).predecessor == [ahead.lanelet_id]
        ahead = network.find_lanelet_by_id(following)
    assert ahead.center_vertices[-1, 0] == road.length_m
    beside = network.find_lanelet_by_id(beyond)
    assert beside.adj_right is None
    assert beside.line_marking_right_vertices is LineMarking.SOLID
    assert beside.line_marking_left_vertices is LineMarking.DASHED


def test_roads_of_many_parts_have_numbers_for_all_vehicles(run: Path, tmp_path: Path) -> None:
    recording = Recording.read(run)
    lines = tuple(SolidLine(1, "left", 5.0 * n, 5.0 * n + 2.0) for n in range(1, 180))
    scenario = recording.scenario
    scenario = evolve(scenario, road=evolve(scenario.road, solid_lines=lines))
    write_commonroad(evolve(recording, scenario=scenario), tmp_path / "x.xml")
    found = CommonRoadFileReader(str(tmp_path / "x.xml")).open()[0]
    assert len(found.lanelet_network.lanelets) > FIRST_OBSTACLE
    numbers = sorted(one.obstacle_id for one in found.dynamic_obstacles)
    assert numbers[0] == 2 * FIRST_OBSTACLE
    assert len(numbers) == len(recording.names)


def colliding(path: Path) -> set[tuple[int, int]]:
    """Return the pairs of vehicles that CommonRoad's drivability checker finds in collision."""
    scenario, _ = CommonRoadFileReader(str(path)).open()
    assert len(scenario.lanelet_network.lanelets) == 3
    bodies = {one.obstacle_id: create_collision_object(one) for one in scenario.dynamic_obstacles}
    assert len(bodies) > 8
    found = set()
    for number, body in bodies.items():
        for other, other_body in bodies.items():
            if number < other:
                checker = pycrcc.CollisionChecker()
                checker.add_collision_object(other_body)
                if checker.collide(body):
                    found.add((number, other))
    return found


def test_a_part_of_a_run(run: Path, rows: list[dict[str, Any]], tmp_path: Path) -> None:
    export(run, Format.csv, tmp_path, 10.0, 12.0)
    with (tmp_path / "trajectories.csv").open(encoding="utf-8") as file:
        times_s = [float(one["t_s"]) for one in csv.DictReader(file)]
    assert len(times_s) == sum(10.0 <= row["t_s"] <= 12.0 for row in rows) > 0
    for chosen, name in ((Format.fcd, "x.xml"), (Format.csv, "x")):
        with pytest.raises(BadInputError, match="--from, --to: got '500 to the end'"):
            export(run, chosen, tmp_path / name, 500.0)
        with pytest.raises(BadInputError, match="--from: got '12'; allowed: at most --to = 10"):
            export(run, chosen, tmp_path / name, 12.0, 10.0)
        with pytest.raises(BadInputError, match="--to: got nan"):
            export(run, chosen, tmp_path / name, None, math.nan)
    with pytest.raises(BadInputError, match="at least two ticks"):
        export(run, Format.commonroad, tmp_path / "x.xml", 12.0, 12.0)
    assert not (tmp_path / "x.xml").exists()


@pytest.mark.parametrize(
    ("chosen", "name"),
    [(Format.fcd, "fcd.txt"), (Format.mcap, "run.xml"), (Format.commonroad, "run.xml.gz")],
)
def test_files_have_the_suffix_of_their_format(
    run: Path, tmp_path: Path, chosen: Format, name: str
) -> None:
    with pytest.raises(BadInputError, match="--out"):
        export(run, chosen, tmp_path / name)
    with pytest.raises(BadInputError, match="--out"):
        export(run, chosen, tmp_path)
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="folder"):
        export(tmp_path, Format.csv)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written(run: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for chosen, name in ((Format.csv, "file/x"), (Format.fcd, "file/x.xml")):
        with pytest.raises(CommandFailedError, match="file"):
            export(run, chosen, tmp_path / name)
    for name in ("file", "tables.csv"):
        with pytest.raises(BadInputError, match=r"--out: .* allowed: a folder"):
            export(run, Format.csv, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("chosen", Format)
def test_on_a_full_disk_the_command_fails_in_one_line(
    run: Path, chosen: Format, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A limit on the size of files stands for the disk; nothing is left of what did not fit."""
    out = {"csv": ".", "fcd": "x.xml", "mcap": "x.mcap", "commonroad": "x.xml"}[chosen]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(CommandFailedError) as failed:
            export(run, chosen, tmp_path / out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert "File too large" in str(failed.value) or chosen is Format.commonroad
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("file", "content", "chosen"),
    [
        ("trips.parquet", "cut", Format.fcd),
        ("trips.parquet", "cut", Format.csv),
        ("trajectories.parquet", "cut", Format.mcap),
        ("events.jsonl", '{"t_s": 3.0, "ki\n', Format.mcap),
        ("events.jsonl", "[]", Format.mcap),
    ],
)
def test_damaged_runs_are_refused(
    run: Path, tmp_path: Path, file: str, content: str, chosen: Format
) -> None:
    shutil.copytree(run, tmp_path / "run")
    whole = (run / file).read_bytes()
    cut = whole[:200] + bytes(200) + whole[400:]
    (tmp_path / "run" / file).write_bytes(cut if content == "cut" else content.encode())
    with pytest.raises(BadInputError):
        export(tmp_path / "run", chosen)
    exported = tmp_path / "run" / "export"
    assert not exported.exists() or not list(exported.iterdir())


def test_the_command_prints_its_files(
    run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    here = Here(capsys)
    status, out, errors = here("export", run, "--format", "csv", "--out", tmp_path)
    assert (status, errors) == (0, [])
    names = ("trajectories.csv", "trips.csv", "ticks.csv", "columns.csv")
    assert out.split() == [str(tmp_path / name) for name in names]
    assert "pdf" in here.refused("export", run, "--format", "pdf")
