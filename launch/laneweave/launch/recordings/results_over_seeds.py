"""A table with a row per run and a column per number in the summaries, and its aggregation.

Columns are named after the path in the summary: `travel_time_s_mean` contains `travel_time_s.mean`.
A sweep writes the table as `results.parquet`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from laneweave.launch.recordings.runs import Run, flatten
from laneweave.protocol.files import write_atomically
from laneweave.protocol.summary import described
from laneweave.sim_bridge.recording.columns import SCHEMA_KEY, Column, Table

RESULTS = Table(
    "laneweave.sweep.results/1",
    (
        Column("label", pa.string(), "label of the sweep: a method with its settings"),
        Column("method", pa.string(), "value of laneweave run --method"),
        Column("volume_veh_per_lane_h", pa.float64(), "demand per lane", "veh/(lane h)"),
        Column("seed", pa.int64(), "seed of the scenario"),
        Column("status", pa.string(), "done or failed"),
        Column("reason", pa.string(), "why the run failed; empty: it is done"),
        Column("wall_s", pa.float64(), "run time of the run's process", "s", nullable=True),
    ),
)
"""One row per run; columns with the numbers of the summaries follow."""
KEYS = ["label", "volume_veh_per_lane_h"]
"""Columns whose values are the same for runs that differ only in their seeds."""
PREFERRED = "preferred_percent"
"""Column with the share of vehicles that left in their preferred lanes [%], or null."""


def results_table(runs: Iterable[Run]) -> pa.Table:
    """Return a table of the runs, in the given order.

    Counts are integers, other numbers floats; missing numbers are null.
    """
    listed = list(runs)
    arrays: dict[str, pa.Array[Any]] = {
        "label": pa.array([run.label for run in listed], pa.string()),
        "method": pa.array([run.method for run in listed], pa.string()),
        KEYS[1]: pa.array([run.volume_veh_per_lane_h for run in listed], pa.float64()),
        "seed": pa.array([run.scenario.seed for run in listed], pa.int64()),
        "status": pa.array([run.status for run in listed], pa.string()),
        "reason": pa.array([run.reason for run in listed], pa.string()),
        "wall_s": pa.array([run.wall_s for run in listed], pa.float64()),
    }
    fields = [column.field for column in RESULTS.columns]
    flat = [_figures(run) for run in listed]
    for name in dict.fromkeys(name for one in flat for name in one if name not in arrays):
        values = [one.get(name) for one in flat]
        counts = all(isinstance(value, int) for value in values if value is not None)
        known = any(value is not None for value in values)
        arrays[name] = pa.array(values, pa.int64() if counts and known else pa.float64())
        unit, meaning = _described(name)
        fields.append(Column(name, arrays[name].type, meaning, unit, nullable=True).field)
    return pa.table(arrays, schema=pa.schema(fields, {SCHEMA_KEY: RESULTS.schema}))


def write_results(runs: Iterable[Run], path: Path) -> None:
    """Write a table of the runs atomically."""
    table = results_table(runs)
    write_atomically(path, lambda part: pq.write_table(table, part, compression="zstd"))


def over_seeds(table: pa.Table, wanted: Iterable[tuple[str, str]]) -> list[dict[str, Any]]:
    """Aggregate results over seeds: one row per label and volume, in order of appearance.

    Args:
        table: result of `results_table`.
        wanted: (column, pyarrow function) pairs; `stddev` is the sample standard deviation.

    Returns:
        Rows with `KEYS`, `runs` (number of runs), and `COLUMN_FUNCTION` for each pair: None if no
        run has a value.
    """
    pairs = list(wanted)
    for column in dict.fromkeys(column for column, _ in pairs):
        if column not in table.column_names:
            table = table.append_column(column, pa.nulls(table.num_rows, pa.float64()))
    sample = pc.VarianceOptions(ddof=1)
    aggregations: list[Any] = [
        (column, function, sample if function == "stddev" else None) for column, function in pairs
    ]
    grouped = table.group_by(KEYS, use_threads=False)
    rows = grouped.aggregate([("seed", "count"), *aggregations]).to_pylist()
    return [{"runs": row.pop("seed_count"), **row} for row in rows]


def _described(name: str) -> tuple[str, str]:
    """Return unit and meaning of a column with a number of the summaries."""
    if name == PREFERRED:
        return "%", "share of the departed vehicles that left in their preferred lane"
    for path, unit, meaning in described():
        # The rest of a column's name is a name from the scenario, or a key of a table.
        pattern = re.escape(path.replace(".", "_")).replace(r"\*", ".+") + "(_.+)?"
        if re.fullmatch(pattern, name):
            return unit, meaning
    return "", name


def _figures(run: Run) -> dict[str, float | int | None]:
    """Return all numbers in the summary of a run by path; unknown numbers are None."""
    if run.summary is None:
        return {}
    return {
        name: value
        for name, value in flatten(run.summary.to_json(), "_").items()
        if value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))
    } | {PREFERRED: run.preferred_percent}
