"""Formations drive around a vehicle that has broken down."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

import laneweave
from laneweave.protocol.scenario.fields import Scenario


@pytest.mark.more
@pytest.mark.parametrize(("at_m", "loss"), [(600.0, 0.0), (450.0, 0.0), (600.0, 0.3)])
def test_formations_leave_the_lane_before_the_line(
    tmp_path: Path, at_m: float, loss: float
) -> None:
    """Only those stop that have no time to leave, and all leave the road in their lanes."""
    breakdown = {"at_s": 40.0, "lane": 1, "at_m": at_m, "decel_mps2": 3.0, "for_s": 60.0}
    summary = laneweave.run(
        Scenario(),
        out=tmp_path / "run",
        transport="simulated",
        faults={"breakdown": [breakdown], "messages": [{"loss": loss}]},
        demand__volume_veh_per_lane_h=1000.0,
        demand__duration_s=120.0,
        tracking__shortcut=True,
    )
    rows = pq.read_table(
        tmp_path / "run" / "trajectories.parquet", columns=["vehicle", "speed_mps"]
    )
    standing = rows["speed_mps"].to_numpy() < 0.5
    stopped = {*rows["vehicle"].to_numpy(zero_copy_only=False)[standing]}
    assert summary.safety.overlaps == 0
    assert summary.vehicles.left == summary.vehicles.entered
    assert len(stopped) <= 10
    in_their_lanes = summary.vehicles.on_preferred_lane
    assert in_their_lanes is not None
    assert in_their_lanes >= summary.vehicles.left - 3
