"""Arrivals: repeatable, with the headways and lane shares that the scenario asks for."""

from __future__ import annotations

import numpy as np
import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.road.demand import arrivals
from support.examples import examples


def scenario(seed: int = 1, lanes: int = 3, **demand: object) -> Scenario:
    return parse_scenario({"seed": seed, "road": {"lanes": lanes}, "demand": demand})


def test_equal_seeds_give_equal_arrivals_and_others_do_not() -> None:
    assert arrivals(scenario(7)) == arrivals(scenario(7))
    assert arrivals(scenario(7)) != arrivals(scenario(8))


@given(
    seed=st.integers(0, 2**63 - 1),
    volume=st.floats(50.0, 3600.0),
    duration=st.floats(1.0, 200.0),
    longer=st.floats(0.0, 200.0),
)
@examples(40)
def test_a_longer_stream_begins_with_the_shorter_one(
    seed: int, volume: float, duration: float, longer: float
) -> None:
    short = arrivals(scenario(seed, volume_veh_per_lane_h=volume, duration_s=duration))
    long = arrivals(scenario(seed, volume_veh_per_lane_h=volume, duration_s=duration + longer))
    assert long[: len(short)] == short
    assert all(arrival.t_s > duration for arrival in long[len(short) :])


def test_names_number_the_arrivals_in_time_order() -> None:
    stream = arrivals(scenario(3))
    assert [arrival.vehicle for arrival in stream[:3]] == ["v0001", "v0002", "v0003"]
    assert [arrival.t_s for arrival in stream] == sorted(arrival.t_s for arrival in stream)
    assert len({arrival.vehicle for arrival in stream}) == len(stream)


def test_a_lane_does_not_depend_on_the_number_of_lanes() -> None:
    two, four = arrivals(scenario(5, lanes=2)), arrivals(scenario(5, lanes=4))
    for lane in (0, 1):
        assert [a.t_s for a in two if a.lane == lane] == [a.t_s for a in four if a.lane == lane]


@pytest.mark.parametrize("volume", [1000.0, 1750.0])
def test_headways_have_the_minimum_and_the_mean_and_are_exponential(volume: float) -> None:
    stream = arrivals(scenario(11, volume_veh_per_lane_h=volume, duration_s=20_000.0))
    headways = np.concatenate([np.diff([a.t_s for a in stream if a.lane == n]) for n in range(3)])
    excess = headways - 1.0
    mean = 3600.0 / volume - 1.0
    assert excess.min() >= 0.0
    assert excess.mean() == pytest.approx(mean, rel=0.03)
    assert excess.std() == pytest.approx(mean, rel=0.04)
    assert np.median(excess) == pytest.approx(mean * np.log(2.0), rel=0.05)
    lag_one = np.corrcoef(excess[:-1], excess[1:])[0, 1]
    assert abs(lag_one) < 0.03


def test_lanes_are_independent() -> None:
    stream = arrivals(scenario(2, duration_s=4000.0))
    counts = [
        np.histogram([a.t_s for a in stream if a.lane == lane], bins=200)[0] for lane in range(3)
    ]
    correlation = np.corrcoef(counts)
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 0.25


@pytest.mark.parametrize("shares", [(), (1.0, 2.0, 1.0), (0.0, 1.0, 0.0)])
def test_preferences_follow_the_lane_shares(shares: tuple[float, ...]) -> None:
    chosen = scenario(4, duration_s=20_000.0, lane_shares=list(shares))
    stream = arrivals(chosen)
    for lane in range(3):
        mine = [arrival.preferred_lane for arrival in stream if arrival.lane == lane]
        for preferred, share in enumerate(chosen.flow.lane_shares):
            assert mine.count(preferred) / len(mine) == pytest.approx(share, abs=0.02)


def test_a_volume_at_the_least_headway_is_regular() -> None:
    stream = arrivals(scenario(1, lanes=1, volume_veh_per_lane_h=3600.0, duration_s=10.5))
    assert [arrival.t_s for arrival in stream] == pytest.approx(range(1, 11))
    assert {arrival.preferred_lane for arrival in stream} == {0}


def test_types_have_their_shares_and_change_nothing_else() -> None:
    base = {
        "demand": {"volume_veh_per_lane_h": 2000.0, "duration_s": 3000.0},
        "formation": {"operation": "rolling", "gap_m": 20.0},
    }
    types = [{"name": "truck", "share": 0.15}, {"name": "van", "share": 0.3}]
    drawn = arrivals(parse_scenario({**base, "vehicle_type": types}))
    counts = {name: sum(one.vehicle_type == name for one in drawn) for name in ("truck", "van")}
    assert counts["truck"] / len(drawn) == pytest.approx(0.15, abs=0.02)
    assert counts["van"] / len(drawn) == pytest.approx(0.3, abs=0.02)
    cars = tuple(evolve(one, vehicle_type="car") for one in drawn)
    assert cars == arrivals(parse_scenario(base))


RAMP = {
    "name": "on-ramp",
    "lane": 0,
    "at_m": 50.0,
    "merge_m": 200.0,
    "volume_veh_per_h": 900.0,
}


def road_with_ramp(demand: dict[str, object], **ramp: object) -> Scenario:
    """Return a long demand on a road with an on-ramp in lane 0 and three lanes."""
    return parse_scenario(
        {
            "road": {
                "lanes": 4,
                "s2_m": 100.0,
                "s3_m": 850.0,
                "closures": [{"lane": 0, "to_m": 50.0}, {"lane": 0, "from_m": 500.0}],
            },
            "demand": {"duration_s": 20_000.0, **demand},
            "formation": {"operation": "rolling", "gap_m": 20.0},
            "vehicle_type": [{"name": "truck", "share": 0.1}],
            "entrance": [RAMP | ramp],
        }
    )


def test_vehicles_arrive_in_lanes_by_their_shares() -> None:
    volume = 600.0
    chosen = road_with_ramp({"volume_veh_per_lane_h": volume, "arrival_shares": [0, 1, 2, 0]})
    assert list(chosen.flow.inflows) == [0, 1, 2]
    stream = arrivals(chosen)
    for lane, of_mean in ((0, 1.5), (1, 1.0), (2, 2.0), (3, 0.0)):
        count = sum(one.lane == lane for one in stream)
        expected = of_mean * volume * chosen.demand.duration_s / 3600.0
        assert count == pytest.approx(expected, rel=0.05)


def test_an_entrance_has_shares_of_its_own() -> None:
    same = road_with_ramp({"lane_shares": [0, 1, 1, 2]})
    own = road_with_ramp(
        {"lane_shares": [0, 1, 1, 2]},
        lane_shares=[0, 4, 0, 1],
        vehicle_types=[{"type": "truck", "share": 0.4}],
    )
    before, after = arrivals(same), arrivals(own)
    assert [one for one in before if one.lane] == [one for one in after if one.lane]
    for stream, preferring, trucks in (
        (before, (0, 0.25, 0.25, 0.5), 0.1),
        (after, (0, 0.8, 0, 0.2), 0.4),
    ):
        ramp = [one for one in stream if one.lane == 0]
        for lane, share in enumerate(preferring):
            count = sum(one.preferred_lane == lane for one in ramp)
            assert count / len(ramp) == pytest.approx(share, abs=0.03)
        count = sum(one.vehicle_type == "truck" for one in ramp)
        assert count / len(ramp) == pytest.approx(trucks, abs=0.03)


def test_no_vehicle_arrives_in_or_prefers_a_lane_in_which_its_type_may_not_drive() -> None:
    found = parse_scenario(
        {
            "formation": {"operation": "rolling"},
            "demand": {"duration_s": 3000.0},
            "vehicle_type": [{"name": "truck", "share": 0.2}],
            "road": {
                "restrictions": [
                    {"lane": 2, "vehicle_types": ["truck"], "to_m": 500.0},
                    {"lane": 1, "vehicle_types": ["truck"], "from_m": 500.0},
                    {"lane": 0, "vehicle_types": ["car"], "to_m": 500.0},
                ]
            },
        }
    )
    stream = arrivals(found)
    trucks = [one for one in stream if one.vehicle_type == "truck"]
    cars = [one for one in stream if one.vehicle_type == "car"]
    assert {one.lane for one in trucks} == {0, 1}
    assert {one.preferred_lane for one in trucks} == {0, 2}
    assert {one.lane for one in cars} == {1, 2}
    assert {one.preferred_lane for one in cars} == {0, 1, 2}
    assert len(trucks) / len(stream) == pytest.approx(0.2, abs=0.02)
    assert len(stream) == pytest.approx(2500, rel=0.05)
