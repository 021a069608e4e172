"""Where bodies are on the road, whether they overlap, how close they are, and what they see.

A vehicle's body is a rectangle of its length L and width W. Its pose says

    s        where the middle of its front bumper is along the road,
    y        where its body's centre is across the road,
    heading  the angle of its body, atan2(v_y, v): a body points where it goes.

So the body's centre is (s - L/2 cos heading, y). The overlap test is exact for these rectangles. It
is the ground truth of a run's safety; SUMO's collision list misses pairs that overlap between two
lanes and is only a second opinion.

Everything here sorts the vehicles along the road once and looks at near ones only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from laneweave.protocol.messages import Neighbour

Pose = tuple[float, float, float, float]
"""(s m, y m, heading rad, speed m/s)."""

_Point = tuple[float, float]

_TOUCH_M = 1e-9
"""Bodies that touch do not overlap, and a body that touches a lane border is not across it."""


class LeastGaps(NamedTuple):
    """The closest that any two vehicles are, one behind the other; infinite if there are none."""

    gap_m: float
    """Bumper to bumper, along the road."""
    headway_s: float
    """Distance front to front divided by the speed of the follower."""


class Around(NamedTuple):
    """Whom a vehicle sees, by lane."""

    ahead: tuple[Neighbour, ...]
    behind: tuple[Neighbour, ...]


NOBODY_AROUND = Around((), ())


def pose_of(state: Sequence[float]) -> Pose:
    """Return the pose of a vehicle state (s, v, a, y, v_y, a_y)."""
    s_m, v_mps, _, y_m, v_y_mps, _ = state
    return s_m, y_m, math.atan2(v_y_mps, max(v_mps, 0.0)), v_mps


def corners(pose: Pose, length_m: float, width_m: float) -> tuple[_Point, _Point, _Point, _Point]:
    """Return a body's corners (x, y): front right, front left, rear left, rear right.

    In metres; x along the road from its start, y across it from the right edge.
    """
    s_m, y_m, heading, _ = pose
    cosine, sine = math.cos(heading), math.sin(heading)
    along_x, along_y = length_m * cosine, length_m * sine
    across_x, across_y = -0.5 * width_m * sine, 0.5 * width_m * cosine
    front_y, rear_y = y_m + 0.5 * along_y, y_m - 0.5 * along_y
    return (
        (s_m - across_x, front_y - across_y),
        (s_m + across_x, front_y + across_y),
        (s_m - along_x + across_x, rear_y + across_y),
        (s_m - along_x - across_x, rear_y - across_y),
    )


def overlapping_pairs(
    poses: Mapping[str, Pose], length_m: float, width_m: float
) -> list[tuple[str, str]]:
    """Return all pairs of vehicles whose bodies overlap.

    Args:
        poses: pose of each vehicle.
        length_m: length of every body.
        width_m: width of every body.

    Returns:
        Sorted pairs of names, the lesser name first. Bodies that merely touch are not among them.
    """
    reach_m = math.hypot(length_m, width_m)
    pairs = []
    for follower, leader in _near_pairs(poses, length_m + width_m):
        one, other = poses[follower], poses[leader]
        if abs(one[1] - other[1]) < reach_m and _intersect(one, other, length_m, width_m):
            pairs.append((min(follower, leader), max(follower, leader)))
    return sorted(pairs)


def least_gaps(poses: Mapping[str, Pose], length_m: float, width_m: float) -> LeastGaps:
    """Return the least gap and the least time headway between vehicles in line.

    Two vehicles are in line if their bodies overlap laterally. The gap is how far the one behind
    would have to move along the road to touch the other: exact for rotated bodies, negative if and
    only if the bodies overlap. The one behind is the one whose front is behind.

    Args:
        poses: pose of each vehicle.
        length_m: length of every body.
        width_m: width of every body.
    """
    bodies = sorted(poses.values())
    extents = [_extent(pose, length_m, width_m) for pose in bodies]
    # Of two leaders in line the one whose front is farther can only have the lesser gap if their
    # fronts are closer than the most that rotation adds to a body.
    slack_m = length_m + width_m
    candidates = []
    least_headway = math.inf
    for index, (rear, front, low, high) in enumerate(extents):
        s_m, _, _, speed_mps = bodies[index]
        horizon_m = math.inf
        for ahead in range(index + 1, len(bodies)):
            distance_m = bodies[ahead][0] - s_m
            if distance_m > horizon_m:
                break
            other_rear, other_front, other_low, other_high = extents[ahead]
            if other_low >= high - _TOUCH_M or other_high <= low + _TOUCH_M:
                continue
            if horizon_m == math.inf:
                horizon_m = distance_m + slack_m
                if speed_mps > 0.0:
                    least_headway = min(least_headway, distance_m / speed_mps)
            candidates.append((max(other_rear - front, rear - other_front), index, ahead))
    least_gap = math.inf
    for bound_m, index, ahead in sorted(candidates):
        if bound_m >= least_gap:
            break
        least_gap = min(least_gap, _gap_m(bodies[index], bodies[ahead], length_m, width_m))
    return LeastGaps(least_gap, least_headway)


def neighbours(
    poses: Mapping[str, Pose],
    *,
    lanes: int,
    lane_width_m: float,
    length_m: float,
    width_m: float,
    accels_mps2: Mapping[str, float] | None = None,
) -> dict[str, Around]:
    """Return whom each vehicle's local sensing would see around it if it were exact.

    In each lane that its body touches or that is adjacent to such a lane, a vehicle sees the
    nearest vehicle ahead that touches the lane, and the nearest one behind. A vehicle that
    straddles two lanes is seen in both. The gap is bumper to bumper, with bodies taken as
    unrotated; it is negative for vehicles side by side, of which the one with the front ahead is
    ahead (at equal positions: the one with the greater name).

    Args:
        poses: pose of each vehicle.
        lanes: number of lanes.
        lane_width_m: width of a lane.
        length_m: length of every body.
        width_m: width of every body.
        accels_mps2: acceleration of each vehicle; None: all zero.

    Returns:
        For each vehicle at most one neighbour ahead in each lane and one behind, by lane.
    """
    order = sorted(((pose[0], name) for name, pose in poses.items()), reverse=True)
    touched = {
        name: _lanes_of(pose, lanes, lane_width_m, length_m, width_m)
        for name, pose in poses.items()
    }
    accels = accels_mps2 or {}

    def nearest(order: Iterable[tuple[float, str]], sign: float) -> dict[str, list[Neighbour]]:
        last: list[tuple[float, str] | None] = [None] * lanes
        seen = {}
        for s_m, name in order:
            first, final = touched[name]
            found = []
            for lane in range(max(first - 1, 0), min(final + 2, lanes)):
                other = last[lane]
                if other is not None:
                    gap_m = sign * (other[0] - s_m) - length_m
                    speed_mps, accel = poses[other[1]][3], accels.get(other[1], 0.0)
                    found.append(Neighbour(lane, gap_m, speed_mps, accel))
            seen[name] = found
            for lane in range(first, final + 1):
                last[lane] = (s_m, name)
        return seen

    ahead, behind = nearest(order, 1.0), nearest(reversed(order), -1.0)
    return {name: Around(tuple(ahead[name]), tuple(behind[name])) for name in poses}


def _lanes_of(
    pose: Pose, lanes: int, lane_width_m: float, length_m: float, width_m: float
) -> tuple[int, int]:
    """Return the first and the last lane that a body touches."""
    _, _, low, high = _extent(pose, length_m, width_m)
    first = min(max(int((low + _TOUCH_M) // lane_width_m), 0), lanes - 1)
    return first, min(max(int((high - _TOUCH_M) // lane_width_m), first), lanes - 1)


def _near_pairs(poses: Mapping[str, Pose], reach_m: float) -> Iterator[tuple[str, str]]:
    """Yield all pairs (behind, ahead) whose fronts are closer than `reach_m` along the road."""
    order = sorted((pose[0], name) for name, pose in poses.items())
    for index, (s_m, name) in enumerate(order):
        for ahead in range(index + 1, len(order)):
            other_s_m, other = order[ahead]
            if other_s_m - s_m >= reach_m:
                break
            yield name, other


def _extent(pose: Pose, length_m: float, width_m: float) -> tuple[float, float, float, float]:
    """Return a body's bounds: (least x, greatest x, least y, greatest y)."""
    s_m, y_m, heading, _ = pose
    if heading == 0.0:
        return s_m - length_m, s_m, y_m - 0.5 * width_m, y_m + 0.5 * width_m
    cosine, sine = math.cos(heading), math.sin(heading)
    swing_m = 0.5 * width_m * abs(sine)
    half_m = 0.5 * (width_m * abs(cosine) + length_m * abs(sine))
    return s_m - length_m * cosine - swing_m, s_m + swing_m, y_m - half_m, y_m + half_m


def _intersect(one: Pose, other: Pose, length_m: float, width_m: float) -> bool:
    """Tell whether two bodies overlap, by the separating axis theorem."""
    if one[2] == 0.0 == other[2]:
        aside_m = abs(other[1] - one[1])
        return abs(other[0] - one[0]) < length_m - _TOUCH_M and aside_m < width_m - _TOUCH_M
    half_length, half_width = 0.5 * length_m, 0.5 * width_m
    turn = other[2] - one[2]
    half_along = half_length + half_length * abs(math.cos(turn)) + half_width * abs(math.sin(turn))
    half_across = half_width + half_length * abs(math.sin(turn)) + half_width * abs(math.cos(turn))
    between_x = (other[0] - half_length * math.cos(other[2])) - (
        one[0] - half_length * math.cos(one[2])
    )
    between_y = other[1] - one[1]
    for pose in (one, other):
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        if abs(between_x * cosine + between_y * sine) >= half_along - _TOUCH_M:
            return False
        if abs(between_y * cosine - between_x * sine) >= half_across - _TOUCH_M:
            return False
    return True


def _gap_m(behind: Pose, ahead: Pose, length_m: float, width_m: float) -> float:
    """Return the distance along the road between two bodies that overlap laterally.

    Over the y that both bodies cover, the rear boundary of a body is convex and the front boundary
    is concave, both with kinks at corners: the least difference of the one ahead and the one behind
    is at a corner or at an end of the common range.
    """
    if behind[2] == 0.0 and ahead[2] == 0.0:
        return ahead[0] - length_m - behind[0]
    one, other = corners(behind, length_m, width_m), corners(ahead, length_m, width_m)
    low = max(min(y for _, y in one), min(y for _, y in other))
    high = min(max(y for _, y in one), max(y for _, y in other))
    levels = (low, *(y for _, y in (*one, *other) if low < y < high), high)
    crossings = [(_crossings(one, y), _crossings(other, y)) for y in levels]
    return max(
        min(min(rear) - max(front) for front, rear in crossings),
        # Where two turned bodies overlap laterally the one with its front ahead can be behind.
        min(min(rear) - max(front) for rear, front in crossings),
    )


def _crossings(shape: Sequence[_Point], level_y: float) -> list[float]:
    """Return the x at which a polygon's sides cross a level y that the polygon covers."""
    found = []
    for index, (x, y) in enumerate(shape):
        other_x, other_y = shape[index - 1]
        if min(y, other_y) <= level_y <= max(y, other_y):
            share = (level_y - y) / (other_y - y) if other_y != y else 0.0
            found += [x + share * (other_x - x)] if other_y != y else [x, other_x]
    # Rounding can put the end of the common range just outside; its nearest corner is meant.
    return found or [min(shape, key=lambda point: abs(point[1] - level_y))[0]]
