"""Lane sorting with restrictions and solid lines: real roles and SUMO on the simulated network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from laneweave.launch.recordings.trajectories import read_trajectories, read_trips
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario

COLUMNS = ["vehicle", "s_m", "y_m", "lane", "reserved_lane"]
TRUCK = {"name": "truck", "share": 0.25, "length_m": 12.0, "width_m": 2.5, "max_accel_mps2": 1.3}
LEFT = 2
Row = tuple[str, float, float, int, int]


def scenario(**rules: list[dict[str, Any]]) -> Scenario:
    """Return a road with trucks on which vehicles sort from 100 m on."""
    road = {"s1_m": 50.0, "s2_m": 50.0, "s3_m": 800.0}
    return parse_scenario(
        {
            "road": road | rules,
            "demand": {"volume_veh_per_lane_h": 1000.0, "duration_s": 40.0},
            "formation": {"operation": "rolling", "gap_m": 20.0, "sort_in_s2": True},
            "vehicle_type": [TRUCK | {"min_accel_mps2": -7.0}],
        }
    )


def drive(own: Scenario, folder: Path) -> tuple[list[Row], set[str]]:
    """Return the rows of the recorded trajectories, and the trucks; all is well with the run."""
    outcome = SimulatedRun(own, folder, show_progress=False).run()
    assert not outcome.problems
    summary = json.loads((folder / "summary.json").read_text())
    vehicles, safety = summary["vehicles"], summary["safety"]
    assert vehicles["left"] == vehicles["at_destination"] == vehicles["demanded"] > 20
    assert safety["overlaps"] == safety["emergency_brakes"] == 0
    columns = read_trajectories(folder, COLUMNS).to_pydict()
    trucks = {name for name, trip in read_trips(folder).items() if trip["vehicle_type"] == "truck"}
    return [*zip(*(columns[name] for name in COLUMNS), strict=True)], trucks


def by_vehicle(rows: list[Row]) -> Iterator[tuple[str, list[Row]]]:
    for name in sorted({row[0] for row in rows}):
        yield name, [row for row in rows if row[0] == name]


@pytest.mark.more
def test_no_truck_is_ever_in_the_lane_that_is_closed_to_trucks(tmp_path: Path) -> None:
    own = scenario(restrictions=[{"lane": LEFT, "vehicle_types": ["truck"]}])
    rows, trucks = drive(own, tmp_path)
    begins_m = LEFT * own.road.lane_width_m
    assert max(y_m for name, _, y_m, _, _ in rows if name in trucks) < begins_m
    assert len(trucks) > 5
    # Trucks and cars change lanes.
    changing = {
        name for name, own_rows in by_vehicle(rows) if len({row[3] for row in own_rows}) > 1
    }
    assert changing & trucks
    assert changing - trucks


@pytest.mark.more
def test_rules_for_parts_of_the_road_are_kept_there(tmp_path: Path) -> None:
    line_m, ban_m = (300.0, 500.0), (450.0, 600.0)
    own = scenario(
        restrictions=[
            {"lane": LEFT, "vehicle_types": ["truck"], "from_m": ban_m[0], "to_m": ban_m[1]}
        ],
        solid_lines=[{"lane": 0, "to": "left", "from_m": line_m[0], "to_m": line_m[1]}],
    )
    rows, trucks = drive(own, tmp_path)
    entered_left = {name for name, _, _, lane, _ in rows if name in trucks and lane == LEFT}
    assert entered_left  # before it or after it
    for name, s_m, _, lane, _ in rows:
        if name in trucks and ban_m[0] < s_m < ban_m[1]:
            assert lane != LEFT, f"{name} at {s_m} m"
    crossings_m = []
    for name, own_rows in by_vehicle(rows):
        length_m = 12.0 if name in trucks else own.vehicle.length_m
        for before, after in pairwise(own_rows):
            if (before[3], after[3]) == (0, 1):
                crossings_m.append(after[1])
            # In the course of a move: the reserved cell is that of the other lane already.
            if (after[3], after[4]) == (0, 1):
                assert not after[1] - length_m < line_m[1] or not after[1] > line_m[0], after
    assert min(crossings_m) < line_m[0] - 10.0
    assert max(crossings_m) > line_m[1]
