"""Parts of lanes cover the open road, and name the parts behind and beside them."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.export.road_parts import RoadPart, road_parts
from laneweave.protocol.config.scenario_files import load_scenario, scenario_of
from laneweave.protocol.scenario.fields import Scenario

SCENARIOS = Path(__file__).resolve().parents[4] / "scenarios"


def part_at(parts: tuple[RoadPart, ...], lane: int, s_m: float) -> RoadPart | None:
    found = [one for one in parts if one.lane == lane and one.from_m <= s_m < one.to_m]
    assert len(found) <= 1
    return found[0] if found else None


@pytest.mark.parametrize(
    "name", ["paper", "lane-drop", "blocked-lane", "on-ramp", "off-ramp", "weaving", "motorway"]
)
def test_parts_are_where_the_road_is_open(name: str) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.toml")
    parts, road = road_parts(scenario), scenario.road
    assert [part.number for part in parts] == list(range(1, len(parts) + 1))
    for s_m in range(0, int(road.length_m), 7):
        closed = {one.lane for one in road.closures if one.from_m <= s_m < one.to_m}
        opened = {one.lane for one in scenario.entrance if one.at_m <= s_m < one.merge_m}
        for lane in range(road.lanes):
            part = part_at(parts, lane, s_m)
            assert (part is not None) == (lane not in closed)
            if part is not None and lane in opened:
                assert part.beside == (None, None)
                assert part.may_cross == (False, False)
    check_neighbours(parts)


def check_neighbours(parts: tuple[RoadPart, ...]) -> None:
    """Check that neighbours name each other, and that parts follow each other without a gap."""
    for part in parts:
        for side, number in enumerate(part.beside):
            if number is not None:
                other = parts[number - 1]
                assert other.beside[1 - side] == part.number
                assert (other.from_m, other.to_m) == (part.from_m, part.to_m)
                assert other.lane == part.lane + (-1, 1)[side]
            else:
                assert not part.may_cross[side]
        if part.behind is not None:
            behind = parts[part.behind - 1]
            assert (behind.lane, behind.to_m) == (part.lane, part.from_m)


def test_vehicles_may_not_cross_solid_lines_of_their_lane() -> None:
    scenario: Scenario = scenario_of(
        {
            "formation": {"operation": "rolling"},
            "road": {
                "solid_lines": [
                    {"lane": 1, "to": "left", "from_m": 100.0, "to_m": 300.0},
                    {"lane": 2, "to": "right", "from_m": 200.0, "to_m": 300.0},
                    {"lane": 0, "to": "left", "vehicle_types": ["car"]},
                ]
            },
        }
    )
    parts = road_parts(scenario)
    check_neighbours(parts)
    for s_m, to_left, to_right in ((50.0, True, True), (150.0, False, True), (250.0, False, False)):
        middle, left = part_at(parts, 1, s_m), part_at(parts, 2, s_m)
        assert middle is not None
        assert left is not None
        assert (middle.may_cross[1], left.may_cross[0]) == (to_left, to_right)
        assert middle.beside[1] == left.number
    first = part_at(parts, 0, 50.0)
    assert first is not None
    assert not first.may_cross[1]
