"""A short recorded run, which the tests of the live page share."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.cli.main import command_line
from support.sharing import made_once


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run in virtual time. It is to be left as it is."""
    return made_once(tmp_path_factory, "recorded", _run)


def _run(out: Path) -> None:
    scenario = out.parent / "road.toml"
    scenario.write_text('schema = "laneweave.scenario/1"\n[road]\ns2_m = 60.0\ns3_m = 240.0\n')
    options = ["--transport", "simulated", "--volume", "1600", "--duration", "12", "--no-report"]
    assert not command_line()(
        ["run", str(scenario), *options, "--out", str(out)], standalone_mode=False
    )
