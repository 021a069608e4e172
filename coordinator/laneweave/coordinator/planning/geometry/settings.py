"""Sizes, times and clearances from which conflicts are computed (`clearances`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import attrs
import numpy as np

from laneweave.coordinator.planning.geometry.bodies import (
    FRONT,
    LEFT,
    PEAK_SPEED,
    REAR,
    RIGHT,
    Floats,
    minimum_jerk_path,
    minimum_jerk_share,
    outline,
)
from laneweave.coordinator.planning.grid import Cell, displacements
from laneweave.coordinator.planning.json_fields import as_mapping
from laneweave.protocol.errors import BadInputError

_SAMPLES: Final = 128
"""Of a move of the default profile."""


def _between(least: float, most: float) -> Callable[[Any, attrs.Attribute[Any], Any], None]:
    def check(_: object, attribute: attrs.Attribute[Any], value: object) -> None:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (is_number and least <= value <= most):  # type: ignore[operator]
            allowed = f"a number from {least:g} to {most:g}"
            raise BadInputError(attribute.name, value, allowed)

    return check


@attrs.frozen(kw_only=True, cache_hash=True)
class Geometry:
    """What decides whether two moves bring two bodies too close; the defaults are the paper's.

    Two bodies are *too close* when at some moment less than `clearance_across_m` is between them
    sideways and, at the same moment, less than `clearance_along_m` between their bumpers.

    The least gap for which a vehicle's tracker follows its plan is 3 m (`tracking.min_gap_m`); the
    default clearance of 5 m leaves 2 m for errors and for braking. Two vehicles that drive behind
    each other are 10 m apart when both are on time, 6.4 m when the one ahead is 0.5 s late.
    Sideways 1.7 m are between bodies at rest. Moves that pass come either much closer than that or
    not at all: for any lateness the default geometry makes the same table from 0 to 1.4 m.
    """

    length_m: float = attrs.field(default=5.0, validator=_between(1, 30))
    """Of every body."""
    width_m: float = attrs.field(default=1.8, validator=_between(0.5, 4))
    """Of every body."""
    lane_width_m: float = attrs.field(default=3.5, validator=_between(2, 10))
    pitch_m: float = attrs.field(default=15.0, validator=_between(1, 200))
    """Length of a cell, d_F."""
    move_s: float = attrs.field(default=3.8, validator=_between(0.5, 60))
    """How long a move takes."""
    slot_s: float = attrs.field(default=4.0, validator=_between(0.5, 60))
    """From the beginning of one step to that of the next, T_F."""
    speed_mps: float = attrs.field(default=15.0, validator=_between(1, 60))
    """Of the lattice, v_F; the faster, the less bodies turn."""
    clearance_along_m: float = attrs.field(default=5.0, validator=_between(0, 200))
    clearance_across_m: float = attrs.field(default=0.3, validator=_between(0, 10))
    profile_error_along_m: float = attrs.field(default=0.6, validator=_between(0, 50))
    """By so much the gap between two vehicles may be smaller than the default profile says, because
    they drive another one. The default is right for trajectories of least jerk within the default
    limits of acceleration (0.55 m)."""
    profile_error_across_m: float = attrs.field(default=0.1, validator=_between(0, 10))
    """The same sideways (0.05 m)."""
    lateness_s: float | None = attrs.field(
        default=None, validator=attrs.validators.optional(_between(0, 60))
    )
    """Moves begin at most so long after their step does. None: each move of a step may begin at any
    time; somebody else, as the execution protocol, sees to it that steps come in order."""

    def __attrs_post_init__(self) -> None:
        """Check how the fields fit together.

        They do when moves whose footprints are disjoint keep the clearances, however late; then the
        table forbids no pair that footprints allow.

        Raises:
            BadInputError: names the first field that does not fit.
        """
        _require(
            self.pitch_m > self.length_m, self, "pitch_m", f"above length_m = {self.length_m:g}"
        )
        _require(
            self.lane_width_m > self.width_m,
            self,
            "lane_width_m",
            f"above width_m = {self.width_m:g}",
        )
        _require(self.slot_s >= self.move_s, self, "slot_s", f"at least move_s = {self.move_s:g}")
        backwards_mps = PEAK_SPEED * self.pitch_m / self.move_s
        _require(
            self.speed_mps > backwards_mps,
            self,
            "speed_mps",
            f"above {backwards_mps:.6g}, the speed at which a move of pitch_m = {self.pitch_m:g} "
            f"in move_s = {self.move_s:g} falls back",
        )
        along_m, across_m = self._gaps_of_neighbours_m()
        _require(
            along_m >= 0.0,
            self,
            "pitch_m",
            f"at least {_up(self.pitch_m - along_m)}, for length_m = {self.length_m:g}, bodies "
            "that turn, and profile errors",
        )
        _require(
            across_m >= 0.0,
            self,
            "lane_width_m",
            f"at least {_up(self.lane_width_m - across_m)}, for width_m = {self.width_m:g}, bodies "
            "that turn, and profile errors",
        )
        _require(
            self.clearance_along_m <= along_m,
            self,
            "clearance_along_m",
            f"at most {_down(along_m)}: pitch_m less length_m, turned bodies, profile errors",
        )
        _require(
            self.clearance_across_m <= across_m,
            self,
            "clearance_across_m",
            f"at most {_down(across_m)}: lane_width_m less width_m, turned bodies, profile errors",
        )
        if self.lateness_s is not None:
            most_s = self._most_lateness_s(along_m, across_m)
            _require(
                self.lateness_s <= most_s,
                self,
                "lateness_s",
                f"at most {_down(most_s)}, that bodies are near their cells when the next step "
                f"begins after slot_s = {self.slot_s:g}; or none, for any",
            )

    def paths(self) -> dict[Cell, Floats]:
        """Return the default profile: places (n + 1, 2) [m] of each displacement, least jerk."""
        return {
            (c, lane): minimum_jerk_path(c * self.pitch_m, lane * self.lane_width_m, _SAMPLES)
            for c, lane in displacements(2)
        }

    def outline(self, path: Floats) -> Floats:
        """Return what a body covers on a path (n + 1, 2) [m] of `move_s`; see `bodies.outline`."""
        return outline(path, self.move_s, self.speed_mps, self.length_m, self.width_m)

    def _gaps_of_neighbours_m(self) -> tuple[float, float]:
        """Return the least gaps along and across between vehicles with disjoint footprints.

        Their rectangles of cells are separated by a column or by a lane, and bodies stick out of
        their rectangles only because they turn.
        """
        along_m = across_m = 0.0
        for (c, lane), path in self.paths().items():
            edges = self.outline(path)
            way_m, side_m, half_m = c * self.pitch_m, lane * self.lane_width_m, 0.5 * self.width_m
            ahead_m = edges[:, FRONT].max() - max(way_m, 0.0)
            behind_m = min(way_m, 0.0) - self.length_m - edges[:, REAR].min()
            left_m = edges[:, LEFT].max() - max(side_m, 0.0) - half_m
            right_m = min(side_m, 0.0) - half_m - edges[:, RIGHT].min()
            along_m, across_m = max(along_m, ahead_m, behind_m), max(across_m, left_m, right_m)
        return (
            float(self.pitch_m - self.length_m - 2.0 * along_m - self.profile_error_along_m),
            float(self.lane_width_m - self.width_m - 2.0 * across_m - self.profile_error_across_m),
        )

    def _most_lateness_s(self, along_m: float, across_m: float) -> float:
        """Return how late moves may be without being in the way of those of the next step.

        A late move ends when others have begun to leave their cells, which are different ones.
        The less the one has still to go, the more the others have gone: together no more than the
        way made in the time by which lateness exceeds the rest of the slot (its first half grows
        ever faster).
        """
        share = min(
            (along_m - self.clearance_along_m) / self.pitch_m,
            (across_m - self.clearance_across_m) / self.lane_width_m,
            0.5,
        )
        times = np.linspace(0.0, 1.0, _SAMPLES + 1)
        passed = np.flatnonzero(minimum_jerk_share(times) <= share)
        return self.slot_s - self.move_s + float(times[passed[-1]]) * self.move_s

    @classmethod
    def from_dict(cls, data: object) -> Geometry:
        """Read the JSON form: an object with any of the fields.

        Raises:
            BadInputError: names the field, within `geometry`.
        """
        names = tuple(attribute.name for attribute in attrs.fields(cls))
        fields = as_mapping("geometry", data, names)
        try:
            return cls(**fields)
        except BadInputError as error:
            raise error.within("geometry") from None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return attrs.asdict(self)


def _require(ok: bool, geometry: Geometry, name: str, allowed: str) -> None:
    if not ok:
        raise BadInputError(name, getattr(geometry, name), allowed)


def _up(value: float) -> str:
    """Return a number that is not below the value."""
    return f"{math.ceil(value * 1e3) / 1e3:g}"


def _down(value: float) -> str:
    """Return a number that is not above the value."""
    return f"{math.floor(value * 1e3) / 1e3:g}"
