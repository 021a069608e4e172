"""Where positions on the road of a corridor are in the world."""

from __future__ import annotations

import math

import pytest

from laneweave.sim_bridge.corridors.corridor_shape import CorridorShape, _piece
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor
from support.interchange import LANE_M
from support.tables import for_each


@pytest.fixture
def shape(interchange: SumoCorridor) -> CorridorShape:
    return CorridorShape(interchange.corridor)


@for_each("s_m", [0.0, 5.0, 699.0, 700.0, 701.0, 1000.0, 1360.5, 1950.0])
@for_each("lane", [1, 2, 3])
def test_the_main_road_of_the_interchange_is_straight(
    shape: CorridorShape, s_m: float, lane: int
) -> None:
    (x, y, direction), piece = shape.at(s_m, (lane + 0.5) * LANE_M + 0.3)
    assert (x, y, direction) == pytest.approx((s_m, (lane + 0.5) * LANE_M + 0.3, 0.0), abs=1e-6)
    edges = {"main1": 1, "main2": 0, "main3": 1, "main4": 0, "main5": 1}
    assert piece.index == lane - edges[piece.edge]


def test_a_lane_with_an_exit_and_a_ramp_leads_to_both(shape: CorridorShape) -> None:
    centre_m = 0.5 * LANE_M
    (_, y, _), piece = shape.at(940.0, centre_m)
    assert piece.edge == "main2"
    assert y == pytest.approx(centre_m)
    (x, y, _), piece = shape.at(1000.0, centre_m)
    assert piece.edge == "on"
    assert (x, y) == pytest.approx((1000.0, centre_m - 40.0))
    (_, y, _), piece = shape.at(1200.0, centre_m)
    assert piece.edge == "main4"
    assert y == pytest.approx(centre_m)


def test_a_body_beside_a_closed_lane_is_drawn_beside_its_neighbour(shape: CorridorShape) -> None:
    (x, y, _), piece = shape.at(1365.0, LANE_M - 0.1)
    assert piece.edge == "main5"
    assert (x, y) == pytest.approx((1365.0, LANE_M - 0.1))


def test_a_curve_keeps_the_distance_from_the_centre_line() -> None:
    radius_m = 100.0
    points = [
        (radius_m * math.sin(angle), radius_m * (1.0 - math.cos(angle)))
        for angle in (0.5 * math.pi * n / 90.0 for n in range(91))
    ]
    piece = _piece(500.0, 600.0, points)
    for s_m in (500.0, 533.3, 599.9):
        x, y, direction = piece.at(s_m, 2.0)
        assert math.hypot(x, y - radius_m) == pytest.approx(radius_m - 2.0, abs=0.05)
        assert direction == pytest.approx((s_m - 500.0) / 100.0 * 0.5 * math.pi, abs=0.02)


def test_points_that_coincide_are_one() -> None:
    piece = _piece(0.0, 10.0, [(0.0, 0.0), (0.0, 0.0), (10.0, 0.0), (10.0, 0.0)])
    assert piece.at(5.0, 0.0) == (5.0, 0.0, 0.0)
    assert _piece(0.0, 1.0, [(3.0, 4.0), (3.0, 4.0)]).at(0.0, 0.0)[:2] == (3.0, 4.0)
