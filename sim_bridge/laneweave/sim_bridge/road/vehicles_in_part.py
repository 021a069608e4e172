"""Which vehicles are in the way when a part of a lane is to be closed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from attrs import frozen

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.vehicle.sudden_stops import room_before_part_m
from laneweave.protocol.wire.messages import Name


class BodyOnRoad(Protocol):
    """What matters of a vehicle on the road to closed parts; see `RoadVehicle`."""

    name: Name

    @property
    def state(self) -> State:
        """(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""

    @property
    def size(self) -> tuple[float, float]:
        """Length and width of the body [m]."""

    @property
    def lanes_used(self) -> set[int]:
        """Lanes in which parts of the body are, or will be."""

    @property
    def has_cell(self) -> bool:
        """Whether it is on the lattice."""

    @property
    def stops_m(self) -> float:
        """Position at which it stops if it begins to brake after its reaction time."""

    @property
    def waits(self) -> bool:
        """Whether it waits for a lane to be open again."""

    @property
    def re_enters(self) -> bool:
        """Whether it has waited, and is on its way into a cell."""


@frozen
class VehiclesInPart:
    """The vehicles in the way of a part that is to be closed."""

    inside: tuple[Name, ...]
    near: tuple[Name, ...]
    """Those so near that they could not stop before it, or that start there, or will."""
    coming: tuple[Name, ...]
    """Those that could not stop at the stop line before it."""

    def allow_closing(self, *, waits: bool) -> bool:
        """Return whether the part may be closed; `waits`: only if no vehicle has to brake hard."""
        return not (self.inside or self.near or (self.coming and waits))

    @property
    def problem(self) -> str:
        """Why the part cannot be closed, in words; empty: it can."""
        inside, near = map(len, (self.inside, self.near))
        texts = []
        if inside:
            texts.append(f"{inside} {_vehicles(inside)} in it ({_some(self.inside)})")
        if near:
            also = "more " if inside else ""
            texts.append(f"{near} {also}cannot stop before it ({_some(self.near)})")
        return " and ".join(texts)


def _vehicles(count: int) -> str:
    return "vehicle is" if count == 1 else "vehicles are"


def _some(names: tuple[Name, ...]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def cleared_before_m(scenario: Scenario) -> float:
    """Return the length of a lane before a part that is cleared with it."""
    return room_before_part_m(scenario, re_entry(scenario).room_m)


def vehicles_in_part(
    scenario: Scenario, lane: int, from_m: float, to_m: float, vehicles: Iterable[BodyOnRoad]
) -> VehiclesInPart:
    """Return the vehicles in the way of a part that is to be closed from and to a position."""
    inside, near, coming = list[Name](), list[Name](), list[Name]()
    first_m, room_m = from_m - cleared_before_m(scenario), re_entry(scenario).room_m
    for vehicle in vehicles:
        s_m = vehicle.state[0]
        if lane not in vehicle.lanes_used or s_m - vehicle.size[0] >= to_m:
            continue
        if s_m >= from_m:
            inside.append(vehicle.name)
        elif (vehicle.re_enters and vehicle.stops_m >= first_m) or (
            not vehicle.has_cell and from_m - s_m < room_m
        ):
            near.append(vehicle.name)  # it would drive into the part
        elif vehicle.stops_m > from_m:
            near.append(vehicle.name)
        elif vehicle.stops_m > from_m - room_m:
            coming.append(vehicle.name)
    return VehiclesInPart(tuple(inside), tuple(near), tuple(coming))
