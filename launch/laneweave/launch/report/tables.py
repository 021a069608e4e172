"""The tables of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from attrs import frozen

from laneweave.launch.recordings.results import KEYS, PREFERRED, over_seeds, results_table
from laneweave.launch.recordings.runs import Comparison, Run
from laneweave.launch.report.summary_table import summary_rows

_Column = tuple[str, str, str, int]
"""Heading, column of the results, its aggregation over seeds, digits."""

_TRAFFIC: Final = (
    ("travel time mean (s)", "travel_time_s_mean", 2),
    ("p95 (s)", "travel_time_s_p95", 2),
    ("throughput (veh/(lane·h))", "throughput_veh_per_lane_h", 0),
    ("on the preferred lane (%)", PREFERRED, 2),
)
_SAFETY: Final[tuple[_Column, ...]] = (
    ("smallest gap (m)", "safety_min_gap_m", "min", 2),
    ("hardest braking (m/s²)", "safety_min_accel_mps2", "min", 2),
    ("emergency brakes", "safety_emergency_brakes", "sum", 0),
    ("overlaps", "safety_overlaps", "sum", 0),
    ("real-time factor", "runtime_real_time_factor", "min", 1),
)
_PLANNING: Final[tuple[_Column, ...]] = (
    ("largest formation", "planning_largest_formation", "max", 0),
    ("plans", "planning_plans", "sum", 0),
    ("fallbacks", "planning_fallbacks", "sum", 0),
    ("p50 (ms)", "planning_solve_ms_p50", "max", 1),
    ("p95 (ms)", "planning_solve_ms_p95", "max", 1),
    ("max (ms)", "planning_solve_ms_max", "max", 1),
)
_BY_SOLVER: Final = "planning_by_solver_"


@frozen
class Table:
    """A table of a page; without rows it is not shown."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    """Cells as text; the first one is the heading of its row."""
    caption: str
    text_columns: int = 1
    """The first columns are text, the others numbers."""


def tables_of(comparison: Comparison) -> list[Table]:
    """Return the tables of a report: of its only run, or of runs side by side."""
    if len(comparison.runs) == 1 and not comparison.failed:
        return [run_table(comparison.runs[0])]
    results = results_table(comparison.runs)
    extremes = [(column, function) for _, column, function, _ in (*_SAFETY, *_PLANNING)]
    solvers = [name for name in results.column_names if name.startswith(_BY_SOLVER)]
    extremes += [(name, "sum") for name in solvers]
    extremes += [(column, function) for _, column, _ in _TRAFFIC for function in ("mean", "stddev")]
    rows = over_seeds(results, extremes)
    return [traffic_table(rows), safety_table(rows), planning_table(rows), failed_table(comparison)]


def run_table(run: Run) -> Table:
    """Return the figures of one run."""
    rows = summary_rows(run.summary) if run.summary else []
    caption = "Results of the run; summary.json has all figures."
    return Table(("", "value"), [("method", run.label), *rows], caption, 2)


def traffic_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return travel times, throughput and shares: means over seeds with standard deviations."""
    cells = [
        [*_key(row), str(row["runs"]), *(_mean(row, column, n) for _, column, n in _TRAFFIC)]
        for row in rows
    ]
    headings = ("label", "veh/(lane·h)", "runs", *(name for name, *_ in _TRAFFIC))
    return Table(headings, cells, "Means over the seeds, ± their standard deviation.")


def safety_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the extremes over all seeds."""
    cells = [[*_key(row), *_cells(row, _SAFETY)] for row in rows]
    headings = ("label", "veh/(lane·h)", *(name for name, *_ in _SAFETY))
    return Table(headings, cells, "Extremes or sums over the seeds, not means.")


def planning_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return planning times and solvers of the rows that have plans."""
    cells = []
    for row in rows:
        if row["planning_plans_sum"]:
            solvers = {
                name.removeprefix(_BY_SOLVER).removesuffix("_sum"): plans
                for name, plans in row.items()
                if name.startswith(_BY_SOLVER) and plans
            }
            named = ", ".join(f"{name} {plans}" for name, plans in sorted(solvers.items()))
            cells.append([*_key(row), named or "-", *_cells(row, _PLANNING)])
    headings = ("label", "veh/(lane·h)", "solvers", *(name for name, *_ in _PLANNING))
    return Table(headings, cells, "Planning: sums over the seeds; sizes and times are maxima.")


def failed_table(comparison: Comparison) -> Table:
    """Return the runs that failed."""
    rows = [
        (run.label, f"{run.volume_veh_per_lane_h:g}", str(run.scenario.seed), run.reason)
        for run in comparison.failed
    ]
    caption = "Runs that failed; no figure and no mean contains them."
    return Table(("label", "veh/(lane·h)", "seed", "reason"), rows, caption, 4)


def _key(row: Mapping[str, Any]) -> list[str]:
    return [row[KEYS[0]], f"{row[KEYS[1]]:g}"]


def _cells(row: Mapping[str, Any], columns: Sequence[_Column]) -> list[str]:
    values = ((row[f"{column}_{function}"], digits) for _, column, function, digits in columns)
    return ["-" if value is None else f"{value:.{digits}f}" for value, digits in values]


def _mean(row: Mapping[str, Any], column: str, digits: int) -> str:
    """Return `mean ± standard deviation` of the seeds that have the figure."""
    mean, deviation = row[f"{column}_mean"], row[f"{column}_stddev"]
    if mean is None:
        return "-"
    text = f"{mean:.{digits}f}"
    return text if deviation is None else f"{text} ± {deviation:.{digits}f}"
