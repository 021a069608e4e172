"""Safety and comfort of a run, measured from trajectories while they are recorded.

Surrogate safety measures concern pairs of vehicles in line, that is, whose bodies overlap
laterally. `gap` is the distance from the front of the vehicle behind to the rear of the one ahead,
v and v' are their speeds. Bodies count as rectangles along the road.

    time to collision (TTC)          gap / (v - v') while v > v' (Hayward 1972)
    deceleration rate to avoid a     (v - v')^2 / (2 gap) while v > v' (Almqvist et al. 1991)
    crash (DRAC)
    post-encroachment time (PET)     when a vehicle reaches into a lane: (1) the time until the next
                                     vehicle behind in that lane is where the rear of the entering
                                     vehicle was; (2) the time until the entering vehicle is where
                                     the rear of the next vehicle ahead was; 0: they are beside one
                                     another already (Allen et al. 1978, applied to lane changes)
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple, Self

import numpy as np
import pyarrow as pa
from attrs import frozen
from numpy.typing import NDArray

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.summary import (
    HARD_BRAKE_MPS2,
    MAX_COMFORTABLE_ACCEL_MPS2,
    MAX_COMFORTABLE_JERK_MPS3,
    TTC_CRITICAL_S,
    TTC_SHORT_S,
    Comfort,
)
from laneweave.sim_bridge.recording.statistics import finite

EMERGENCY_SHARE: Final = 0.9
"""Fraction of the braking limit beyond which braking counts as emergency braking."""
REACH_M: Final = 100.0
"""Maximum distance between the fronts of two vehicles in line."""
MAX_PET_S: Final = 10.0
"""Longer post-encroachment times are not measured."""
_TOUCH_M: Final = 1e-9
_ACCEL_BIN_MPS2, _JERK_BIN_MPS3, _BINS = 0.01, 0.1, 4000
"""Classes of the distributions from which percentiles are computed."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@frozen
class Rows:
    """Complete ticks in the order of time, a row per vehicle and tick; arrays of shape (rows,)."""

    names: Sequence[str]
    """Names of the vehicles, each once."""
    vehicle: Ints
    """Index of each row's name."""
    t_s: Floats
    s_m: Floats
    y_m: Floats
    speed_mps: Floats
    accel_mps2: Floats

    @classmethod
    def of(cls, vehicles: pa.Array[pa.StringScalar], *columns: Floats) -> Self:
        """Return rows with a name in each; `columns` are the other fields in their order."""
        codes = vehicles.dictionary_encode()
        numbers = codes.indices.to_numpy().astype(np.int64)
        return cls([str(name) for name in codes.dictionary], numbers, *columns)

    @property
    def columns(self) -> tuple[Floats, ...]:
        """All values, in the order of the fields."""
        return self.t_s, self.s_m, self.y_m, self.speed_mps, self.accel_mps2

    def finite(self) -> Rows:
        """Return the rows whose values are all finite; plug-in methods may record others."""
        good = np.all([np.isfinite(column) for column in self.columns], axis=0)
        return Rows(self.names, self.vehicle[good], *(column[good] for column in self.columns))

    def joined(self, later: Rows) -> Rows:
        """Return these rows followed by later ones."""
        numbers = {name: number for number, name in enumerate(self.names)}
        places = [numbers.setdefault(name, len(numbers)) for name in later.names]
        vehicle = [self.vehicle, np.array(places, dtype=np.int64)[later.vehicle]]
        pairs = zip(self.columns, later.columns, strict=True)
        return Rows(list(numbers), np.concatenate(vehicle), *map(np.concatenate, pairs))

    def since(self, first: int) -> Rows:
        """Return the rows from a number on, without names that do not occur in them."""
        kept, vehicle = np.unique(self.vehicle[first:], return_inverse=True)
        names = [self.names[number] for number in kept]
        return Rows(names, vehicle.astype(np.int64), *(column[first:] for column in self.columns))


class _Distribution:
    """Counts of values by class, from which their root mean square and percentiles follow."""

    def __init__(self, bin_width: float) -> None:
        self._bin_width = bin_width
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._sum_of_squares = self._max = 0.0

    def add(self, values: Floats) -> None:
        """Add absolute values."""
        numbers = np.minimum(np.rint(values / self._bin_width), _BINS - 1).astype(np.int64)
        self._max = max(self._max, float(values.max(initial=0.0)))
        self._counts += np.bincount(numbers, minlength=_BINS)
        self._sum_of_squares += float(values @ values)

    @property
    def rms(self) -> float:
        """Root mean square; NaN: there are no values."""
        count = int(self._counts.sum())
        return math.sqrt(self._sum_of_squares / count) if count else math.nan

    def percentile(self, percent: float) -> float:
        """Return a percentile, within half the width of a class; NaN: there are no values.

        A percentile in the last class, which is open, is the maximum.
        """
        total = np.cumsum(self._counts)
        if not total[-1]:
            return math.nan
        number = int(np.searchsorted(total, percent / 100.0 * total[-1]))
        return self._max if number == _BINS - 1 else self._bin_width * number


class _Encroachment(NamedTuple):
    """A place in a lane where the rear of one vehicle was, and that another one will reach."""

    vehicle: str
    """The vehicle that will reach it."""
    lane: int
    at_m: float
    since_s: float


class _Derived:
    """Sizes and lanes of rows, and the rows of the same vehicle one tick before and after."""

    def __init__(self, rows: Rows, scenario: Scenario, limits: Sequence[Vehicle]) -> None:
        lane_width_m, tick_s = scenario.road.lane_width_m, scenario.runtime.tick_s
        vehicle = rows.vehicle
        sizes_m = np.array([one.size_m for one in limits])[vehicle]
        self.length_m, self.half_width_m = sizes_m[:, 0], 0.5 * sizes_m[:, 1]
        self.brake_mps2 = np.array([EMERGENCY_SHARE * one.min_accel_mps2 for one in limits])[
            vehicle
        ]
        self.tick = np.cumsum(np.diff(rows.t_s, prepend=rows.t_s[0]) > 0.0)
        self.ticks = np.searchsorted(self.tick, np.arange(self.tick[-1] + 2))
        """First row of each tick, and the number of rows."""
        low_m = rows.y_m - self.half_width_m + _TOUCH_M
        high_m = rows.y_m + self.half_width_m - _TOUCH_M
        self.low_lane = np.floor(low_m / lane_width_m).astype(np.int64)
        self.high_lane = np.floor(high_m / lane_width_m).astype(np.int64)
        order = np.lexsort((self.tick, vehicle))
        follows = vehicle[order[1:]] == vehicle[order[:-1]]
        # Ticks without any vehicle have no rows.
        follows &= np.diff(rows.t_s[order]) < 1.5 * tick_s
        self.before = np.full(len(vehicle), -1)
        """Row of the same vehicle one tick before; -1: there is none."""
        self.before[order[1:][follows]] = order[:-1][follows]
        self.after = np.full(len(vehicle), -1)
        """Row of the same vehicle one tick later."""
        self.after[order[:-1][follows]] = order[1:][follows]


class DrivingMeasures:
    """Collector of safety and comfort; stores only what concerns vehicles on the road."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin without trajectories."""
        self._scenario = scenario
        self._tick_s = scenario.runtime.tick_s
        self._limits: dict[str, Vehicle] = {}
        """Sizes and limits of vehicles on the road; missing: those of a car."""
        self._last: Rows | None = None
        """Rows of the last tick."""
        self._open: list[_Encroachment] = []
        self._accels = _Distribution(_ACCEL_BIN_MPS2)
        self._jerks = _Distribution(_JERK_BIN_MPS3)
        self._hard_braking = set[str]()
        """Vehicles on the road that have braked hard."""
        self.hard_brakes = 0
        """Number of vehicles that have braked hard."""
        self._uncomfortable = self._driven = 0
        """Numbers of vehicle ticks."""
        self.emergency_brakes = 0
        self.min_accel_mps2, self.max_accel_mps2 = math.inf, -math.inf
        self.max_jerk_mps3 = -math.inf
        self.min_ttc_s = self.min_pet_s = math.inf
        self.max_drac_mps2 = 0.0
        """Maximum deceleration rate to avoid a crash, of vehicles that do not overlap."""
        self.ttc_below_s = dict.fromkeys((TTC_SHORT_S, TTC_CRITICAL_S), 0.0)
        """Time that vehicles have spent below each time to collision."""

    @property
    def comfort(self) -> Comfort | None:
        """Accelerations and jerks so far; None: no vehicle was on the road in successive ticks."""
        if not self._driven:
            return None
        return Comfort(
            accel_rms_mps2=finite(self._accels.rms),
            accel_p95_mps2=finite(self._accels.percentile(95.0)),
            jerk_rms_mps3=finite(self._jerks.rms),
            jerk_p95_mps3=finite(self._jerks.percentile(95.0)),
            uncomfortable_percent=finite(100.0 * self._uncomfortable / self._driven),
        )

    def enter(self, vehicle: str, limits: Vehicle) -> None:
        """Note size and limits of a vehicle; one for which this is not called counts as a car."""
        self._limits[vehicle] = limits

    def add(self, rows: Rows) -> None:
        """Measure the ticks that follow those measured so far; only finite rows count."""
        rows = rows.finite()
        if not len(rows.t_s):
            return
        known = 0 if self._last is None else len(self._last.t_s)
        if self._last is not None:
            rows = self._last.joined(rows)
        limits = [self._limits.get(name, self._scenario.vehicle) for name in rows.names]
        found = _Derived(rows, self._scenario, limits)
        self._measure_driving(rows, found, known)
        self._measure_gaps(rows, found, known)
        self._measure_encroachments(rows, found, known)
        self._last = rows.since(int(found.ticks[-2]))
        for name in set(rows.names).difference(self._last.names):
            self._limits.pop(name, None)
            self._hard_braking.discard(name)

    def _measure_driving(self, rows: Rows, found: _Derived, known: int) -> None:
        """Measure accelerations and jerks; the first `known` rows were measured before."""
        accel = rows.accel_mps2[known:]
        self.min_accel_mps2 = min(self.min_accel_mps2, float(accel.min()))
        self.max_accel_mps2 = max(self.max_accel_mps2, float(accel.max()))
        self._accels.add(np.abs(accel))
        hard = known + np.flatnonzero(accel < -HARD_BRAKE_MPS2)
        names = {rows.names[number] for number in np.unique(rows.vehicle[hard])}
        self.hard_brakes += len(names - self._hard_braking)
        self._hard_braking |= names
        brakes = rows.accel_mps2 < found.brake_mps2
        before = found.before[known:]
        braked_before = (before >= 0) & brakes[before]
        self.emergency_brakes += int(np.count_nonzero(brakes[known:] & ~braked_before))

        row = known + np.flatnonzero(before >= 0)
        last = found.before[row]
        jerk = np.abs(rows.accel_mps2[row] - rows.accel_mps2[last]) / self._tick_s
        self.max_jerk_mps3 = max(self.max_jerk_mps3, float(jerk.max(initial=-math.inf)))
        self._jerks.add(jerk)
        beyond = jerk > MAX_COMFORTABLE_JERK_MPS3
        beyond |= np.abs(rows.accel_mps2[row]) > MAX_COMFORTABLE_ACCEL_MPS2
        self._uncomfortable += int(np.count_nonzero(beyond))
        self._driven += len(row)

    def _measure_gaps(self, rows: Rows, found: _Derived, known: int) -> None:
        """Measure times to collision and decelerations to avoid a crash."""
        behind, ahead = _in_line(rows, found)
        closing_mps = rows.speed_mps[behind] - rows.speed_mps[ahead]
        chosen = (behind >= known) & (closing_mps > 0.0)
        behind, ahead, closing_mps = behind[chosen], ahead[chosen], closing_mps[chosen]
        gap_m = np.maximum(rows.s_m[ahead] - found.length_m[ahead] - rows.s_m[behind], 0.0)
        with np.errstate(over="ignore"):  # speeds of stopping vehicles can be subnormal
            ttc_s = gap_m / closing_mps
        apart = gap_m > 0.0
        drac_mps2 = closing_mps[apart] ** 2 / (2.0 * gap_m[apart])
        self.min_ttc_s = min(self.min_ttc_s, float(ttc_s.min(initial=math.inf)))
        self.max_drac_mps2 = max(self.max_drac_mps2, float(drac_mps2.max(initial=0.0)))
        for limit_s in self.ttc_below_s:
            self.ttc_below_s[limit_s] += self._tick_s * int(np.count_nonzero(ttc_s < limit_s))

    def _measure_encroachments(self, rows: Rows, found: _Derived, known: int) -> None:
        """Measure post-encroachment times of lane changes."""
        numbers = {name: number for number, name in enumerate(rows.names)}
        first_rows = dict(zip(rows.vehicle[:known].tolist(), range(known), strict=True))
        waiting = [
            (one, first_rows[number])
            for one in self._open
            if (number := numbers.get(one.vehicle)) in first_rows
        ]
        waiting += _encroachments(rows, found, known)
        self._open = []
        for one, row in waiting:
            reached_s = _reached_s(one, row, rows, found)
            if reached_s is None and rows.t_s[-1] < one.since_s + MAX_PET_S:
                self._open.append(one)
            elif reached_s is not None and reached_s <= one.since_s + MAX_PET_S:
                self.min_pet_s = min(self.min_pet_s, reached_s - one.since_s)


def _in_line(rows: Rows, found: _Derived) -> tuple[Ints, Ints]:
    """Return the rows of vehicles with another one ahead in line, and the rows of those ahead."""
    order = np.lexsort((rows.s_m, found.tick))
    tick, s_m, y_m = found.tick[order], rows.s_m[order], rows.y_m[order]
    half_m = found.half_width_m[order]
    pairs: list[tuple[Ints, Ints]] = []
    searching = np.arange(len(order))
    for step in range(1, len(order)):
        searching = searching[searching + step < len(order)]
        ahead = searching + step
        near = (tick[ahead] == tick[searching]) & (s_m[ahead] - s_m[searching] <= REACH_M)
        searching, ahead = searching[near], ahead[near]
        if not len(searching):
            break
        aside_m = np.abs(y_m[ahead] - y_m[searching])
        in_line = aside_m < half_m[ahead] + half_m[searching] - _TOUCH_M
        pairs.append((order[searching[in_line]], order[ahead[in_line]]))
        searching = searching[~in_line]
    if not pairs:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    behind, ahead = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return behind, ahead


def _encroachments(rows: Rows, found: _Derived, known: int) -> Iterator[tuple[_Encroachment, int]]:
    """Yield the encroachments of vehicles that reach into another lane, and the row of each.

    The row is that of the vehicle which will reach the place, at the time of the encroachment.
    """
    row = known + np.flatnonzero(found.before[known:] >= 0)
    last = found.before[row]
    for lanes, entered in (
        (found.high_lane, found.high_lane[row] > found.high_lane[last]),
        (found.low_lane, found.low_lane[row] < found.low_lane[last]),
    ):
        for own in row[entered].tolist():
            lane = int(lanes[own])
            tick = found.tick[own]
            beside = np.arange(found.ticks[tick], found.ticks[tick + 1])
            in_lane = (found.low_lane[beside] <= lane) & (lane <= found.high_lane[beside])
            beside = beside[in_lane & (beside != own)]
            is_ahead = rows.s_m[beside] > rows.s_m[own]
            ahead, behind = beside[is_ahead], beside[~is_ahead]
            t_s = float(rows.t_s[own])
            if len(behind):
                other = int(behind[np.argmax(rows.s_m[behind])])
                rear_m = float(rows.s_m[own] - found.length_m[own])
                name = rows.names[rows.vehicle[other]]
                yield _Encroachment(name, lane, rear_m, t_s), other
            if len(ahead):
                rears_m = rows.s_m[ahead] - found.length_m[ahead]
                name = rows.names[rows.vehicle[own]]
                yield _Encroachment(name, lane, float(rears_m.min()), t_s), own


def _reached_s(one: _Encroachment, row: int, rows: Rows, found: _Derived) -> float | None:
    """Return when the vehicle is at the place; infinite: it leaves the lane; None: not yet known.

    Args:
        one: the encroachment.
        row: a row of the vehicle before it reaches the place.
        rows: rows.
        found: what follows from them.
    """
    if rows.s_m[row] >= one.at_m:
        return float(rows.t_s[row])  # it is beside the other vehicle already
    last_s = one.since_s + MAX_PET_S
    while (later := int(found.after[row])) >= 0 and rows.t_s[row] < last_s:
        if not found.low_lane[later] <= one.lane <= found.high_lane[later]:
            return math.inf
        if rows.s_m[later] >= one.at_m:
            driven_m = rows.s_m[later] - rows.s_m[row]
            share = (one.at_m - rows.s_m[row]) / driven_m
            return float(rows.t_s[row] + share * (rows.t_s[later] - rows.t_s[row]))
        row = later
    return None
