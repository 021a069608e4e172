"""Who takes part in a deployment: identities, vehicles of the demand, members of fleets."""

from __future__ import annotations

from laneweave.protocol.config.participants import demanded_vehicles, identities_of, members_of
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.deployment_fields import Shard, parse_shard
from laneweave.sim_bridge.road.demand import arrivals
from support.refusals import refusal
from support.tables import for_each


def test_the_identities_of_a_deployment() -> None:
    scenario = parse_scenario(
        {
            "runtime": {"coordinators": 2},
            "security": {"fleets": {"f": "0/2"}, "vehicles": ["a"], "clients": ["x"]},
        }
    )
    names = {identity.common_name for identity in identities_of(scenario)}
    assert names == {"router", "bridge", "coordinator.c1", "coordinator.c2", "fleet.f", "client.x",
                     "operator.operator", "vehicle.a",
                     "observer.ping", "observer.status", "observer.watch"}  # fmt: skip


@for_each("volume", [20.0, 400.0, 1600.0, 3600.0])
@for_each("duration_s", [3.0, 40.0, 600.0])
def test_no_demand_has_more_vehicles_than_are_expected(volume: float, duration_s: float) -> None:
    for seed in range(5):
        scenario = parse_scenario(
            {
                "seed": seed,
                "demand": {"volume_veh_per_lane_h": volume, "duration_s": duration_s},
            }
        )
        expected = demanded_vehicles(scenario)
        arriving = [arrival.vehicle for arrival in arrivals(scenario)]
        assert tuple(arriving) == expected[: len(arriving)]
        assert len(expected) <= 3 * volume * duration_s / 3600 * 1.4 + 60


@for_each("text", ["", "1", "1/1", "2/2", "-1/2", "0/0", "0/1/2", "a/b", "0/10001",
                                  "1 / 2", "0/" + "9" * 30, "²/3"])  # fmt: skip
def test_what_is_no_shard_is_refused(text: str) -> None:
    assert refusal(parse_shard, text, "--shard").field == "--shard"


def test_shards_share_all_vehicles() -> None:
    vehicles = [f"v{number:04d}" for number in range(1, 200)]
    parts = [members_of(f"{index}/3", vehicles) for index in range(3)]
    assert sorted(name for part in parts for name in part) == vehicles
    assert parts[1] == tuple(name for name in vehicles if Shard(1, 3).contains(name))
    assert members_of(("x", "y"), vehicles) == ("x", "y")
