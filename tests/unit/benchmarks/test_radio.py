"""The table of docs/RADIO.md follows the record, and names what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import radio
from evaluation.markdown import MISSING
from experiments import Job

POINT = next(point for point in radio.POINTS if point.technology is not None and point.seeds == 3)
UNDISTURBED = radio.Point(POINT.operation)


Recorded = tuple[radio.Point, int, dict[str, Any]]
"""Point, seed, and figures other than those of a good run."""


def row_of(tmp_path: Path, *runs: Recorded) -> list[str]:
    """Return the cells of `POINT` behind its settings, in a record with some runs."""
    good = {
        "travel_time_s": 70.0, "demanded": 100, "left": 100, "in_another_lane": 0, "overlaps": 0,
        "min_gap_m": 8.0, "sidelink_lost": 0.05, "cellular_lost": 0.03,
    }  # fmt: skip
    record = {
        Job(point, seed).key: good | {"seed": seed} | changed for point, seed, changed in runs
    }
    path = tmp_path / radio.RECORD
    path.write_text(json.dumps(record))
    lines = radio.table(path).splitlines()
    planned = [point for point in radio.POINTS if point.technology is not None]
    assert len(lines) == 2 + len(planned)
    return [cell.strip() for cell in lines[2 + planned.index(POINT)].strip("|").split("|")][4:]


def test_runs_and_their_figures(tmp_path: Path) -> None:
    assert row_of(tmp_path) == ["0 of 3", MISSING, "", "", "", "", ""]
    some: list[Recorded] = [
        (UNDISTURBED, 1, {"travel_time_s": 50.0}),
        (POINT, 1, {"in_another_lane": 3}),
    ]
    assert row_of(tmp_path, *some) == [
        "1 of 3", "5.0 %", "3.0 %", "1.400", "97.0 %", "8.0 m", "0",
    ]  # fmt: skip
    others: list[Recorded] = [
        (POINT, 2, {"left": 90, "min_gap_m": 7.0, "overlaps": 2}),
        (POINT, 3, {}),
    ]
    assert row_of(tmp_path, *some, *others) == [
        "3", "5.0 %", "3.0 %", "1.400", "99.0 % (10 on the road)", "7.0 m", "2",
    ]  # fmt: skip


def test_a_run_in_which_no_vehicle_left(tmp_path: Path) -> None:
    nothing = {"left": 0, "travel_time_s": None, "min_gap_m": None, "sidelink_lost": None}
    assert row_of(tmp_path, (POINT, 1, nothing | {"overlaps": 2})) == [
        "1 of 3", "-", "3.0 %", "-", "- (100 on the road)", "- m", "2",
    ]  # fmt: skip
