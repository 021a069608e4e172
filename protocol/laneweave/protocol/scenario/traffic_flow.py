"""The traffic flow: which vehicles enter in which lane, and what formations can carry."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType

import attrs
from attrs import frozen

from laneweave.protocol.scenario.formation_table import FormationSettings, formation_columns
from laneweave.protocol.scenario.road_tables import (
    Demand,
    DestinationShare,
    Entrance,
    EntryPoint,
    Road,
    TypeShare,
)
from laneweave.protocol.wire.messages import CAR


@frozen
class Inflow:
    """The vehicles that enter the road at one entry point."""

    volume_veh_per_h: float
    destinations: tuple[DestinationShare, ...]
    """Shares of vehicles that leave by exits; the others leave at the end of the road."""
    lane_shares: tuple[float, ...]
    """Share of these others that prefer each lane, with sum one; empty: no preferences."""
    types: tuple[TypeShare, ...]
    """Shares of types; the others are cars."""


@frozen
class TrafficFlow:
    """Inflows by entry point, and the volumes for which formations have room."""

    _road: Road
    _demand: Demand
    _entrances: tuple[Entrance, ...]
    _formation: FormationSettings
    _types: tuple[TypeShare, ...]
    """Shares of all types but cars, at entrances without shares of their own."""
    _entry_points: Sequence[EntryPoint]
    _drawn: bool
    """Whether vehicles are drawn at random, and not those of a SUMO simulation."""

    @property
    def lane_shares(self) -> tuple[float, ...]:
        """Share of vehicles that prefer each lane; the sum is one. Empty: no preferences."""
        if (self._road.closures or not self._drawn) and not self._demand.lane_shares:
            return ()
        lanes = range(self._road.lanes)
        return _normalised(self._demand.lane_shares or (1.0,) * len(lanes), lanes)

    @cached_property
    def inflows(self) -> Mapping[int, Inflow]:
        """The vehicles that enter, by number of entry point; those without vehicles are left out.

        A type that may not drive in some lanes at the start of the road enters in the others.
        """
        demand, first, types = self._demand, self._road.first_lanes, self._types
        arriving = _normalised(demand.arrival_shares or (1.0,) * self._road.lanes, first)
        volumes = {
            lane: demand.volume_veh_per_lane_h * (len(first) * arriving[lane]) for lane in first
        }
        found = {
            lane: Inflow(volume, demand.destinations, self.lane_shares, types)
            for lane, volume in volumes.items()
            if volume > 0.0
        }
        found = self._permitted(found)
        every = range(self._road.lanes)
        numbers = {point.entrance: number for number, point in enumerate(self._entry_points)}
        for one in self._entrances:
            preferring = _normalised(one.lane_shares, every) if one.lane_shares else ()
            own = Inflow(
                one.volume_veh_per_h,
                one.destinations,
                preferring or self.lane_shares,
                one.vehicle_types or types,
            )
            found |= self._permitted({numbers[one.name]: own})
        return MappingProxyType(dict(sorted(found.items())))

    def _permitted(self, inflows: Mapping[int, Inflow]) -> dict[int, Inflow]:
        """Return the inflows of an entrance after each type has left lanes in which it may not be.

        A type enters in its other lanes, in proportion to the volumes of these. Types
        without a lane do not enter, and there are more vehicles of the others.
        """
        if not self._road.restrictions or not inflows:
            return dict(inflows)
        shares = {one.type: one.share for one in next(iter(inflows.values())).types}
        shares[CAR] = max(0.0, 1.0 - sum(shares.values()))
        points = self._entry_points
        entering_at = {
            name: [
                number
                for number in inflows
                if not self._road.is_restricted(points[number].lane, points[number].at_m, name)
            ]
            for name in shares
        }
        entering = sum(share for name, share in shares.items() if entering_at[name])
        total = sum(one.volume_veh_per_h for one in inflows.values())
        found = {}
        for number, inflow in inflows.items():
            volumes = {
                name: total
                * (share / entering)
                * inflow.volume_veh_per_h
                / sum(inflows[other].volume_veh_per_h for other in entering_at[name])
                for name, share in shares.items()
                if share > 0.0 and number in entering_at[name]
            }
            volume = sum(volumes.values())
            if volume > 0.0:
                types = tuple(
                    TypeShare(name, min(own / volume, 1.0))
                    for name, own in volumes.items()
                    if name != CAR
                )
                found[number] = attrs.evolve(inflow, volume_veh_per_h=volume, types=types)
        return found

    @property
    def _ramp_share(self) -> float:
        """Vehicles from ramps for each one that enters at the start of the road."""
        from_ramps = sum(one.volume_veh_per_h for one in self._entrances)
        return from_ramps / (self._demand.volume_veh_per_lane_h * len(self._road.first_lanes))

    @property
    def vehicles_from_ramps(self) -> int:
        """Vehicles from ramps for which a full formation has room, within its maximum length."""
        formation, lanes = self._formation, self._road.narrowest_lanes
        expected = math.ceil(formation.max_vehicles * self._ramp_share - 1e-9)
        free = lanes if lanes > 1 else 0
        room = formation.max_columns * lanes - free - formation.max_vehicles
        return max(0, min(expected, room))

    def formation_bound_veh_per_lane_h(self, *, change_columns: bool) -> float:
        """Return the maximum volume at the start of the road where lanes end.

        A full formation has as many columns as its vehicles, and those expected from ramps, need,
        and one more unless all types change columns.
        """
        formation = self._formation
        most, per_column_s = formation.max_vehicles, formation.gap_m / formation.speed_mps
        lanes = self._road.narrowest_lanes
        columns = formation_columns(most + self.vehicles_from_ramps, lanes)
        if not change_columns:
            columns = max(columns, min(columns + 1, formation.max_columns))
        if not formation.closes_by_vehicles:
            columns, most = formation.block_columns, self.block_vehicles
        return 3600.0 * most / (columns * per_column_s * len(self._road.first_lanes))

    @property
    def block_vehicles(self) -> int:
        """Maximum number of vehicles in a formation whose length is fixed."""
        lanes, formation = self._road.narrowest_lanes, self._formation
        if lanes == self._road.lanes:
            return formation.max_vehicles
        room = (formation.block_columns - 1) * lanes / (1.0 + self._ramp_share)
        return min(formation.max_vehicles, max(math.floor(room), 1))


def _normalised(shares: Sequence[float], lanes: Collection[int]) -> tuple[float, ...]:
    """Return the shares of some lanes divided by their sum, and 0 for the others."""
    total = sum(shares[lane] for lane in lanes)
    return tuple(share / total if lane in lanes else 0.0 for lane, share in enumerate(shares))
