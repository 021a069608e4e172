"""A bridge with two vehicles."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.bridge_bench import TWO, A, B, Desk, make_scenario


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    """Two vehicles have just entered, and both agents have been asked."""
    desk = Desk(make_scenario(), tmp_path, TWO)
    desk.start(A, B)
    desk.drive_to_entry(A, B)
    desk.effects.clear()
    return desk
