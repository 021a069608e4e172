"""results.parquet: one row per run, one column per number of its summary.

A number's column has the name of the way to it: `travel_time_s.mean` is in `travel_time_s_mean`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from attrs import frozen

from laneweave.protocol.files import write_atomically

SCHEMA_KEY, SCHEMA = b"laneweave.schema", b"laneweave.sweep.results/1"

_FIRST: dict[str, pa.DataType] = {
    "label": pa.string(),
    "method": pa.string(),
    "volume_veh_per_lane_h": pa.float64(),
    "seed": pa.int64(),
    "status": pa.string(),
    "reason": pa.string(),
    "wall_s": pa.float64(),
}


@frozen
class Row:
    """A point that was run."""

    label: str
    method: str
    volume_veh_per_lane_h: float
    seed: int
    status: str
    """`done` or `failed`."""
    reason: str
    """Why it failed; empty: it did not."""
    wall_s: float
    summary: Mapping[str, Any]
    """As in summary.json; empty: there is none."""


def results_table(rows: Iterable[Row]) -> pa.Table:
    """Return the table of some runs, in their order.

    Columns of counts are integers, the others floats; what a run's summary lacks is null.
    """
    listed = list(rows)
    flat = [flat_numbers(row.summary) for row in listed]
    arrays = {
        name: pa.array([getattr(row, name) for row in listed], kind)
        for name, kind in _FIRST.items()
    }
    names = dict.fromkeys(name for one in flat for name in one)
    for name in names:
        if name in arrays:
            continue
        values = [one.get(name) for one in flat]
        counts = all(isinstance(value, int) for value in values if value is not None)
        known = any(value is not None for value in values)
        arrays[name] = pa.array(values, pa.int64() if counts and known else pa.float64())
    return pa.table(arrays).replace_schema_metadata({SCHEMA_KEY: SCHEMA})


def write_results(rows: Iterable[Row], path: Path) -> None:
    """Write the table whole or not at all."""
    write_atomically(
        path, lambda part: pq.write_table(results_table(rows), part, compression="zstd")
    )


def flat_numbers(tables: Mapping[str, Any], parent: str = "") -> dict[str, float | int | None]:
    """Return all numbers in nested tables by their way, joined with `_`; null stays null."""
    flat: dict[str, float | int | None] = {}
    for key, value in tables.items():
        name = f"{parent}{key}"
        if isinstance(value, Mapping):
            flat |= flat_numbers(value, f"{name}_")
        elif value is None or (isinstance(value, (int, float)) and not isinstance(value, bool)):
            flat[name] = value
    return flat
