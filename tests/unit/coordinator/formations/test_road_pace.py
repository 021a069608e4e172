"""The pace of the road: road time per second of a coordinator's own clock."""

from __future__ import annotations

import pytest

from laneweave.coordinator.formations.road_pace import EVERY_S, SLOWEST, RoadPace


def heard(pace: float, ticks: int = 100, t_s: float = 0.0) -> RoadPace:
    """Return a measurement from a clock message every 0.1 s of road time at this pace."""
    measure = RoadPace()
    for tick in range(ticks):
        measure.on_clock(t_s + 0.1 * tick, 50.0 + 0.1 * tick / pace)
    return measure


@pytest.mark.parametrize("pace", [0.5, 1.0, 2.5])
def test_road_time_takes_less_the_faster_the_road_is(pace: float) -> None:
    measure = heard(pace)
    assert measure.pace == pytest.approx(pace)
    assert measure.node_s(20.0) == pytest.approx(20.0 / pace)


def test_before_it_is_measured_road_time_is_real_time() -> None:
    assert heard(3.0, ticks=5).node_s(4.0) == pytest.approx(4.0)


def test_a_road_that_stands_still_is_not_waited_for_without_end() -> None:
    measure = RoadPace()
    for now_s in (0.0, EVERY_S, 2 * EVERY_S):
        measure.on_clock(7.0, now_s)
    assert measure.node_s(1.0) == pytest.approx(1.0 / SLOWEST)


def test_another_road_begins_a_measurement_of_its_own() -> None:
    measure = heard(2.0)
    measure.on_clock(0.0, 1000.0)
    measure.on_clock(EVERY_S, 1000.0 + EVERY_S)
    assert measure.pace == pytest.approx(1.0)
