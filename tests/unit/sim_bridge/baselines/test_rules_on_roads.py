"""The rule-based method on roads with closed lanes, ramps and exits: vehicles leave in time."""

from __future__ import annotations

from typing import Any

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, Exits
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import ReferenceVehicle
from laneweave.sim_bridge.baselines.rule_based import check_rule
from laneweave.sim_bridge.baselines.rules import Lanes, Rules
from laneweave.sim_bridge.baselines.wanted_lanes import WantedLane, WantedLanes
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies
from laneweave.sim_bridge.road.demand import arrivals
from support.closed_lanes import ramp_road
from support.examples import examples
from support.rule_road import RuleRoad, vehicle
from support.tables import for_each
from support.variants import variants


def closed_road(
    *closures: tuple[int, float, float],
    shares: tuple[float, ...] = (),
    volume: float = 1000.0,
    **rule: Any,  # noqa: ANN401 (fields)
) -> Scenario:
    """Return a road on which parts of lanes (lane, from, to) are closed."""
    names = ("lane", "from_m", "to_m")
    return parse_scenario(
        {
            "road": {
                "s1_m": 50.0,
                "s2_m": 100.0,
                "s3_m": 850.0,
                "closures": [dict(zip(names, one, strict=True)) for one in closures],
            },
            "demand": {
                "volume_veh_per_lane_h": volume,
                "duration_s": 30.0,
                "lane_shares": list(shares),
            },
            "formation": {"operation": "rolling"},
            "rule": rule,
        }
    )


FAR_M = 2000.0
DROP = closed_road((0, 800.0, FAR_M))
BLOCKED = closed_road((0, 600.0, 700.0))
BLOCKED_BETWEEN = closed_road((1, 600.0, 700.0))
OPENS_BEFORE = closed_road((0, 800.0, FAR_M), (1, 500.0, 600.0))
STAGGERED = closed_road((0, 500.0, FAR_M), (1, 800.0, FAR_M))


def step(road: RuleRoad) -> None:
    """Advance by one tick; no body is in a closed part of a lane."""
    road.step()
    size = road.scenario.vehicle
    bodies = Bodies(road.traffic.poses(), size.length_m, size.width_m)
    assert bodies.in_closed_lanes(road.scenario) == []


def drive(scenario: Scenario) -> dict[ReferenceVehicle, float]:
    """Drive all vehicles of a demand, and return their travel times [s]."""
    check_rule(scenario)
    road, exits = RuleRoad(scenario), Exits(scenario.geometry.sections, scenario.road.length_m)
    demand = arrivals(scenario)
    waiting, left_s = list(demand), dict[ReferenceVehicle, float]()
    while len(left_s) < len(demand):
        assert road.t_s < 200.0
        while waiting and waiting[0].t_s <= road.t_s + scenario.runtime.tick_s:
            road.entrance.queue(waiting.pop(0))
        step(road)
        for one in road.left[len(left_s) :]:
            section = exits.left_by(one.lane, one.s_m)
            assert section is not None
            assert section.serves(one.preferred_lane, one.destination)
            left_s[one] = road.t_s - one.arrival.t_s
    return left_s


# --- wanted lanes -----------------------------------------------------------------------------


@for_each(
    "scenario, s_m, lane, preferred, wanted",
    [
        (DROP, 200.0, 1, ANY_LANE, 1),
        (DROP, 200.0, 0, ANY_LANE, 1),
        (DROP, 200.0, 0, 2, 1),
        (DROP, 900.0, 1, 2, 2),
        # The left lane is closed here, but open beyond the dead end.
        (OPENS_BEFORE, 200.0, 0, ANY_LANE, 1),
        (STAGGERED, 200.0, 0, ANY_LANE, 1),
        (STAGGERED, 200.0, 1, ANY_LANE, 2),
        # Two lanes are equally near: the left one, or the one towards the preferred lane.
        (BLOCKED_BETWEEN, 200.0, 1, ANY_LANE, 2),
        (BLOCKED_BETWEEN, 200.0, 1, 0, 0),
        # A vehicle leaves its preferred lane before the closed part, and returns behind it.
        (BLOCKED, 200.0, 0, 0, 1),
        (BLOCKED, 650.0, 1, 0, 0),
        (BLOCKED, 710.0, 0, 0, 0),
    ],
)
def test_a_vehicle_wants_a_lane_that_is_open_beyond_the_next_dead_end(
    scenario: Scenario, s_m: float, lane: int, preferred: int, wanted: int
) -> None:
    assert WantedLanes(scenario).of(vehicle("a", s_m, lane, preferred)).lane == wanted


# --- speeds before a dead end -----------------------------------------------------------------


def test_a_vehicle_approaches_a_dead_end_as_it_does_the_end_of_the_road() -> None:
    rules = Rules(DROP)
    assert rules.approach_speed_mps(vehicle("a", 790.0, 1, ANY_LANE)) == 15.0
    assert rules.approach_speed_mps(vehicle("a", 785.0, 0, ANY_LANE)) == pytest.approx(1.5)
    rules = Rules(closed_road((0, 800.0, FAR_M), lane_change_s=4.0))
    assert rules.approach_speed_mps(vehicle("a", 680.0, 0, ANY_LANE)) == pytest.approx(6.0)


def test_a_vehicle_slows_down_for_another_one_before_its_dead_end() -> None:
    leaving, behind = vehicle("a", 500.0, 0, ANY_LANE), vehicle("b", 495.0, 1, ANY_LANE)
    for yielding, slowing in (("unsorted", leaving), ("all", behind)):
        lanes = Lanes(3)
        lanes.enter(leaving, 0)
        lanes.enter(behind, 1)
        rules = Rules(closed_road((0, 800.0, FAR_M), yielding=yielding))
        assert rules.sort(lanes) == {slowing: 800.0}
    assert rules.slow_speed_mps(150.0, 800.0) == 15.0
    assert rules.slow_speed_mps(400.0, 800.0) == pytest.approx(7.5)
    assert rules.slow_speed_mps(650.0, 800.0) == 0.0


@pytest.mark.parametrize("lane_change_s", [0.0, 0.5, 4.0])
def test_a_vehicle_that_cannot_leave_its_lane_waits_before_the_dead_end(
    lane_change_s: float,
) -> None:
    waiting, beside = vehicle("a", 600.0, 0, ANY_LANE), vehicle("b", 600.0, 1, ANY_LANE)
    scenario = closed_road((0, 800.0, FAR_M), lane_change_s=lane_change_s)
    road = RuleRoad(scenario, [waiting, beside])
    for _ in range(600):
        beside.s_m, beside.speed_mps = waiting.s_m, waiting.speed_mps
        step(road)
    assert waiting.lane == 0
    assert waiting.s_m < 800.0
    assert waiting.speed_mps < 0.2
    for _ in range(300):
        step(road)
    assert [one.lane for one in road.left] == [1, 1]


# --- traffic ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rule", variants([{}, {"yielding": "all"}, {"lane_change_s": 4.0}]), ids=str
)
@pytest.mark.parametrize(
    ("closure", "shares"),
    [
        ((0, 800.0, FAR_M), ()),
        ((0, 600.0, 700.0), ()),
        ((0, 800.0, FAR_M), (0.0, 1.0, 1.0)),
        ((0, 600.0, 700.0), (1.0, 1.0, 1.0)),
        ((1, 600.0, 700.0), (1.0, 1.0, 1.0)),
    ],
    ids=str,
)
def test_all_vehicles_pass_closed_parts(
    closure: tuple[int, float, float], shares: tuple[float, ...], rule: dict[str, Any]
) -> None:
    scenario = closed_road(closure, shares=shares, **rule)
    left_s = drive(scenario).values()
    assert sum(left_s) / len(left_s) < 1.1 * scenario.geometry.free_flow_s


# --- ramps and exits --------------------------------------------------------------------------

ON_RAMP = ramp_road()
WEAVING = ramp_road(ends_m=700.0, exit_name="off")


@for_each(
    "s_m, lane, destination, wanted",
    [
        (100.0, 3, "off", WantedLane(0, 700.0, stops=True)),
        (300.0, 1, "off", WantedLane(0, 700.0, stops=True)),
        (300.0, 0, "off", WantedLane(0, 700.0, stops=False)),
        (52.0, 0, "off", WantedLane(0, 700.0, stops=False)),
        (100.0, 0, END_OF_ROAD, WantedLane(1, 700.0, stops=True)),
        (300.0, 1, END_OF_ROAD, WantedLane(1, 1000.0, stops=False)),
    ],
)
def test_a_vehicle_wants_the_lane_of_its_exit_and_leaves_that_of_others(
    s_m: float, lane: int, destination: str, wanted: WantedLane
) -> None:
    one = vehicle("a", s_m, lane, ANY_LANE, destination=destination)
    assert WantedLanes(WEAVING).of(one) == wanted


def test_a_vehicle_wants_the_nearest_lane_of_its_exit() -> None:
    closures = [{"lane": lane, "from_m": 800.0} for lane in (0, 1)]
    scenario = parse_scenario(
        {
            "road": {"lanes": 4, "s1_m": 50.0, "s2_m": 100.0, "s3_m": 850.0, "closures": closures},
            "exit": [{"name": "off", "lanes": [0, 1], "at_m": 800.0}],
            "demand": {"volume_veh_per_lane_h": 600.0},
            "formation": {"operation": "rolling"},
        }
    )
    wanted = [
        WantedLanes(scenario).of(vehicle("a", 300.0, lane, ANY_LANE, destination="off")).lane
        for lane in range(4)
    ]
    assert wanted == [0, 1, 1, 1]
    # For the others both lanes end.
    assert WantedLanes(scenario).of(vehicle("a", 300.0, 0, ANY_LANE)).lane == 2


@for_each(
    "scenario, lane, preferred, destination, s_m, changes",
    [
        # Into a closed part, before it, and behind it as soon as a body has room.
        *((BLOCKED, 1, 0, END_OF_ROAD, s_m, False) for s_m in (200.0, 599.0, 650.0, 704.0)),
        (BLOCKED, 1, 0, END_OF_ROAD, 705.0, True),
        # Beside a ramp.
        (WEAVING, 0, ANY_LANE, END_OF_ROAD, 204.0, False),
        (WEAVING, 0, ANY_LANE, END_OF_ROAD, 205.0, True),
        (WEAVING, 1, ANY_LANE, "off", 204.0, False),
        (WEAVING, 1, ANY_LANE, "off", 205.0, True),
        (WEAVING, 1, ANY_LANE, "off", 699.0, True),
        (WEAVING, 1, ANY_LANE, END_OF_ROAD, 300.0, False),
    ],
)
def test_no_vehicle_changes_into_a_closed_part_or_beside_a_ramp(
    scenario: Scenario, lane: int, preferred: int, destination: str, s_m: float, *, changes: bool
) -> None:
    one = vehicle("a", s_m, lane, preferred, destination=destination)
    lanes = Lanes(scenario.road.lanes)
    lanes.enter(one, lane)
    assert Rules(scenario).sort(lanes) == {}
    assert (one.lane != lane) == changes


def test_a_vehicle_that_cannot_reach_its_exit_lane_waits_before_it() -> None:
    waiting = vehicle("a", 600.0, 1, ANY_LANE, destination="off")
    beside = vehicle("b", 600.0, 0, ANY_LANE, destination="off")
    road = RuleRoad(
        evolve(WEAVING, rule=evolve(WEAVING.rule, lane_change_s=4.0)), [waiting, beside]
    )
    for _ in range(600):
        beside.s_m, beside.speed_mps = waiting.s_m, waiting.speed_mps
        step(road)
    assert (waiting.lane, road.left) == (1, [])
    assert waiting.s_m < 700.0
    for _ in range(300):
        step(road)
    assert [one.lane for one in road.left] == [0, 0]


def test_a_vehicle_enters_a_ramp_behind_those_in_its_lane_ahead_of_it() -> None:
    passed, ahead = vehicle("a", 40.0, 0, ANY_LANE), vehicle("b", 70.0, 0, ANY_LANE)
    road = RuleRoad(ON_RAMP, [passed, ahead])
    arriving = next(one for one in arrivals(ON_RAMP) if one.lane == 0)
    road.entrance.queue(evolve(arriving, t_s=0.0))
    (entered,) = road.step()
    # 1.5 m in a tick, from the beginning of the ramp.
    assert [entered.s_m, entered.entered_s] == pytest.approx([51.5, 0.0])
    road = RuleRoad(ON_RAMP, [vehicle("b", 60.0, 0, ANY_LANE)])
    road.entrance.queue(evolve(arriving, t_s=0.0))
    assert road.step() == []


@pytest.mark.parametrize(
    "rule", variants([{}, {"yielding": "all"}, {"lane_change_s": 4.0}]), ids=str
)
@pytest.mark.parametrize("scenario", [ON_RAMP, WEAVING], ids=["on-ramp", "weaving"])
def test_all_vehicles_leave_at_their_destinations(scenario: Scenario, rule: dict[str, Any]) -> None:
    demand = evolve(scenario.demand, duration_s=30.0, volume_veh_per_lane_h=1000.0)
    scenario = evolve(scenario, rule=evolve(scenario.rule, **rule), demand=demand)
    free_s = scenario.geometry.free_flow_trip_s
    delays_s = [
        travel_s - free_s(one.arrival.lane, one.destination)
        for one, travel_s in drive(scenario).items()
    ]
    assert min(delays_s) > -0.2
    assert sum(delays_s) / len(delays_s) < 7.0


# --- crowds -----------------------------------------------------------------------------------


@pytest.mark.more
@pytest.mark.slow
@examples(40)
@given(
    closures=st.sampled_from(
        [
            ((0, 800.0, FAR_M),),
            ((1, 600.0, 700.0),),
            ((0, 500.0, FAR_M), (1, 800.0, FAR_M)),
            ((0, 800.0, FAR_M), (1, 500.0, 600.0)),
        ]
    ),
    lane_change_s=st.sampled_from([0.0, 4.0]),
    yielding=st.sampled_from(["unsorted", "all"]),
    places=st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from([ANY_LANE, 2]), st.integers(0, 5)),
        min_size=2,
        max_size=12,
        unique_by=lambda place: (place[0], place[2]),
    ),
)
def test_a_crowd_leaves_its_lanes_before_dead_ends(
    closures: tuple[tuple[int, float, float], ...],
    lane_change_s: float,
    yielding: str,
    places: list[tuple[int, int, int]],
) -> None:
    scenario = closed_road(*closures, lane_change_s=lane_change_s, yielding=yielding)
    road = RuleRoad(
        scenario,
        [
            vehicle(f"v{lane}{row}", 160.0 + 16.0 * row, lane, preferred)
            for lane, preferred, row in places
        ],
    )
    while road.traffic.vehicles and road.t_s < 300.0:
        step(road)
    assert len(road.left) == len(places)


def test_a_dead_end_too_early_for_the_rules_is_refused() -> None:
    with pytest.raises(
        BadInputError, match=r"the part of S3 before road\.closures\[0\]"
    ) as refused:
        check_rule(closed_road((0, 295.0, FAR_M)))
    assert refused.value.field == "rule.stop_distance_m"
