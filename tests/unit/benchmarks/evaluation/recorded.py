"""Constructed runs and points for the tests of the evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attrs import evolve

from evaluation.evidence import Evidence, setting_of
from evaluation.points import PointRow, RunRow, Traced
from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import METHODS
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import RunSummary
from support.summaries import make_summary

BASE = load_scenario(None, demand__duration_s=600.0)


def scenario(volume: float, seed: int, base: Scenario = BASE) -> Scenario:
    """Return the scenario of a point."""
    demand = evolve(base.demand, volume_veh_per_lane_h=volume)
    return evolve(base, demand=demand, seed=seed)


def summary(travel_s: float | None, **changed: Any) -> RunSummary:  # noqa: ANN401 - any JSON
    """Return a summary with a travel time; keys of `changed` replace tables in part."""
    times_s = {"mean": travel_s, "p95": None if travel_s is None else travel_s + 1.0}
    return make_summary(travel_time_s=times_s, **changed)


def run(
    label: str,
    volume: float,
    seed: int,
    found: RunSummary | None,
    reason: str = "",
    folder: str = "x",
) -> Run:
    """Return a run without files."""
    place = Path("nowhere") / folder
    return Run(place, label, METHODS[label].method, scenario(volume, seed), found, reason)


TRACED = Traced(
    runs=1,
    lattice_least_m=14.93,
    lattice_pairs=4000,
    lattice_worst_off_m=0.07,
    lattice_kept=True,
    slow_m=None,
    slowest_mps=12.9,
    slowest_settled_mps=14.6,
)


def point(
    label: str,
    volume: float,
    travel_s: float | None,
    traced: Traced | None = TRACED,
    seeds: Sequence[int] = (1, 2, 3, 4, 5),
) -> PointRow:
    """Return a point without failures, with 800 vehicles in each run."""
    runs = [
        RunRow(
            label,
            volume,
            seed,
            "",
            complete=True,
            demanded=800,
            left=800,
            on_preferred_lane=800,
            travel_s=travel_s,
            travel_p95_s=None if travel_s is None else travel_s + 1.0,
            throughput_veh_per_lane_h=volume,
            hard_brakes=0,
            min_gap_m=9.8,
            min_headway_s=0.86,
            min_accel_mps2=-6.8,
            max_accel_mps2=4.8,
            min_ttc_s=2.9,
            ttc_below_3_s=4.0,
            min_pet_s=0.66,
            uncomfortable_percent=0.31,
            co2_g_per_km=133.8,
            planning_p95_ms=12.0,
            traced=traced,
        )
        for seed in seeds
    ]
    return PointRow(label, volume, tuple(runs))


def changed(row: PointRow, **figures: Any) -> PointRow:  # noqa: ANN401 - any of RunRow
    """Return a point with other figures in its last run."""
    return evolve(row, runs=(*row.runs[:-1], evolve(row.runs[-1], **figures)))


def evidence(*points: PointRow) -> Evidence:
    """Return evidence of some points, in the setting of the evaluation."""
    setting = setting_of([run("rule", 1000.0, 1, None)])
    return Evidence(setting=setting, runs=tuple(one for row in points for one in row.runs))
