"""Random arrivals at the start of the road.

In each lane the headway between two arrivals is

    min_headway + Exp(3600 / volume - min_headway)      (mean 3600 / volume seconds),

and the preferred lane of each vehicle is drawn from the scenario's lane shares, if there are any.
Every lane has one random generator for headways and one for preferences, seeded with the scenario's
seed. The same seed gives the same arrivals, arrivals in a lane do not depend on other lanes, and a
longer duration only appends arrivals, without changing the names of earlier ones.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from attrs import frozen
from numpy.random import SeedSequence, default_rng

from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario

_HEADWAYS, _PREFERENCES = 0, 1


@frozen
class Arrival:
    """Arrival of a vehicle at the entrance."""

    vehicle: str
    """Name: `v` and the number in order of arrival over all lanes, from 1."""
    lane: int
    """Lane in which the vehicle arrives; 0 is the rightmost."""
    preferred_lane: int
    """Lane in which the vehicle wants to leave the road; `ANY_LANE`: no preference."""
    t_s: float
    """Road time at which the vehicle would pass the start of an empty road."""

    def prefers(self, lane: int) -> bool:
        """Return whether the vehicle may leave the road in a lane."""
        return self.preferred_lane in (lane, ANY_LANE)


def arrivals(scenario: Scenario) -> tuple[Arrival, ...]:
    """Return the seeded arrivals in [0, demand.duration_s], sorted by time, then lane."""
    drawn = sorted(
        (t_s, lane, preferred)
        for lane in range(scenario.road.lanes)
        for t_s, preferred in _arrivals_in(lane, scenario)
    )
    return tuple(
        Arrival(vehicle_name(number), lane, preferred, t_s)
        for number, (t_s, lane, preferred) in enumerate(drawn, start=1)
    )


def count_until(stream: Sequence[Arrival], t_s: float) -> int:
    """Return the number of sorted arrivals up to a road time."""
    return bisect_right(stream, t_s, key=lambda arrival: arrival.t_s)


def _arrivals_in(lane: int, scenario: Scenario) -> list[tuple[float, int]]:
    """Return (time [s], preferred lane) of each arrival in one lane."""
    demand = scenario.demand
    mean_excess_s = max(0.0, 3600.0 / demand.volume_veh_per_lane_h - demand.min_headway_s)
    headways, preferences = (
        default_rng(SeedSequence(scenario.seed, spawn_key=(purpose, lane)))
        for purpose in (_HEADWAYS, _PREFERENCES)
    )
    shares = scenario.lane_shares
    # Drop the last bound: rounded to less than 1, it would exclude some draws in [0, 1).
    bounds = np.array([*accumulate(shares)][:-1])
    result: list[tuple[float, int]] = []
    t_s = 0.0
    while True:
        t_s += demand.min_headway_s + mean_excess_s * headways.standard_exponential()
        if t_s > demand.duration_s:
            return result
        preferred = int(np.searchsorted(bounds, preferences.random(), side="right"))
        result.append((float(t_s), preferred if shares else ANY_LANE))
