"""Trajectories of a run, as a table or as arrays sorted by vehicle, and trips of a run.

All readers of trajectories.parquet use this module. It returns recordings of earlier versions, too,
with the columns of `sim_bridge.recording.columns.TRAJECTORIES`. In the first schema, `column` and
`lane` were the reserved cell; the cell of the body follows from its position, the lateral speed
from differences of positions, and the preferred lane from the trip.
"""

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

from laneweave.launch.recordings.files import TRAJECTORIES_FILE, TRIPS_FILE, reading
from laneweave.launch.recordings.runs import scenario_of
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Lattice
from laneweave.sim_bridge.recording.columns import SCHEMA_KEY, TRAJECTORIES
from laneweave.sim_bridge.recording.trajectories import body_cells

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

NO_LATTICE = np.iinfo(np.int64).min
"""Value of columns and reserved lanes of `Tracks` where the method has no lattice."""
JUMP_MPS = 2.8
"""Lateral speed above which a vehicle jumps to another lane; as in `player.js`."""
_FLOATS = ("s_m", "y_m", "speed_mps", "lateral_speed_mps", "accel_mps2")
_COLUMNS, _LANES = ("column", "reserved_column"), ("lane", "reserved_lane")
_FIRST_SCHEMA = ("t_s", "vehicle", "s_m", "y_m", "speed_mps", "accel_mps2", "column", "lane")
_SOURCES = {
    "column": ("t_s", "s_m", "y_m", "column"),
    "lane": ("t_s", "s_m", "y_m", "column"),
    "lateral_speed_mps": ("t_s", "vehicle", "y_m"),
    "reserved_column": ("column",),
    "reserved_lane": ("column", "lane"),
    "preferred_lane": ("vehicle",),
}
"""Columns of the first schema from which others follow."""


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
    lateral_speed_mps: Floats
    accel_mps2: Floats
    column: Ints
    """Column in which the body is, or `NO_LATTICE`."""
    lane: Ints
    """Lane in which the centre of the body is."""
    reserved_column: Ints
    """Column of the cell that the vehicle holds or moves to, or `NO_LATTICE`."""
    reserved_lane: Ints
    """Lane of that cell, or `NO_LATTICE`."""

    @property
    def vehicle(self) -> Ints:
        """Vehicle index of each row."""
        return np.repeat(np.arange(len(self.names)), np.diff(self.starts))

    @property
    def changed(self) -> Bools:
        """Whether the vehicle's reserved cell in each row differs from that in the previous row."""
        changed = np.zeros(len(self.t_s), dtype=np.bool_)
        changed[1:] = (np.diff(self.reserved_column) != 0) | (np.diff(self.reserved_lane) != 0)
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
        BadInputError: the trips cannot be read.
    """
    with reading(folder, TRIPS_FILE):
        return {trip["vehicle"]: trip for trip in pq.read_table(folder / TRIPS_FILE).to_pylist()}


def read_trajectories(folder: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Return the trajectories of a run in the order of the file: by time.

    Args:
        folder: folder of the run, of this or of an earlier version.
        columns: names of the columns to read; None: all of `columns.TRAJECTORIES`.

    Raises:
        BadInputError: there is no such column, or the trajectories cannot be read.
    """
    names = TRAJECTORIES.names if columns is None else list(columns)
    for name in names:
        if name not in TRAJECTORIES.names:
            raise BadInputError("columns", name, "any of " + ", ".join(TRAJECTORIES.names))
    with reading(folder, TRAJECTORIES_FILE):
        schema = (pq.read_schema(folder / TRAJECTORIES_FILE).metadata or {}).get(SCHEMA_KEY)
        if schema is None:
            return _from_first_schema(folder, names)
        if schema.decode() != TRAJECTORIES.schema:
            wanted = f"a recording with schema {TRAJECTORIES.schema} or an earlier one"
            raise BadInputError(TRAJECTORIES_FILE, schema.decode(), wanted)
        return pq.read_table(folder / TRAJECTORIES_FILE, columns=names)


def _from_first_schema(folder: Path, names: Sequence[str]) -> pa.Table:
    """Return columns of a recording without schema number; see the module's docstring."""
    sources = [source for name in names for source in _SOURCES.get(name, (name,))]
    wanted = [name for name in _FIRST_SCHEMA if name in sources]
    table = pq.read_table(folder / TRAJECTORIES_FILE, columns=wanted).combine_chunks()
    found: dict[str, Any] = {name: table[name] for name in wanted}
    if "reserved_column" in names:
        found["reserved_column"] = table["column"]
    if "reserved_lane" in names:
        no_column = table["column"].is_null()
        found["reserved_lane"] = pc.if_else(no_column, pa.scalar(None, pa.int8()), table["lane"])
    if "lateral_speed_mps" in names:
        found["lateral_speed_mps"] = _lateral_speeds(table)
    if "preferred_lane" in names:
        preferred = {name: trip["preferred_lane"] for name, trip in read_trips(folder).items()}
        vehicles = map(str, table["vehicle"].to_pylist())
        found["preferred_lane"] = [preferred.get(name) for name in vehicles]
    if "column" in names or "lane" in names:
        lattice: Lattice = scenario_of(folder / TRAJECTORIES_FILE).lattice
        t_s, s_m, y_m = (
            table[name].to_numpy().astype(np.float64) for name in ("t_s", "s_m", "y_m")
        )
        columns, found["lane"] = body_cells(t_s, s_m, y_m, lattice)
        no_lattice = np.asarray(table["column"].is_null())
        found["column"] = pa.array(columns, mask=no_lattice)
    whole = TRAJECTORIES.arrow_schema(pq.read_schema(folder / TRAJECTORIES_FILE).metadata)
    chosen = pa.schema([field for field in whole if field.name in names])
    schema = chosen.with_metadata(whole.metadata or {})
    arrays = [
        found[field.name].cast(field.type)
        if isinstance(found[field.name], pa.ChunkedArray)
        else pa.array(found[field.name], field.type)
        for field in schema
    ]
    return pa.table(arrays, schema=schema).select(list(names))


def _lateral_speeds(table: pa.Table) -> pa.Array[Any]:
    """Return lateral speeds from differences of y; null for vehicles with a single row."""
    vehicle = table["vehicle"].combine_chunks().dictionary_encode().indices.to_numpy()
    t_s, y_m = (table[name].to_numpy().astype(np.float64) for name in ("t_s", "y_m"))
    speeds = np.full(len(t_s), np.nan)
    order = np.lexsort((t_s, vehicle))
    bounds = np.flatnonzero(np.diff(vehicle[order])) + 1
    for rows in np.split(order, bounds):
        if len(rows) > 1:
            speeds[rows] = np.gradient(y_m[rows], t_s[rows])
    return pa.array(speeds, pa.float32(), mask=np.isnan(speeds))


def read_tracks(folder: Path) -> Tracks:
    """Return the trajectories of a run.

    Raises:
        BadInputError: the trajectories cannot be read.
    """
    table = read_trajectories(folder, ["t_s", "vehicle", *_FLOATS, *_COLUMNS, *_LANES])
    codes = table["vehicle"].combine_chunks().dictionary_encode()
    names = [str(name) for name in codes.dictionary.to_pylist()]
    vehicle = codes.indices.to_numpy(zero_copy_only=False).astype(np.int64)
    t_s = table["t_s"].to_numpy().astype(np.float64)
    order = np.lexsort((t_s, vehicle))
    counts = np.bincount(vehicle, minlength=len(names))
    values: dict[str, Any] = {
        name: table[name].to_numpy()[order].astype(np.float64) for name in _FLOATS
    }
    for name in (*_COLUMNS, *_LANES):
        column = pc.fill_null(pc.cast(table[name], "int64"), int(NO_LATTICE)).to_numpy()
        values[name] = column[order].astype(np.int64)
    return Tracks(
        names=tuple(names),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        t_s=t_s[order],
        **values,
    )
