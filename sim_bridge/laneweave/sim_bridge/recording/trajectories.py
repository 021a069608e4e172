"""Trajectories: one row per vehicle and tick in `trajectories.parquet`, and extreme values."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from laneweave.protocol.lattice import Lattice
from laneweave.protocol.summary import TTC_CRITICAL_S, TTC_SHORT_S, Comfort, Safety
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.columns import TRAJECTORIES, Metadata
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.driving_measures import DrivingMeasures, Rows
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet
from laneweave.sim_bridge.recording.statistics import finite

ROWS_PER_GROUP = 100_000
"""Number of rows that are written together."""
TICKS_PER_GROUP = 3000
"""Maximum number of ticks whose rows are written together."""

Sample = tuple[str, float, float, float, float, float, int | None, int | None, int]
"""(vehicle, s [m], y [m], speed [m/s], lateral speed [m/s], acceleration [m/s2], reserved column,
reserved lane, preferred lane).

s: front bumper; y: centre of the body from the right road edge; reserved cell: None without a
lattice.
"""
_SAMPLED = [name for name in TRAJECTORIES.names if name not in ("t_s", "column", "lane")]
"""Columns of the values of a sample."""


def body_cells(
    t_s: NDArray[np.float64],
    s_m: NDArray[np.float64],
    y_m: NDArray[np.float64],
    lattice: Lattice,
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Return the columns and lanes in which bodies are; all arrays have shape (rows,).

    Args:
        t_s: road times [s].
        s_m: positions of the front bumpers [m].
        y_m: centres of the bodies, from the right road edge [m].
        lattice: the lattice.
    """
    columns = np.rint((s_m - lattice.speed_mps * t_s) / lattice.pitch_m).astype(np.int32)
    lanes = np.clip(np.floor(y_m / lattice.lane_width_m), 0, lattice.lanes - 1)
    return columns, lanes.astype(np.int8)


class Trajectories:
    """Writes trajectories and measures safety and comfort."""

    def __init__(
        self,
        path: Path,
        metadata: Metadata,
        lattice: Lattice,
        measures: DrivingMeasures,
        disk: Disk | None = None,
    ) -> None:
        """Open the file.

        Args:
            path: the file.
            metadata: its metadata.
            lattice: the lattice of the scenario.
            measures: receives all trajectories.
            disk: errors of its disk.
        """
        self.peak = 0
        """Maximum number of vehicles on the road at a tick."""
        self._file = GrowingParquet(
            path,
            TRAJECTORIES.arrow_schema(metadata),
            disk,
            use_dictionary=[one.name for one in TRAJECTORIES.columns if one.type != pa.float32()],
            use_byte_stream_split=[
                one.name for one in TRAJECTORIES.columns if one.type == pa.float32()
            ],
        )
        self._lattice = lattice
        self._times: list[float] = []
        self._rows: list[Sample] = []
        """Buffered rows; `_times` contains their times."""
        self._measured_rows = 0
        """Number of buffered rows that are measured."""
        self._buffered_ticks = 0
        self._measures = measures
        self._overlaps: set[tuple[str, str]] = set()
        self._collisions: set[tuple[str, str]] = set()
        self._min_gap_m = self._min_headway_s = math.inf

    def tick(self, t_s: float, rows: list[Sample]) -> None:
        """Record all vehicles on the road; called once per tick."""
        self._times += [round(t_s, 6)] * len(rows)
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

    @property
    def overlap_count(self) -> int:
        """Number of pairs of bodies that have intersected."""
        return len(self._overlaps)

    def safety(self) -> Safety:
        """Return the counts and extreme values so far."""
        self._measure()
        found = self._measures
        return Safety(
            overlaps=len(self._overlaps),
            sumo_collisions=len(self._collisions),
            min_gap_m=finite(self._min_gap_m),
            min_headway_s=finite(self._min_headway_s),
            emergency_brakes=found.emergency_brakes,
            hard_brakes=found.hard_brakes,
            max_accel_mps2=finite(found.max_accel_mps2),
            min_accel_mps2=finite(found.min_accel_mps2),
            max_jerk_mps3=finite(found.max_jerk_mps3),
            min_ttc_s=finite(found.min_ttc_s),
            ttc_below_3_s=finite(found.ttc_below_s[TTC_SHORT_S]),
            ttc_below_1_5_s=finite(found.ttc_below_s[TTC_CRITICAL_S]),
            drac_max_mps2=finite(found.max_drac_mps2),
            min_pet_s=finite(found.min_pet_s),
        )

    def comfort(self) -> Comfort | None:
        """Return accelerations and jerks so far; None: nothing was measured."""
        self._measure()
        return self._measures.comfort

    def save(self) -> None:
        """Write the buffered rows as a provisional row group."""
        self._write_rows(provisional=True)

    def close(self) -> None:
        """Write the buffered rows, and close the file."""
        with closing(self._file):
            self._write_rows()

    def _measure(self) -> None:
        """Measure the buffered rows that are not measured yet."""
        rows = self._rows[self._measured_rows :]
        if rows:
            vehicles, s_m, y_m, speed_mps, _, accel_mps2, *_ = zip(*rows, strict=True)
            columns = (self._times[self._measured_rows :], s_m, y_m, speed_mps, accel_mps2)
            self._measured_rows = len(self._rows)
            self._measures.add(Rows.of(pa.array(vehicles), *map(np.array, columns)))

    def _write_rows(self, *, provisional: bool = False) -> None:
        """Measure the buffered rows, and write them as one row group."""
        self._measure()
        if not provisional:
            self._buffered_ticks = 0
        if not self._rows:
            return
        samples = dict(zip(_SAMPLED, zip(*self._rows, strict=True), strict=True))
        values: dict[str, Any] = {"t_s": np.array(self._times), **samples}
        if not provisional:
            self._times, self._rows, self._measured_rows = [], [], 0
        s_m, y_m = np.array(values["s_m"]), np.array(values["y_m"])
        columns, lanes = body_cells(values["t_s"], s_m, y_m, self._lattice)
        no_lattice = np.array([one is None for one in values["reserved_column"]])
        values |= {"column": pa.array(columns, mask=no_lattice), "lane": lanes}
        values |= {"s_m": s_m.astype(np.float32), "y_m": y_m.astype(np.float32)}
        arrays = [pa.array(values[one.name], one.type) for one in TRAJECTORIES.columns]
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._file.schema)
        self._file.append(batch, provisional=provisional)
