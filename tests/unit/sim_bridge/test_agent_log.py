"""The log of lost agents: a line per fleet, which names the first vehicles."""

from __future__ import annotations

from pathlib import Path

import pytest
import structlog
from structlog.testing import capture_logs

from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.agent_log import AgentLog
from support.bridge_bench import Street, arrival, make_scenario

VEHICLES = [Name(f"v{number:04}") for number in range(1, 15)]
EAST, WEST = VEHICLES[::2], VEHICLES[1::2]


def fleet_of(vehicle: str) -> str:
    return "east" if int(vehicle[1:]) % 2 else "west"


@pytest.fixture(autouse=True)
def _all_levels_are_logged() -> None:
    """Other tests of the same worker may have set a level."""
    structlog.reset_defaults()


def test_a_fleet_that_is_lost_is_one_line() -> None:
    agents = AgentLog(fleet_of)
    with capture_logs() as logged:
        agents.update([], VEHICLES, 1.0)
        agents.update(EAST[:4], VEHICLES, 2.0)
        agents.update(EAST, VEHICLES, 2.1)  # the tokens do not vanish at the same time
        assert logged == []
        agents.update(EAST, VEHICLES, 3.1)
        agents.update(EAST, VEHICLES, 9.0)
    (line,) = logged
    assert line == {
        "log_level": "warning",
        "event": "agents lost",
        "fleet": "east",
        "count": 7,
        "vehicles": "v0001, v0003, v0005, v0007, v0009 and 2 more",
        "road_s": 2.0,
    }


def test_fleets_have_their_own_lines_and_come_back() -> None:
    agents = AgentLog(fleet_of)
    with capture_logs() as logged:
        agents.update(VEHICLES[:2], VEHICLES, 2.0)
        agents.update(VEHICLES[:2], VEHICLES, 4.0)
        agents.update([], VEHICLES[1:], 5.0)  # the first one has left the road
        agents.update([], VEHICLES[1:], 6.5)
    lines = [(line["event"], line["fleet"], line["vehicles"]) for line in logged]
    assert lines == [
        ("agents lost", "east", "v0001"),
        ("agents lost", "west", "v0002"),
        ("agents back", "west", "v0002"),
    ]


def test_further_changes_of_a_fleet_wait_for_the_next_line() -> None:
    agents = AgentLog(lambda _: "")
    with capture_logs() as logged:
        for number in range(1, 15):
            agents.update(VEHICLES[:number], VEHICLES, float(number))
        agents.close(14.0)
    assert [(line["count"], line["road_s"]) for line in logged] == [(2, 1.0), (10, 3.0), (2, 13.0)]
    assert not any("fleet" in line for line in logged)


def test_the_bridge_names_the_fleet_that_has_died(tmp_path: Path) -> None:
    scenario = make_scenario(road={"lanes": 2, "s1_m": 20.0, "s2_m": 20.0, "s3_m": 240.0})
    arrivals = [arrival(f"v{number}", 1.0 + 2.0 * number, lane=number % 2) for number in range(4)]
    street = Street(scenario, tmp_path, arrivals, pace=2.0)
    street.start_coordinators()
    with capture_logs() as logged:
        for shard in range(2):
            street.start_shard(shard, 2)
        street.run_to(100)
        lost = sorted(name for name in street.bridge.vehicles if Shard(1, 2).contains(name))
        street.network.kill("shard-1")
        street.run()
    lines = [line for line in logged if line["event"] == "agents lost"]
    assert lost
    assert [(line["fleet"], line["vehicles"]) for line in lines] == [("1-of-2", ", ".join(lost))]
