"""Tables of a run as CSV, with a dictionary of their columns."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as pq

from laneweave.launch.export.recording import trajectories_within, within
from laneweave.launch.recordings.files import reading
from laneweave.protocol.files import write_atomically
from laneweave.sim_bridge.recording.columns import TICKS, TRAJECTORIES, TRIPS

DICTIONARY_FILE = "columns.csv"


def write_csv(run: Path, folder: Path, from_s: float | None, to_s: float | None) -> list[Path]:
    """Write trajectories, trips and ticks, and what their columns mean; return the files.

    Args:
        run: the run's folder.
        folder: folder of the files, created if necessary.
        from_s: road time of the first trajectories and ticks; None: all.
        to_s: road time of the last ones.

    Raises:
        BadInputError: a table cannot be read, or has no rows in this time.
        OSError: a file cannot be written.
    """
    tables = {"trajectories": (TRAJECTORIES, trajectories_within(run, from_s, to_s))}
    for name, declared in (("trips", TRIPS), ("ticks", TICKS)):
        file = run / f"{name}.parquet"
        if file.is_file():
            with reading(run, file.name):
                table = pq.read_table(file)
            tables[name] = (declared, table if declared is TRIPS else within(table, from_s, to_s))
    folder.mkdir(parents=True, exist_ok=True)
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
