"""Vehicles that SUMO drives to the ramps of a corridor.

Each gets the first cell of its lane into which it can settle from its speed, behind the vehicle
before. If it would be at the ramp too early for this cell, it is advised to drive more slowly; the
time that it loses counts as delay. When its front is on the ramp, laneweave takes over.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

from attrs import evolve, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.corridors.settling import LONGEST_S, fall_back_m, settling_s
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission, EntryMeter, EntryState

RAMP_SHARE = 0.9
"""Share of the speed limit at which vehicles are expected to come to their ramp."""
ADVICE_SHARE = 0.7
"""Share of its maximum acceleration with which a vehicle is expected to accelerate."""
MIN_ADVICE_MPS = 3.0
"""Lowest speed that a vehicle is advised to drive."""
EARLY_S = 0.3
"""Time by which a vehicle may be too early without advice."""
BESIDE_COLUMNS = 3
"""Number of columns by which a vehicle rather falls back than entering beside another one."""
MAX_COLUMNS = 12
"""Maximum number of columns that are tried."""


@frozen
class Approaching:
    """A vehicle that SUMO drives towards a ramp, or on it."""

    arrival: Arrival
    s_m: float
    """Position of its front on the road; before `Entrance.at_m` it is not on the ramp yet."""
    speed_mps: float


class RampView(Protocol):
    """What SUMO drives to the ramps."""

    def approaching(self, lane: int) -> Sequence[Approaching]:
        """Return the vehicles that come to the ramp of a lane, the foremost first."""

    def advise(self, vehicle: str, speed_mps: float | None) -> None:
        """Set the speed at which a vehicle is driven towards its ramp; None: its own."""

    @property
    def exhausted(self) -> bool:
        """Whether no vehicles come to a ramp any more."""


class CorridorRamps:
    """Takes vehicles over from SUMO; see `RampTraffic`."""

    def __init__(self, scenario: Scenario, view: RampView, speeds_mps: Mapping[int, float]) -> None:
        """Begin without vehicles.

        Args:
            scenario: road, types of vehicles.
            view: the vehicles on their way to the ramps.
            speeds_mps: speed limit of the ramp of each lane.
        """
        self._view = view
        self._speeds_mps = {lane: RAMP_SHARE * one for lane, one in speeds_mps.items()}
        self._lattice = scenario.lattice
        self._limits = {name: one.vehicle for name, one in scenario.types.items()}
        self._at_m = {one.lane: one.at_m for one in scenario.entrance}
        move_m = scenario.formation.speed_mps * scenario.cycles_s[0]
        lines_m = {
            one.lane: min(
                (
                    end.line_m
                    for end in dead_ends(scenario)
                    if end.lane == one.lane and end.end_m > one.at_m
                ),
                default=scenario.road.length_m,
            )
            for one in scenario.entrance
        }
        self._longest_s = {
            lane: min((lines_m[lane] - move_m - at_m) / scenario.formation.speed_mps, LONGEST_S)
            for lane, at_m in self._at_m.items()
        }
        """Time in which a vehicle has to settle to change lanes in time, by lane."""
        self._occupied: Collection[Cell] = ()
        """Cells in which vehicles are, or to which they move."""
        self._known: dict[Name, Arrival] = {}
        """Approaching vehicles, each with the time at which it was first expected at its ramp."""

    def demanded(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that have come near a ramp since the last call."""
        new = []
        for lane, at_m in self._at_m.items():
            for one in self._view.approaching(lane):
                name = Name(one.arrival.vehicle)
                if name not in self._known:
                    expected_s = t_s + (at_m - one.s_m) / max(
                        one.speed_mps, self._lattice.speed_mps
                    )
                    self._known[name] = evolve(one.arrival, t_s=expected_s)
                    new.append(self._known[name])
        return new

    def announced(self) -> Sequence[Arrival]:
        """Return the vehicles that approach."""
        return [*self._known.values()]

    @property
    def exhausted(self) -> bool:
        """Whether no more vehicles will come."""
        return self._view.exhausted

    def admit(self, t_s: float, meter: EntryMeter, occupied: Collection[Cell]) -> list[Admission]:
        """Take over the vehicles whose fronts are on their ramps, and advise the others."""
        admissions = []
        self._occupied = occupied
        for lane, at_m in self._at_m.items():
            column = meter.next_open(lane, t_s)
            for one in self._view.approaching(lane):
                name = Name(one.arrival.vehicle)
                if name not in self._known:
                    continue  # it has come since `demanded`
                if one.s_m < at_m:
                    column = self._advise(one, lane, column, t_s, meter)
                    continue
                admission = self._take(one, lane, column, t_s, meter)
                admissions.append(admission)
                column = admission.cell[0] - 1
                del self._known[name]
        return admissions

    def _take(
        self, one: Approaching, lane: int, first: int, t_s: float, meter: EntryMeter
    ) -> Admission:
        """Return the entry of a vehicle whose front is on its ramp."""
        arrival = self._known[Name(one.arrival.vehicle)]
        slower_mps = self._lattice.speed_mps - one.speed_mps
        limits = self._limits[arrival.vehicle_type]
        settling: list[tuple[bool, int, int, float]] = []
        for column in range(first, first - MAX_COLUMNS, -1):
            ahead_m = one.s_m - self._lattice.cell_s_m(column, t_s)
            time_s = settling_s(ahead_m, slower_mps, self._lattice.speed_mps, limits)
            if time_s is not None and meter.is_possible(arrival, column):
                late = time_s > self._longest_s[lane]
                settling.append((late, self._cost(column, lane), column, time_s))
        # If it settles too late, it may have to stop at the end of its lane.
        if settling:
            _, _, column, time_s = min(settling)
        else:
            column, time_s = first, LONGEST_S
            while not meter.is_possible(arrival, column):
                column -= 1
        return self._admission(one, arrival, column, time_s, t_s, meter)

    def _cost(self, column: int, lane: int) -> int:
        """Return how far behind a column is; more if a vehicle beside it has to make room first."""
        is_beside = (column, lane + 1) in self._occupied
        return BESIDE_COLUMNS * is_beside - column

    def _admission(
        self,
        one: Approaching,
        arrival: Arrival,
        column: int,
        time_s: float,
        t_s: float,
        meter: EntryMeter,
    ) -> Admission:
        if not meter.take(arrival, column):
            raise RuntimeError(f"{arrival.vehicle} cannot have column {column}")
        ahead_m = one.s_m - self._lattice.cell_s_m(column, t_s)
        start = EntryState(one.s_m, one.speed_mps, time_s)
        return Admission(arrival, (column, arrival.lane), t_s, ahead_m, start=start)

    def _advise(
        self, one: Approaching, lane: int, first: int, t_s: float, meter: EntryMeter
    ) -> int:
        """Advise a vehicle for the first cell that it can reach; return the column behind it."""
        arrival = self._known[Name(one.arrival.vehicle)]
        lattice, limits = self._lattice, self._limits[arrival.vehicle_type]
        distance_m = self._at_m[lane] - one.s_m
        # SUMO drives at the limit of the ramp, if nothing is ahead.
        comes_mps = max(one.speed_mps, self._speeds_mps[lane])
        slower_mps = round(lattice.speed_mps - comes_mps, 0)
        longest_s = self._longest_s[lane]
        fall_back = fall_back_m(slower_mps, lattice.speed_mps, limits, longest_s)
        accel_mps2 = ADVICE_SHARE * limits.max_accel_mps2
        comes_s = t_s + _shortest_s(distance_m, one.speed_mps, comes_mps, accel_mps2)
        for column in sorted(
            range(first, first - MAX_COLUMNS, -1), key=lambda column: self._cost(column, lane)
        ):
            if not meter.is_possible(arrival, column):
                continue
            wanted_s = lattice.passing_time_s(column, self._at_m[lane] - fall_back)
            if wanted_s < comes_s - EARLY_S:
                continue  # the cell will have passed
            advice = None
            if wanted_s > comes_s + EARLY_S:
                advice = _slow_mps(distance_m, wanted_s - t_s, comes_mps, accel_mps2)
            self._view.advise(arrival.vehicle, advice)
            return column - 1
        self._view.advise(arrival.vehicle, None)
        return first


def _shortest_s(distance_m: float, speed_mps: float, end_mps: float, accel_mps2: float) -> float:
    """Return the time for a distance, accelerating to `end_mps` and then at this speed."""
    gained_m = (end_mps**2 - speed_mps**2) / (2.0 * accel_mps2)
    if gained_m >= distance_m:
        end_mps = math.sqrt(speed_mps**2 + 2.0 * accel_mps2 * distance_m)
        return (end_mps - speed_mps) / accel_mps2
    return (end_mps - speed_mps) / accel_mps2 + (distance_m - gained_m) / end_mps


def _slow_mps(distance_m: float, time_s: float, end_mps: float, accel_mps2: float) -> float | None:
    """Return the speed at which a vehicle drives first, to come in time and at `end_mps`.

    None: it is time to accelerate.
    """
    low, high = MIN_ADVICE_MPS, end_mps
    if distance_m <= (end_mps**2 - low**2) / (2.0 * accel_mps2):
        low = math.sqrt(max(end_mps**2 - 2.0 * accel_mps2 * distance_m, 0.0))
        if low >= end_mps - 0.5:
            return None
    for _ in range(12):
        middle = 0.5 * (low + high)
        later = _cruising_s(distance_m, middle, end_mps, accel_mps2) > time_s
        low, high = (middle, high) if later else (low, middle)
    return high


def _cruising_s(distance_m: float, slow_mps: float, end_mps: float, accel_mps2: float) -> float:
    """Return the time for a distance, at a slow speed and then accelerating to `end_mps`."""
    gained_m = (end_mps**2 - slow_mps**2) / (2.0 * accel_mps2)
    return (distance_m - gained_m) / slow_mps + (end_mps - slow_mps) / accel_mps2
