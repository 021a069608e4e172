"""Recordings as earlier versions left them: without events that say which columns are whose."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq

from laneweave.sim_bridge.recording.trips import SCENARIO_KEY

NEWER_FIELDS = ("entry", "close", "max_columns")
"""Fields of `formation` that earlier versions did not have."""


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
        metadata = dict(table.schema.metadata)
        scenario = json.loads(metadata[SCENARIO_KEY])
        formation = scenario["formation"]
        scenario["formation"] = {
            key: formation[key] for key in formation if key not in NEWER_FIELDS
        } | {"operation": "paper", "block_columns": 4, "cycle_s": 4.0, "move_s": 3.8}
        metadata[SCENARIO_KEY] = json.dumps(scenario).encode()
        pq.write_table(table.replace_schema_metadata(metadata), path)
    return folder
