"""Sizes and motions of bodies, from which conflicts are computed (`conflict_table`).

A vehicle's position is that of its front bumper along the road and of its body's centre across it,
in metres from its position in the cell that it leaves. A body points in its direction of
travel, so it turns while it changes lanes; `outline` covers it with axis-aligned boxes.
"""

from __future__ import annotations

import math
from typing import Final

import attrs
import numpy as np
from attrs import field
from numpy.typing import NDArray

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import within
from laneweave.protocol.lattice import Cell, displacements

Floats = NDArray[np.float64]

REAR, FRONT, RIGHT, LEFT = range(4)
"""Columns of an outline."""

PEAK_SPEED: Final = 1.875
"""Maximum speed of a minimum-jerk motion, as a multiple of its mean speed."""
_SAMPLES: Final = 128
"""Number of samples of the default profile."""


def minimum_jerk_share(time: Floats) -> Floats:
    """Return the fraction of distance travelled after a fraction of time, from rest to rest.

    The minimum-jerk quintic (Flash and Hogan, Journal of Neuroscience 5, 1985).
    """
    share: Floats = time**3 * (10.0 + time * (6.0 * time - 15.0))
    return share


def minimum_jerk_path(along_m: float, across_m: float, samples: int) -> Floats:
    """Return positions (samples + 1, 2) [m] along and across the road, evenly spaced in time."""
    share = minimum_jerk_share(np.linspace(0.0, 1.0, samples + 1))
    path: Floats = share[:, None] * np.array([along_m, across_m])
    return path


def outline(
    path: Floats, duration_s: float, speed_mps: float, length_m: float, width_m: float
) -> Floats:
    """Return axis-aligned boxes around a body that turns along its path.

    Edges may be interpolated linearly between samples: each box is enlarged by an upper bound on
    the interpolation error, an eighth of the largest second difference. (At 0.1 s and 6 m/s2 that
    is 8 mm.) Velocities are fourth-order central differences.

    Args:
        path: positions (n + 1, 2) [m], evenly spaced in time, n >= 2; at rest at both ends.
        duration_s: duration of the whole path.
        speed_mps: speed of the lattice; determines how far a body turns.
        length_m: length of the body.
        width_m: width of the body.

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
    """Return velocities (n + 1, 2) [m/s]; the body is at rest before and after the path."""
    held = np.pad(path, ((2, 2), (0, 0)), mode="edge")
    near, far = held[3:-1] - held[1:-3], held[4:] - held[:-4]
    velocity: Floats = (8.0 * near - far) / (12.0 * sample_s)
    velocity[[0, -1]] = 0.0
    return velocity


@attrs.frozen(kw_only=True, cache_hash=True)
class BodyGeometry:
    """Sizes, times and clearances that decide whether two moves bring two bodies too close.

    Two bodies are *too close* if at some moment they are less than `clearance_across_m` apart
    sideways and the gap between their bumpers is below `clearance_along_m`. The defaults are the
    paper's sizes and times.

    A vehicle's tracker needs a gap of at least 3 m to follow its plan (`tracking.min_gap_m`);
    the default clearance of 5 m leaves 2 m for errors and for braking. A vehicle that
    follows another has a gap of 10 m if both are on time, 6.4 m if the one ahead is 0.5 s late.
    Bodies at rest in neighbouring lanes are 1.7 m apart. With unlimited lateness, all values of
    `clearance_across_m` from 0 to 1.4 m give the same table.
    """

    length_m: float = field(default=5.0, validator=within(1, 30))
    width_m: float = field(default=1.8, validator=within(0.5, 4))
    lane_width_m: float = field(default=3.5, validator=within(2, 10))
    pitch_m: float = field(default=15.0, validator=within(1, 200))
    """Cell length d_F."""
    move_s: float = field(default=3.8, validator=within(0.5, 60))
    """Duration of a move."""
    slot_s: float = field(default=4.0, validator=within(0.5, 60))
    """Time T_F from the start of one step to that of the next."""
    speed_mps: float = field(default=15.0, validator=within(1, 60))
    """Lattice speed v_F; the higher it is, the less bodies turn."""
    clearance_along_m: float = field(default=5.0, validator=within(0, 200))
    clearance_across_m: float = field(default=0.3, validator=within(0, 10))
    profile_error_along_m: float = field(default=0.6, validator=within(0, 50))
    """Upper bound on how much smaller gaps are with the actual motions than with the default
    profile. The default covers the motions of agents in moves of 3.8 s within the default limits
    (0.55 m); their gentle moves, of 4.4 s and more, need up to 1.8 m."""
    profile_error_across_m: float = field(default=0.1, validator=within(0, 10))
    """The same bound across the road (0.05 m)."""
    lateness_s: float | None = field(
        default=None, validator=attrs.validators.optional(within(0, 60))
    )
    """Maximum delay of a move's start. None: a move may begin at any time within its
    step, and the execution protocol keeps the steps in order."""

    def __attrs_post_init__(self) -> None:
        """Check the fields against each other.

        Moves with disjoint footprints must keep the clearances at any lateness, so that the table
        forbids no pair that footprints allow.

        Raises:
            BadInputError: names the first inconsistent field.
        """
        self._require(
            self.pitch_m > self.length_m, "pitch_m", f"above length_m = {self.length_m:g}"
        )
        self._require(
            self.lane_width_m > self.width_m, "lane_width_m", f"above width_m = {self.width_m:g}"
        )
        self._require(self.slot_s >= self.move_s, "slot_s", f"at least move_s = {self.move_s:g}")
        backwards_mps = PEAK_SPEED * self.pitch_m / self.move_s
        self._require(
            self.speed_mps > backwards_mps,
            "speed_mps",
            f"above {backwards_mps:.6g}, the speed at which a move of pitch_m = {self.pitch_m:g} "
            f"in move_s = {self.move_s:g} falls back",
        )
        along_m, across_m = self._min_gaps_m()
        self._require(
            along_m >= 0.0,
            "pitch_m",
            f"at least {_up(self.pitch_m - along_m)}, for length_m = {self.length_m:g}, bodies "
            "that turn, and profile errors",
        )
        self._require(
            across_m >= 0.0,
            "lane_width_m",
            f"at least {_up(self.lane_width_m - across_m)}, for width_m = {self.width_m:g}, bodies "
            "that turn, and profile errors",
        )
        self._require(
            self.clearance_along_m <= along_m,
            "clearance_along_m",
            f"at most {_down(along_m)}: pitch_m minus length_m, turned bodies, profile errors",
        )
        self._require(
            self.clearance_across_m <= across_m,
            "clearance_across_m",
            f"at most {_down(across_m)}: lane_width_m minus width_m, turned bodies, profile errors",
        )
        if self.lateness_s is not None:
            max_s = self._max_lateness_s(along_m, across_m)
            self._require(
                self.lateness_s <= max_s,
                "lateness_s",
                f"at most {_down(max_s)}, so that bodies are near their cells when the next step "
                f"begins after slot_s = {self.slot_s:g}; or none, for any",
            )

    def _require(self, ok: bool, name: str, allowed: str) -> None:
        if not ok:
            raise BadInputError(name, getattr(self, name), allowed)

    def paths(self) -> dict[Cell, Floats]:
        """Return the default profile, minimum-jerk positions (n + 1, 2) [m], by displacement."""
        return {
            (c, lane): minimum_jerk_path(c * self.pitch_m, lane * self.lane_width_m, _SAMPLES)
            for c, lane in displacements(2)
        }

    def outline(self, path: Floats) -> Floats:
        """Return the boxes around a body on a path (n + 1, 2) [m] of `move_s`; see `outline`."""
        return outline(path, self.move_s, self.speed_mps, self.length_m, self.width_m)

    def _min_gaps_m(self) -> tuple[float, float]:
        """Return the minimum gaps along and across between vehicles with disjoint footprints.

        Disjoint footprints, rectangles of cells, have no column or no lane in common, and bodies
        extend beyond their rectangles only because they turn.
        """
        along_m = across_m = 0.0
        for (c, lane), path in self.paths().items():
            edges = self.outline(path)
            forward_m, side_m, half_m = (
                c * self.pitch_m,
                lane * self.lane_width_m,
                0.5 * self.width_m,
            )
            ahead_m = edges[:, FRONT].max() - max(forward_m, 0.0)
            behind_m = min(forward_m, 0.0) - self.length_m - edges[:, REAR].min()
            left_m = edges[:, LEFT].max() - max(side_m, 0.0) - half_m
            right_m = min(side_m, 0.0) - half_m - edges[:, RIGHT].min()
            along_m, across_m = max(along_m, ahead_m, behind_m), max(across_m, left_m, right_m)
        return (
            float(self.pitch_m - self.length_m - 2.0 * along_m - self.profile_error_along_m),
            float(self.lane_width_m - self.width_m - 2.0 * across_m - self.profile_error_across_m),
        )

    def _max_lateness_s(self, along_m: float, across_m: float) -> float:
        """Return the maximum lateness at which moves keep clear of those of the next step.

        A late move overlaps a move of the next step in time. The remaining distance of the former
        plus the covered distance of the latter is at most the distance that a move covers from rest
        within the overlap, since that distance is convex in time in the first half of a move.
        """
        share = min(
            (along_m - self.clearance_along_m) / self.pitch_m,
            (across_m - self.clearance_across_m) / self.lane_width_m,
            0.5,
        )
        times = np.linspace(0.0, 1.0, _SAMPLES + 1)
        passed = np.flatnonzero(minimum_jerk_share(times) <= share)
        return self.slot_s - self.move_s + float(times[passed[-1]]) * self.move_s


def _up(value: float) -> str:
    """Return the value rounded up to 3 decimals."""
    return f"{math.ceil(value * 1e3) / 1e3:g}"


def _down(value: float) -> str:
    """Return the value rounded down to 3 decimals."""
    return f"{math.floor(value * 1e3) / 1e3:g}"
