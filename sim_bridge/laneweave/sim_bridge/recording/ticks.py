"""Ticks: one row per tick in `ticks.parquet`, with its duration and the number of vehicles."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from laneweave.protocol.summary import DurationMs
from laneweave.sim_bridge.recording.columns import TICKS
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet
from laneweave.sim_bridge.recording.statistics import percentiles_of

ROWS_PER_GROUP = 3000
"""Number of rows that are written together."""


class Ticks:
    """Writer of the durations of ticks."""

    def __init__(self, path: Path, disk: Disk | None = None) -> None:
        """Open the file."""
        self._path = path
        self._file = GrowingParquet(path, TICKS.arrow_schema(), disk)
        self._rows: list[tuple[float, int, float]] = []
        """Buffered rows."""

    def add(self, t_s: float, on_road: int, duration_s: float) -> None:
        """Record a tick: road time, vehicles on the road, and duration."""
        self._rows.append((t_s, on_road, duration_s * 1e3))
        if len(self._rows) >= ROWS_PER_GROUP:
            self._write_rows()

    def save(self) -> None:
        """Write the buffered rows as a provisional row group."""
        self._write_rows(provisional=True)

    def close(self) -> None:
        """Write the buffered rows, and close the file."""
        with closing(self._file):
            self._write_rows()

    def durations(self) -> DurationMs:
        """Return statistics of all ticks, read from the file."""
        tick_ms = pq.read_table(self._path, columns=["tick_ms"])["tick_ms"].to_numpy()
        return DurationMs(**percentiles_of(tick_ms.astype(np.float64), 50, 99))

    def _write_rows(self, *, provisional: bool = False) -> None:
        if not self._rows:
            return
        columns = zip(*self._rows, strict=True)
        arrays = [
            pa.array(values, column.type)
            for values, column in zip(columns, TICKS.columns, strict=True)
        ]
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._file.schema)
        self._file.append(batch, provisional=provisional)
        if not provisional:
            self._rows = []
