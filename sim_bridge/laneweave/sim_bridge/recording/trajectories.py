"""Trajectories: one row per vehicle and tick in `trajectories.parquet`, and extreme values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from laneweave.protocol.lattice import Lattice
from laneweave.protocol.summary import HARD_BRAKE_MPS2, Safety
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.columns import TRAJECTORIES, Metadata
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet
from laneweave.sim_bridge.recording.statistics import finite

ROWS_PER_GROUP = 100_000
"""Number of rows that are written together."""
TICKS_PER_GROUP = 3000
"""Maximum number of ticks whose rows are written together."""
EMERGENCY_SHARE = 0.9
"""Fraction of the braking limit beyond which braking counts as emergency braking."""

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
    """Writes trajectories and computes their extreme values."""

    def __init__(
        self,
        path: Path,
        metadata: Metadata,
        lattice: Lattice,
        min_accel_mps2: float,
        min_accel_of: Callable[[str], float] | None = None,
        disk: Disk | None = None,
    ) -> None:
        """Open the file.

        Args:
            path: the file.
            metadata: its metadata.
            lattice: the lattice of the scenario.
            min_accel_mps2: braking limit of the type that brakes least.
            min_accel_of: returns the braking limit of a vehicle; None: it is that of all.
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
        self._buffered_ticks = 0
        self._brake_mps2 = EMERGENCY_SHARE * min_accel_mps2
        self._min_accel_of = min_accel_of
        self._last_s, self._last_accels = -math.inf, dict[str, float]()
        """Time of the last tick, and accelerations of all vehicles at that tick."""
        self._overlaps: set[tuple[str, str]] = set()
        self._collisions: set[tuple[str, str]] = set()
        self._min_gap_m = self._min_headway_s = math.inf
        self._emergency_brakes = 0
        self._hard_brakes = set[str]()
        self._min_accel_mps2, self._max_accel_mps2 = math.inf, -math.inf
        self._max_jerk_mps3 = -math.inf

    def tick(self, t_s: float, rows: list[Sample]) -> None:
        """Record all vehicles on the road; called once per tick."""
        brake_mps2, last_accels, dt_s = self._brake_mps2, self._last_accels, t_s - self._last_s
        accels = {row[0]: row[5] for row in rows}
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
            if accel < -HARD_BRAKE_MPS2:
                self._hard_brakes.add(vehicle)
        self._last_s, self._last_accels = t_s, accels
        self._min_accel_mps2 = min(self._min_accel_mps2, *accels.values(), math.inf)
        self._max_accel_mps2 = max(self._max_accel_mps2, *accels.values(), -math.inf)
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
        return Safety(
            overlaps=len(self._overlaps),
            sumo_collisions=len(self._collisions),
            min_gap_m=finite(self._min_gap_m),
            min_headway_s=finite(self._min_headway_s),
            emergency_brakes=self._emergency_brakes,
            hard_brakes=len(self._hard_brakes),
            max_accel_mps2=finite(self._max_accel_mps2),
            min_accel_mps2=finite(self._min_accel_mps2),
            max_jerk_mps3=finite(self._max_jerk_mps3),
        )

    def save(self) -> None:
        """Write the buffered rows as a provisional row group."""
        self._write_rows(provisional=True)

    def close(self) -> None:
        """Write the buffered rows, and close the file."""
        with closing(self._file):
            self._write_rows()

    def _write_rows(self, *, provisional: bool = False) -> None:
        """Write the buffered rows as one row group."""
        if not provisional:
            self._buffered_ticks = 0
        if not self._rows:
            return
        samples = dict(zip(_SAMPLED, zip(*self._rows, strict=True), strict=True))
        values: dict[str, Any] = {"t_s": np.array(self._times), **samples}
        if not provisional:
            self._times, self._rows = [], []
        s_m, y_m = np.array(values["s_m"]), np.array(values["y_m"])
        columns, lanes = body_cells(values["t_s"], s_m, y_m, self._lattice)
        no_lattice = np.array([one is None for one in values["reserved_column"]])
        values |= {"column": pa.array(columns, mask=no_lattice), "lane": lanes}
        values |= {"s_m": s_m.astype(np.float32), "y_m": y_m.astype(np.float32)}
        arrays = [pa.array(values[one.name], one.type) for one in TRAJECTORIES.columns]
        batch = pa.RecordBatch.from_arrays(arrays, schema=self._file.schema)
        self._file.append(batch, provisional=provisional)
