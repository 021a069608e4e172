"""The tables of a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import pyarrow as pa
from attrs import frozen

from laneweave.launch.recordings.results_over_seeds import (
    KEYS,
    PREFERRED,
    over_seeds,
    results_table,
)
from laneweave.launch.recordings.runs import Comparison, Run
from laneweave.launch.report.summary_table import Row, summary_rows

_Column = tuple[str, str, str, int]
"""Heading, column of the results, aggregation over seeds (empty: text), number of decimals."""

_TRAFFIC: Final[tuple[_Column, ...]] = (
    ("runs", "runs", "", 0),
    ("in the preferred lane (%)", PREFERRED, "mean", 2),
    ("travel time mean (s)", "travel_time_s_mean", "mean", 2),
    ("counted", "travel_time_s_n", "sum", 0),
    ("95th percentile (s)", "travel_time_s_p95", "mean", 2),
    ("throughput (veh/(lane·h))", "throughput_veh_per_lane_h", "mean", 0),
)
_SAFETY: Final[tuple[_Column, ...]] = (
    ("smallest gap (m)", "safety_min_gap_m", "min", 2),
    ("hardest braking (m/s²)", "safety_min_accel_mps2", "min", 2),
    ("emergency brakes", "safety_emergency_brakes", "sum", 0),
    ("overlaps", "safety_overlaps", "sum", 0),
    ("real-time factor", "runtime_real_time_factor", "min", 1),
)
_PLANNING: Final[tuple[_Column, ...]] = (
    ("most vehicles in a plan", "planning_largest_formation", "max", 0),
    ("plans", "planning_plans", "sum", 0),
    ("fallbacks", "planning_fallbacks", "sum", 0),
    ("median (ms)", "planning_solve_ms_p50", "max", 1),
    ("95th percentile (ms)", "planning_solve_ms_p95", "max", 1),
    ("maximum (ms)", "planning_solve_ms_max", "max", 1),
)
_BY_SOLVER: Final = "planning_by_solver_"
_TECHNICAL: Final = (
    "leader changes",
    "messages",
    "partitions",
    "planning time",
    "plans by",
    "processes",
    "real-time factor",
    "tick",
    "time without leader",
    "tracking",
)
"""Beginnings of the names of the rows in `technical_table`."""


@frozen
class Table:
    """A table on a page; shown only if it has rows."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    """Texts of the cells; the first cell of a row is its heading."""
    caption: str
    text_columns: int = 1
    """Number of leading columns with text; the others are numbers."""
    folded: bool = False
    """Whether the page shows only the caption until it is clicked."""


def tables_of(comparison: Comparison) -> list[Table]:
    """Return the tables of a report on a single run, or on several runs side by side."""
    if len(comparison.runs) == 1 and not comparison.failed:
        return [run_table(comparison.runs[0]), technical_table(comparison.runs[0])]
    results, traffic = results_table(comparison.runs), _TRAFFIC
    if not any(run.scenario.flow.lane_shares for run in comparison.runs):
        traffic = tuple(column for column in _TRAFFIC if column[1] != PREFERRED)
    by_solver = tuple(_solver_columns(results))
    columns = (*_TRAFFIC, *_SAFETY, *_PLANNING, *by_solver)
    wanted = [(column, function) for _, column, function, _ in columns if function]
    wanted += [(column, "stddev") for column, function in wanted if function == "mean"]
    rows = over_seeds(results, wanted)
    planned = [row for row in rows if row["planning_plans_sum"]]
    return [
        _table(
            rows,
            traffic,
            "Means over the seeds ± standard deviation; counted: vehicles of the travel times.",
        ),
        _table(
            rows,
            _SAFETY,
            "Extremes or sums over the seeds. Emergency brakes: how often vehicles braked with "
            "more than 90 % of their limit; real-time factor above 1: faster than real time.",
        ),
        _table(
            planned,
            (*by_solver, *_PLANNING),
            "Planning: sums over the seeds; numbers of vehicles and planning times of one plan are "
            "maxima. Fallbacks: plans by another planner than the chosen one.",
        ),
        failed_table(comparison),
    ]


def run_table(run: Run) -> Table:
    """Return the table of one run, without the rows of `technical_table`."""
    rows = [row for row in _rows(run) if not row[0].startswith(_TECHNICAL)]
    caption = "Results of the run; all values are in summary.json."
    return Table(("", "value"), [("method", run.label), *rows], caption, 2)


def technical_table(run: Run) -> Table:
    """Return the folded table of how one run was computed."""
    rows = [row for row in _rows(run) if row[0].startswith(_TECHNICAL)]
    return Table(("", "value"), rows, "Planning, tracking and run time", 2, folded=True)


def _rows(run: Run) -> list[Row]:
    return summary_rows(run.summary, run.scenario) if run.summary else []


def failed_table(comparison: Comparison) -> Table:
    """Return the table of the failed runs."""
    rows = [
        (run.label, f"{run.volume_veh_per_lane_h:g}", str(run.scenario.seed), run.reason)
        for run in comparison.failed
    ]
    caption = "Failed runs, which are excluded from all figures and means."
    return Table(("label", "veh/(lane·h)", "seed", "reason"), rows, caption, 4)


def _table(rows: Sequence[Mapping[str, Any]], columns: Sequence[_Column], caption: str) -> Table:
    """Return a table with one row per label and volume."""
    cells = [
        [row[KEYS[0]], f"{row[KEYS[1]]:g}", *(_cell(row, column) for column in columns)]
        for row in rows
    ]
    return Table(("label", "veh/(lane·h)", *(name for name, *_ in columns)), cells, caption)


def _cell(row: Mapping[str, Any], wanted: _Column) -> str:
    """Return the text of a cell; a mean is followed by its standard deviation, if known."""
    _, column, function, digits = wanted
    if not function:
        return str(row[column])
    value = row[f"{column}_{function}"]
    deviation = row[f"{column}_stddev"] if function == "mean" else None
    if value is None:
        return "-"
    text = f"{value:.{digits}f}"
    return text if deviation is None else f"{text} ± {deviation:.{digits}f}"


def _solver_columns(results: pa.Table) -> Iterator[_Column]:
    """Yield a column for each solver that made a plan."""
    for name in sorted(results.column_names):
        if name.startswith(_BY_SOLVER) and any(results[name].to_pylist()):
            yield f"plans by {name.removeprefix(_BY_SOLVER)}", name, "sum", 0
