"""Timing: the possible values of T_F, durations of moves, and the tracker's horizon."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

from attrs import frozen

from laneweave.protocol.road_layout import LaneSection
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.vehicle_tables import PEAK_ACCEL, PEAK_JERK, Vehicle
from laneweave.protocol.summary import TTC_SHORT_S

SHORTEST_CYCLE_S, LONGEST_CYCLE_S = 4.0, 7.0
"""Range of T_F if `formation.cycle_s` is not set; the lower end is the paper's value."""
COMFORTABLE_MPS2, BRISK_MPS2 = 3.0, 3.5
"""Maximum acceleration of minimum-jerk moves: with `comfortable_cycle_s`, with `brisk_cycle_s`."""
ROLLING_CYCLES_S = ((2000.0, 6.0), (2200.0, 5.4), (math.inf, 5.0))
"""Volumes [vehicles/(lane h)] in ascending order, and T_F [s] of the rolling operation up to each;
denser traffic needs more steps on the same road (decision 76)."""
GENTLE_RATIO = 0.9
"""Maximum ratio between the peaks of a minimum-jerk move, its acceleration and its jerk, and their
limits, at which there is a gentle move of the same duration (decision 76)."""
MIN_TTC_S = TTC_SHORT_S + 0.2
"""Minimum time to collision of a gentle move, with a margin for tracking errors."""
GENTLE_TTC_SHARE = 0.7
"""Minimum time to collision that a gentle move can keep, as a fraction of `longest_ttc_s`; like
`GENTLE_RATIO`, a conservative estimate."""
MIN_MERGING_SLOTS = 4
"""Number of slots that the rolling operation should have in a lane that begins and ends on the
road, as that of a ramp; with three, up to 1 % of the vehicles did not change lanes in time at 2000
vehicles/(lane h)."""
CYCLE_STEP_S = 0.2
"""Step between values of T_F; few values keep the number of planned trajectories low."""


def longest_ttc_s(gap_m: float, closer_m: float, duration_s: float) -> float:
    """Return the longest possible minimum time to collision while a gap shrinks by `closer_m`.

    It is that of a gap which shrinks exponentially.
    """
    return duration_s / math.log(gap_m / (gap_m - closer_m))


@frozen
class Timing:
    """The slots of a scenario, which are the same for all types of vehicles."""

    _formation: FormationSettings
    _cars: Vehicle
    _volume_veh_per_lane_h: float
    _sections: Sequence[LaneSection]
    _length_m: float
    """Length of the road."""
    _tick_s: float
    _horizon_ticks: int | None
    """Horizon of the tracker; None: the longest T_F."""

    @cached_property
    def cycles_s(self) -> tuple[float, float]:
        """Shortest and longest T_F [s]; equal in the rolling operation."""
        cycle_s = self._formation.cycle_s
        if cycle_s is not None:
            return cycle_s, cycle_s
        if self._formation.traits.common_slots:
            volume = self._volume_veh_per_lane_h
            cycle_s = next(one_s for max_volume, one_s in ROLLING_CYCLES_S if volume <= max_volume)
            cycle_s = max(cycle_s, self._shortest_cycle_s)
            longest_s = self._shortest_merging_s / MIN_MERGING_SLOTS
            if cycle_s > longest_s:
                steps = math.floor(longest_s / CYCLE_STEP_S + 1e-9)
                cycle_s = min(cycle_s, max(CYCLE_STEP_S * steps, self._shortest_cycle_s))
            return cycle_s, cycle_s
        return self._shortest_cycle_s, max(self._shortest_cycle_s, LONGEST_CYCLE_S)

    @property
    def _shortest_cycle_s(self) -> float:
        """Shortest T_F for which moves are likely to be possible, at least `SHORTEST_CYCLE_S`.

        A minimum-jerk move over d in T closes up with at most 15/8 d/T and accelerates with
        10 / sqrt(3) d / T^2 at most. Moves are possible if these do not exceed `closing_mps` and
        `accel_ratio` times the limit (which a trajectory within the limit can replace), in nearly
        all cases.
        """
        if not self._formation.change_columns:
            return SHORTEST_CYCLE_S
        # T_F is the same for all types; those that are weaker drive fewer moves.
        d_m, accel_mps2 = self._formation.gap_m, self._cars.max_accel_mps2
        traits, closing_mps = self._formation.traits, self._formation.traits.closing_mps
        if closing_mps is None:
            closing_mps = self._formation.speed_mps / 2.0
        by_speed_s = 15.0 / 8.0 * d_m / closing_mps
        by_accel_s = math.sqrt(PEAK_ACCEL * d_m / (traits.accel_ratio * accel_mps2))
        slot_s = max(by_speed_s, by_accel_s) + self._formation.slack_s
        return max(SHORTEST_CYCLE_S, CYCLE_STEP_S * math.ceil(slot_s / CYCLE_STEP_S - 1e-9))

    @property
    def _shortest_merging_s(self) -> float:
        """Shortest time at v_F in a section that begins and ends on the road."""
        sections_m = (
            section.to_m - max(section.from_m, section.moves_from_m)
            for section in self._sections
            if section.from_m > 0.0 and section.to_m < self._length_m
        )
        return min(sections_m, default=math.inf) / self._formation.speed_mps

    @property
    def slots_s(self) -> tuple[float, ...]:
        """Possible values of T_F [s], ascending in steps of `CYCLE_STEP_S`."""
        shortest_s, longest_s = self.cycles_s
        count = round((longest_s - shortest_s) / CYCLE_STEP_S)
        return tuple(shortest_s + CYCLE_STEP_S * number for number in range(count + 1))

    @property
    def comfortable_cycle_s(self) -> float:
        """Shortest T_F [s] with minimum-jerk moves within `COMFORTABLE_MPS2`; if none, the longest.

        Gentle moves (decision 76) may exceed it slightly if d_F is short.
        """
        return self._shortest_within(COMFORTABLE_MPS2)

    @property
    def brisk_cycle_s(self) -> float:
        """Shortest T_F [s] with gentle moves, and minimum-jerk moves within `BRISK_MPS2`."""
        return max(self._shortest_within(BRISK_MPS2), self.gentle_cycle_s)

    @property
    def gentle_cycle_s(self) -> float:
        """T_F [s] from which cars' moves by a column are gentle; if there is none, the longest.

        It is estimated, and up to 1.2 s above the shortest such T_F.
        """
        cars, pitch_m = self._cars, self._formation.gap_m
        beyond_m = 2.0 * pitch_m - cars.length_m
        by_ttc_s = MIN_TTC_S / (GENTLE_TTC_SHARE * longest_ttc_s(beyond_m, pitch_m, 1.0))
        by_jerk_s = math.cbrt(PEAK_JERK * pitch_m / (GENTLE_RATIO * cars.max_jerk_mps3))
        within_accel_s = self._shortest_within(GENTLE_RATIO * cars.max_accel_mps2)
        return max(self._shortest_from(max(by_ttc_s, by_jerk_s)), within_accel_s)

    def _shortest_within(self, accel_mps2: float) -> float:
        """Return the shortest T_F with minimum-jerk moves within a limit; if none, the longest."""
        return self._shortest_from(math.sqrt(PEAK_ACCEL * self._formation.gap_m / accel_mps2))

    def _shortest_from(self, min_s: float) -> float:
        """Return the shortest T_F with moves of at least `min_s`; if none, the longest."""
        enough = (one for one in self.slots_s if one >= min_s + self._formation.slack_s)
        return min(enough, default=self.slots_s[-1])

    @property
    def horizon_ticks(self) -> int:
        """Horizon of the tracker in ticks."""
        ticks = self._horizon_ticks
        return round(self.cycles_s[1] / self._tick_s) if ticks is None else ticks

    @property
    def move_s(self) -> float:
        """Duration of a move in the shortest T_F [s]."""
        return self.cycles_s[0] - self._formation.slack_s

    def move_ticks(self, slot_s: float) -> int:
        """Return the duration of a move [ticks] in slots of this length."""
        return round((slot_s - self._formation.slack_s) / self._tick_s)

    @property
    def move_durations(self) -> frozenset[int]:
        """Possible durations of a move in ticks."""
        return frozenset(map(self.move_ticks, self.slots_s))
