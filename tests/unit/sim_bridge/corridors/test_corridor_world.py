"""The world of a corridor: which vehicles it shows, and what it refuses."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.corridors.corridor_setup import setup_of
from laneweave.sim_bridge.corridors.corridor_world import CorridorWorld
from laneweave.sim_bridge.corridors.scenario_tables import scenario_tables
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from support.interchange import CORRIDOR, vehicle, write_interchange

BUS = '<vType id="bus" vClass="bus" length="12" sigma="0"/>'


def test_closed_lanes_to_which_vehicles_come_are_refused_before_sumo_starts(
    tmp_path: Path,
) -> None:
    """Otherwise SUMO stayed open, and the process could start no other simulation."""
    vehicles = [vehicle(f"m{n}", 2 * n, "main" if n % 3 else "upstream") for n in range(12)]
    found = read_corridor(write_interchange(tmp_path, vehicles), CORRIDOR)
    tables = scenario_tables(found)
    closures = [*tables["road"].get("closures", []), {"lane": 3, "to_m": 300.0}]
    scenario = parse_scenario(tables | {"road": tables["road"] | {"closures": closures}})
    setup = setup_of(found, scenario)
    for _ in range(2):
        with pytest.raises(BadInputError, match=r"road\.closures"):
            CorridorWorld(setup, tmp_path)


def test_a_bus_that_comes_by_its_own_lane_is_seen(tmp_path: Path) -> None:
    """Entrances are reached in lanes for cars, and the bus comes in a lane of its own."""
    vehicles = [vehicle("bus", 0, "upstream", "bus")]
    vehicles += [vehicle(f"m{n}", 1 + n, "main" if n % 3 else "upstream") for n in range(12)]
    config = write_interchange(tmp_path, vehicles, types=BUS)
    roads = tmp_path / "small.net.xml"
    lane = r'<lane id="(start|main1)_0" index="0"'
    text, count = re.subn(lane, r'<lane id="\1_0" index="0" allow="bus"', roads.read_text())
    assert count == 2
    roads.write_text(text)
    found = read_corridor(config, CORRIDOR)
    setup = setup_of(found, parse_scenario(scenario_tables(found)))
    with CorridorWorld(setup, tmp_path) as world:
        for _ in range(1000):
            world.step()
            if world.vehicle.getRoadID("bus").startswith("main2"):
                break
        assert "bus" in world._coming
        assert "bus" in {one.name for one in world.others()}
