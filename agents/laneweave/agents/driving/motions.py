"""Announced motions: moves that other vehicles have published.

A MOTION message contains the cells, start and duration of a move; the trajectory follows from the
scenario. Announced motions are matched with sensed neighbours by position and speed, because
sensors do not report names and an announcement may be forged or outdated.
"""

from __future__ import annotations

import numpy as np
from attrs import define, frozen
from numpy.typing import NDArray

from laneweave.agents.driving.trajectory import move_profile
from laneweave.protocol.lattice import Cell, displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Motion, Name

Array = NDArray[np.float64]

REPEAT_TICKS = 10
"""Interval at which a motion in progress is published again."""
FRESH_TICKS = 3 * REPEAT_TICKS
"""Time since its last message after which a motion is dropped."""
NEAR_M = 1.0
"""Maximum distance along the road between a neighbour and a matching motion."""
NEAR_MPS = 1.0
"""Maximum difference in speed between a neighbour and a matching motion."""
TURNED_M = 0.4
"""Extra sideways reach of a body that changes lanes, because it lags behind its reference and
turns."""


@frozen(eq=False)
class _MoveTable:
    """Trajectory shared by all moves with the same displacement and duration."""

    ticks: int
    along_m: list[float]
    """Distance covered along the road, relative to the lattice, by tick."""
    speeds_mps: list[float]
    """Speed on the road, by tick."""
    ahead_m: Array
    """(ticks, N + 1): distance from each tick's position to the positions over the next horizon."""
    entered: int
    """First tick at which the body touches the target lane."""
    left: int
    """First tick at which the body no longer touches the lane of origin."""

    @classmethod
    def of(cls, scenario: Scenario, dx: int, dy: int, ticks: int) -> _MoveTable:
        """Tabulate a move of a car."""
        n = scenario.timing.horizon_ticks
        states = move_profile(scenario, scenario.vehicle, dx, dy, ticks).states
        along = np.concatenate([states[:, 0], np.full(n, states[-1, 0])])
        starts = np.arange(ticks)[:, None]
        advance_m = scenario.formation.speed_mps * scenario.runtime.tick_s
        reach_m = scenario.types.widest_body_m / 2.0 + TURNED_M
        aside, half_m = np.abs(states[:, 3]), scenario.road.lane_width_m / 2.0
        # Without a lane change, the lane of origin is the target lane throughout.
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
    """Newest announced motion of one vehicle."""

    motion: Motion
    table: _MoveTable
    tick: int
    """Tick at which the motion was last sent."""
    start_m: float
    """Position of the motion's origin, relative to the lattice."""
    low_m: float
    high_m: float
    """Range of positions at which the vehicle can be sensed, relative to the lattice."""


class Motions:
    """Announced motions that one vehicle has received."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin without motions."""
        formation = scenario.formation
        self._scenario = scenario
        self._pitch_m = formation.gap_m
        self._moves = displacements(formation.mode)[1:]
        self._advance_m = formation.speed_mps * scenario.runtime.tick_s
        self._durations = scenario.timing.move_durations
        self._tables: dict[tuple[int, int, int], _MoveTable] = {}
        self.known: dict[Name, _Known] = {}
        """Motions by vehicle; may include outdated ones until `advance` drops them."""
        self._places: list[tuple[float, float, _Known]] | None = None
        """(`low_m`, `high_m`, motion) of each motion; None after `known` has changed."""
        self._tick = 0
        self._expiry_tick = 0
        """Earliest tick at which a motion becomes outdated."""

    def add(self, motion: Motion) -> None:
        """Add a motion, unless the move is impossible or a newer motion of its vehicle is known."""
        known = self.known.get(motion.vehicle)
        if known is not None:
            content, newest = _content(motion), _content(known.motion)
            if content == newest:
                known.tick = max(known.tick, motion.tick)
                return
            if content[:2] < newest[:2]:
                return
        (column, lane), (to_column, to_lane) = motion.origin, motion.target
        dx, dy = to_column - column, to_lane - lane
        ticks = motion.ticks
        if (dx, dy) not in self._moves or ticks not in self._durations:
            return  # not a move of this scenario
        table = self._tables.get((dx, dy, ticks))
        if table is None:
            # A motion does not name the type. Types that are weaker than cars may drive profiles
            # up to 1 m away: such an announcement is not matched for half a second.
            table = self._tables[dx, dy, ticks] = _MoveTable.of(self._scenario, dx, dy, ticks)
        start_m, end_m = column * self._pitch_m, to_column * self._pitch_m
        low_m, high_m = min(start_m, end_m) - NEAR_M, max(start_m, end_m) + NEAR_M
        self.known[motion.vehicle] = _Known(motion, table, motion.tick, start_m, low_m, high_m)
        self._places = None
        self._expiry_tick = -1  # the motion may have ended already

    def advance(self, tick: int) -> None:
        """Set the current tick; drop motions that are over, have expired or begin much later."""
        if self._tick <= tick < self._expiry_tick:
            self._tick = tick
            return
        self._tick = tick  # a lower tick means another road
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
        """Return the predicted positions of a sensed neighbour with an announced motion.

        Args:
            lane: relevant lane in which the neighbour is sensed.
            s_m: commanded position of its front bumper.
            speed_mps: its commanded speed.
            lanes: the first and the last relevant lane.
            free: value for positions after the neighbour has left these lanes.

        Returns:
            Commanded positions (N + 1,), starting with `s_m`; None: no motion matches.
        """
        tick = self._tick
        x_m = s_m - self._advance_m * tick
        places = self._places
        if places is None:
            # Tuples are fast to skip, and nearly all are skipped.
            places = [(known.low_m, known.high_m, known) for known in self.known.values()]
            self._places = places
        for low_m, high_m, known in places:
            if not low_m <= x_m <= high_m:
                continue
            table = known.table
            k = max(tick - known.motion.begin_tick, 0)  # the sender may be a tick ahead
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
    """Return the fields that repetitions share; those of a newer motion compare greater."""
    return motion.incarnation, motion.begin_tick, motion.origin, motion.target
