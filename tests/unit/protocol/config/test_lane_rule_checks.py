"""Restrictions and solid lines of a road: what is read, what is refused, and who enters where."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, LONGEST_ROAD_M
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Restriction, SolidLine
from support.refusals import refusal
from support.tables import for_each

ROLLING = {"operation": "rolling", "gap_m": 20.0}
TYPES = [{"name": "truck", "share": 0.15, "length_m": 12.0}, {"name": "bus", "share": 0.05}]
BAN = {"lane": 2, "vehicle_types": ["truck"]}
LINE = {"lane": 1, "to": "left"}


def scenario(
    *restrictions: dict[str, Any],
    lines: tuple[dict[str, Any], ...] = (),
    road: dict[str, Any] | None = None,
    **tables: Any,  # noqa: ANN401 (tables)
) -> Scenario:
    rules = {"restrictions": list(restrictions), "solid_lines": list(lines)}
    data = {"formation": ROLLING, "vehicle_type": TYPES, "road": rules | (road or {})}
    return parse_scenario(data | tables)


def shares(found: Scenario, lane: int) -> dict[str, float]:
    return {one.type: one.share for one in found.flow.inflows[lane].types}


def test_without_rules_a_scenario_is_as_before() -> None:
    found = scenario()
    assert (found.road.restrictions, found.road.solid_lines) == ((), ())
    assert [one.volume_veh_per_h for one in found.flow.inflows.values()] == [1000.0] * 3
    assert shares(found, 2) == {"truck": 0.15, "bus": 0.05}


def test_rules_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "road.toml"
    path.write_text(
        """\
schema = "laneweave.scenario/1"
formation.operation = "rolling"
[[road.restrictions]]
lane = 2
vehicle_types = ["truck"]
[[road.restrictions]]
lane = 0
from_m = 200.0
to_m = 400.0
vehicle_types = ["car", "truck"]
[[road.solid_lines]]
lane = 1
to = "right"
to_m = 700.0
[[vehicle_type]]
name = "truck"
share = 0.1
"""
    )
    road = load_scenario(path).road
    assert road.restrictions == (
        Restriction(2, ("truck",), 0.0, LONGEST_ROAD_M),
        Restriction(0, ("car", "truck"), 200.0, 400.0),
    )
    assert road.solid_lines == (SolidLine(1, "right", 0.0, 700.0, ()),)
    path.write_text(path.read_text().replace("lane = 2", "lane = 3"))
    with pytest.raises(BadInputError, match=r"road\.restrictions\[0\]\.lane: got 3.*road.toml:4"):
        load_scenario(path)


@for_each(("rules", "message"), [
    ({"restrictions": [BAN | {"lane": 3}]}, "restrictions[0].lane: got 3; allowed: a lane from"),
    ({"restrictions": [BAN | {"vehicle_types": []}]}, "restrictions[0].vehicle_types: got []"),
    ({"restrictions": [{"lane": 1}]}, "restrictions[0].vehicle_types: got no value"),
    ({"restrictions": [BAN, BAN | {"vehicle_types": ["van"]}]},
     "restrictions[1].vehicle_types: got ['van']; allowed: names of types, each once: car"),
    ({"restrictions": [BAN | {"from_m": 1000.0}]},
     "restrictions[0].from_m: got 1000.0; allowed: less than the length of the road, 1000"),
    ({"restrictions": [BAN | {"from_m": 500.0, "to_m": 500.0}]},
     "restrictions[0].to_m: got 500.0; allowed: more than from_m, 500"),
    ({"solid_lines": [LINE | {"lane": 4}]}, "solid_lines[0].lane: got 4"),
    ({"solid_lines": [LINE | {"to": "up"}]}, "solid_lines[0].to: got 'up'; allowed: left"),
    ({"solid_lines": [LINE, LINE | {"lane": 2}]},
     "solid_lines[1].to: got 'left'; allowed: the side of lane 2 on which there is"),
    ({"solid_lines": [LINE | {"vehicle_types": ["bus", "bus"]}]},
     "solid_lines[0].vehicle_types: got ['bus', 'bus']"),
    ({"restrictions": [BAN | {"lane": lane} for lane in (2, 0, 1)]},
     "types other than truck, which has no lane left at entrance main"),
    ({"restrictions": [{"lane": lane, "vehicle_types": ["bus"], "from_m": 500.0}
                       for lane in range(3)]},
     "types other than bus, which has no lane left to leave by end"),
])  # fmt: skip
def test_impossible_rules_are_refused_in_one_line(rules: dict[str, Any], message: str) -> None:
    line = str(refusal(scenario, road=rules))
    assert line.startswith("road.")
    assert message in line


@pytest.mark.parametrize("rules", [{"restrictions": [BAN]}, {"solid_lines": [LINE]}])
def test_only_the_rolling_operation_knows_them(rules: dict[str, Any]) -> None:
    with pytest.raises(BadInputError, match=r"formation\.operation: got 'formations'"):
        scenario(road=rules, formation={"gap_m": 20.0})


def test_a_type_enters_in_its_other_lanes() -> None:
    found = scenario(BAN, {"lane": 0, "vehicle_types": ["car", "truck"]})
    volumes = {lane: inflow.volume_veh_per_h for lane, inflow in found.flow.inflows.items()}
    # 450 trucks in lane 1, 50 buses in each lane, and the cars in lanes 1 and 2.
    assert volumes == pytest.approx({0: 50.0, 1: 450.0 + 50.0 + 1200.0, 2: 50.0 + 1200.0})
    assert shares(found, 0) == pytest.approx({"bus": 1.0})
    assert shares(found, 1) == pytest.approx({"truck": 450.0 / 1700.0, "bus": 50.0 / 1700.0})
    assert shares(found, 2) == pytest.approx({"bus": 0.04})


def test_a_type_that_may_not_enter_by_a_ramp_is_refused_there() -> None:
    ramp = {"name": "on", "lane": 0, "at_m": 50.0, "merge_m": 250.0, "volume_veh_per_h": 300.0}
    own: dict[str, Any] = {
        "road": {"closures": [{"lane": 0, "to_m": 50.0}, {"lane": 0, "from_m": 700.0}]}
    }
    ban = {"lane": 0, "vehicle_types": ["truck"]}
    with pytest.raises(BadInputError, match="no lane left at entrance on"):
        scenario(ban, entrance=[ramp], **own)
    buses = [{"type": "bus", "share": 0.5}]
    found = scenario(ban, entrance=[ramp | {"vehicle_types": buses}], **own)
    assert shares(found, 0) == {"bus": 0.5}


def test_goals_are_lanes_in_which_the_type_may_drive_at_their_ends() -> None:
    found = scenario(BAN, {"lane": 0, "vehicle_types": ["bus"], "to_m": 900.0})
    goals = found.geometry.goal_sections
    assert goals(2, END_OF_ROAD, "car") == {2}
    assert goals(2, END_OF_ROAD, "truck") == {0, 1}
    assert goals(1, END_OF_ROAD, "truck") == {1}
    assert goals(ANY_LANE, END_OF_ROAD, "truck") == {0, 1}
    assert goals(0, END_OF_ROAD, "bus") == {0}  # its lane is open to it again
    assert goals(ANY_LANE, "elsewhere", "truck") == set()
