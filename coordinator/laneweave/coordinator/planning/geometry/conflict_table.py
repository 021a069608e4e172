"""Which two moves bring two bodies too close: the conflict table computed from geometry.

Two vehicles make one move each in the same step, from cells that lie an offset apart. Their least
clearance is the smallest gap between bumpers at all moments at which the bodies are less than
`clearance_across_m` apart sideways, over

- all pairs of moments of both moves, beginning and end included, if each may be late by any amount
  (`Geometry.lateness_s` is None): one may wait for ever where it is, or have arrived long ago;
- all moments at which they can be there together, if neither is later than `lateness_s`.

Nothing is lost between samples. A move is cut into parts of 1/160 of its time, 24 ms; during a
part the body stays in the box around all its outlines (`bodies.outline`), and two parts count as
simultaneous if any of their moments may be. So a clearance is too small by what both bodies drive
in a part, at most 0.36 m in the default geometry, and never too large.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import numpy as np

from laneweave.coordinator.planning.geometry.bodies import FRONT, LEFT, REAR, RIGHT, Floats
from laneweave.coordinator.planning.geometry.settings import Geometry
from laneweave.coordinator.planning.grid import Cell, displacements

Pair = tuple[Cell, Cell, Cell]
"""Columns and lanes from A's cell to B's; displacement of A; displacement of B."""

FARTHEST: Final = 2
"""Moves from cells farther apart, in columns or lanes, are never too close."""

PARTS: Final = 160
"""Of a move."""

_LOOK = FARTHEST + 1
_ROUNDING_M: Final = 1e-9


def least_clearances(geometry: Geometry, paths: Mapping[Cell, Floats] | None = None) -> Floats:
    """Return the least clearance of every pair of moves.

    Args:
        geometry: sizes, times and how late vehicles may be.
        paths: the actual motion of each displacement: places (n + 1, 2) [m] along and across, from
            the cell, evenly spaced over `geometry.move_s`; None: `geometry.paths()`.

    Returns:
        [m], (7, 7, D, D): columns from A's cell to B's (-3 to 3), lanes (-3 to 3), and A's and B's
        displacement by their number in `displacements(2)`; D is 9, or 5 where `paths` are only
        those of mode 1. Negative: they overlap along the road. Infinite: never that close sideways.
    """
    known = geometry.paths() if paths is None else paths
    steps = [step for step in displacements(2) if step in known]
    boxes = [_boxes(geometry, known[step]) for step in steps]
    number = np.arange(PARTS)
    apart = np.abs(number[:, None] - number[None, :])
    first, second = np.nonzero(apart <= _parts_late(geometry))
    found = np.full((2 * _LOOK + 1, 2 * _LOOK + 1, len(steps), len(steps)), np.inf)
    for i, a in enumerate(boxes):
        for j, b in enumerate(boxes):
            _fill(found[:, :, i, j], a[:, first], b[:, second], geometry)
    return found


def pairs_closer_than(
    geometry: Geometry, paths: Mapping[Cell, Floats] | None = None
) -> frozenset[Pair]:
    """Return the pairs that come closer than the clearances of the geometry.

    Raises:
        ValueError: moves come too close from cells so far apart that the planner does not look for
            them; not with the default profile.
    """
    known = geometry.paths() if paths is None else paths
    steps = [step for step in displacements(2) if step in known]
    close = least_clearances(geometry, known) < geometry.clearance_along_m - _ROUNDING_M
    pairs = []
    for column, lane, i, j in np.argwhere(close).tolist():
        offset = column - _LOOK, lane - _LOOK
        if max(map(abs, offset)) > FARTHEST:
            raise ValueError(f"moves from cells {offset} apart come too close on these paths")
        pairs.append((offset, steps[i], steps[j]))
    return frozenset(pairs)


@lru_cache(maxsize=32)
def close_pairs(geometry: Geometry) -> frozenset[Pair]:
    """Return the conflict table of a geometry, with the default profile; cached."""
    return pairs_closer_than(geometry)


def _parts_late(geometry: Geometry) -> int:
    """Return how many parts two moves may be apart."""
    if geometry.lateness_s is None:
        return PARTS
    return min(PARTS, math.ceil(PARTS * geometry.lateness_s / geometry.move_s))


def _boxes(geometry: Geometry, path: Floats) -> Floats:
    """Return the edges (4, PARTS) within which a body stays during each part of its move."""
    outline = geometry.outline(path)
    sampled, ends = np.linspace(0.0, 1.0, len(outline)), np.linspace(0.0, 1.0, PARTS + 1)
    times = np.union1d(sampled, ends)
    first = np.searchsorted(times, ends[:-1])
    rear, front, right, left = (np.interp(times, sampled, edge) for edge in outline.T)

    def least(edge: Floats) -> Floats:
        after = np.append(edge[first[1:]], edge[-1])
        within: Floats = np.minimum(np.minimum.reduceat(edge, first), after)
        return within

    return np.stack([least(rear), -least(-front), least(right), -least(-left)])


def _fill(found: Floats, a: Floats, b: Floats, geometry: Geometry) -> None:
    """Write the clearances (7, 7) of two moves, given their edges (4, K) in simultaneous parts."""
    behind, ahead = b[REAR] - a[FRONT], a[REAR] - b[FRONT]
    right, left = b[RIGHT] - a[LEFT], a[RIGHT] - b[LEFT]
    least_m = geometry.clearance_across_m + geometry.profile_error_across_m - _ROUNDING_M
    offsets = range(-_LOOK, _LOOK + 1)
    for lane in offsets:
        side_m = lane * geometry.lane_width_m
        close = np.maximum(right + side_m, left - side_m) < least_m
        if not close.any():
            continue
        near_behind, near_ahead = behind[close], ahead[close]
        for column in offsets:
            way_m = column * geometry.pitch_m
            gap_m = np.maximum(near_behind + way_m, near_ahead - way_m).min()
            found[column + _LOOK, lane + _LOOK] = gap_m - geometry.profile_error_along_m
