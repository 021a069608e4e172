"""The pace of the road: road time per second of a coordinator's own clock."""

from __future__ import annotations

import pytest

from laneweave.coordinator.formations.formation_planner import MIN_PACE, PACE_WINDOW_S, RoadPace


def heard(pace: float, ticks: int = 100, t_s: float = 0.0) -> RoadPace:
    """Return a measurement from a clock message every 0.1 s of road time at this pace."""
    measure = RoadPace()
    for tick in range(ticks):
        measure.on_clock(t_s + 0.1 * tick, 50.0 + 0.1 * tick / pace)
    return measure


@pytest.mark.parametrize("pace", [0.5, 1.0, 2.5])
def test_the_pace_is_road_time_per_time_of_the_node(pace: float) -> None:
    measure = heard(pace)
    assert measure.pace == pytest.approx(pace)


def test_the_pace_is_1_before_it_is_measured() -> None:
    assert heard(3.0, ticks=5).pace == 1.0


def test_the_pace_of_a_road_that_stands_still_has_a_lower_bound() -> None:
    measure = RoadPace()
    for now_s in (0.0, PACE_WINDOW_S, 2 * PACE_WINDOW_S):
        measure.on_clock(7.0, now_s)
    assert measure.pace == MIN_PACE


def test_another_road_restarts_the_measurement() -> None:
    measure = heard(2.0)
    measure.on_clock(0.0, 1000.0)
    measure.on_clock(PACE_WINDOW_S, 1000.0 + PACE_WINDOW_S)
    assert measure.pace == pytest.approx(1.0)
