"""Announced motions: the moves that other vehicles have published.

A MOTION message names a move's cells and its start; the trajectory follows from the scenario. An
announced motion is matched with a sensed neighbour by place and speed: sensors do not know names,
and an announcement may be forged or no longer driven.
"""

from __future__ import annotations

import numpy as np
from attrs import define, frozen
from numpy.typing import NDArray

from laneweave.agents.driving.trajectory import move_profile
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Motion, Name

Array = NDArray[np.float64]

REPEAT_TICKS = 10
"""A motion is sent when it begins and repeated at this interval."""
FRESH_TICKS = 3 * REPEAT_TICKS
"""A motion that has not been repeated for longer is dropped."""
NEAR_M = 1.0
"""Largest distance along the road between a neighbour and the motion that it is matched with."""
NEAR_MPS = 1.0
"""Largest difference of their speeds."""
TURNED_M = 0.4
"""Bodies lag behind their references and turn: they may touch a lane this much earlier, and leave
it this much later."""


@frozen(eq=False)
class _MoveTable:
    """The trajectory of all moves by the same columns and lanes in the same time."""

    ticks: int

    along_m: list[float]
    """Distance covered along the road, relative to the lattice, by tick."""
    speeds_mps: list[float]
    """Speed on the road, by tick."""
    ahead_m: Array
    """(ticks, N + 1): distance from each tick's position to those of the following horizon."""
    entered: int
    """First tick at which the body touches the target lane."""
    left: int
    """First tick at which the body no longer touches the lane of origin."""

    @classmethod
    def of(cls, scenario: Scenario, dx: int, dy: int, ticks: int) -> _MoveTable:
        """Tabulate a move."""
        n, states = scenario.horizon_ticks, move_profile(scenario, dx, dy, ticks).states
        along = np.concatenate([states[:, 0], np.full(n, states[-1, 0])])
        starts = np.arange(ticks)[:, None]
        advance_m = scenario.formation.speed_mps * scenario.runtime.tick_s
        reach_m = scenario.vehicle.width_m / 2.0 + TURNED_M
        aside, half_m = np.abs(states[:, 3]), scenario.road.lane_width_m / 2.0
        # Without a lane change the lane of origin is the target lane all the time.
        return cls(
            ticks,
            along[:ticks].tolist(),
            (states[:ticks, 1] + scenario.formation.speed_mps).tolist(),
            along[starts + np.arange(n + 1)] - along[starts] + advance_m * np.arange(n + 1),
            int((aside + reach_m <= half_m).sum()) if dy else 0,
            int((aside - reach_m < half_m).sum()) if dy else ticks + n + 1,
        )


@define(eq=False)
class _Known:
    """The newest announced motion of one vehicle."""

    motion: Motion
    table: _MoveTable
    tick: int
    """When it was sent last."""
    start_m: float
    """Where it began, relative to the lattice."""
    low_m: float
    """Its vehicle is sensed between here and `high_m` while it lasts, relative to the lattice."""
    high_m: float


class Motions:
    """The announced motions that one vehicle knows."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin without any."""
        formation = scenario.formation
        self._scenario = scenario
        self._pitch_m = formation.gap_m
        self._diagonal = formation.mode != 1
        self._advance_m = formation.speed_mps * scenario.runtime.tick_s
        self._durations = scenario.move_durations
        self._tables: dict[tuple[int, int, int], _MoveTable] = {}
        self.known: dict[Name, _Known] = {}
        """By vehicle; may contain outdated ones until `advance` drops them."""
        self._places: list[tuple[float, float, _Known]] | None = None
        """(`low_m`, `high_m`, motion) of each; None when `known` has changed."""
        self._tick = 0
        self._expiry_tick = 0
        """Tick at which the next one is outdated."""

    def add(self, motion: Motion) -> None:
        """Add a motion, unless a newer one of its vehicle is known or it is no possible move."""
        known = self.known.get(motion.vehicle)
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
        if max(abs(dx), abs(dy)) != 1 or (dx and dy and not self._diagonal):
            return  # not a move of this scenario
        if ticks not in self._durations:
            return
        table = self._tables.get((dx, dy, ticks))
        if table is None:
            table = self._tables[dx, dy, ticks] = _MoveTable.of(self._scenario, dx, dy, ticks)
        start_m, end_m = column * self._pitch_m, to_column * self._pitch_m
        low_m, high_m = min(start_m, end_m) - NEAR_M, max(start_m, end_m) + NEAR_M
        self.known[motion.vehicle] = _Known(motion, table, motion.tick, start_m, low_m, high_m)
        self._places = None
        self._expiry_tick = -1  # it may have ended already

    def advance(self, tick: int) -> None:
        """Set the current tick and drop outdated motions.

        Those are motions that have ended, were not repeated, or begin too far in the future.
        """
        if self._tick <= tick < self._expiry_tick:
            self._tick = tick
            return
        self._tick = tick  # a lower one is of another road, on which all are outdated
        outdated = [
            name
            for name, known in self.known.items()
            if not -FRESH_TICKS <= tick - known.motion.begin_tick < known.table.ticks
            or tick > known.tick + FRESH_TICKS
        ]
        for name in outdated:
            del self.known[name]
        self._places = None
        self._expiry_tick = min(
            (
                min(known.motion.begin_tick + known.table.ticks, known.tick + FRESH_TICKS + 1)
                for known in self.known.values()
            ),
            default=tick,
        )

    def fronts(
        self,
        lane: int,
        s_m: float,
        speed_mps: float,
        lanes: tuple[int, int],
        free: float,
    ) -> Array | None:
        """Return the future positions of a sensed neighbour whose motion is known.

        Args:
            lane: lane in which it is sensed, a relevant one.
            s_m: commanded position of its front bumper.
            speed_mps: its commanded speed.
            lanes: the first and the last relevant lane.
            free: value of the positions after it has left these lanes.

        Returns:
            Commanded positions (N + 1,), beginning with `s_m`; None: no motion matches.
        """
        tick = self._tick
        x_m = s_m - self._advance_m * tick
        places = self._places
        if places is None:
            # Tuples, since nearly all are skipped.
            places = [(known.low_m, known.high_m, known) for known in self.known.values()]
            self._places = places
        for low_m, high_m, known in places:
            if not low_m <= x_m <= high_m:
                continue
            table = known.table
            k = max(tick - known.motion.begin_tick, 0)  # others may be a tick ahead
            if (
                -NEAR_M <= known.start_m + table.along_m[k] - x_m <= NEAR_M
                and -NEAR_MPS <= table.speeds_mps[k] - speed_mps <= NEAR_MPS
            ):
                origin, target = known.motion.origin[1], known.motion.target[1]
                if (lane == origin and k < table.left) or (lane == target and k >= table.entered):
                    fronts: Array = table.ahead_m[k] + s_m
                    if not lanes[0] <= target <= lanes[1]:
                        fronts[table.left - k :] = free
                    return fronts
        return None


def _content(motion: Motion) -> tuple[int, int, Cell, Cell]:
    """Return what does not change when a motion is repeated; the newer of two is greater."""
    return motion.incarnation, motion.begin_tick, motion.origin, motion.target
