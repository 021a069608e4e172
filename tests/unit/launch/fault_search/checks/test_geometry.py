"""Bodies of the checker: what they occupy, and when two of them overlap."""

import math
import random

import pytest

from laneweave.launch.fault_search.checks.geometry import Body, Geometry, overlap_between

GEOMETRY = Geometry(pitch_m=15.0, lane_width_m=3.5, length_m=5.0, width_m=1.8)
Cell = tuple[int, int]


def body(
    cell: Cell, target: Cell | None = None, begin_s: float = 0.0, lasts_s: float = 1.0
) -> Body:
    made = Body.standing(GEOMETRY, cell, 0.0)
    if target is not None:
        made.go(target, begin_s, lasts_s)
    return made


def test_a_motion_takes_its_time() -> None:
    moving = body((0, 0), (1, 1), begin_s=2.0, lasts_s=4.0)
    assert moving.at(1.0) == moving.at(2.0) == (0.0, 1.75)
    assert moving.at(3.0) == pytest.approx((3.75, 2.625))
    assert moving.at(6.0) == moving.at(9.0) == (15.0, 5.25)


@pytest.mark.parametrize(
    ("origin", "target", "cells"),
    [
        ((2, 1), (2, 1), {(2, 1)}),
        ((2, 1), (3, 1), {(2, 1), (3, 1)}),
        ((2, 1), (2, 0), {(2, 1), (2, 0)}),
        ((-2, 1), (-3, 2), {(-2, 1), (-3, 2), (-2, 2), (-3, 1)}),
    ],
)
def test_a_motion_occupies_its_bounding_box(origin: Cell, target: Cell, cells: set[Cell]) -> None:
    assert body(origin, target).cells == cells


def test_a_body_that_turns_round_half_way_occupies_both_cells() -> None:
    moving = body((0, 0), (1, 0), lasts_s=2.0)
    moving.go((0, 0), 1.0, 1.0)
    assert moving.at(1.0) == pytest.approx((7.5, 1.75))
    assert moving.cells == {(0, 0), (1, 0)}


def test_a_body_that_has_nearly_arrived_occupies_only_its_cell() -> None:
    moving = body((0, 0), (0, 1), lasts_s=1.0)
    moving.go((1, 1), 0.99, 1.0)  # 35 mm before the middle of the lane
    assert moving.cells == {(0, 1), (1, 1)}


@pytest.mark.parametrize("target", [(1, 0), (0, 1), (1, 1)])
def test_a_motion_is_done_shortly_before_its_end(target: Cell) -> None:
    moving = body((0, 0), target, begin_s=1.0, lasts_s=0.8)
    x_m, y_m = moving.at(moving.done_s)
    assert abs(x_m - moving.target[0]) <= 1.0 + 1e-9
    assert abs(y_m - moving.target[1]) <= 0.5 + 1e-9
    assert 1.6 < moving.done_s < 1.8


def test_a_body_at_rest_is_done() -> None:
    assert body((3, 3)).done_s == 0.0


def test_exact_against_small_steps() -> None:
    rng = random.Random(1)
    found = 0
    for _ in range(300):
        pair = [
            body(
                (rng.randint(0, 2), rng.randint(0, 1)),
                (rng.randint(0, 2), rng.randint(0, 1)),
                rng.uniform(0.0, 1.0),
                rng.uniform(0.5, 2.0),
            )
            for _ in range(2)
        ]
        at_s = overlap_between(pair[0], pair[1], 1.0, 3.0)
        times = [1.0 + step * 0.001 for step in range(2001)]
        stepped_s = next((t_s for t_s in times if _overlap(pair[0], pair[1], t_s)), math.inf)
        if at_s is None:
            assert stepped_s == math.inf
        else:
            found += 1
            assert at_s <= stepped_s
            assert _overlap(pair[0], pair[1], at_s, margin_m=1e-6)
            assert stepped_s - at_s < 0.0011 or stepped_s == math.inf
    assert found > 50


def _overlap(one: Body, other: Body, t_s: float, margin_m: float = 0.0) -> bool:
    (x_m, y_m), (u_m, w_m) = one.at(t_s), other.at(t_s)
    along_m, across_m = abs(x_m - u_m) - margin_m, abs(y_m - w_m) - margin_m
    return along_m < GEOMETRY.length_m and across_m < GEOMETRY.width_m
