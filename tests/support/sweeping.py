"""Small sweeps for tests: a short road, few seconds of demand."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from support.commands import LANEWEAVE, run

SHORT_ROAD = """
[road]
s1_m = 10.0
s2_m = 10.0
s3_m = 160.0

[demand]
duration_s = 8.0
"""
"""Runs that take a tenth of the time that it takes to start them."""

CLOCKS = ("wall_s", "tick_ms", "solve_ms", "real_time_factor")
"""In the names of columns that depend on the machine."""


def short_road(folder: Path) -> Path:
    """Write the scenario."""
    path = folder / "short.toml"
    path.write_text(SHORT_ROAD, encoding="utf-8")
    return path


def command(scenario: Path, out: Path, *options: object) -> list[str]:
    """Return the command line of a sweep."""
    named = [LANEWEAVE, "sweep", scenario, "--out", out, *options]
    return [str(word) for word in named]


def sweep(scenario: Path, out: Path, *options: object) -> subprocess.CompletedProcess[str]:
    """Run a sweep to its end."""
    return run(*command(scenario, out, *options))


def results(out: Path) -> list[dict[str, Any]]:
    """Return the rows of a sweep's table, without what depends on the machine."""
    rows = pq.read_table(out / "results.parquet").to_pylist()
    return [
        {name: value for name, value in row.items() if not any(part in name for part in CLOCKS)}
        for row in rows
    ]
