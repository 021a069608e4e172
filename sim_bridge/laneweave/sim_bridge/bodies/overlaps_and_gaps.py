"""Overlaps and gaps between bodies; exact states of each vehicle's neighbours.

A vehicle's body is a rectangle of the length L and width W of its type. Its pose consists of

    s        position of the middle of its front bumper along the road,
    y        position of its centre across the road,
    heading  angle of its body, atan2(v_y, v): a body points in its direction of motion.

The body's centre is (s - L/2 cos heading, y). The overlap test is exact for these rectangles and
decides whether a run counts as safe. SUMO's collision list, which misses overlaps between two
lanes, is also recorded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from attrs import frozen

from laneweave.protocol.road_layout import TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.protocol.wire.messages import Neighbour

Pose = tuple[float, float, float, float]
"""(s [m], y [m], heading [rad], speed [m/s])."""

Size = tuple[float, float]
"""(length [m], width [m])."""
NO_SIZES: Mapping[str, Size] = MappingProxyType({})
_Point = tuple[float, float]

TURNING_MPS = 0.5
"""Speed from which a body points in its direction of motion."""
_TOUCH_M = 1e-9
"""Tolerance: touching bodies do not overlap; a body that touches a lane's border is inside."""


@frozen
class OtherBody:
    """A body in a lane of the road, or behind its exit, which the bridge does not drive."""

    name: str
    lane: int
    """Lane in which it is, or that leads to it."""
    exit_m: float
    """Where this lane leaves the road; vehicles before see the body."""
    rear_m: float
    """Distance of its rear from the start of the road, along this lane."""
    length_m: float
    speed_mps: float
    accel_mps2: float

    @property
    def front_m(self) -> float:
        """Distance of its front from the start of the road, along this lane."""
        return self.rear_m + self.length_m


class MinGaps(NamedTuple):
    """Minimum gap and headway of vehicles in line; infinite if there are none."""

    gap_m: float
    """Bumper-to-bumper distance along the road."""
    headway_s: float
    """Front-to-front distance divided by the speed of the follower."""


class Neighbours(NamedTuple):
    """Measured neighbours of a vehicle, by lane."""

    ahead: tuple[Neighbour, ...]
    behind: tuple[Neighbour, ...]


NO_NEIGHBOURS = Neighbours((), ())

ExactNeighbour = tuple[int, float, float, float]
"""(lane, gap [m], speed [m/s], acceleration [m/s2]): a `Neighbour` without measurement errors."""

ExactNeighbours = tuple[Sequence[ExactNeighbour], Sequence[ExactNeighbour]]
"""(ahead, behind): `Neighbours` without measurement errors."""


def pose_of(state: Sequence[float]) -> Pose:
    """Return the pose of a vehicle state (s, v, a, y, v_y, a_y).

    A body that stands does not turn, though the ratio of its speeds may be anything.
    """
    s_m, v_mps, _, y_m, v_y_mps, _ = state
    forward_mps = max(v_mps, 0.0)
    turned = min(forward_mps / TURNING_MPS, 1.0)
    return s_m, y_m, turned * math.atan2(v_y_mps, forward_mps), v_mps


def corners(pose: Pose, length_m: float, width_m: float) -> tuple[_Point, _Point, _Point, _Point]:
    """Return a body's corners (x, y) [m]: front right, front left, rear left, rear right.

    x is measured along the road from its start, y across it from the right edge.
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


class Bodies:
    """All bodies on the road at one time, sorted once for all queries."""

    def __init__(
        self,
        poses: Mapping[str, Pose],
        length_m: float,
        width_m: float,
        sizes: Mapping[str, Size] = NO_SIZES,
    ) -> None:
        """Sort the bodies along the road.

        Args:
            poses: pose of each vehicle.
            length_m: length of bodies that are not in `sizes`.
            width_m: width of bodies that are not in `sizes`.
            sizes: sizes of other bodies, by vehicle.
        """
        order = sorted([(pose[0], name, pose) for name, pose in poses.items()])
        self._names = [name for _, name, _ in order]
        self._poses = [pose for _, _, pose in order]
        self._sizes = [(length_m, width_m)] * len(order)
        if sizes:
            self._sizes = [sizes.get(name, (length_m, width_m)) for name in self._names]
        self._reach_m = max((length + width for length, width in self._sizes), default=0.0)
        """Maximum distance between the fronts of overlapping bodies."""
        self._extents = [
            _extent(pose, *size) for pose, size in zip(self._poses, self._sizes, strict=True)
        ]

    def overlapping_pairs(self) -> list[tuple[str, str]]:
        """Return all pairs of vehicles whose bodies overlap, as sorted pairs of names.

        Bodies that only touch are not included.
        """
        names, poses, extents, sizes = self._names, self._poses, self._extents, self._sizes
        reach_m = self._reach_m
        count = len(poses)
        pairs = []
        for index, one in enumerate(poses):
            s_m, (_, _, low, high) = one[0], extents[index]
            for ahead in range(index + 1, count):
                other = poses[ahead]
                if other[0] - s_m >= reach_m:
                    break
                _, _, other_low, other_high = extents[ahead]
                if other_low >= high or other_high <= low:
                    continue  # side by side, like most near pairs
                if _intersect(one, other, sizes[index], sizes[ahead]):
                    name, other_name = names[index], names[ahead]
                    pairs.append((min(name, other_name), max(name, other_name)))
        return sorted(pairs)

    def in_closed_lanes(
        self, scenario: Scenario, closed: Iterable[TemporaryClosure] = ()
    ) -> list[tuple[str, str]]:
        """Return (name of a closed part, vehicle) for each body that reaches into it.

        A closed part counts as a body of its lane's width; rotated bodies as their bounding boxes.
        `closed`: parts that are closed for a time.
        """
        pairs = []
        lane_m = scenario.road.lane_width_m
        tick_m = scenario.vehicle.max_speed_mps * scenario.runtime.tick_s
        closures = scenario.geometry.closed_to_bodies(scenario.types.longest_body_m, tick_m)
        parts: list[Closure | TemporaryClosure] = [*closures, *closed]
        for part in parts:
            low_m = part.lane * lane_m + _TOUCH_M
            high_m = low_m + lane_m - 2.0 * _TOUCH_M
            for name, (rear, front, low, high) in zip(self._names, self._extents, strict=True):
                along = rear < part.to_m - _TOUCH_M and front > part.from_m + _TOUCH_M
                if along and low < high_m and high > low_m:
                    pairs.append((f"closure-{part.lane}-{part.from_m:g}", name))
        return pairs

    def min_gaps(self) -> MinGaps:
        """Return the minimum gap and time headway of vehicles in line.

        Two vehicles are in line if their bodies overlap laterally; the follower is the vehicle
        whose front is behind. The gap is the distance along the road by which the follower can move
        until it touches the other vehicle: exact for rotated bodies, negative for overlapping
        bodies.
        """
        # Sorted by pose, so that ties between fronts do not depend on names.
        bodies = sorted(zip(self._poses, self._extents, self._sizes, strict=True))
        # Of bodies that are not rotated, one farther ahead can have the smaller gap only if it is
        # longer. A rotated body can also have a gap that exceeds the distance between the fronts.
        reach_m = self._reach_m
        count = len(bodies)
        rotated = []
        """(lower bound of the gap [m], indices) of pairs with a rotated body."""
        min_gap = min_headway = math.inf
        for index, body in enumerate(bodies):
            (s_m, _, heading, speed_mps), (rear, front, low, high), _ = body
            low, high = low + _TOUCH_M, high - _TOUCH_M
            horizon_m = math.inf
            for ahead in range(index + 1, count):
                other, (other_rear, other_front, other_low, other_high), _ = bodies[ahead]
                distance_m = other[0] - s_m
                if distance_m > horizon_m:
                    break
                if other_low >= high or other_high <= low:
                    continue
                is_rotated = heading != 0.0 or other[2] != 0.0
                if horizon_m == math.inf:
                    horizon_m = distance_m + (2.0 * reach_m if is_rotated else reach_m)
                    if speed_mps > 0.0:
                        min_headway = min(min_headway, distance_m / speed_mps)
                bound_m = max(other_rear - front, rear - other_front)
                if is_rotated:
                    rotated.append((bound_m, index, ahead))
                elif bound_m < min_gap:
                    min_gap = bound_m  # exact for unrotated bodies
        for bound_m, index, ahead in sorted(rotated):
            if bound_m >= min_gap:
                break
            (one, _, size), (other, _, other_size) = bodies[index], bodies[ahead]
            gap_m = _gap_m(corners(one, *size), corners(other, *other_size))
            min_gap = min(min_gap, gap_m)
        return MinGaps(min_gap, min_headway)

    def exact_neighbours(
        self, lanes: int, lane_width_m: float, accels_mps2: Mapping[str, float]
    ) -> dict[str, ExactNeighbours]:
        """Return the neighbours of each vehicle without measurement errors.

        Neighbours are the nearest vehicles ahead and behind in each lane that the body touches and
        in the adjacent lanes: of those whose fronts are ahead, the one with the rearmost rear, and
        of the others the one with the foremost front. A vehicle that straddles two lanes is in
        both. The bumper-to-bumper gap ignores rotation and is negative for vehicles side by side.
        Between vehicles with equal fronts, the one with the later name counts as ahead.

        Args:
            lanes: number of lanes.
            lane_width_m: width of a lane.
            accels_mps2: acceleration by vehicle; zero for vehicles that are not included.
        """
        touched = []
        """First and last lane that each body touches."""
        for _, _, low, high in self._extents:
            first = min(max(int((low + _TOUCH_M) // lane_width_m), 0), lanes - 1)
            last = min(max(int((high - _TOUCH_M) // lane_width_m), first), lanes - 1)
            touched.append((first, last))
        names, poses, sizes = self._names, self._poses, self._sizes
        accels = [accels_mps2.get(name, 0.0) for name in names]

        def rear_m(index: int) -> float:
            return poses[index][0] - sizes[index][0]

        def nearest(order: Iterable[int], sign: float) -> list[list[ExactNeighbour]]:
            """Return the neighbours of each vehicle among the vehicles before it in `order`."""
            last_seen = [-1] * lanes
            seen: list[list[ExactNeighbour]] = [[]] * len(names)
            for index in order:
                first, last = touched[index]
                s_m = poses[index][0]
                found = []
                for lane in range(max(first - 1, 0), min(last + 2, lanes)):
                    other = last_seen[lane]
                    if other >= 0:
                        other_s_m, _, _, speed_mps = poses[other]
                        length_m, _ = sizes[other if sign > 0.0 else index]
                        gap_m = sign * (other_s_m - s_m) - length_m
                        found.append((lane, gap_m, speed_mps, accels[other]))
                seen[index] = found
                for lane in range(first, last + 1):
                    before = last_seen[lane]
                    # A long body ahead of another one, beside it, may reach farther back.
                    if sign < 0.0 or before < 0 or rear_m(index) <= rear_m(before):
                        last_seen[lane] = index
            return seen

        ahead = nearest(range(len(names) - 1, -1, -1), 1.0)
        behind = nearest(range(len(names)), -1.0)
        return dict(zip(names, zip(ahead, behind, strict=True), strict=True))


def _extent(pose: Pose, length_m: float, width_m: float) -> tuple[float, float, float, float]:
    """Return a body's bounds: (min x, max x, min y, max y)."""
    s_m, y_m, heading, _ = pose
    if heading == 0.0:
        return s_m - length_m, s_m, y_m - 0.5 * width_m, y_m + 0.5 * width_m
    cosine, sine = math.cos(heading), math.sin(heading)
    swing_m = 0.5 * width_m * abs(sine)
    half_m = 0.5 * (width_m * abs(cosine) + length_m * abs(sine))
    return s_m - length_m * cosine - swing_m, s_m + swing_m, y_m - half_m, y_m + half_m


def _intersect(one: Pose, other: Pose, size: Size, other_size: Size) -> bool:
    """Return whether two bodies overlap, by the separating axis theorem."""
    if one[2] == 0.0 == other[2]:
        aside_m, width_m = abs(other[1] - one[1]), 0.5 * (size[1] + other_size[1])
        apart_m = other[0] - one[0]
        along = -size[0] + _TOUCH_M < apart_m < other_size[0] - _TOUCH_M
        return along and aside_m < width_m - _TOUCH_M
    turn = other[2] - one[2]
    cosine_turn, sine_turn = abs(math.cos(turn)), abs(math.sin(turn))
    between_x = (other[0] - 0.5 * other_size[0] * math.cos(other[2])) - (
        one[0] - 0.5 * size[0] * math.cos(one[2])
    )
    between_y = other[1] - one[1]
    for pose, (length, width), (other_length, other_width) in (
        (one, size, other_size),
        (other, other_size, size),
    ):
        half_along = 0.5 * (length + other_length * cosine_turn + other_width * sine_turn)
        half_across = 0.5 * (width + other_length * sine_turn + other_width * cosine_turn)
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        if abs(between_x * cosine + between_y * sine) >= half_along - _TOUCH_M:
            return False
        if abs(between_y * cosine - between_x * sine) >= half_across - _TOUCH_M:
            return False
    return True


def _gap_m(one: Sequence[_Point], other: Sequence[_Point]) -> float:
    """Return the distance along the road from a body to one ahead that it overlaps laterally.

    As functions of y, rear boundaries are convex and front boundaries are concave, with kinks at
    corners, so their minimum difference is at a corner or at an end of the common range of y.
    """
    low = max(min(y for _, y in one), min(y for _, y in other))
    high = min(max(y for _, y in one), max(y for _, y in other))
    levels = (low, *(y for _, y in (*one, *other) if low < y < high), high)
    crossings = [(_crossings(one, y), _crossings(other, y)) for y in levels]
    return max(
        min(min(rear) - max(front) for front, rear in crossings),
        # A rotated body with the front ahead can be behind the other body.
        min(min(rear) - max(front) for rear, front in crossings),
    )


def _crossings(shape: Sequence[_Point], level_y: float) -> list[float]:
    """Return the x coordinates at which the sides of a polygon cross a level y."""
    found = []
    for index, (x, y) in enumerate(shape):
        other_x, other_y = shape[index - 1]
        if min(y, other_y) <= level_y <= max(y, other_y):
            if y == other_y:
                found += [x, other_x]
            else:
                found.append(x + (level_y - y) / (other_y - y) * (other_x - x))
    # Due to rounding, the level may be just outside the polygon.
    return found or [min(shape, key=lambda point: abs(point[1] - level_y))[0]]
