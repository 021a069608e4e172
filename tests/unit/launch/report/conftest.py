"""A small sweep with real runs, which the tests of reports share."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.sharing import made_once
from support.sweeping import short_road, sweep


@pytest.fixture(scope="session")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a sweep: 16 s of demand at two volumes. It is to be left as it is."""
    return made_once(tmp_path_factory, "report", _sweep)


def _sweep(out: Path) -> None:
    lists = ("--volumes", "1000,1600", "--seeds", "1:2", "--duration", 16)
    scenario = short_road(out.parent)
    # Long enough for everybody to settle, and to reach the preferred lane.
    text = scenario.read_text().replace("s3_m = 160.0", "s3_m = 240.0")
    text = text.replace("s2_m = 10.0", "s2_m = 180.0")
    scenario.write_text(text + '\n[formation]\noperation = "paper"\n')
    done = sweep(scenario, out, *lists)
    assert done.returncode == 0, done.stderr
