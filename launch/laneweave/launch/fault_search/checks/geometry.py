"""Geometry of the checker: bodies are rectangles that move in straight lines.

Positions are in m relative to the moving lattice, so the body of a vehicle that holds its cell does
not move: x = column * pitch, y = (lane + 1/2) * lane width.
"""

from __future__ import annotations

import math

from attrs import define, frozen

Point = tuple[float, float]
"""(x, y) in m."""
Cells = frozenset[tuple[int, int]]

DONE_ALONG_M = 1.0
DONE_ACROSS_M = 0.5
"""Remaining distances at which the checker considers a motion complete: twice those of agents."""


@frozen
class Geometry:
    """Sizes of cells and bodies in m."""

    pitch_m: float
    lane_width_m: float
    length_m: float
    width_m: float

    def point(self, cell: tuple[float, float]) -> Point:
        """Return the position of (column, lane)."""
        return cell[0] * self.pitch_m, (cell[1] + 0.5) * self.lane_width_m

    def swept(self, origin: Point, target: Point) -> Cells:
        """Return the cells in the bounding box of a straight path."""
        low = [min(pair) for pair in zip(origin, target, strict=True)]
        high = [max(pair) for pair in zip(origin, target, strict=True)]
        # A body close to its target occupies only the target cell.
        columns = range(
            math.floor((low[0] + DONE_ALONG_M) / self.pitch_m),
            math.ceil((high[0] - DONE_ALONG_M) / self.pitch_m) + 1,
        )
        lanes = range(
            math.floor((low[1] + DONE_ACROSS_M) / self.lane_width_m - 0.5),
            math.ceil((high[1] - DONE_ACROSS_M) / self.lane_width_m - 0.5) + 1,
        )
        return frozenset((column, lane) for column in columns for lane in lanes)


@define(eq=False)
class Body:
    """Body of a vehicle with its current motion."""

    geometry: Geometry
    origin: Point
    target: Point
    begin_s: float
    end_s: float
    """Time of arrival at the target; `begin_s` if the body has never moved."""
    cells: Cells
    """Occupied cells."""

    @classmethod
    def standing(cls, geometry: Geometry, cell: tuple[int, int], t_s: float) -> Body:
        """Return a body at rest in a cell."""
        point = geometry.point(cell)
        return cls(geometry, point, point, t_s, t_s, frozenset({cell}))

    def at(self, t_s: float) -> Point:
        """Return the position at a time."""
        if t_s >= self.end_s:
            return self.target
        share = max(0.0, (t_s - self.begin_s) / (self.end_s - self.begin_s))
        return (
            self.origin[0] + share * (self.target[0] - self.origin[0]),
            self.origin[1] + share * (self.target[1] - self.origin[1]),
        )

    def go(self, cell: tuple[int, int], t_s: float, duration_s: float) -> None:
        """Begin a motion from the current position."""
        self.origin, self.target = self.at(t_s), self.geometry.point(cell)
        self.begin_s, self.end_s = t_s, t_s + duration_s
        self.cells = self.geometry.swept(self.origin, self.target)

    def rest(self, cell: tuple[int, int]) -> None:
        """Occupy only the target cell, once a motion is complete."""
        self.cells = frozenset({cell})

    @property
    def done_s(self) -> float:
        """Time at which the body is close enough to its target to complete the motion."""
        shares = [
            tolerance_m / abs(path_m)
            for tolerance_m, path_m in (
                (DONE_ALONG_M, self.target[0] - self.origin[0]),
                (DONE_ACROSS_M, self.target[1] - self.origin[1]),
            )
            if path_m
        ]
        share = min(1.0, *shares) if shares else 1.0
        return self.end_s - share * (self.end_s - self.begin_s)


def overlap_between(mine: Body, other: Body, from_s: float, to_s: float) -> float | None:
    """Return the first time at which two bodies overlap, or None.

    No motion may begin between `from_s` and `to_s`, but motions may end. The result is exact:
    while rectangles move in straight lines, they overlap in x during one interval, and in y during
    another.
    """
    ends = sorted({end for end in (mine.end_s, other.end_s) if from_s < end < to_s})
    starts = [from_s, *ends]
    for begin_s, end_s in zip(starts, [*ends, to_s], strict=True):
        share = _first_share(mine, other, begin_s, end_s)
        if share is not None:
            return begin_s + share * (end_s - begin_s)
    return None


def _first_share(mine: Body, other: Body, begin_s: float, end_s: float) -> float | None:
    geometry = mine.geometry
    (x0, y0), (x1, y1) = mine.at(begin_s), mine.at(end_s)
    (u0, w0), (u1, w1) = other.at(begin_s), other.at(end_s)
    low, high = 0.0, 1.0
    for first, last, size in (
        (x0 - u0, x1 - u1, geometry.length_m),
        (y0 - w0, y1 - w1, geometry.width_m),
    ):
        slope = last - first
        if slope == 0.0:
            if abs(first) >= size:
                return None
            continue
        into, out = sorted(((-size - first) / slope, (size - first) / slope))
        low, high = max(low, into), min(high, out)
        if low >= high:
            return None
    return low
