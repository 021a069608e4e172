"""Bodies that drive, point by point, and how close they come; shares no code with the planner.

Nothing here is fast or clever: places at many moments, the corners of turned rectangles, and the
gaps between the boxes around them.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from random import Random
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Cell = tuple[int, int]

MOMENTS = 120
DELAYS = 30
"""Looked at, of a move, and between on time and as late as may be."""
TICK_S = 0.02


@dataclass(frozen=True)
class Bodies:
    """The object `geometry` of a request."""

    length_m: float = 5.0
    width_m: float = 1.8
    lane_width_m: float = 3.5
    pitch_m: float = 15.0
    move_s: float = 3.8
    slot_s: float = 4.0
    speed_mps: float = 15.0
    clearance_along_m: float = 5.0
    clearance_across_m: float = 0.3
    profile_error_along_m: float = 0.6
    profile_error_across_m: float = 0.1
    lateness_s: float | None = None


# ------------------------------------------------------------------------------------ one body


def motion(bodies: Bodies, displacement: Cell, times_s: Floats) -> tuple[Floats, Floats]:
    """Places and speeds (n, 2) in the lattice at these times after the move began: least jerk."""
    t = np.clip(times_s / bodies.move_s, 0.0, 1.0)[:, None]
    way_m = np.array([displacement[0] * bodies.pitch_m, displacement[1] * bodies.lane_width_m])
    place = way_m * (6.0 * t**5 - 15.0 * t**4 + 10.0 * t**3)
    speed = way_m / bodies.move_s * 30.0 * t**2 * (1.0 - t) ** 2
    return place, speed


def boxes(bodies: Bodies, place: Floats, speed: Floats) -> tuple[Floats, Floats]:
    """The least and the greatest coordinates (n, 2) of the corners of bodies that point ahead.

    The middle of the body's front bumper is at `place` along the road, its centre across.
    """
    ahead = np.stack([bodies.speed_mps + speed[:, 0], speed[:, 1]], axis=1)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    beside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    half = 0.5 * bodies.length_m
    centre = np.stack([place[:, 0] - half * ahead[:, 0], place[:, 1]], axis=1)
    corners = np.stack(
        [
            centre + x * half * ahead + y * 0.5 * bodies.width_m * beside
            for x in (-1.0, 1.0)
            for y in (-1.0, 1.0)
        ]
    )
    return corners.min(axis=0), corners.max(axis=0)


# ----------------------------------------------------------------------------------- two moves


@lru_cache(maxsize=200_000)
def too_close(bodies: Bodies, offset: Cell, a: Cell, b: Cell) -> bool:
    """Whether two vehicles that make the displacements `a` and `b` in one step come too close."""
    return least_gap_m(bodies, offset, a, b) < bodies.clearance_along_m


def least_gap_m(
    bodies: Bodies, offset: Cell, a: Cell, b: Cell, more_across_m: float = 0.0
) -> float:
    """The least gap between bumpers while there is less than the clearance sideways."""
    low_a, high_a = _boxes_of_vehicle(bodies, a, 0)
    low_b, high_b = _boxes_of_vehicle(bodies, b, 1)
    shift = np.array([offset[0] * bodies.pitch_m, offset[1] * bodies.lane_width_m])
    gaps = np.maximum(low_b + shift - high_a, low_a - high_b - shift)
    gaps -= (bodies.profile_error_along_m, bodies.profile_error_across_m)
    near = gaps[:, 1] < bodies.clearance_across_m + more_across_m
    return float(gaps[near, 0].min()) if near.any() else np.inf


@lru_cache(maxsize=400)
def _boxes_of_vehicle(bodies: Bodies, displacement: Cell, vehicle: int) -> tuple[Floats, Floats]:
    """The first or the second vehicle at all pairs of moments that are looked at."""
    move_s, late_s = bodies.move_s, bodies.lateness_s
    if late_s is None:
        times_s = np.linspace(0.0, move_s, MOMENTS + 1)
        moments_s = np.meshgrid(times_s, times_s)[vehicle]
    else:
        clock_s = np.linspace(0.0, move_s + late_s, MOMENTS + 1)
        delays_s = np.linspace(-late_s, late_s, 2 * DELAYS + 1)
        # Who is not late begins at 0; the other, so much later.
        moments_s = clock_s[:, None] - np.maximum((-delays_s, delays_s)[vehicle], 0.0)
    return boxes(bodies, *motion(bodies, displacement, moments_s.ravel()))


# -------------------------------------------------------------------------------- a whole plan


@dataclass(frozen=True)
class Profile:
    """Motions as somebody really drives them: places and speeds at evenly spaced times."""

    duration_s: float
    places: dict[Cell, Floats]
    speeds: dict[Cell, Floats]

    def at(self, displacement: Cell, times_s: Floats) -> tuple[Floats, Floats]:
        place, speed = self.places[displacement], self.speeds[displacement]
        known_s = np.linspace(0.0, self.duration_s, len(place))

        def between(values: Floats) -> Floats:
            return np.stack([np.interp(times_s, known_s, column) for column in values.T], axis=1)

        return between(place), between(speed)


def least_gap_of_plan_m(
    bodies: Bodies,
    paths: list[list[Cell]],
    rng: Random,
    late_s: float,
    slot_s: float,
    profile: Profile | None = None,
    window_s: tuple[float, float] = (0.0, np.inf),
) -> float:
    """Drive a plan by a timetable; the least gap while there is less than the clearance sideways.

    In every step every vehicle begins up to `late_s` late, and not before its last move has ended.
    Only what happens within the window of time counts.
    """
    steps = len(paths[0]) - 1
    clock_s = np.arange(0.0, steps * slot_s + bodies.move_s + late_s + TICK_S, TICK_S)
    driven = [_driven(bodies, path, rng, late_s, slot_s, clock_s, profile) for path in paths]
    inside = (clock_s >= window_s[0]) & (clock_s <= window_s[1])
    least_m = np.inf
    for (low_a, high_a), (low_b, high_b) in combinations(driven, 2):
        gaps = np.maximum(low_b - high_a, low_a - high_b)
        near = (gaps[:, 1] < bodies.clearance_across_m) & inside
        if near.any():
            least_m = min(least_m, float(gaps[near, 0].min()))
    return least_m


def _driven(
    bodies: Bodies,
    path: list[Cell],
    rng: Random,
    late_s: float,
    slot_s: float,
    clock_s: Floats,
    profile: Profile | None,
) -> tuple[Floats, Floats]:
    pitch = np.array([bodies.pitch_m, bodies.lane_width_m])
    place = np.broadcast_to(np.array(path[0]) * pitch, (len(clock_s), 2)).copy()
    speed = np.zeros_like(place)
    free_s = 0.0
    for step in range(len(path) - 1):
        begin_s = max(step * slot_s + rng.choice((0.0, late_s, rng.uniform(0.0, late_s))), free_s)
        displacement = path[step + 1][0] - path[step][0], path[step + 1][1] - path[step][1]
        if displacement == (0, 0):
            continue
        free_s = begin_s + bodies.move_s
        since_s = clock_s - begin_s
        if profile is None:
            moved, fast = motion(bodies, displacement, since_s)
        else:
            moved, fast = profile.at(displacement, since_s)
        place += moved
        speed += fast
    return boxes(bodies, place, speed)


def drive(request: dict[str, Any], response: dict[str, Any], rng: Random) -> float:
    """The least gap of a plan that is driven with random delays.

    If any lateness is allowed, a step begins when the one before has ended.
    """
    bodies = Bodies(**request["geometry"])
    paths = [[(int(c), int(lane)) for c, lane in path] for path in response["paths"]]
    if bodies.lateness_s is None:
        late_s = rng.choice((0.3, 1.0, 2.0, bodies.move_s))
        return least_gap_of_plan_m(bodies, paths, rng, late_s, bodies.move_s + late_s)
    return least_gap_of_plan_m(bodies, paths, rng, bodies.lateness_s, bodies.slot_s)
