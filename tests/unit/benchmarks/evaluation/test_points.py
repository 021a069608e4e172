"""Rows of points, agreement of two runs, and the planned points."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import pytest
from attrs import evolve

from evaluation.points import PlanningTimes, PointRow, points_of_runs, run_rows
from evaluation.programme import (
    FORMATIONS,
    GOALS,
    LABELS,
    PARTS,
    VOLUMES,
    paper_bound,
    planned,
    points_of,
)
from evaluation.trials import TRIALS, agreement, agreement_rows, is_finished
from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import METHODS
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from unit.benchmarks.evaluation.recorded import BASE, point, run, summary

ROOT = Path(__file__).resolve().parents[4]


def rows_of(runs: Iterable[Run]) -> tuple[PointRow, ...]:
    return points_of_runs(run_rows(runs))


def test_planning_times_over_the_seeds() -> None:
    runs = [
        evolve(one, planning=(PlanningTimes("tappa", plans, *times_ms),))
        for one, plans, times_ms in zip(
            point("formations", 1000.0, 67.0, seeds=(1, 2, 3)).runs,
            (10, 20, 30),
            ((1.0, 9.0, 10.0), (2.0, 5.0, 30.0), (6.0, 7.0, 8.0)),
            strict=True,
        )
    ]
    (row,) = points_of_runs(runs)
    assert row.planning == (PlanningTimes("tappa", 60, 2.0, 9.0, 30.0),)


def test_means_extremes_and_sums_over_seeds() -> None:
    safety = {"overlaps": 2, "min_gap_m": 4.0, "min_accel_mps2": -10.5}
    (row,) = rows_of(
        [
            run("rule", 1600.0, 2, summary(72.0, safety=safety), "2 pairs of vehicles overlapped"),
            run("rule", 1600.0, 1, summary(70.0, vehicles={"on_preferred_lane": 99})),
        ]
    )
    assert row.seeds == (1, 2)
    failed = [(one.seed, one.reason) for one in row.runs if one.reason]
    assert failed == [(2, "2 pairs of vehicles overlapped")]
    assert (row.overlaps, row.unfinished) == (2, 0)
    assert (row.mean("travel_s"), row.mean("travel_p95_s")) == (71.0, 72.0)
    assert (row.total("left"), row.total("on_preferred_lane")) == (200, 199)
    assert row.on_lane_percent == 99.5
    assert row.total("overlaps") == 2
    assert (row.lowest("min_gap_m"), row.lowest("min_accel_mps2")) == (4.0, -10.5)
    assert row.highest("max_accel_mps2") == 4.8
    assert not row.within_limits
    assert row.traced is None


def test_of_runs_that_were_cut_off_only_overlaps_count() -> None:
    cut = summary(500.0, ending="limit", safety={"overlaps": 1})
    (row,) = rows_of(
        [
            run("rule", 1600.0, 1, summary(70.0)),
            run("rule", 1600.0, 2, cut, "the run is not complete: limit"),
            run("rule", 1600.0, 3, None, "its process was ended by SIGKILL"),
        ]
    )
    assert row.seeds == (1,)
    assert [one.seed for one in row.runs if not one.complete] == [2, 3]
    assert (row.unfinished, row.jammed) == (2, 1)
    assert (row.values("travel_s"), row.total("demanded"), row.overlaps) == ([70.0], 100, 1)


def test_rows_are_in_the_order_of_labels_and_volumes() -> None:
    runs = [run(label, volume, 1, summary(70.0)) for volume in (1600.0, 1000.0) for label in LABELS]
    rows = [(row.label, row.volume_veh_per_lane_h) for row in rows_of(runs)]
    assert rows == [
        (label, volume) for label in METHODS if label in LABELS for volume in (1000, 1600)
    ]


def test_runs_that_cannot_be_compared() -> None:
    one = run("rule", 1600.0, 1, summary(70.0))
    with pytest.raises(BadInputError, match="only once"):
        rows_of([one, evolve(one, folder=Path("other"))])
    shorter = evolve(one.scenario.demand, duration_s=300.0)
    with pytest.raises(BadInputError, match="duration_s = 600"):
        rows_of([one, evolve(one, scenario=evolve(one.scenario, demand=shorter, seed=2))])
    longer = evolve(BASE.road, s2_m=900.0)
    with pytest.raises(BadInputError, match="as in the other runs"):
        rows_of([one, evolve(one, scenario=evolve(one.scenario, road=longer, seed=2))])


def trip(vehicle: str, lane: int | None, travel_s: float | None) -> dict[str, object]:
    return {"vehicle": vehicle, "final_lane": lane, "travel_time_s": travel_s}


def test_agreement_of_runs() -> None:
    one = [trip("a", 0, 66.0), trip("b", 2, 67.0)]
    found = agreement(one, [trip("b", 2, 67.1), trip("a", 0, 66.0)], 0.1)
    assert found.holds
    assert (found.vehicles, found.worst_s) == (2, 0.1)
    for changed, what in (
        ([trip("b", 1, 67.0)], "other_lane"),
        ([trip("b", 2, 67.2)], "over_a_tick"),
        ([trip("b", None, None)], "missing"),
        ([], "missing"),
        ([one[1], trip("c", None, None)], "missing"),
    ):
        found = agreement(one, [one[0], *changed], 0.1)
        assert not found.holds
        assert getattr(found, what) == 1
    assert not agreement([], [], 0.1).holds


def test_the_programme_is_what_the_tables_show() -> None:
    assert {label for part in PARTS for label in part.labels} == set(LABELS) <= set(METHODS)
    assert set(FORMATIONS) <= set(LABELS)
    points = points_of(BASE, 1)
    assert {(point.label, point.volume_veh_per_lane_h) for point in points} == {
        (label, volume) for label in LABELS for volume in VOLUMES if planned(label, volume)
    }
    assert all(planned(goal.label, goal.volume_veh_per_lane_h) for goal in GOALS)
    for label in LABELS:
        assert all(planned(label, volume) for volume in (500.0, 750.0, 1000.0, 1600.0))
    greatest = {
        label: max(volume for volume in VOLUMES if planned(label, volume)) for label in FORMATIONS
    }
    bound = paper_bound(BASE.formation.speed_mps, BASE.formation.gap_m)
    assert greatest == {"formations": 2000, "paper-6": bound, "paper-12": 2000, "rolling": 2400}
    assert bound < 2000


def test_planning_times_are_those_of_each_solver(tmp_path: Path) -> None:
    made = [("tappa", 1.0), ("tappa", 2.0), ("tappa", 9.0), ("branching", 5.0), (None, 7.0)]
    events = [
        {"t_s": 1.0, "kind": "plan-made", "role": "coordinator", "solve_ms": solve_ms}
        | ({} if solver is None else {"solver": solver})
        for solver, solve_ms in made
    ]
    events += [
        {"t_s": 1.0, "kind": "stream-planned", "role": "coordinator", "solve_ms": 3.5},
        {"t_s": 1.0, "kind": "plan-made", "role": "agent", "solve_ms": 1e9},
        {"t_s": 1.0, "kind": "plan-made", "role": "coordinator", "solve_ms": "soon"},
        {"t_s": 1.0, "kind": "left", "vehicle": "v0001"},
    ]
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(one) + "\n" for one in events))
    found = summary(70.0, planning={"plans": 6, "fallbacks": 2})
    one = evolve(run("formations", 1000.0, 1, found), folder=tmp_path)
    (row,) = rows_of([one, run("formations", 1000.0, 2, summary(70.0, planning={"plans": 4}))])
    assert (row.total("plans"), row.total("fallbacks")) == (10, 2)
    assert row.planning == (
        PlanningTimes("branching", 2, 6.0, 6.9, 7.0),
        PlanningTimes("rolling", 1, 3.5, 3.5, 3.5),
        PlanningTimes("tappa", 3, 2.0, 8.3, 9.0),
    )


def test_trajectories_of_formation_control_are_kept() -> None:
    kept = {(point.label, point.keep_trajectories) for point in points_of(BASE, 3)}
    assert kept == {(label, label in FORMATIONS) for label in LABELS}
    assert all(point.keep_trajectories for point in points_of(BASE, 1))


def test_trials() -> None:
    assert len({(trial.part, trial.name) for trial in TRIALS}) == len(TRIALS)
    road = load_scenario(ROOT / "benchmarks" / "long-road.toml").road
    assert road.length_m == 10_000.0


def test_only_complete_trials_with_the_same_options_count(tmp_path: Path) -> None:
    trial = TRIALS[0]
    folder = tmp_path / trial.part / trial.name
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text("{}")
    assert not is_finished(trial, tmp_path)
    (folder / "command.json").write_text('["--operation", "rolling"]')
    assert not is_finished(trial, tmp_path)
    assert agreement_rows(tmp_path) == []
