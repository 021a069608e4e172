"""Tables of a scenario file about the road and its traffic."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Final

from attrs import field, frozen

from laneweave.protocol.field_validators import key_part, one_of, within, within_or_none
from laneweave.protocol.road_layout import LONGEST_ROAD_M, LaneChange, LaneSection

MAIN_ENTRANCE: Final = "main"
"""Name of the entrance at the start of the road."""


@frozen
class Closure:
    """A part of a lane that is closed."""

    lane: int = field(validator=within(0, 7))
    from_m: float = field(default=0.0, validator=within(0.0, LONGEST_ROAD_M))
    """Where it begins; by default, the lane is closed from the start of the road."""
    to_m: float = field(
        default=LONGEST_ROAD_M, validator=within(0.0, LONGEST_ROAD_M, open_low=True)
    )
    """Where the lane is open again; by default, it is not."""


@frozen
class RoadEvent:
    """A part of a lane that is closed for a time, or with a speed, a vehicle of another system.

    A part is cleared first: vehicles leave it, and none enters it. It is closed as soon as no
    vehicle is in it, or so near that it could not stop before it. A vehicle of another system
    enters between `from_m` and `to_m` as soon as there is room, and stays in its lane.
    """

    lane: int = field(validator=within(0, 7))
    from_m: float = field(validator=within(0.0, LONGEST_ROAD_M))
    to_m: float = field(validator=within(0.0, LONGEST_ROAD_M))
    at_s: float = field(validator=within(0.0, 1e6))
    """Road time from which it is closed."""
    until_s: float | None = field(default=None, validator=within_or_none(0.0, 1e6))
    """Road time until which it is closed; by default, for ever."""
    for_s: float | None = field(default=None, validator=within_or_none(0.0, 1e6, open_low=True))
    """Time after which it is opened again, unless `until_s` is earlier."""
    speed_mps: float = field(default=0.0, validator=within(0.0, 60.0))
    """Speed of a vehicle of another system; 0: a closed part."""
    clear_s: float = field(default=20.0, validator=within(0.0, 600.0))
    """Time for which the lane is cleared at most, until no vehicle need brake hard for the part, or
    for the vehicle that enters."""

    def ends_s(self, since_s: float) -> float:
        """Return the road time at which it ends if it has begun at a time; infinite: never."""
        until_s = math.inf if self.until_s is None else self.until_s
        return until_s if self.for_s is None else min(until_s, since_s + self.for_s)


@frozen
class Restriction:
    """A part of a lane in which vehicles of some types may not drive."""

    lane: int = field(validator=within(0, 7))
    vehicle_types: tuple[str, ...]
    from_m: float = field(default=0.0, validator=within(0.0, LONGEST_ROAD_M))
    """Where it begins; by default, at the start of the road."""
    to_m: float = field(
        default=LONGEST_ROAD_M, validator=within(0.0, LONGEST_ROAD_M, open_low=True)
    )
    """Where it ends; by default, at the end of the road."""

    def applies_to(self, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may not drive there."""
        return vehicle_type in self.vehicle_types

    @property
    def changes(self) -> tuple[LaneChange, ...]:
        """The lane changes that it forbids: those into the lane."""
        return (self.lane - 1, self.lane), (self.lane + 1, self.lane)


@frozen
class SolidLine:
    """A line beside a part of a lane that vehicles may not cross from this lane."""

    lane: int = field(validator=within(0, 7))
    to: str = field(validator=one_of("left", "right"))
    """The side of the lane on which the line is."""
    from_m: float = field(default=0.0, validator=within(0.0, LONGEST_ROAD_M))
    """Where it begins; by default, at the start of the road."""
    to_m: float = field(
        default=LONGEST_ROAD_M, validator=within(0.0, LONGEST_ROAD_M, open_low=True)
    )
    """Where it ends; by default, at the end of the road."""
    vehicle_types: tuple[str, ...] = ()
    """Types that may not cross it; empty: all types."""

    def applies_to(self, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may not cross the line."""
        return not self.vehicle_types or vehicle_type in self.vehicle_types

    @property
    def changes(self) -> tuple[LaneChange, ...]:
        """The lane change that it forbids."""
        return ((self.lane, self.lane + (1 if self.to == "left" else -1)),)


LaneRule = Restriction | SolidLine


@frozen
class Road:
    """The road: segments S1 (entry), S2 (driving), S3 (lane sorting); paper, Section 5.2.1."""

    lanes: int = field(default=3, validator=within(1, 8))
    lane_width_m: float = field(default=3.5, validator=within(2.0, 10.0))
    s1_m: float = field(default=50.0, validator=within(0.0, 20_000.0))
    s2_m: float = field(default=350.0, validator=within(0.0, 20_000.0))
    s3_m: float = field(default=600.0, validator=within(0.0, 20_000.0, open_low=True))
    closures: tuple[Closure, ...] = ()
    """Parts of lanes in which no vehicle may drive."""
    events: tuple[RoadEvent, ...] = ()
    """Parts of lanes that are closed for a time; vehicles learn of them when they are closed."""
    restrictions: tuple[Restriction, ...] = ()
    """Parts of lanes in which vehicles of some types may not drive."""
    solid_lines: tuple[SolidLine, ...] = ()
    """Lines that vehicles may not cross."""

    @property
    def length_m(self) -> float:
        """Total length of the road."""
        return self.s1_m + self.s2_m + self.s3_m

    @property
    def sorting_start_m(self) -> float:
        """Position at which S3 and lane changes begin."""
        return self.s1_m + self.s2_m

    @property
    def first_lanes(self) -> tuple[int, ...]:
        """Lanes that are open at the start of the road."""
        closed = {closure.lane for closure in self.closures if closure.from_m <= 0.0}
        return tuple(lane for lane in range(self.lanes) if lane not in closed)

    @cached_property
    def narrowest_lanes(self) -> int:
        """Smallest number of lanes that are open anywhere."""
        starts_m = {0.0, *(one.from_m for one in self.closures)}
        return min(self.open_lanes_at(s_m) for s_m in starts_m)

    def open_lanes_at(self, s_m: float) -> int:
        """Return the number of lanes that are open at a position."""
        closed = {one.lane for one in self.closures if one.from_m <= s_m < one.to_m}
        return self.lanes - len(closed)

    def is_restricted(self, lane: int, s_m: float, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may not drive in a lane at a position."""
        return any(
            one.lane == lane and one.from_m <= s_m < one.to_m and one.applies_to(vehicle_type)
            for one in self.restrictions
        )

    def may_leave_by(self, section: LaneSection, vehicle_type: str) -> bool:
        """Return whether vehicles of a type may drive at the end of a section."""
        return not any(
            one.lane == section.lane
            and one.from_m < section.to_m <= one.to_m
            and one.applies_to(vehicle_type)
            for one in self.restrictions
        )


@frozen
class DestinationShare:
    """The share of an entrance's vehicles that leave by an exit."""

    exit: str
    share: float = field(validator=within(0.0, 1.0))


@frozen
class TypeShare:
    """The share of a type among the vehicles of an entrance."""

    type: str
    share: float = field(validator=within(0.0, 1.0))


@frozen
class EntryPoint:
    """Where vehicles enter in a lane: at the start of the road, or at the beginning of a ramp."""

    lane: int
    at_m: float = 0.0
    entrance: str = MAIN_ENTRANCE


@frozen
class Exit:
    """An exit before the end of the road, by which vehicles leave."""

    name: str = field(validator=key_part)
    lanes: tuple[int, ...]
    """Lanes that end there, each of them closed from there on."""
    at_m: float = field(validator=within(0.0, LONGEST_ROAD_M, open_low=True))


@frozen
class Entrance:
    """An on-ramp: a lane in which vehicles enter the road behind its start.

    The ramp is the part of the lane from `at_m` to `merge_m`. The demand's minimum headway applies.
    """

    name: str = field(validator=key_part)
    lane: int = field(validator=within(0, 7))
    at_m: float = field(validator=within(0.0, LONGEST_ROAD_M, open_low=True))
    """Where vehicles enter with speed v_F, each in a cell of the lattice; the lane opens there."""
    merge_m: float = field(validator=within(0.0, LONGEST_ROAD_M, open_low=True))
    """Where the ramp joins the road: lane changes to and from its lane are possible from there."""
    volume_veh_per_h: float = field(validator=within(0, 3600, open_low=True))
    destinations: tuple[DestinationShare, ...] = ()
    """Shares of vehicles that leave by exits; the others leave at the end of the road."""
    lane_shares: tuple[float, ...] = ()
    """Shares of preferred lanes among the others; empty: `demand.lane_shares`, which must be given
    if this is."""
    vehicle_types: tuple[TypeShare, ...] = ()
    """Shares of types, the others are cars; empty: those of `vehicle_type`."""


@frozen
class Demand:
    """Random arrivals in each lane: minimum plus exponential headways with mean 3600 / volume."""

    volume_veh_per_lane_h: float = field(default=1000.0, validator=within(0, 3600, open_low=True))
    duration_s: float = field(default=300.0, validator=within(0, 86_400, open_low=True))
    min_headway_s: float = field(default=1.0, validator=within(0.0, 60.0))
    arrival_shares: tuple[float, ...] = ()
    """Share of the vehicles that arrive in each lane at the start of the road, on any scale; empty:
    equal shares. Their mean volume is `volume_veh_per_lane_h`."""
    lane_shares: tuple[float, ...] = ()
    """Share of vehicles that prefer each lane at the end of the road; empty: equal shares, and on a
    road with closures no preferences."""
    destinations: tuple[DestinationShare, ...] = ()
    """Shares of vehicles that leave by exits before the end of the road; the others leave there."""
