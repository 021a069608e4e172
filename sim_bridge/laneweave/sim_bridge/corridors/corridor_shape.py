"""The shape of a corridor in the world: from positions on its road to SUMO's coordinates.

A position on the road is a distance s along the corridor and a distance y from its right edge, or
from its left edge where vehicles drive on the left: the road is then mirrored. Each
corridor lane has a centre line, made of the shapes of the lanes of its edges and of the lanes
inside the junctions between them. A body is placed beside the centre line of the lane that it is
in, as far as its centre is from the middle of the lane.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise

from attrs import evolve, frozen

from laneweave.sim_bridge.corridors.corridor import Corridor
from laneweave.sim_bridge.corridors.sumo_network import Lane, Link, Point, through_links

WorldPose = tuple[float, float, float]
"""(x, y [m], direction [rad], anticlockwise from east)."""


@frozen
class Piece:
    """A part of a corridor lane: a lane of an edge, or the way across a junction."""

    from_m: float
    begins_m: float
    """Where it begins to belong to the corridor; before, its lane belongs to SUMO."""
    to_m: float
    points: tuple[Point, ...]
    """Its centre line."""
    lengths_m: tuple[float, ...]
    """Distance of each point from the first one along the line."""
    edge: str = ""
    """Name of the edge; empty: inside a junction."""
    index: int = -1
    """Number of the lane in its edge."""

    def at(self, s_m: float, left_m: float) -> WorldPose:
        """Return the point at a position, to the left of the centre line, and the direction.

        Positions before or behind the piece lie on its first or last straight line.
        """
        share = (s_m - self.from_m) / (self.to_m - self.from_m)
        along_m = share * self.lengths_m[-1]
        index = min(max(bisect_right(self.lengths_m, along_m) - 1, 0), len(self.points) - 2)
        (x, y), (next_x, next_y) = self.points[index], self.points[index + 1]
        part = (along_m - self.lengths_m[index]) / (
            self.lengths_m[index + 1] - self.lengths_m[index]
        )
        direction = math.atan2(next_y - y, next_x - x)
        return (
            x + part * (next_x - x) - left_m * math.sin(direction),
            y + part * (next_y - y) + left_m * math.cos(direction),
            direction,
        )


class CorridorShape:
    """The centre lines of all corridor lanes."""

    def __init__(self, corridor: Corridor) -> None:
        """Join the shapes of the lanes of a corridor."""
        self.side = -1.0 if corridor.network.left_hand else 1.0
        """-1: the road is mirrored, since vehicles drive on the left."""
        self._lane_m = corridor.lane_width_m
        pieces: list[list[Piece]] = [[] for _ in range(corridor.lanes)]
        for lane, piece in (*_main(corridor), *_ramps(corridor)):
            pieces[lane].append(piece)
        self._pieces = tuple(tuple(sorted(own, key=lambda one: one.begins_m)) for own in pieces)

    def piece_at(self, lane: int, s_m: float) -> Piece:
        """Return the piece of a corridor lane at a position, or the nearest one."""
        own = self._pieces[lane]
        index = bisect_right(own, s_m, key=lambda one: one.begins_m) - 1
        before = own[max(index, 0)]
        if s_m <= before.to_m or index + 1 >= len(own):
            return before
        after = own[index + 1]
        return before if s_m - before.to_m <= after.begins_m - s_m else after

    def at(self, s_m: float, y_m: float) -> tuple[WorldPose, Piece]:
        """Return the point at a position on the road, its direction, and the piece there."""
        lane = min(max(int(y_m // self._lane_m), 0), len(self._pieces) - 1)
        if not self._exists(lane, s_m):
            # A body beside the end of a lane is drawn beside the lane that goes on.
            others = [one for one in (lane + 1, lane - 1) if 0 <= one < len(self._pieces)]
            lane = next((one for one in others if self._exists(one, s_m)), lane)
        piece = self.piece_at(lane, s_m)
        return piece.at(s_m, self.side * (y_m - (lane + 0.5) * self._lane_m)), piece

    def _exists(self, lane: int, s_m: float) -> bool:
        return any(one.begins_m <= s_m <= one.to_m for one in self._pieces[lane])


def _main(corridor: Corridor) -> Iterator[tuple[int, Piece]]:
    """Yield (lane, piece) of the edges of a corridor, and of the junctions between them."""
    for one in corridor.edges:
        for lane in one.edge.car_lanes:
            yield one.first_lane + lane.index, _of_lane(lane, one.from_m, one.to_m)
    for before, after in pairwise(corridor.edges):
        for link in through_links(corridor.network, before.edge, after.edge):
            if after.from_m > before.to_m:
                number = before.first_lane + link.origin.index
                yield number, _of_link(link, before.to_m, after.from_m)


def _ramps(corridor: Corridor) -> Iterator[tuple[int, Piece]]:
    """Yield (lane, piece) of the ways on which vehicles come to their acceleration lanes."""
    for ramp in corridor.ramps:
        to_m = ramp.merge_m
        pieces = []
        for link in ramp.path:
            if link.length_m > 0.0:
                pieces.append(_of_link(link, to_m - link.length_m, to_m))
                to_m -= link.length_m
            pieces.append(_of_lane(link.origin, to_m - link.origin.length_m, to_m))
            to_m -= link.origin.length_m
        for piece in pieces:
            if piece.to_m > ramp.at_m:
                yield ramp.lane, evolve(piece, begins_m=max(piece.from_m, ramp.at_m))


def _of_lane(lane: Lane, from_m: float, to_m: float) -> Piece:
    return _piece(from_m, to_m, lane.shape, lane.edge, lane.index)


def _of_link(link: Link, from_m: float, to_m: float) -> Piece:
    across = [point for lane in link.across for point in lane.shape]
    return _piece(from_m, to_m, (link.origin.shape[-1], *across, link.target.shape[0]))


def _piece(
    from_m: float, to_m: float, shape: Sequence[Point], edge: str = "", index: int = -1
) -> Piece:
    points = [shape[0]]
    points += [point for before, point in pairwise(shape) if math.dist(before, point) > 1e-6]
    if len(points) < 2:
        points.append((points[0][0] + 1e-3, points[0][1]))
    steps_m = (math.dist(*pair) for pair in pairwise(points))
    lengths_m = tuple(accumulate(steps_m, initial=0.0))
    return Piece(from_m, from_m, to_m, tuple(points), lengths_m, edge, index)
