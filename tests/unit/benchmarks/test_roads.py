"""The results of roads that docs/EVALUATION_ROADS.md shows support its sentences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import roads
from experiments import jobs_of
from support.tables import for_each

EVIDENCE = Path(__file__).parents[3] / "docs" / "evidence" / roads.RECORD
ROWS: dict[str, dict[str, Any]] = json.loads(EVIDENCE.read_text(encoding="utf-8"))
RUNS = {
    job.key: (job.point, ROWS[job.key])
    for job in jobs_of(roads.POINTS)
    if job.key in ROWS and job.point.label not in roads.REFERENCES
}


def test_points_have_names_of_their_own_and_rows_belong_to_points() -> None:
    names = [point.name for point in roads.POINTS]
    assert len(set(names)) == len(names)
    assert all(key == f"{row['point']} seed {row['seed']}" for key, row in ROWS.items())


def test_every_point_has_been_measured() -> None:
    assert {point.name for point in roads.POINTS} == {row["point"] for row in ROWS.values()}


def test_every_point_has_a_scenario() -> None:
    for point in roads.POINTS:
        assert point.settings(1).demand.volume_veh_per_lane_h == point.volume


@for_each("key", RUNS)
def test_no_run_has_overlaps_and_every_vehicle_leaves(key: str) -> None:
    point, row = RUNS[key]
    assert (row["ending"], row["overlaps"], row["beyond_limits"]) == ("complete", 0, 0)
    assert row["left"] == row["demanded"] > 0
    if point.faults is None:
        assert row["keeps_pitch"]
        assert row["problems"] == []


@for_each("point", [one for one in roads.POINTS if not one.faults])
def test_vehicles_reach_their_destinations(point: roads.Point) -> None:
    rows = [row for one, row in RUNS.values() if one == point]
    demanded = sum(row["demanded"] for row in rows)
    assert sum(row["at_destination"] for row in rows) >= point.reached_goal * demanded


@for_each("key", RUNS)
def test_travel_times_reach_their_goals(key: str) -> None:
    point, row = RUNS[key]
    if point.goal is not None:
        assert row["ratio"] <= point.goal
    if point.ramp_goal_s is not None:
        assert row["delay_by_entrance_s"]["on-ramp"] <= point.ramp_goal_s
