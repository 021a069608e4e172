"""Overlaps, gaps and sensing against brute force."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from laneweave.protocol.road_layout import TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Neighbour
from laneweave.sim_bridge.bodies import overlaps_and_gaps as overlap
from laneweave.sim_bridge.bodies.overlaps_and_gaps import (
    Bodies,
    MinGaps,
    Neighbours,
    Pose,
    Size,
    corners,
    pose_of,
)
from support.examples import examples

LENGTH_M, WIDTH_M, LANE_M = 5.0, 1.8, 3.5
TRUCK: Size = (12.0, 2.5)

HEADINGS = st.one_of(st.just(0.0), st.floats(-math.pi / 4, math.pi / 4))
POSES: st.SearchStrategy[Pose] = st.tuples(
    st.floats(0.0, 30.0), st.floats(0.9, 9.6), HEADINGS, st.floats(0.0, 25.0)
)


def named(poses: list[Pose], trucks: list[bool]) -> dict[str, Pose]:
    """Return poses by name; names of trucks begin with a t."""
    return {
        f"{'t' if truck else 'v'}{number}": pose
        for number, (pose, truck) in enumerate(zip(poses, trucks, strict=False))
    }


TRUCKS = st.lists(st.booleans(), min_size=8, max_size=8)
ROADS = st.builds(named, st.lists(POSES, min_size=2, max_size=8), TRUCKS)


def size_of(name: str) -> Size:
    return TRUCK if name.startswith("t") else (LENGTH_M, WIDTH_M)


def bodies(road: dict[str, Pose]) -> Bodies:
    trucks = {name: TRUCK for name in road if name.startswith("t")}
    return Bodies(road, LENGTH_M, WIDTH_M, trucks)


def grid_in(
    pose: Pose, size: Size, points: int = 61
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Points of a body, its border included, shape (points^2, 2)."""
    front_right, front_left, _, rear_right = (np.array(p) for p in corners(pose, *size))
    shares = np.linspace(0.0, 1.0, points)
    along = (front_right - rear_right)[None, None, :] * shares[:, None, None]
    across = (front_left - front_right)[None, None, :] * shares[None, :, None]
    return np.asarray((rear_right + along + across).reshape(-1, 2))


def depth(
    pose: Pose, size: Size, points: np.ndarray[tuple[int, int], np.dtype[np.float64]]
) -> float:
    """Depth of the deepest of some points in a body in m, negative if none is inside."""
    s, y, heading, _ = pose
    length_m, width_m = size
    x, z = points[:, 0] - (s - length_m / 2 * math.cos(heading)), points[:, 1] - y
    along = np.abs(x * math.cos(heading) + z * math.sin(heading))
    across = np.abs(z * math.cos(heading) - x * math.sin(heading))
    return float(np.minimum(length_m / 2 - along, width_m / 2 - across).max())


@pytest.mark.slow
@given(ROADS)
@examples(150)
def test_overlaps_agree_with_point_sampling(road: dict[str, Pose]) -> None:
    found = set(bodies(road).overlapping_pairs())
    for one, other in itertools.combinations(sorted(road), 2):
        size, other_size = size_of(one), size_of(other)
        deepest = max(
            depth(road[one], size, grid_in(road[other], other_size)),
            depth(road[other], other_size, grid_in(road[one], size)),
        )
        if deepest > 1e-6:
            assert (one, other) in found
        if (one, other) in found:
            # A grid of 61 x 61 points misses at most slivers thinner than its mesh.
            assert deepest > -0.2


def test_touching_is_not_overlapping() -> None:
    def pairs(second: Pose) -> list[tuple[str, str]]:
        return bodies({"b": (20.0, 1.75, 0.0, 15.0), "a": second}).overlapping_pairs()

    assert pairs((25.0, 1.75, 0.0, 15.0)) == []
    assert pairs((24.999, 1.75, 0.0, 15.0)) == [("a", "b")]
    assert pairs((20.0, 1.75 + WIDTH_M, 0.0, 15.0)) == []
    assert pairs((20.0, 1.749 + WIDTH_M, 0.0, 15.0)) == [("a", "b")]
    assert pairs((20.0, 1.75, 0.0, 15.0)) == [("a", "b")]


def test_corners_of_a_rotated_body_match_its_pose() -> None:
    pose = (20.0, 5.0, 0.3, 15.0)
    shape = np.array(corners(pose, LENGTH_M, WIDTH_M))
    assert shape.mean(axis=0) == pytest.approx([20.0 - LENGTH_M / 2 * math.cos(0.3), 5.0])
    assert shape[:2].mean(axis=0)[0] == pytest.approx(20.0)
    assert np.linalg.norm(shape[0] - shape[1]) == pytest.approx(WIDTH_M)
    assert np.linalg.norm(shape[1] - shape[2]) == pytest.approx(LENGTH_M)


def brute_gap(road: dict[str, Pose]) -> float:
    """The least shift along the road that makes two bodies touch, from slices across the road."""
    least = math.inf
    for pair in itertools.combinations(road, 2):
        slices = []
        shapes = [np.array(corners(road[name], *size_of(name))) for name in pair]
        low = max(shape[:, 1].min() for shape in shapes)
        high = min(shape[:, 1].max() for shape in shapes)
        if high - low < 1e-6:
            continue
        for y in np.linspace(low, high, 400):
            ranges = []
            for shape in shapes:
                crossing = []
                for (x0, y0), (x1, y1) in zip(shape, np.roll(shape, 1, axis=0), strict=True):
                    if abs(y1 - y0) < 1e-12:
                        crossing += [x0, x1] if abs(y - y0) < 1e-9 else []
                    elif min(y0, y1) - 1e-12 <= y <= max(y0, y1) + 1e-12:
                        crossing.append(x0 + (y - y0) / (y1 - y0) * (x1 - x0))
                ranges.append((min(crossing), max(crossing)))
            slices.append((ranges[1][0] - ranges[0][1], ranges[0][0] - ranges[1][1]))
        least = min(least, max(np.array(slices).min(axis=0)))
    return least


@pytest.mark.slow
@given(st.lists(POSES, min_size=2, max_size=4), TRUCKS)
@example(
    [(16.0, 5.0, 0.0, 0.0), (0.0, 4.0, 0.5, 0.0), (1.0, 1.0, 0.5, 0.0)], [True, True] + [False] * 6
).via("the gap behind the body next ahead exceeds the distance of the fronts")
@examples(25)
def test_least_gap_agrees_with_slices(poses: list[Pose], trucks: list[bool]) -> None:
    poses = [(s, y, 0.0 if abs(heading) < 1e-3 else heading, v) for s, y, heading, v in poses]
    road = named(poses, trucks)
    gap = bodies(road).min_gaps().gap_m
    expected = brute_gap(road)
    if math.isinf(expected):
        assert math.isinf(gap) or len(poses) > 2 or gap > -1e9
    else:
        # The slices miss corners by up to a mesh width.
        assert gap == pytest.approx(expected, abs=0.1)


@given(ROADS)
@examples(150)
def test_a_negative_gap_means_an_overlap(road: dict[str, Pose]) -> None:
    gap = bodies(road).min_gaps().gap_m
    overlaps = bool(bodies(road).overlapping_pairs())
    if abs(gap) > 1e-6:
        assert (gap < 0.0) == overlaps


def test_gap_and_headway_of_a_simple_queue() -> None:
    assert bodies({}).min_gaps() == MinGaps(math.inf, math.inf)
    beside = {"a": (10.0, 1.75, 0.0, 15.0), "b": (10.0, 5.25, 0.0, 15.0)}
    assert bodies(beside).min_gaps() == MinGaps(math.inf, math.inf)
    road = {
        "first": (100.0, 1.75, 0.0, 10.0),
        "second": (85.0, 1.75, 0.0, 15.0),
        "third": (76.0, 1.75, 0.0, 5.0),
        "other lane": (84.0, 5.25, 0.0, 15.0),
    }
    assert bodies(road).min_gaps() == MinGaps(4.0, 1.0)


def sense(
    road: dict[str, Pose], accels_mps2: dict[str, float] | None = None
) -> dict[str, Neighbours]:
    seen = bodies(road).exact_neighbours(3, LANE_M, accels_mps2 or {})
    return {
        name: Neighbours(*(tuple(Neighbour(*each) for each in others) for others in sides))
        for name, sides in seen.items()
    }


def test_bodies_of_different_sizes_touch_where_they_do() -> None:
    def pairs(car: Pose, truck: Pose) -> list[tuple[str, str]]:
        return bodies({"v": car, "t": truck}).overlapping_pairs()

    car = (20.0, 1.75, 0.0, 15.0)
    assert pairs(car, (32.0, 1.75, 0.0, 15.0)) == []
    assert pairs(car, (31.999, 1.75, 0.0, 15.0)) == [("t", "v")]
    assert pairs(car, (15.0, 1.75, 0.0, 15.0)) == []
    assert pairs(car, (15.001, 1.75, 0.0, 15.0)) == [("t", "v")]
    assert pairs(car, (20.0, 1.75 + 2.15, 0.0, 15.0)) == []
    assert pairs(car, (20.0, 1.749 + 2.15, 0.0, 15.0)) == [("t", "v")]
    assert bodies({"v": car, "t": (40.0, 1.75, 0.0, 15.0)}).min_gaps().gap_m == 8.0
    assert bodies({"v": car, "t": (10.0, 1.75, 0.0, 15.0)}).min_gaps().gap_m == 5.0


def test_a_closed_part_keeps_its_name_while_others_open() -> None:
    bodies, scenario = overlap.Bodies({"v1": (510.0, 1.75, 0.0, 0.0)}, 5.0, 1.8), Scenario()
    left, right = TemporaryClosure(2, 100.0, 200.0), TemporaryClosure(0, 500.0, 600.0)
    for closed in ((left, right), (right,)):
        assert bodies.in_closed_lanes(scenario, closed) == [("closure-0-500", "v1")]


def test_sensing_sees_how_others_accelerate() -> None:
    road = {"first": (120.0, 1.75, 0.0, 14.0), "ego": (100.0, 1.75, 0.0, 15.0)}
    seen = sense(road, {"first": -2.5, "ego": 1.5})
    assert seen["ego"].ahead == (Neighbour(0, 15.0, 14.0, -2.5),)
    assert seen["first"].behind == (Neighbour(0, 15.0, 15.0, 1.5),)
    assert sense(road)["ego"].ahead == (Neighbour(0, 15.0, 14.0, 0.0),)


@given(ROADS)
@examples(100)
def test_sensing_agrees_with_brute_force(road: dict[str, Pose]) -> None:
    seen = sense(road)
    lanes_of = {}
    for name, pose in road.items():
        ys = [y for _, y in corners(pose, *size_of(name))]
        low, high = int((min(ys) + 1e-9) // LANE_M), int((max(ys) - 1e-9) // LANE_M)
        low = min(max(low, 0), 2)
        lanes_of[name] = range(low, min(max(high, low), 2) + 1)
    for name in road:
        ahead, behind = {}, {}
        own = road[name][0], name
        for lane in range(max(lanes_of[name].start - 1, 0), min(lanes_of[name].stop + 1, 3)):
            there = [(road[other][0], other) for other in road if lane in lanes_of[other]]
            front = [each for each in there if each > own]
            back = [each for each in there if each < own]
            if front:
                rear_m, _, other = min(
                    (front_m - size_of(other)[0], front_m, other) for front_m, other in front
                )
                ahead[lane] = (rear_m - own[0], road[other][3])
            if back:
                nearest_m, other = max(back)
                behind[lane] = (own[0] - size_of(name)[0] - nearest_m, road[other][3])
        for found, expected in ((seen[name].ahead, ahead), (seen[name].behind, behind)):
            assert [other.lane for other in found] == sorted(expected)
            assert {other.lane: other.gap_m for other in found} == pytest.approx(
                {lane: gap_m for lane, (gap_m, _) in expected.items()}
            )
            assert {other.lane: other.speed_mps for other in found} == {
                lane: speed_mps for lane, (_, speed_mps) in expected.items()
            }


def test_heading_points_where_the_body_goes() -> None:
    assert pose_of((10.0, 15.0, 1.0, 2.0, 1.5, 0.0)) == (10.0, 2.0, math.atan2(1.5, 15.0), 15.0)
    assert pose_of((10.0, 0.0, 0.0, 2.0, 0.0, 0.0))[2] == 0.0
    # Whatever noise does to a body that stands, it does not turn into the next lane.
    assert abs(pose_of((10.0, 0.01, 0.0, 2.0, 0.0025, 0.0))[2]) < 0.01
    assert pose_of((10.0, 1.0, 0.0, 2.0, 0.25, 0.0))[2] == math.atan2(0.25, 1.0)


def steps_taken(work: Callable[[], object]) -> int:
    """Return how many lines of the module under test some work runs through."""
    taken = 0

    def trace(frame: FrameType, event: str, _: object) -> Callable[..., Any] | None:
        nonlocal taken
        taken += event == "line"
        return trace if frame.f_code.co_filename == overlap.__file__ else None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return taken


@pytest.mark.parametrize(
    "work", [Bodies.overlapping_pairs, Bodies.min_gaps, Bodies.exact_neighbours]
)
def test_the_effort_grows_with_the_vehicles_and_not_with_their_pairs(
    work: Callable[..., object],
) -> None:
    def steps(vehicles: int) -> int:
        road = {f"v{n:04d}": (11.0 * n, (n % 3 + 0.5) * LANE_M, 0.1, 15.0) for n in range(vehicles)}
        more: tuple[object, ...] = (3, LANE_M, {}) if work is Bodies.exact_neighbours else ()
        return steps_taken(lambda: work(bodies(road), *more))

    few = steps(90)
    assert 90 < few < 100_000
    assert steps(360) < 5 * few
