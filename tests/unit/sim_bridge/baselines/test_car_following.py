"""Car following of the rule-based method keeps its gap, its limits, and room to brake."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.sim_bridge.baselines.rules import Following
from support.examples import examples
from support.rule_road import PAPER, rule_scenario

SPEEDS = st.floats(0.0, 15.0)
TICK_S = 0.1


def moved(s_m: float, speed_mps: float, wanted_mps: float) -> tuple[float, float]:
    """Return where a vehicle is after a tick in which it brakes no harder than 10 m/s2."""
    new_mps = max(wanted_mps, speed_mps - 1.0, 0.0)
    return s_m + 0.5 * (speed_mps + new_mps) * TICK_S, new_mps


def test_the_gap_is_the_one_of_the_paper_and_the_net_gap_has_a_body_more() -> None:
    paper, net = Following(PAPER), Following(rule_scenario(gap="net"))
    assert paper.gap_m(15.0) == pytest.approx(5.0 + 15.0 * 0.66)
    # Front to front d_0 is no more than a body: bumpers must not touch.
    assert paper.gap_m(0.0) == pytest.approx(5.0 + 1.0)
    assert net.gap_m(15.0) == pytest.approx(5.0 + 5.0 + 15.0 * 0.66)
    assert net.gap_m(0.0) == pytest.approx(5.0 + 5.0)


def test_a_vehicle_at_its_gap_keeps_its_speed() -> None:
    following = Following(PAPER)
    ahead_m = following.gap_m(12.0) + 12.0 * TICK_S
    assert following.speed_mps(0.0, 12.0, ahead_m, 12.0) == pytest.approx(12.0)


def test_a_small_gap_or_one_behind_a_slow_vehicle_does_not_suit() -> None:
    following = Following(PAPER)
    assert following.is_safe(0.0, 15.0, 14.91, 15.0)
    assert not following.is_safe(0.0, 15.0, 14.89, 15.0)
    # 14.91 m are the headway, but 11.25 m to stop and a body do not fit in.
    assert not following.is_safe(0.0, 15.0, 14.91, 0.0)


@examples(100)
@given(
    gap=st.sampled_from(["front-to-front", "net"]),
    speed_mps=SPEEDS,
    ahead_mps=SPEEDS,
    more_m=st.floats(0.0, 30.0),
    wishes=st.lists(st.floats(-10.0, 5.0), min_size=1, max_size=80),
)
def test_following_from_a_suitable_gap_never_touches(
    gap: str, speed_mps: float, ahead_mps: float, more_m: float, wishes: list[float]
) -> None:
    following = Following(rule_scenario(gap=gap))
    s_m, ahead_m = 0.0, following.gap_m(speed_mps) + more_m
    if not following.is_safe(s_m, speed_mps, ahead_m, ahead_mps):
        return
    for accel in wishes:
        ahead_m, ahead_mps = moved(ahead_m, ahead_mps, min(ahead_mps + accel * TICK_S, 15.0))
        safe_mps = following.speed_mps(s_m, speed_mps, ahead_m, ahead_mps)
        s_m, speed_mps = moved(s_m, speed_mps, min(safe_mps, 15.0, speed_mps + 0.5))
        # Stopping within a tick takes up to b dt^2 / 8 more than braking to the end.
        assert ahead_m - s_m - 5.0 >= 1.0 - 0.05


@given(speed_mps=SPEEDS, ahead_mps=SPEEDS, distance_m=st.floats(-5.0, 100.0))
def test_a_speed_is_never_negative_and_grows_with_the_distance(
    speed_mps: float, ahead_mps: float, distance_m: float
) -> None:
    following = Following(PAPER)
    near = following.speed_mps(0.0, speed_mps, distance_m, ahead_mps)
    far = following.speed_mps(0.0, speed_mps, distance_m + 1.0, ahead_mps)
    assert 0.0 <= near <= far
