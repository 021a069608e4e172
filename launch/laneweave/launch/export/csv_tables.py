"""Tables of a run as CSV, with a dictionary of their columns."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as pq

from laneweave.launch.export.recording import within
from laneweave.launch.recordings.trajectories import read_trajectories
from laneweave.protocol.files import write_atomically
from laneweave.sim_bridge.recording.columns import TICKS, TRAJECTORIES, TRIPS

DICTIONARY_FILE = "columns.csv"


def write_csv(run: Path, folder: Path, from_s: float | None, to_s: float | None) -> list[Path]:
    """Write trajectories, trips and ticks, and what their columns mean; return the files.

    Args:
        run: the run's folder.
        folder: folder of the files.
        from_s: road time of the first trajectories and ticks; None: all.
        to_s: road time of the last ones.

    Raises:
        BadInputError: the trajectories cannot be read.
        OSError: a file cannot be written.
    """
    tables = {"trajectories": (TRAJECTORIES, within(read_trajectories(run), from_s, to_s))}
    if (run / "trips.parquet").is_file():
        tables["trips"] = (TRIPS, pq.read_table(run / "trips.parquet"))
    if (run / "ticks.parquet").is_file():
        tables["ticks"] = (TICKS, within(pq.read_table(run / "ticks.parquet"), from_s, to_s))
    files = [_write(table, folder / f"{name}.csv") for name, (_, table) in tables.items()]
    described = [
        {
            "file": f"{name}.csv",
            "column": one.name,
            "type": str(one.type),
            "unit": one.unit,
            "frame": one.frame,
            "meaning": one.meaning,
        }
        for name, (declared, table) in tables.items()
        for one in declared.columns
        if one.name in table.column_names
    ]
    return [*files, _write(pa.Table.from_pylist(described), folder / DICTIONARY_FILE)]


def _write(table: pa.Table, path: Path) -> Path:
    write_atomically(path, lambda part: csv.write_csv(table, part))
    return path
