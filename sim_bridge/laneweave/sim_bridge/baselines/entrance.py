"""Who waits to enter the road: a queue for each lane, in order of arrival."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.road.demand import Arrival


class Entrance:
    """Queues in front of the road."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin with nobody."""
        self._queues: list[deque[Arrival]] = [deque() for _ in range(scenario.road.lanes)]
        self._speed_mps = scenario.formation.speed_mps
        self._tick_s = scenario.runtime.tick_s

    def __len__(self) -> int:
        """How many wait."""
        return sum(map(len, self._queues))

    def queue(self, arrival: Arrival) -> None:
        """Let a vehicle wait behind those of its lane."""
        self._queues[arrival.lane].append(arrival)

    def first(self, lane: int) -> Arrival | None:
        """Return who is next on a lane."""
        return self._queues[lane][0] if self._queues[lane] else None

    def firsts(self) -> Iterator[Arrival]:
        """Yield who is next, lane by lane."""
        for queue in self._queues:
            if queue:
                yield queue[0]

    def furthest_m(self, arrival: Arrival, t_s: float) -> float:
        """Return how far beyond s = 0 a vehicle can be at a tick if it was not at the last one.

        Vehicles arrive between ticks: one that need not wait is where it would be had it driven on
        at v_F since its arrival.
        """
        return self._speed_mps * min(max(t_s - arrival.t_s, 0.0), self._tick_s)

    def take(self, lane: int) -> Arrival:
        """Let who is next on a lane enter."""
        return self._queues[lane].popleft()
