"""Bodies under way between two cells: where they are, which way they point, what they cover.

A vehicle's place is the middle of its front bumper along the road and its body's centre across it,
in metres from its place in the cell that it leaves. A body points where it goes, so it is turned
while it changes lanes; what it covers is told by the smallest upright box around it, which is never
less than the body.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

REAR, FRONT, RIGHT, LEFT = range(4)
"""Columns of an outline."""

PEAK_SPEED: Final = 1.875
"""Greatest speed of a motion of least jerk, as a multiple of its mean speed."""


def minimum_jerk_share(time: Floats) -> Floats:
    """Return the share of the way made after a share of the time, from rest to rest.

    The quintic of least jerk (Flash and Hogan, Journal of Neuroscience 5, 1985).
    """
    share: Floats = time**3 * (10.0 + time * (6.0 * time - 15.0))
    return share


def minimum_jerk_path(along_m: float, across_m: float, samples: int) -> Floats:
    """Return places (samples + 1, 2) [m] along and across the road, evenly spaced in time."""
    share = minimum_jerk_share(np.linspace(0.0, 1.0, samples + 1))
    path: Floats = share[:, None] * np.array([along_m, across_m])
    return path


def outline(
    path: Floats, duration_s: float, speed_mps: float, length_m: float, width_m: float
) -> Floats:
    """Return the boxes around a turned body on its way.

    Between two samples the edges may be taken as straight lines: each box is larger by what they
    deviate from them at most, an eighth of the largest second difference. (At 0.1 s and 6 m/s2
    that is 8 mm.) Speeds are central differences of fourth order.

    Args:
        path: places (n + 1, 2) [m], evenly spaced in time, n >= 2; at rest at both ends.
        duration_s: time of the whole path.
        speed_mps: of the lattice; it decides how far a body turns.
        length_m: of the body.
        width_m: of the body.

    Returns:
        (n + 1, 4) [m]: rear, front, right and left edge.
    """
    velocity = _velocity(path, duration_s / (len(path) - 1))
    heading = np.arctan2(velocity[:, 1], np.maximum(speed_mps + velocity[:, 0], 0.0))
    cosine, sine = np.cos(heading), np.abs(np.sin(heading))
    along_m = 0.5 * width_m * sine
    across_m = 0.5 * (length_m * sine + width_m * cosine)
    edges = np.empty((len(path), 4))
    edges[:, REAR] = path[:, 0] - length_m * cosine - along_m
    edges[:, FRONT] = path[:, 0] + along_m
    edges[:, RIGHT] = path[:, 1] - across_m
    edges[:, LEFT] = path[:, 1] + across_m
    error_m = np.abs(np.diff(edges, 2, axis=0)).max(axis=0) / 8.0
    grown: Floats = edges + error_m * np.array([-1.0, 1.0, -1.0, 1.0])
    return grown


def _velocity(path: Floats, sample_s: float) -> Floats:
    """Return speeds (n + 1, 2) [m/s]; before and after its samples the body rests."""
    held = np.pad(path, ((2, 2), (0, 0)), mode="edge")
    near, far = held[3:-1] - held[1:-3], held[4:] - held[:-4]
    velocity: Floats = (8.0 * near - far) / (12.0 * sample_s)
    velocity[[0, -1]] = 0.0
    return velocity
