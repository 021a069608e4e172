"""Recordings as earlier versions left them.

No events say which columns are whose, and trajectories have the first schema: without number,
lateral speed and preferred lane; `column` and `lane` are the reserved cell.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from laneweave.sim_bridge.recording.columns import SCENARIO_KEY, SCHEMA_KEY, Metadata

NEWER_FIELDS = ("entry", "close", "max_columns")
"""Fields of `formation` that earlier versions did not have."""
FIRST_SCHEMA = {
    "t_s": "t_s",
    "vehicle": "vehicle",
    "s_m": "s_m",
    "y_m": "y_m",
    "speed_mps": "speed_mps",
    "accel_mps2": "accel_mps2",
    "reserved_column": "column",
    "reserved_lane": "lane",
}
"""Today's names of the columns of the first schema of trajectories, and their names then."""


def older_recording(recorded: Path, folder: Path) -> Path:
    """Copy a recording of formations and make it one of the paper's operation, of blocks of four.

    Args:
        recorded: folder of the recording.
        folder: where the copy goes.
    """
    shutil.copytree(recorded, folder)
    events = folder / "events.jsonl"
    kept = []
    for line in events.read_text().splitlines():
        event = json.loads(line)
        if event["kind"] != "formation-closed":
            kept.append({key: event[key] for key in event if key not in ("t0_s", "slot_s")})
    events.write_text("".join(json.dumps(event) + "\n" for event in kept))
    for name in ("trajectories", "trips"):
        path = folder / f"{name}.parquet"
        table = pq.read_table(path)
        if name == "trajectories":
            table = first_schema(table)
        metadata = dict(table.schema.metadata)
        scenario = json.loads(metadata[SCENARIO_KEY])
        formation = scenario["formation"]
        scenario["formation"] = {
            key: formation[key] for key in formation if key not in NEWER_FIELDS
        } | {"operation": "paper", "block_columns": 4, "cycle_s": 4.0, "move_s": 3.8}
        metadata[SCENARIO_KEY] = json.dumps(scenario).encode()
        pq.write_table(table.replace_schema_metadata(metadata), path)
    return folder


def first_schema(table: pa.Table) -> pa.Table:
    """Return trajectories as the first version of the schema had them."""
    chosen = table.select(list(FIRST_SCHEMA)).rename_columns(list(FIRST_SCHEMA.values()))
    fields = [field.remove_metadata() for field in chosen.schema]
    found = table.schema.metadata or {}
    metadata: Metadata = {key: text for key, text in found.items() if key != SCHEMA_KEY}
    return pa.table(chosen.columns, schema=pa.schema(fields, metadata))
