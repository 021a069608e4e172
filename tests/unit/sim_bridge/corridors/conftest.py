"""The corridor of the interchange, which SUMO reads once."""

from __future__ import annotations

import pytest

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.scenario_tables import scenario_tables
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, read_corridor
from support.interchange import CORRIDOR, TRUCKS, stream, write_interchange


@pytest.fixture(scope="session")
def interchange(tmp_path_factory: pytest.TempPathFactory) -> SumoCorridor:
    """The corridor with a mixed stream of a minute."""
    folder = tmp_path_factory.mktemp("interchange")
    return read_corridor(write_interchange(folder, stream(60), types=TRUCKS), CORRIDOR)


@pytest.fixture(scope="session")
def scenario(interchange: SumoCorridor) -> Scenario:
    """The scenario of the corridor."""
    return parse_scenario(scenario_tables(interchange))
