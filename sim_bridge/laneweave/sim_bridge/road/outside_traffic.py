"""Interface of traffic that a simulator drives to the entrances of a road."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

from laneweave.protocol.lattice import Cell
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission, EntryMeter


class OutsideTraffic(Protocol):
    """Vehicles that a simulator drives to the entrances."""

    def demanded(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that have become known since the last call."""

    def announced(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that will enter soon, with the times at which they are expected."""

    @property
    def start_lanes(self) -> Sequence[int]:
        """Lanes to whose beginning vehicles come from upstream."""

    def has_room(self, destination: str, going: int, waiting: int) -> bool:
        """Return whether a vehicle that waits at the start may enter: its exit is not full.

        Args:
            destination: name of its exit, or `END_OF_ROAD`.
            going: number of vehicles that are on the way to it.
            waiting: number of those that are held back.
        """

    def full_lanes(self) -> set[int]:
        """Return the lanes to whose start a vehicle is too close for another to enter before it."""

    def admit(self, t_s: float, meter: EntryMeter, occupied: Collection[Cell]) -> list[Admission]:
        """Return the vehicles that have come to their entrances since the last call.

        Args:
            t_s: road time.
            meter: assigns cells.
            occupied: cells in which vehicles are, or to which they move.
        """

    @property
    def exhausted(self) -> bool:
        """Whether no more vehicles will come."""

    @property
    def never_came(self) -> Sequence[Arrival]:
        """The vehicles that were to come, and have not come near an entrance."""
