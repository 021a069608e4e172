"""The rule-based method: all vehicles reach their lanes, within limits, without touching."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.sim_bridge.baselines.rule_based import check_rule
from laneweave.sim_bridge.road.demand import arrivals
from support.bridge_bench import arrival
from support.examples import examples
from support.rule_road import PAPER, RuleRoad, rule_scenario, vehicle
from support.tables import for_each

METHODS: list[dict[str, Any]] = [
    {"gap": gap, "yielding": yielding, "lane_change_s": lane_change_s}
    for gap in ("front-to-front", "net")
    for yielding in ("unsorted", "all")
    for lane_change_s in (0.0, 4.0)
]


# --- entering ---------------------------------------------------------------------------------


def test_a_vehicle_that_does_not_wait_enters_where_it_would_have_driven() -> None:
    road = RuleRoad(PAPER)
    road.entrance.queue(arrival("v1", 0.04))
    (entered,) = road.step()
    assert entered.s_m == pytest.approx(15.0 * 0.06)
    assert entered.entered_s == pytest.approx(0.04)
    assert entered.speed_mps == 15.0


def test_a_vehicle_without_room_waits_as_briefly_as_possible() -> None:
    road = RuleRoad(rule_scenario(gap="net"))
    road.entrance.queue(arrival("v1", 0.1))
    road.entrance.queue(arrival("v2", 0.1))
    (first,) = road.step()
    while not (entered := road.step()):
        pass
    needed_m = 5.0 + 5.0 + 15.0 * 0.66
    assert first.s_m - entered[0].s_m == pytest.approx(needed_m)
    assert entered[0].entered_s == pytest.approx(0.1 + needed_m / 15.0)


def test_no_vehicle_enters_close_behind_a_standing_one() -> None:
    road = RuleRoad(PAPER, [vehicle("v1", 15.0, speed_mps=0.0), vehicle("v0", 21.5, speed_mps=0.0)])
    road.entrance.queue(arrival("v2", 0.0))
    assert road.step() == []


# --- moving -----------------------------------------------------------------------------------


@for_each("rule", METHODS)
@for_each("s_m", [700.0, 860.0, 930.0])
def test_three_abreast_that_want_to_change_round_all_do(rule: dict[str, Any], s_m: float) -> None:
    """The knot that a rule without a tie-break never unties."""
    speed_mps = 15.0 if s_m < 800.0 else 5.0
    # The ways of two lane changes are kept free before the end.
    s_m -= 2 * 15.0 * rule["lane_change_s"]
    wanted = (2, 0, 1)
    road = RuleRoad(
        rule_scenario(**rule),
        [vehicle(f"v{lane}", s_m, lane, wanted[lane], speed_mps) for lane in range(3)],
    )
    road.run(120.0)
    assert [one.lane for one in sorted(road.left, key=lambda one: one.name)] == list(wanted)


@pytest.mark.slow
@examples(60)
@given(
    rule=st.sampled_from(METHODS),
    places=st.lists(
        st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(0, 5), st.floats(0.0, 4.0)),
        min_size=2,
        max_size=12,
        unique_by=lambda place: (place[0], place[2]),
    ),
)
def test_all_vehicles_leave_on_their_preferred_lanes_without_touching(
    rule: dict[str, Any], places: list[tuple[int, int, int, float]]
) -> None:
    """A crowd that enters S3 so dense that it cannot sort itself without giving way."""
    road = RuleRoad(
        rule_scenario(**rule),
        [
            vehicle(f"v{lane}{row}", 300.0 + 24.0 * row + shift_m, lane, preferred_lane)
            for lane, preferred_lane, row, shift_m in places
        ],
    )
    road.run(300.0)
    assert len(road.left) == len(places)
    assert all(one.lane == one.preferred_lane for one in road.left)


@pytest.mark.slow
@pytest.mark.parametrize("gap", ["front-to-front", "net"])
@pytest.mark.parametrize("lane_change_s", [0.0, 4.0])
@pytest.mark.more
def test_a_jam_clears_up(gap: str, lane_change_s: float) -> None:
    scenario = parse_scenario(
        {
            "seed": 3,
            "demand": {"volume_veh_per_lane_h": 2400.0, "duration_s": 60.0},
            "rule": {"gap": gap, "lane_change_s": lane_change_s},
        }
    )
    road, demand = RuleRoad(scenario), arrivals(scenario)
    road.serve(demand, until_s=600.0)
    assert len(road.left) == len(demand) > 100
    assert all((one.lane, one.previous_lane) == (one.preferred_lane, None) for one in road.left)


@for_each("yielding", ["unsorted", "all"])
def test_a_vehicle_blocked_in_its_lane_change_yields(yielding: str) -> None:
    """`v1` cannot finish before `v0` is gone, and `v0` cannot change while `v1` is so near."""
    waiting = vehicle("v0", 860.0, 1, 0, speed_mps=0.0)
    stuck = vehicle("v1", 860.0 - 5.99, 1, 0, speed_mps=0.0)
    road = RuleRoad(rule_scenario(lane_change_s=4.0, yielding=yielding), [waiting, stuck])
    road.traffic._lanes.begin_change(stuck, 0)
    road.run(60.0)
    assert [one.lane for one in road.left] == [0, 0]


def test_a_lane_change_takes_its_time_and_counts_on_both_lanes() -> None:
    road = RuleRoad(rule_scenario(lane_change_s=4.0), [vehicle("v1", 500.0, 0, 1)])
    (one,) = road.traffic.vehicles
    road.step()
    assert (one.lane, one.previous_lane) == (1, 0)
    assert one.y_m == pytest.approx(1.75 + 3.5 / 40)
    assert [len(lane) for lane in road.traffic._lanes] == [1, 1, 0]
    for _ in range(39):
        road.step()
    assert (one.y_m, one.previous_lane, one.lateral_speed_mps) == (5.25, None, 0.0)
    assert [len(lane) for lane in road.traffic._lanes] == [0, 1, 0]


def test_a_lane_change_follows_the_slower_of_two_vehicles() -> None:
    """On the old lane a near vehicle drives on; on the new one a farther vehicle stands."""
    changing, standing = vehicle("v2", 500.0, 0, 1), vehicle("v1", 560.0, 1)
    road = RuleRoad(rule_scenario(lane_change_s=4.0), [changing, standing, vehicle("v0", 515.0, 0)])
    road.traffic._lanes.begin_change(changing, 1)
    for _ in range(60):
        standing.speed_mps = 0.0
        road.step()
    assert standing.s_m - changing.s_m >= 5.0 + 1.0 - 0.05


def test_no_vehicle_slides_sideways() -> None:
    road = RuleRoad(
        rule_scenario(lane_change_s=4.0),
        [vehicle("v1", 500.0, 0, 1, speed_mps=0.0), vehicle("v0", 506.0, 0, 0, speed_mps=0.0)],
    )
    (one, _) = road.traffic.vehicles
    for _ in range(60):
        road.step()
        assert abs(one.lateral_speed_mps) <= 0.25 * one.speed_mps + 1e-9


# --- scenarios that do not fit ----------------------------------------------------------------


@for_each(
    "tables, field",
    [
        ({"rule": {"stop_distance_m": 600.0}}, "rule.stop_distance_m"),
        ({"rule": {"stop_distance_m": 20.0}}, "rule.stop_distance_m"),
        ({"road": {"s3_m": 150.0}, "formation": {"operation": "paper"}}, "rule.stop_distance_m"),
        ({"road": {"lanes": 8}, "rule": {"lane_change_s": 5.0}}, "rule.lane_change_s"),
    ],
)
def test_a_road_too_short_for_the_rules_is_refused(
    tables: dict[str, dict[str, Any]], field: str
) -> None:
    check_rule(PAPER)
    with pytest.raises(BadInputError) as refused:
        check_rule(parse_scenario(tables))
    assert refused.value.field == field
