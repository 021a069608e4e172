"""SUMO drives on roads with closed lanes, ramps and exits: all vehicles leave where they want."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from attrs import evolve

from laneweave.launch.run_methods import LC2013, METHODS
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE, Exits
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Demand, Restriction, Road, SolidLine
from laneweave.protocol.scenario.vehicle_tables import VehicleTypeSettings
from laneweave.sim_bridge.baselines.lc2013 import Lc2013Traffic, check_lc2013
from laneweave.sim_bridge.baselines.reference_road import Entrance, ReferenceVehicle
from laneweave.sim_bridge.baselines.rule_based import check_rule
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.road.demand import arrivals, count_until
from laneweave.sim_bridge.road.sized_bodies import bodies_of
from laneweave.sim_bridge.sumo.traffic import SumoTraffic
from support.closed_lanes import ramp_road
from support.variants import variants

LABELS = [name for name, one in METHODS.items() if one.method == LC2013]
DROP = [{"lane": 0, "from_m": 800.0}]
BLOCKED = [{"lane": 0, "from_m": 600.0, "to_m": 700.0}]
BLOCKED_BETWEEN = [{"lane": 1, "from_m": 600.0, "to_m": 700.0}]


def closed_road(
    closures: list[dict[str, float]], *, volume: float = 1300.0, shares: tuple[float, ...] = ()
) -> Scenario:
    return parse_scenario(
        {
            "road": {"s1_m": 50.0, "s2_m": 100.0, "s3_m": 850.0, "closures": closures},
            "demand": {
                "volume_veh_per_lane_h": volume,
                "duration_s": 30.0,
                "lane_shares": list(shares),
            },
            "formation": {"operation": "rolling"},
        }
    )


def drive(scenario: Scenario, folder: Path) -> dict[ReferenceVehicle, float]:
    """Let SUMO drive all vehicles, check every tick, and return their travel times [s]."""
    check_lc2013(scenario)
    demand, entrance = arrivals(scenario), Entrance(scenario)
    road, tick_s = scenario.road, scenario.runtime.tick_s
    left: dict[ReferenceVehicle, float] = {}
    before: dict[str, Pose] = {}
    queued = tick = 0
    exits = Exits(scenario.geometry.sections, road.length_m)
    with SumoTraffic(scenario, folder / "sumo") as sumo:
        traffic = Lc2013Traffic(scenario, sumo)
        while len(left) < len(demand):
            tick += 1
            t_s = tick * tick_s
            assert t_s < 300.0
            first, queued = queued, count_until(demand, t_s)
            for arrival in demand[first:queued]:
                entrance.queue(arrival)
            traffic.step(t_s, entrance)
            poses = traffic.poses()
            bodies = bodies_of(poses, (one.arrival for one in traffic.vehicles), scenario)
            assert bodies.overlapping_pairs() == bodies.in_closed_lanes(scenario) == []
            assert traffic.collisions() == []
            for name, pose in poses.items():
                assert_continuous(before.get(name, pose), pose, scenario)
            before = poses
            for one in list(traffic.vehicles):
                section = exits.left_by(one.lane, one.s_m)
                if section is not None:
                    assert section.serves(one.preferred_lane, one.destination)
                    traffic.remove(one)
                    left[one] = t_s - one.arrival.t_s
    return left


def assert_continuous(before: Pose, after: Pose, scenario: Scenario) -> None:
    """A vehicle moves by its speed, and sideways by one lane at most, along the road."""
    driven_m = 0.5 * (before[3] + after[3]) * scenario.runtime.tick_s
    assert before == after or after[0] - before[0] == pytest.approx(driven_m, abs=0.02)
    assert abs(after[1] - before[1]) <= scenario.road.lane_width_m + 1e-6
    if not scenario.lc2013.lane_change_s and scenario.lc2013.model == "LC2013":
        lane = after[1] / scenario.road.lane_width_m - 0.5
        assert lane == pytest.approx(round(lane), abs=1e-6)
        assert after[2] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("label", variants(LABELS))
@pytest.mark.parametrize(
    "closures", variants([pytest.param(DROP, id="drop"), pytest.param(BLOCKED, id="blocked")])
)
def test_vehicles_without_preferred_lanes_pass_closed_parts(
    label: str, closures: list[dict[str, float]], tmp_path: Path
) -> None:
    scenario = METHODS[label].settings(closed_road(closures))
    left = drive(scenario, tmp_path)
    assert all(one.preferred_lane == ANY_LANE for one in left)
    lanes = {one.lane for one in left}
    assert lanes >= {1, 2}
    assert 0 not in lanes or closures is BLOCKED
    free_s = scenario.geometry.free_flow_s
    assert min(left.values()) >= free_s - 0.1
    assert sum(left.values()) / len(left) < 1.05 * free_s


@pytest.mark.parametrize(
    ("closures", "shares"),
    variants(
        [
            pytest.param(BLOCKED_BETWEEN, (1.0, 1.0, 1.0), id="blocked-between"),
            pytest.param(DROP, (0.0, 1.0, 1.0), id="drop"),
            pytest.param(BLOCKED, (1.0, 1.0, 1.0), id="blocked"),
        ]
    ),
)
@pytest.mark.parametrize("label", variants(["lc2013", "lc2013-cooperative-4s"]))
def test_vehicles_leave_on_their_preferred_lanes(
    label: str, closures: list[dict[str, Any]], shares: tuple[float, ...], tmp_path: Path
) -> None:
    scenario = METHODS[label].settings(closed_road(closures, volume=1000.0, shares=shares))
    left = drive(scenario, tmp_path)
    assert all(one.lane == one.preferred_lane for one in left)
    assert sum(left.values()) / len(left) < 1.1 * scenario.geometry.free_flow_s


@pytest.mark.more
@pytest.mark.slow
@pytest.mark.parametrize("label", ["lc2013-cooperative-4s", "lc2013-human"])
def test_a_queue_before_a_lane_drop_dissolves(label: str, tmp_path: Path) -> None:
    scenario = METHODS[label].settings(closed_road(DROP, volume=2400.0))
    assert max(drive(scenario, tmp_path).values()) > 70.0


# --- ramps and exits --------------------------------------------------------------------------

SHORT_DEMAND: dict[str, object] = {"duration_s": 30.0}
RAMP = ramp_road(demand=SHORT_DEMAND)
WEAVING = ramp_road(ends_m=700.0, exit_name="off", demand=SHORT_DEMAND)
PREFERENCES = evolve(WEAVING, demand=evolve(WEAVING.demand, lane_shares=(0.0, 1.0, 1.0, 1.0)))


@pytest.mark.parametrize(
    ("label", "scenario"),
    variants(
        [
            ("lc2013", WEAVING),
            ("lc2013-cooperative-4s", RAMP),
            ("lc2013", RAMP),
            ("lc2013", PREFERENCES),
            ("lc2013-human", RAMP),
            ("lc2013-human", WEAVING),
            ("lc2013-cooperative-4s", WEAVING),
        ],
        2,
    ),
)
def test_vehicles_enter_by_ramps_and_leave_by_their_exits(
    label: str, scenario: Scenario, tmp_path: Path
) -> None:
    scenario = METHODS[label].settings(scenario)
    left = drive(scenario, tmp_path)
    for vehicle, travel_s in left.items():
        free_s = scenario.geometry.free_flow_trip_s(vehicle.arrival.lane, vehicle.destination)
        assert free_s - 0.1 <= travel_s < 1.4 * free_s
    ways = {(one.arrival.lane == 0, one.destination) for one in left}
    assert ways >= {(True, "end"), (False, "end")}
    assert not scenario.exit or (False, "off") in ways


@pytest.mark.parametrize("merge_m", [465.0, 475.0])
def test_a_ramp_that_leaves_no_room_for_lane_changes_is_refused(merge_m: float) -> None:
    scenario = ramp_road(lc2013={"lane_change_s": 4.0})
    (ramp,) = scenario.entrance
    scenario = evolve(scenario, entrance=(evolve(ramp, merge_m=merge_m),))
    if merge_m < 470.0:
        check_lc2013(scenario)
    else:
        with pytest.raises(BadInputError, match=r"road\.closures\[1\]\.from_m.*more than 505"):
            check_lc2013(scenario)


def test_trucks_drive_among_cars_within_their_limits(tmp_path: Path) -> None:
    truck = VehicleTypeSettings("truck", 0.3, length_m=12.0, width_m=2.5, max_accel_mps2=1.3)
    demand = Demand(volume_veh_per_lane_h=1000.0, duration_s=30.0)
    scenario = Scenario(vehicle_type=(truck,), demand=demand)
    left = drive(scenario, tmp_path)
    assert all(one.lane == one.preferred_lane for one in left)
    assert {one.arrival.vehicle_type for one in left} == {"car", "truck"}
    with pytest.raises(BadInputError, match=r"vehicle_type: got ..truck..; allowed: none with"):
        check_rule(scenario)


@pytest.mark.parametrize(
    ("road", "field"),
    [
        (Road(restrictions=(Restriction(2, ("car",)),)), "restrictions"),
        (Road(solid_lines=(SolidLine(1, "left"),)), "solid_lines"),
    ],
)
def test_rules_of_lanes_are_refused(road: Road, field: str) -> None:
    for check, method in ((check_lc2013, "lc2013"), (check_rule, "rule")):
        with pytest.raises(BadInputError, match=rf"road\.{field}: .*none with --method {method}"):
            check(Scenario(road=road))
