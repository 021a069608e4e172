"""The conflict table computed from geometry: pairs of moves that bring two bodies too close.

Two vehicles make one move each in the same step, from cells at a given offset. Their
clearance is the smallest gap between bumpers while the bodies are less than `clearance_across_m`
apart sideways. The minimum is taken over

- all pairs of moments of both moves, beginning and end included, if each may be late by any amount
  (`BodyGeometry.lateness_s` is None): one may not have started, or may have arrived long ago;
- otherwise, all pairs of moments that may coincide if neither move is later than `lateness_s`.

The computation is conservative. A move is cut into parts of 1/160 of its time, 24 ms; during a
part the body stays in the box around all its outlines (`swept_bodies.outline`), and two parts count
as simultaneous if any of their moments may coincide. So a computed clearance is never too large,
and too small by at most the distance that both bodies travel in a part (0.36 m by default).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import numpy as np

from laneweave.coordinator.planning.conflict_kinds import MAX_OFFSET, ConflictTable
from laneweave.coordinator.planning.geometry.swept_bodies import (
    FRONT,
    LEFT,
    REAR,
    RIGHT,
    BodyGeometry,
    Floats,
)
from laneweave.protocol.lattice import Cell, displacements

PARTS: Final = 160
"""Number of parts into which a move is cut."""

_MAX_SCANNED = MAX_OFFSET + 1
_ROUNDING_M: Final = 1e-9


@lru_cache(maxsize=32)
def conflict_table(geometry: BodyGeometry) -> ConflictTable:
    """Return the conflict table of a geometry, with the default profile; cached."""
    return pairs_closer_than(geometry)


def min_clearances(geometry: BodyGeometry, paths: Mapping[Cell, Floats] | None = None) -> Floats:
    """Return the minimum clearance of every pair of moves.

    Args:
        geometry: sizes, times and lateness.
        paths: the actual motion of each displacement: positions (n + 1, 2) [m] along and across,
            from the cell, evenly spaced over `geometry.move_s`; None: `geometry.paths()`.

    Returns:
        (7, 7, D, D) [m], by columns and lanes from A's cell to B's (each -3 to 3), and A's and B's
        displacement, in the order of `displacements(2)`; D is 9, or 5 if `paths` are only those
        of mode 1. Negative: bodies overlap along the road. Infinite: bodies are never close
        sideways.
    """
    motions = geometry.paths() if paths is None else paths
    steps = [step for step in displacements(2) if step in motions]
    boxes = [_boxes(geometry, motions[step]) for step in steps]
    number = np.arange(PARTS)
    shift = np.abs(number[:, None] - number[None, :])
    first, second = np.nonzero(shift <= _parts_late(geometry))
    found = np.full((2 * _MAX_SCANNED + 1, 2 * _MAX_SCANNED + 1, len(steps), len(steps)), np.inf)
    for i, a in enumerate(boxes):
        for j, b in enumerate(boxes):
            _fill(found[:, :, i, j], a[:, first], b[:, second], geometry)
    return found


def pairs_closer_than(
    geometry: BodyGeometry, paths: Mapping[Cell, Floats] | None = None
) -> ConflictTable:
    """Return the pairs of moves that come closer than the clearances of the geometry.

    Raises:
        ValueError: moves from cells further apart than `MAX_OFFSET` come too close, which cannot
            happen with the default profile.
    """
    motions = geometry.paths() if paths is None else paths
    steps = [step for step in displacements(2) if step in motions]
    close = min_clearances(geometry, motions) < geometry.clearance_along_m - _ROUNDING_M
    pairs = []
    for column, lane, i, j in np.argwhere(close).tolist():
        offset = column - _MAX_SCANNED, lane - _MAX_SCANNED
        if max(map(abs, offset)) > MAX_OFFSET:
            raise ValueError(f"moves from cells {offset} apart come too close on these paths")
        pairs.append((offset, steps[i], steps[j]))
    return frozenset(pairs)


def _parts_late(geometry: BodyGeometry) -> int:
    """Return the maximum shift between two moves, in parts."""
    if geometry.lateness_s is None:
        return PARTS
    return min(PARTS, math.ceil(PARTS * geometry.lateness_s / geometry.move_s))


def _boxes(geometry: BodyGeometry, path: Floats) -> Floats:
    """Return the box (edges, as (4, PARTS)) that contains a body during each part of a move."""
    outline = geometry.outline(path)
    sampled, ends = np.linspace(0.0, 1.0, len(outline)), np.linspace(0.0, 1.0, PARTS + 1)
    times = np.union1d(sampled, ends)
    first = np.searchsorted(times, ends[:-1])
    rear, front, right, left = (np.interp(times, sampled, edge) for edge in outline.T)

    def minimum(edge: Floats) -> Floats:
        after = np.append(edge[first[1:]], edge[-1])
        within: Floats = np.minimum(np.minimum.reduceat(edge, first), after)
        return within

    return np.stack([minimum(rear), -minimum(-front), minimum(right), -minimum(-left)])


def _fill(found: Floats, a: Floats, b: Floats, geometry: BodyGeometry) -> None:
    """Fill in the clearances (7, 7) of two moves from their boxes (4, K) in simultaneous parts."""
    behind, ahead = b[REAR] - a[FRONT], a[REAR] - b[FRONT]
    right, left = b[RIGHT] - a[LEFT], a[RIGHT] - b[LEFT]
    min_m = geometry.clearance_across_m + geometry.profile_error_across_m - _ROUNDING_M
    offsets = range(-_MAX_SCANNED, _MAX_SCANNED + 1)
    for lane in offsets:
        side_m = lane * geometry.lane_width_m
        close = np.maximum(right + side_m, left - side_m) < min_m
        if not close.any():
            continue
        near_behind, near_ahead = behind[close], ahead[close]
        for column in offsets:
            shift_m = column * geometry.pitch_m
            gap_m = np.maximum(near_behind + shift_m, near_ahead - shift_m).min()
            found[column + _MAX_SCANNED, lane + _MAX_SCANNED] = (
                gap_m - geometry.profile_error_along_m
            )
