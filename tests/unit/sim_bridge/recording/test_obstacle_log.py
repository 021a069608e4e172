"""To which closed part a stop is attributed."""

from __future__ import annotations

from laneweave.protocol.wire.events import (
    ENTERED_LATTICE,
    LEFT_LATTICE,
    PART_CLOSED,
    PART_OPENED,
)
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.obstacle_messages import BREAKDOWN, PASSING, Obstacle
from laneweave.sim_bridge.recording.obstacle_log import ObstacleLog

NEAR = Obstacle(1, 600.0, 700.0, since_s=50.0)
FAR = Obstacle(1, 800.0, 900.0, since_s=40.0)
FAST = Obstacle(1, 0.0, 7.0, cause=PASSING, since_s=60.0, vehicle=Name("other-1"), speed_mps=25.0)


def log_of(*parts: Obstacle) -> ObstacleLog:
    log = ObstacleLog()
    for part in parts:
        log.on_obstacle(part.since_s, PART_CLOSED, part)
    return log


def stops(log: ObstacleLog) -> list[tuple[int, float]]:
    return [(one.stopped, one.waited_s) for one in log.figures or ()]


def test_a_vehicle_stops_for_the_next_part_ahead() -> None:
    log = log_of(FAR, NEAR, FAST)
    for name, s_m in (("v1", 590.0), ("v2", 750.0)):
        log.on_lane_end(65.0, Name(name), 1, LEFT_LATTICE, s_m)
    log.on_lane_end(65.0, Name("v3"), 0, LEFT_LATTICE, 590.0)  # in another lane
    log.on_lane_end(95.0, Name("v1"), 1, ENTERED_LATTICE, 595.0)
    assert stops(log) == [(1, 0.0), (1, 30.0), (0, 0.0)]


def test_a_vehicle_that_stops_twice_before_it_has_a_cell_waits_all_the_time() -> None:
    log = log_of(NEAR)
    for t_s in (60.0, 90.0):
        log.on_lane_end(t_s, Name("v1"), 1, LEFT_LATTICE, 590.0)
    log.on_lane_end(100.0, Name("v1"), 1, ENTERED_LATTICE, 595.0)
    assert stops(log) == [(1, 40.0)]
    log.on_lane_end(110.0, Name("v1"), 1, LEFT_LATTICE, 592.0)
    log.on_lane_end(115.0, Name("v1"), 1, ENTERED_LATTICE, 595.0)
    assert stops(log) == [(1, 45.0)]


def test_a_part_may_be_closed_in_the_tick_in_which_another_one_is_opened() -> None:
    later = Obstacle(1, 600.0, 650.0, since_s=200.0)
    log = log_of(NEAR, later)
    log.on_obstacle(200.0, PART_OPENED, NEAR)
    log.on_obstacle(300.0, PART_OPENED, later)
    assert [(one.to_m, one.since_s, one.opened_s) for one in log.figures or ()] == [
        (700.0, 50.0, 200.0),
        (650.0, 200.0, 300.0),
    ]


def test_beyond_closed_parts_a_passing_vehicle_is_the_cause() -> None:
    log = log_of(NEAR, FAST)
    log.on_lane_end(65.0, Name("v1"), 1, LEFT_LATTICE, 720.0)
    assert stops(log) == [(0, 0.0), (1, 0.0)]
    log.on_obstacle(70.0, PART_OPENED, FAST)
    log.on_lane_end(75.0, Name("v2"), 1, LEFT_LATTICE, 720.0)
    assert stops(log) == [(0, 0.0), (1, 0.0)]


def test_a_vehicle_that_has_broken_down_stops_for_no_part() -> None:
    broken = Obstacle(1, 390.0, 405.0, cause=BREAKDOWN, since_s=55.0, vehicle=Name("v1"))
    log = log_of(NEAR, broken)
    log.on_lane_end(56.0, Name("v1"), 1, LEFT_LATTICE, 395.0)
    assert stops(log) == [(0, 0.0), (0, 0.0)]
