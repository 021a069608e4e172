"""The table over runs, and its aggregation over seeds."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from attrs import evolve

from laneweave.launch.recordings.results_over_seeds import PREFERRED, over_seeds, results_table
from laneweave.launch.recordings.runs import Run
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import RunSummary
from support.closed_lanes import DROP
from support.summaries import make_summary


def run(seed: int, summary: RunSummary | None, label: str = "rule") -> Run:
    return Run(Path("x"), label, "rule", evolve(Scenario(), seed=seed), summary)


def travel(mean: float | None) -> RunSummary:
    return make_summary(travel_time_s={"mean": mean})


def test_means_and_deviations_over_seeds() -> None:
    runs = [run(1, travel(1.0)), run(2, travel(3.0)), run(3, travel(None)), run(4, None)]
    (row,) = over_seeds(
        results_table(runs), [("travel_time_s_mean", name) for name in ("mean", "stddev")]
    )
    assert row["runs"] == 4
    assert row["travel_time_s_mean_mean"] == 2.0
    assert row["travel_time_s_mean_stddev"] == pytest.approx(2.0**0.5)


def test_a_single_seed_has_no_deviation_and_a_missing_figure_is_null() -> None:
    wanted = [("travel_time_s_mean", "stddev"), ("planning_fallbacks", "sum")]
    (row,) = over_seeds(results_table([run(1, travel(1.0))]), wanted)
    assert row["travel_time_s_mean_stddev"] is row["planning_fallbacks_sum"] is None


def test_labels_keep_their_order() -> None:
    table = results_table([run(1, travel(1.0), "rule"), run(1, travel(2.0), "lc2013")])
    assert [row["label"] for row in over_seeds(table, [])] == ["rule", "lc2013"]


def test_the_share_on_the_preferred_lane() -> None:
    vehicles = ({"left": 0, "on_preferred_lane": 0}, {"left": 4, "on_preferred_lane": 3})
    table = results_table(run(n, make_summary(vehicles=one)) for n, one in enumerate(vehicles))
    assert table[PREFERRED].to_pylist() == [None, 75.0]


def test_vehicles_without_preferences_have_no_such_share() -> None:
    table = results_table([Run(Path("x"), "rolling", "formation", DROP, make_summary())])
    assert table[PREFERRED].to_pylist() == [None]
    assert table["vehicles_on_preferred_lane"].to_pylist() == [100]


def test_counts_are_integers() -> None:
    table = results_table([run(1, make_summary()), run(2, None)])
    assert table.schema.field("vehicles_left").type == pa.int64()
    assert table.schema.field("road_m").type == pa.float64()


def test_columns_say_what_they_contain() -> None:
    times = {"by_entrance": {"main": {"n": 9, "mean": 70.0, "delay": 2.0}}}
    own = make_summary(travel_time_s=times, planning={"by_solver": {"tappa": 3}})
    about = {field.name: field.metadata or {} for field in results_table([run(1, own)]).schema}
    for name, metadata in about.items():
        assert metadata[b"meaning"].decode() != name
    assert about["travel_time_s_by_entrance_main_mean"][b"unit"] == b"s"
    assert about["safety_max_jerk_mps3"][b"unit"] == b"m/s3"
    assert about[PREFERRED][b"unit"] == b"%"
    assert about["planning_by_solver_tappa"][b"meaning"] == b"plans by solver"
