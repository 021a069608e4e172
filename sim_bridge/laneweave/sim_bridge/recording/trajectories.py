"""Trajectories: one row per vehicle per tick in `trajectories.parquet`, and extreme values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa

from laneweave.protocol.summary import Safety
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet
from laneweave.sim_bridge.recording.trips import Metadata, finite

ROWS_PER_GROUP = 100_000
"""Number of rows that are written together."""
TICKS_PER_GROUP = 3000
"""Maximum number of ticks whose rows are written together."""
EMERGENCY_SHARE = 0.9
"""Fraction of the braking limit beyond which braking counts as emergency braking."""

_COLUMNS: list[pa.Field[Any]] = [
    pa.field("t_s", pa.float64(), nullable=False),
    pa.field("vehicle", pa.string(), nullable=False),
    pa.field("s_m", pa.float32(), nullable=False),
    pa.field("y_m", pa.float32(), nullable=False),
    pa.field("speed_mps", pa.float32(), nullable=False),
    pa.field("accel_mps2", pa.float32(), nullable=False),
    pa.field("column", pa.int32()),
    pa.field("lane", pa.int8(), nullable=False),
]

Sample = tuple[str, float, float, float, float, int | None, int]
"""(vehicle, s [m], y [m], speed [m/s], acceleration [m/s2], column or None off the lattice, lane).

s: front bumper; y: centre of the body from the right road edge; column and lane: cell.
"""


class Trajectories:
    """Writes trajectories and computes their extreme values."""

    def __init__(
        self,
        path: Path,
        metadata: Metadata,
        min_accel_mps2: float,
        min_accel_of: Callable[[str], float] | None = None,
    ) -> None:
        """Open the file.

        Args:
            path: the file.
            metadata: its metadata.
            min_accel_mps2: braking limit of the type that brakes least.
            min_accel_of: returns the braking limit of a vehicle; None: it is that of all.
        """
        self.peak = 0
        """Maximum number of vehicles on the road at a tick."""
        self._file = GrowingParquet(
            path,
            pa.schema(_COLUMNS, metadata),
            use_dictionary=["t_s", "vehicle", "column", "lane"],
            use_byte_stream_split=["s_m", "y_m", "speed_mps", "accel_mps2"],
        )
        self._times: list[float] = []
        self._rows: list[Sample] = []
        """Buffered rows; `_times` contains their times."""
        self._buffered_ticks = 0
        self._brake_mps2 = EMERGENCY_SHARE * min_accel_mps2
        self._min_accel_of = min_accel_of
        self._last_s, self._last_accels = -math.inf, dict[str, float]()
        """Time of the last tick, and accelerations of all vehicles at that tick."""
        self._overlaps: set[tuple[str, str]] = set()
        self._collisions: set[tuple[str, str]] = set()
        self._min_gap_m = self._min_headway_s = math.inf
        self._emergency_brakes = 0
        self._min_accel_mps2, self._max_accel_mps2 = math.inf, -math.inf
        self._max_jerk_mps3 = -math.inf

    def tick(self, t_s: float, rows: list[Sample]) -> None:
        """Record all vehicles on the road; called once per tick."""
        brake_mps2, last_accels, dt_s = self._brake_mps2, self._last_accels, t_s - self._last_s
        accels = {row[0]: row[4] for row in rows}
        for vehicle, accel in accels.items():
            last = last_accels.get(vehicle)
            if last is not None and dt_s > 0.0:
                self._max_jerk_mps3 = max(self._max_jerk_mps3, abs(accel - last) / dt_s)
            if accel < brake_mps2:
                own_mps2 = brake_mps2
                if self._min_accel_of is not None:
                    own_mps2 = EMERGENCY_SHARE * self._min_accel_of(vehicle)
                if accel < own_mps2 and (last is None or last >= own_mps2):
                    self._emergency_brakes += 1
        self._last_s, self._last_accels = t_s, accels
        self._min_accel_mps2 = min(self._min_accel_mps2, *accels.values(), math.inf)
        self._max_accel_mps2 = max(self._max_accel_mps2, *accels.values(), -math.inf)
        self._times += [t_s] * len(rows)
        self._rows += rows
        self.peak = max(self.peak, len(rows))
        self._buffered_ticks += 1
        if len(self._rows) >= ROWS_PER_GROUP or self._buffered_ticks >= TICKS_PER_GROUP:
            self._write_rows()

    def distances(
        self,
        overlaps: Iterable[tuple[str, str]],
        collisions: Iterable[tuple[str, str]],
        gaps: MinGaps,
    ) -> None:
        """Record overlaps, collisions reported by SUMO, and minimum gaps of one tick."""
        self._overlaps.update(overlaps)
        self._collisions.update(collisions)
        self._min_gap_m = min(self._min_gap_m, gaps.gap_m)
        self._min_headway_s = min(self._min_headway_s, gaps.headway_s)

    def safety(self) -> Safety:
        """Return the counts and extreme values so far."""
        return Safety(
            overlaps=len(self._overlaps),
            sumo_collisions=len(self._collisions),
            min_gap_m=finite(self._min_gap_m),
            min_headway_s=finite(self._min_headway_s),
            emergency_brakes=self._emergency_brakes,
            max_accel_mps2=finite(self._max_accel_mps2),
            min_accel_mps2=finite(self._min_accel_mps2),
            max_jerk_mps3=finite(self._max_jerk_mps3),
        )

    def close(self) -> None:
        """Write the buffered rows, and close the file."""
        try:
            self._write_rows()
        finally:
            self._file.close()

    def _write_rows(self) -> None:
        """Write the buffered rows as one row group."""
        self._buffered_ticks = 0
        if not self._rows:
            return
        columns = [self._times, *zip(*self._rows, strict=True)]
        self._times, self._rows = [], []
        arrays = [
            pa.array(column, field.type) for column, field in zip(columns, _COLUMNS, strict=True)
        ]
        self._file.append(pa.RecordBatch.from_arrays(arrays, schema=self._file.schema))
