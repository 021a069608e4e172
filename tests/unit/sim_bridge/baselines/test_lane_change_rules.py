"""Rules 1 to 3 of the rule-based method: lane changes and slowing down."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.sim_bridge.baselines.reference_road import ReferenceVehicle
from laneweave.sim_bridge.baselines.rules import Lanes, Rules
from support.rule_road import PAPER, rule_scenario, vehicle
from support.tables import for_each

NEEDED_M = 5.0 + 15.0 * 0.66


def lanes_of(*vehicles: ReferenceVehicle) -> Lanes:
    lanes = Lanes(3)
    for one in vehicles:
        lanes.enter(one, one.lane)
    return lanes


def sort(*vehicles: ReferenceVehicle, **rule: str) -> set[str]:
    """Apply the rules once and return the names of the vehicles that slow down."""
    return {one.name for one in Rules(rule_scenario(**rule)).sort(lanes_of(*vehicles))}


# --- rule 1 -----------------------------------------------------------------------------------


def test_no_vehicle_changes_lanes_before_s3_or_on_its_preferred_lane() -> None:
    early, sorted_one = vehicle("a", 399.0, 0, 2), vehicle("b", 600.0, 1, 1)
    assert sort(early, sorted_one) == set()
    assert (early.lane, sorted_one.lane) == (0, 1)


def test_one_lane_at_a_time_towards_the_preferred_one() -> None:
    up, down = vehicle("a", 500.0, 0, 2), vehicle("b", 700.0, 2, 0)
    assert sort(up, down) == set()
    assert (up.lane, down.lane) == (1, 1)


# --- rule 2 -----------------------------------------------------------------------------------


@for_each("side", [-1, 1])
@for_each("distance_m", [0.0, 1.0, NEEDED_M - 0.1, NEEDED_M + 0.1])
def test_a_gap_is_accepted_if_it_is_large_enough(distance_m: float, side: int) -> None:
    one, accepted = vehicle("a", 500.0, 0, 1), distance_m > NEEDED_M
    slowing = sort(one, vehicle("b", 500.0 + side * distance_m, 1))
    assert one.lane == int(accepted)
    assert not (accepted and slowing)


def test_the_speed_of_the_follower_counts() -> None:
    slow = vehicle("a", 500.0, 0, 1, speed_mps=2.0)
    sort(slow, vehicle("b", 507.0, 1), vehicle("c", 490.0, 1, speed_mps=2.0))
    assert slow.lane == 1


def test_two_do_not_take_the_same_gap() -> None:
    near, far = vehicle("a", 505.0, 0, 1), vehicle("b", 500.0, 2, 1)
    assert sort(near, far) == {"b"}
    assert (near.lane, far.lane) == (1, 2)


# --- rule 3 -----------------------------------------------------------------------------------


def test_the_vehicle_behind_yields() -> None:
    assert sort(vehicle("a", 500.0, 0, 1), vehicle("b", 495.0, 1, 2)) == {"b"}
    assert sort(vehicle("a", 500.0, 0, 1), vehicle("b", 505.0, 1, 1)) == {"a"}


def test_a_vehicle_on_its_preferred_lane_yields_only_if_all_do() -> None:
    def pair() -> tuple[ReferenceVehicle, ReferenceVehicle]:
        return vehicle("a", 500.0, 0, 1), vehicle("b", 495.0, 1, 1)

    assert sort(*pair()) == {"a"}
    assert sort(*pair(), yielding="all") == {"b"}


def test_names_break_ties_of_two_vehicles_that_swap_lanes() -> None:
    assert sort(vehicle("a", 500.0, 0, 1), vehicle("b", 500.0, 1, 0)) == {"b"}


@given(
    offsets=st.tuples(*[st.sampled_from([0.0, 0.5, 3.0])] * 3),
    preferred=st.tuples(*[st.integers(0, 2)] * 3),
)
def test_of_three_abreast_one_continues(
    offsets: tuple[float, float, float], preferred: tuple[int, int, int]
) -> None:
    """The first one does not slow down."""
    abreast = [
        vehicle(f"v{lane}", 700.0 + offsets[lane], lane, preferred[lane]) for lane in range(3)
    ]
    slowing = sort(*abreast, yielding="all")
    first = min(abreast, key=lambda one: (-one.s_m, one.name))
    assert first.name not in slowing
    assert len(slowing) < 3


def test_the_slow_speed_falls_to_nothing_at_the_stop_distance() -> None:
    rules = Rules(PAPER)
    assert rules.slow_speed_mps(300.0, 1000.0) == 15.0
    assert rules.slow_speed_mps(400.0, 1000.0) == 15.0
    assert rules.slow_speed_mps(625.0, 1000.0) == pytest.approx(7.5)
    assert rules.slow_speed_mps(850.0, 1000.0) == rules.slow_speed_mps(990.0, 1000.0) == 0.0


def test_a_vehicle_on_another_lane_approaches_the_end_slowly() -> None:
    rules = Rules(PAPER)
    assert rules.approach_speed_mps(vehicle("a", 990.0, 1, 1)) == 15.0
    assert rules.approach_speed_mps(vehicle("a", 850.0, 0, 2)) == 15.0
    assert rules.approach_speed_mps(vehicle("a", 985.0, 0, 1)) == pytest.approx(1.5)
    assert rules.approach_speed_mps(vehicle("a", 1000.0, 0, 1)) == 0.0


def test_lane_changes_that_take_time_must_begin_earlier() -> None:
    rules = Rules(rule_scenario(lane_change_s=4.0))
    assert rules.approach_speed_mps(vehicle("a", 940.0, 0, 1)) == 0.0
    assert rules.approach_speed_mps(vehicle("a", 880.0, 0, 2)) == 0.0
    assert rules.approach_speed_mps(vehicle("a", 880.0, 0, 1)) == pytest.approx(6.0)
