"""Whole simulated runs in which vehicles that hold undisturbed send and receive less."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import laneweave
from support.variants import variants


def drive(
    folder: Path, operation: str, period_ticks: int
) -> tuple[laneweave.RunSummary, list[dict[str, Any]]]:
    """Return the summary of a run in dense traffic, and what happened until vehicles left."""
    summary = laneweave.run(
        out=folder,
        transport="simulated",
        seed=3,
        demand__volume_veh_per_lane_h=1600.0,
        demand__duration_s=12.0,
        formation__operation=operation,
        runtime__hold_period_ticks=period_ticks,
    )
    events = [
        {name: value for name, value in one.items() if not name.endswith("_ms")}
        for one in laneweave.load_run(folder).events()
        if one["kind"] not in ("left", "run-ended")
    ]
    return summary, events


@pytest.mark.slow
@pytest.mark.parametrize("operation", variants(["formations", "rolling"]))
def test_every_ballot_is_as_at_the_full_rate(tmp_path: Path, operation: str) -> None:
    """Plans are made and come into force in the same ticks, since ballots end the rest."""
    full, expected = drive(tmp_path / "full", operation, 1)
    summary, events = drive(tmp_path / "adaptive", operation, 5)
    assert {"plan-in-force"} <= {one["kind"] for one in events}
    assert events == expected
    assert summary.messages.published < 0.65 * full.messages.published
    assert summary.safety.min_gap_m == pytest.approx(full.safety.min_gap_m, abs=0.05)
    assert summary.safety.min_accel_mps2 == pytest.approx(full.safety.min_accel_mps2, abs=0.1)
    assert summary.safety.max_accel_mps2 == pytest.approx(full.safety.max_accel_mps2, abs=0.1)
    assert summary.safety.commands_refused == summary.safety.overlaps == 0
    assert summary.vehicles.left == summary.vehicles.on_preferred_lane == full.vehicles.left
