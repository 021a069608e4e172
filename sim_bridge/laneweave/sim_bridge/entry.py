"""Entry metering at the start of the road: the paper's interlaced ("checkerboard") entry.

A vehicle enters at s = 0 with the lattice speed v_F exactly when its cell passes s = 0. Its cell is
the first free interlaced cell on its lane, behind its lane predecessor, whose passing time is not
before the arrival. Vehicles of a lane enter in order of arrival.

A block of columns becomes one formation, so two rules bound what it takes:

- at most `max_vehicles` vehicles, the paper's largest formation;
- at most as many vehicles that prefer one lane as that lane has cells in the block. **This refines
  the paper's operation**, which groups vehicles without looking at their preferences and so now
  and then forms a group that wants more places on a lane than there are. Here a formation can
  always satisfy every preference; the price is that a vehicle sometimes waits for the next block.

Decisions are causal: columns are taken in the order in which they pass s = 0, and at that moment
the lanes from the right, so nothing depends on arrivals that are still to come.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter

from attrs import frozen

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.sim_bridge.demand import Arrival

TIME_TOLERANCE_S = 1e-9
"""Ticks and passing times are the same instants computed in two ways."""


@frozen
class Admission:
    """A vehicle enters the road at s = 0 with speed v_F."""

    arrival: Arrival
    cell: Cell
    t_s: float
    """Road time at which its cell passes s = 0."""


class EntryMeter:
    """Assigns lattice cells to arriving vehicles; pure and incremental."""

    def __init__(self, lattice: Lattice, max_vehicles: int) -> None:
        """Start with an empty road at road time 0.

        Args:
            lattice: the lattice whose cells are given out.
            max_vehicles: most vehicles in one block.
        """
        self._lattice = lattice
        self._max_vehicles = max_vehicles
        self._queues: list[list[Arrival]] = [[] for _ in range(lattice.lanes)]
        self._names: set[str] = set()
        self._column = 0  # the next column to pass s = 0
        self._block = 0  # the block of that column, how many it took, and their preferences
        self._taken = 0
        self._preferring: Counter[int] = Counter()

    @property
    def waiting(self) -> tuple[Arrival, ...]:
        """Vehicles that were demanded and not admitted yet, lane by lane."""
        return tuple(arrival for queue in self._queues for arrival in queue)

    def demand(self, arrival: Arrival) -> None:
        """Queue a vehicle on its lane, in order of arrival time.

        It may be queued before its arrival time. Queued after it, the vehicle takes the first
        possible cell from then on.

        Raises:
            ValueError: the lattice lacks its lane or its preferred lane, or it waits already.
        """
        lanes = range(self._lattice.lanes)
        if arrival.lane not in lanes or arrival.preferred_lane not in lanes:
            raise ValueError(f"{arrival} needs lanes 0 to {self._lattice.lanes - 1}")
        if arrival.vehicle in self._names:
            raise ValueError(f"{arrival.vehicle} is waiting already")
        self._names.add(arrival.vehicle)
        insort(self._queues[arrival.lane], arrival, key=lambda other: other.t_s)

    def admit(self, until_s: float) -> list[Admission]:
        """Decide on all columns that pass s = 0 up to a road time and were not decided on before.

        Args:
            until_s: road time, usually now; a vehicle demanded later cannot take these columns.

        Returns:
            The vehicles that enter, by time, then lane.
        """
        admissions = []
        while (t_s := self._lattice.passing_time_s(self._column)) <= until_s + TIME_TOLERANCE_S:
            for lane in range(self._lattice.lanes):
                arrival = self._takes((self._column, lane), t_s)
                if arrival is not None:
                    admissions.append(Admission(arrival, (self._column, lane), t_s))
            self._column -= 1
        return admissions

    def _takes(self, cell: Cell, t_s: float) -> Arrival | None:
        """Return the vehicle that takes a cell which passes s = 0 now, if any."""
        column, lane = cell
        queue = self._queues[lane]
        if not (queue and self._lattice.interlaced(cell)):
            return None
        arrival = queue[0]
        if arrival.t_s > t_s:
            return None
        block = self._lattice.block_of(column)
        if block != self._block:
            self._block, self._taken, self._preferring = block, 0, Counter()
        preferred = arrival.preferred_lane
        if (
            self._taken >= self._max_vehicles
            or self._preferring[preferred] >= self._lattice.block_columns
        ):
            return None
        self._taken += 1
        self._preferring[preferred] += 1
        self._names.discard(arrival.vehicle)
        return queue.pop(0)
