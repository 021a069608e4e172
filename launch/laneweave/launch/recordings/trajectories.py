"""Trajectories of a run, as arrays sorted by vehicle, and trips of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from attrs import frozen
from numpy.typing import NDArray

from laneweave.launch.recordings.runs import TRAJECTORIES, not_a_run
from laneweave.protocol.errors import BadInputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

OFF_LATTICE = np.iinfo(np.int64).min
"""Value of `Tracks.column` for a vehicle off the lattice."""


@frozen
class Tracks:
    """All rows of trajectories.parquet, sorted by vehicle and time; arrays of shape (rows,)."""

    names: tuple[str, ...]
    """Names of the vehicles."""
    starts: Ints
    """Index of the first row of each vehicle, followed by the number of rows."""
    t_s: Floats
    s_m: Floats
    y_m: Floats
    speed_mps: Floats
    accel_mps2: Floats
    column: Ints
    """Column of the cell, or `OFF_LATTICE`."""
    lane: Ints

    @property
    def vehicle(self) -> Ints:
        """Vehicle index of each row."""
        return np.repeat(np.arange(len(self.names)), np.diff(self.starts))

    @property
    def changed(self) -> Bools:
        """Whether the vehicle's cell in each row differs from its cell in the previous row."""
        changed = np.zeros(len(self.t_s), dtype=np.bool_)
        changed[1:] = (np.diff(self.column) != 0) | (np.diff(self.lane) != 0)
        changed[self.starts[:-1]] = False
        return changed

    def rows(self, number: int) -> slice:
        """Return the rows of a vehicle."""
        return slice(int(self.starts[number]), int(self.starts[number + 1]))

    def sampled(self, number: int, name: str, times_s: Floats) -> Floats:
        """Return a vehicle's values in a column, interpolated at the given times."""
        rows = self.rows(number)
        return np.asarray(np.interp(times_s, self.t_s[rows], getattr(self, name)[rows]))


def read_trips(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the trips of a run by vehicle.

    Raises:
        OSError, ValueError: the trips cannot be read.
    """
    return {trip["vehicle"]: trip for trip in pq.read_table(folder / "trips.parquet").to_pylist()}


def read_trajectories(folder: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Return the trajectories of a run in the order of the file: by time.

    Args:
        folder: folder of the run.
        columns: names of the columns to read; None: all.

    Raises:
        BadInputError: there is no such column, or the trajectories cannot be read.
    """
    try:
        names = pq.read_schema(folder / TRAJECTORIES).names
        unknown = [name for name in columns or () if name not in names]
        if not unknown:
            return pq.read_table(
                folder / TRAJECTORIES, columns=None if columns is None else [*columns]
            )
    except (OSError, ValueError, KeyError) as error:
        raise not_a_run(folder, error) from error
    raise BadInputError("columns", unknown[0], "any of " + ", ".join(names))


def read_tracks(folder: Path) -> Tracks:
    """Return the trajectories of a run.

    Raises:
        BadInputError: the trajectories cannot be read.
    """
    columns = ["vehicle", "t_s", "s_m", "y_m", "speed_mps", "accel_mps2", "column", "lane"]
    table = read_trajectories(folder, columns)
    codes = table["vehicle"].combine_chunks().dictionary_encode()
    names = [str(name) for name in codes.dictionary.to_pylist()]
    vehicle = codes.indices.to_numpy(zero_copy_only=False).astype(np.int64)
    t_s = table["t_s"].to_numpy().astype(np.float64)
    order = np.lexsort((t_s, vehicle))
    counts = np.bincount(vehicle, minlength=len(names))
    values = {
        name: table[name].to_numpy()[order].astype(np.float64)
        for name in ("s_m", "y_m", "speed_mps", "accel_mps2")
    }
    column = pc.fill_null(pc.cast(table["column"], "int64"), int(OFF_LATTICE)).to_numpy()
    return Tracks(
        names=tuple(names),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        t_s=t_s[order],
        **values,
        column=column[order].astype(np.int64),
        lane=table["lane"].to_numpy()[order].astype(np.int64),
    )
