"""However long a run is, no role keeps anything of the vehicles that have passed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from laneweave.coordinator.formations.roster import Groups
from laneweave.sim_bridge.recording.ticks import Ticks
from laneweave.sim_bridge.recording.trips import Trip
from support.growth import growth_of

COLUMNS = {"close": "columns"}
ROLLING = {"operation": "rolling"}


@pytest.mark.slow
@pytest.mark.more
def test_nothing_grows_with_the_vehicles_that_have_passed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growth = growth_of(tmp_path, monkeypatch, {}, first_s=30.0, phase_s=25.0)
    assert growth.left[-1] - growth.left[0] > 45
    assert not growth.growing()


@pytest.mark.full
@pytest.mark.parametrize(
    "formation", [{}, COLUMNS, ROLLING], ids=["vehicles", "columns", "rolling"]
)
def test_nothing_grows_over_a_longer_time(
    formation: Mapping[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growth = growth_of(tmp_path, monkeypatch, formation, first_s=60.0, phase_s=120.0, phases=3)
    assert growth.left[-1] - growth.left[0] > 400
    assert not growth.growing()


@pytest.mark.full
def test_planted_leaks_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Groups, "forget_departed", lambda *_: None)
    monkeypatch.setattr(Trip, "is_final", lambda *_: False)
    monkeypatch.setattr(Ticks, "_write_rows", lambda *_, **__: None)
    growth = growth_of(tmp_path, monkeypatch, {}, first_s=30.0, phase_s=25.0)
    kinds = sorted(found.split()[0] for found in growth.growing())
    assert kinds == ["dict", "dict", "list"]
