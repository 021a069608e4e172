"""A small sweep with real runs, which the tests of reports share."""

from __future__ import annotations

from pathlib import Path

import pytest

from unit.launch.sweep.sweeping import short_road, sweep


@pytest.fixture(scope="session")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a sweep: 40 s of demand at two volumes, a name that needs escaping."""
    folder = tmp_path_factory.mktemp("report")
    out = folder / "a <b> & 'c'"
    lists = ("--volumes", "1000,1600", "--seeds", "1:2", "--duration", 40)
    scenario = short_road(folder)
    # Long enough for everybody to settle, and to reach the preferred lane.
    text = scenario.read_text().replace("s3_m = 120.0", "s3_m = 240.0")
    text = text.replace("s2_m = 10.0", "s2_m = 180.0")
    scenario.write_text(text + '\n[formation]\noperation = "paper"\n')
    done = sweep(scenario, out, *lists)
    assert done.returncode == 0, done.stderr
    return out
