"""Random arrivals at the entrances of the road: its start, and ramps.

In each lane in which vehicles enter, the headway between two arrivals is

    min_headway + Exp(3600 / volume - min_headway)      (mean 3600 / volume seconds),

and the destination of each vehicle, an exit or a preferred lane at the end of the road, is drawn
from the shares of its entrance, as is its type. Every lane has one random generator for headways,
one for destinations and one for types, seeded with the scenario's seed. The same seed gives the
same arrivals, arrivals in a lane do not depend on other lanes, and a longer duration only appends
arrivals, without changing the names of earlier ones.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate

import numpy as np
from attrs import Factory, field, frozen
from numpy.random import SeedSequence, default_rng

from laneweave.protocol.config.participants import vehicle_name
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.traffic_flow import Inflow
from laneweave.protocol.wire.messages import CAR

_HEADWAYS, _PREFERENCES, _TYPES = 0, 1, 2


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
    """Road time at which the vehicle would pass its entrance on an empty road."""
    destination: str = END_OF_ROAD
    """Name of the exit by which the vehicle wants to leave the road, or `END_OF_ROAD`."""
    vehicle_type: str = CAR
    sumo_id: str = ""
    """Its name in a SUMO simulation of the user; empty: it has been drawn."""
    right_lanes: tuple[int, ...] = ()
    """Lanes at the end of the road from which its route continues; empty: the preferred one, or
    any."""
    entry_point: int = field(default=Factory(lambda self: self.lane, takes_self=True))
    """Number of its entry point (`RoadGeometry.entry_points`); by default, the first of its
    lane."""


def arrivals(scenario: Scenario) -> tuple[Arrival, ...]:
    """Return the seeded arrivals in [0, demand.duration_s], sorted by time, then entry point."""
    drawn = sorted(
        one
        for point, inflow in scenario.flow.inflows.items()
        for one in _arrivals_at(point, inflow, scenario)
    )
    points = scenario.geometry.entry_points
    return tuple(
        Arrival(
            vehicle_name(number),
            points[point].lane,
            preferred,
            t_s,
            destination,
            vehicle_type,
            entry_point=point,
        )
        for number, (t_s, point, preferred, destination, vehicle_type) in enumerate(drawn, start=1)
    )


def count_until(stream: Sequence[Arrival], t_s: float) -> int:
    """Return the number of sorted arrivals up to a road time."""
    return bisect_right(stream, t_s, key=lambda arrival: arrival.t_s)


def _arrivals_at(
    point: int, inflow: Inflow, scenario: Scenario
) -> list[tuple[float, int, int, str, str]]:
    """Return (time [s], entry point, preferred lane, destination, type) of each arrival there."""
    demand = scenario.demand
    mean_excess_s = max(0.0, 3600.0 / inflow.volume_veh_per_h - demand.min_headway_s)
    headways, preferences, types = (
        default_rng(SeedSequence(scenario.seed, spawn_key=(purpose, point)))
        for purpose in (_HEADWAYS, _PREFERENCES, _TYPES)
    )
    names = [*(one.type for one in inflow.types), CAR]
    choices = {name: list(_destinations(inflow, scenario, name)) for name in names}
    # Drop the last bound: rounded to less than 1, it would exclude some draws in [0, 1).
    bounds = {
        name: np.array([*accumulate(share for share, _, _ in own)][:-1])
        for name, own in choices.items()
    }
    type_bounds = np.array([*accumulate(one.share for one in inflow.types)])
    if type_bounds.size and type_bounds[-1] > 1.0 - 1e-9:
        type_bounds[-1] = 1.0  # no cars
    result: list[tuple[float, int, int, str, str]] = []
    t_s = 0.0
    while True:
        t_s += demand.min_headway_s + mean_excess_s * headways.standard_exponential()
        if t_s > demand.duration_s:
            return result
        kind = names[int(np.searchsorted(type_bounds, types.random(), side="right"))]
        number = int(np.searchsorted(bounds[kind], preferences.random(), side="right"))
        _, preferred, destination = choices[kind][number]
        result.append((float(t_s), point, preferred, destination, kind))


def _destinations(
    inflow: Inflow, scenario: Scenario, vehicle_type: str
) -> Iterator[tuple[float, int, str]]:
    """Yield (share, preferred lane, destination) of a type of vehicle that enters in a lane."""
    exits = inflow.destinations
    to_end = 1.0 - sum(one.share for one in exits)
    shares = _lane_shares(inflow, scenario, vehicle_type)
    if shares:
        for preferred, share in enumerate(shares):
            yield to_end * share, preferred, END_OF_ROAD
    else:
        yield to_end, ANY_LANE, END_OF_ROAD
    for one in exits:
        yield one.share, scenario.geometry.exit_lane(one.exit), one.exit


def _lane_shares(inflow: Inflow, scenario: Scenario, vehicle_type: str) -> Sequence[float]:
    """Return the share of vehicles of a type that prefer each lane; empty: no preferences.

    None prefer a lane in which they may not drive at the end of the road.
    """
    ends = [
        section.lane
        for section in scenario.geometry.sections
        if section.serves(ANY_LANE) and scenario.road.may_leave_by(section, vehicle_type)
    ]
    permitted = [share if lane in ends else 0.0 for lane, share in enumerate(inflow.lane_shares)]
    total = sum(permitted)
    if permitted == [*inflow.lane_shares]:
        return inflow.lane_shares
    return [share / total for share in permitted] if total > 0.0 else ()
