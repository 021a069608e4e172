"""Motions: what other vehicles have said of the moves that they are making.

A motion says who moves from which cell to which one and since when; its trajectory follows from
the scenario. Whether somebody who is sensed is the one who said so is told by place: sensing
knows no names, and what was said may be forged, or not be driven any more.
"""

from __future__ import annotations

import numpy as np
from attrs import define, frozen
from numpy.typing import NDArray

from laneweave.agents.driving.reference import move_profile
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.wire.messages import Motion, Name

Array = NDArray[np.float64]

REPEAT_TICKS = 10
"""A motion is sent when it begins, and again after so many ticks."""
FRESH_TICKS = 3 * REPEAT_TICKS
"""One that has not been repeated for longer does not count any more."""
NEAR_M = 1.0
"""Along the road, between where somebody is sensed and where a motion has its vehicle now."""
NEAR_MPS = 1.0
TURNED_M = 0.4
"""Bodies lag behind their references, and turn: they may touch a lane this much earlier, and leave
it this much later."""


@frozen(eq=False)
class _Kind:
    """All moves by as many columns and lanes in as many ticks: their trajectory from each tick."""

    ticks: int

    along_m: list[float]
    """Way along the road so far, relative to the lattice, by tick."""
    speeds_mps: list[float]
    """By tick, on the road."""
    ways_m: Array
    """By tick: the way from there at each tick of the horizon, on the road."""
    entered: int
    """Tick from which on the body touches the lane that the move leads to."""
    left: int
    """Tick from which on it does not touch the lane any more from which it came."""

    @classmethod
    def of(cls, scenario: Scenario, dx: int, dy: int, ticks: int) -> _Kind:
        """Lay a kind of move out for a horizon."""
        n, states = scenario.horizon_ticks, move_profile(scenario, dx, dy, ticks).states
        along = np.concatenate([states[:, 0], np.full(n, states[-1, 0])])
        starts = np.arange(ticks)[:, None]
        advance_m = scenario.formation.speed_mps * scenario.runtime.tick_s
        reach_m = scenario.vehicle.width_m / 2.0 + TURNED_M
        aside, half_m = np.abs(states[:, 3]), scenario.road.lane_width_m / 2.0
        # Without a change of lanes it is in both, which are one, all the time.
        return cls(
            ticks,
            along[:ticks].tolist(),
            (states[:ticks, 1] + scenario.formation.speed_mps).tolist(),
            along[starts + np.arange(n + 1)] - along[starts] + advance_m * np.arange(n + 1),
            int((aside + reach_m <= half_m).sum()) if dy else 0,
            int((aside - reach_m < half_m).sum()) if dy else ticks + n + 1,
        )


@define(eq=False)
class _Heard:
    """The newest motion of one vehicle."""

    motion: Motion
    kind: _Kind
    tick: int
    """When it was sent last."""
    start_m: float
    """Where it began, relative to the lattice."""
    low_m: float
    """Between here and `high_m` its vehicle is sensed while it lasts, relative to the lattice."""
    high_m: float


class Motions:
    """What one vehicle has heard of the motions of others."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin with nothing heard."""
        formation = scenario.formation
        self._scenario = scenario
        self._pitch_m = formation.gap_m
        self._oblique = formation.mode != 1
        self._advance_m = formation.speed_mps * scenario.runtime.tick_s
        self._durations = scenario.move_durations
        self._kinds: dict[tuple[int, int, int], _Kind] = {}
        self.heard: dict[Name, _Heard] = {}
        """By vehicle; some may count no more."""
        self._places: list[tuple[float, float, _Heard]] | None = None
        """(`low_m`, `high_m`, all) of each; None when some have come or gone since."""
        self._tick = 0
        self._forget_tick = 0
        """Tick at which one of them counts no more."""

    def hear(self, motion: Motion) -> None:
        """Take a motion, unless a newer one of its vehicle is known or nobody can drive it."""
        known = self.heard.get(motion.vehicle)
        if known is not None:
            newest = known.motion
            if _content(motion) == _content(newest):
                known.tick = max(known.tick, motion.tick)
                return
            if _content(motion)[:2] < _content(newest)[:2]:
                return
        (column, lane), (to_column, to_lane) = motion.origin, motion.target
        dx, dy = to_column - column, to_lane - lane
        ticks = motion.ticks
        if max(abs(dx), abs(dy)) != 1 or (dx and dy and not self._oblique):
            return  # no move of this scenario, whoever said so
        if ticks not in self._durations:
            return  # likewise
        kind = self._kinds.get((dx, dy, ticks))
        if kind is None:
            kind = self._kinds[dx, dy, ticks] = _Kind.of(self._scenario, dx, dy, ticks)
        start_m, end_m = column * self._pitch_m, to_column * self._pitch_m
        low_m, high_m = min(start_m, end_m) - NEAR_M, max(start_m, end_m) + NEAR_M
        self.heard[motion.vehicle] = _Heard(motion, kind, motion.tick, start_m, low_m, high_m)
        self._places = None
        self._forget_tick = -1  # it may have ended already

    def advance(self, tick: int) -> None:
        """Go on to a tick, and forget what counts no more.

        That is what has ended, was not repeated, or begins when nobody can know of it yet.
        """
        self._tick = tick
        if tick < self._forget_tick:
            return
        gone = [
            name
            for name, heard in self.heard.items()
            if not -FRESH_TICKS <= tick - heard.motion.begin_tick < heard.kind.ticks
            or tick > heard.tick + FRESH_TICKS
        ]
        for name in gone:
            del self.heard[name]
        self._places = None
        self._forget_tick = min(
            (
                min(heard.motion.begin_tick + heard.kind.ticks, heard.tick + FRESH_TICKS + 1)
                for heard in self.heard.values()
            ),
            default=tick,
        )

    def fronts(
        self,
        lane: int,
        s_m: float,
        speed_mps: float,
        lanes: tuple[int, int],
        nobody: float,
    ) -> Array | None:
        """Return where somebody who is sensed now will be, if a motion tells it.

        Args:
            lane: in which somebody is sensed; it counts.
            s_m: commanded position of the front bumper.
            speed_mps: commanded speed.
            lanes: the first and the last one that count.
            nobody: stands for the position when it has left them.

        Returns:
            Commanded positions (N + 1,), the first one where it is sensed.
        """
        tick = self._tick
        x_m = s_m - self._advance_m * tick
        places = self._places
        if places is None:
            # Tuples, since nearly all are passed over.
            places = [(heard.low_m, heard.high_m, heard) for heard in self.heard.values()]
            self._places = places
        for low_m, high_m, heard in places:
            if not low_m <= x_m <= high_m:
                continue
            kind = heard.kind
            k = max(tick - heard.motion.begin_tick, 0)  # others may be a tick ahead
            if (
                -NEAR_M <= heard.start_m + kind.along_m[k] - x_m <= NEAR_M
                and -NEAR_MPS <= kind.speeds_mps[k] - speed_mps <= NEAR_MPS
            ):
                origin, target = heard.motion.origin[1], heard.motion.target[1]
                if (lane == origin and k < kind.left) or (lane == target and k >= kind.entered):
                    fronts: Array = kind.ways_m[k] + s_m
                    if not lanes[0] <= target <= lanes[1]:
                        fronts[kind.left - k :] = nobody
                    return fronts
        return None


def _content(motion: Motion) -> tuple[int, int, Cell, Cell]:
    """Return what does not change when a motion is told again; the newer of two is greater."""
    return motion.incarnation, motion.begin_tick, motion.origin, motion.target
