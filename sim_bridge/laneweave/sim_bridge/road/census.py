"""The counts of vehicles, and the clock and the census, which publish them.

The census is complete, so coordinators know all rosters.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.wire.messages import (
    Announcement,
    Census,
    CensusEntry,
    ClosedFormation,
    Name,
    OffLattice,
    RoadClock,
)
from laneweave.protocol.wire.obstacle_messages import Cleared, Obstacle, Obstacles
from laneweave.protocol.wire.topics import CENSUS, CLOCK, OBSTACLES
from laneweave.sim_bridge.road.demand_queue import DemandQueue, OutsideTraffic, announcement_of
from laneweave.sim_bridge.road.vehicle import RoadVehicle

CENSUS_EVERY_TICKS = 10


class CensusPublisher:
    """Counts vehicles and closed formations, and publishes clock and census."""

    def __init__(
        self,
        bridge: int,
        demand: DemandQueue,
        off_lattice: Callable[[Mapping[Name, RoadVehicle], float], Mapping[Name, OffLattice]],
        outside: OutsideTraffic,
        closed_to: int,
    ) -> None:
        """Begin without vehicles; `bridge` is the incarnation of the bridge."""
        self._outside = outside
        self._bridge = bridge
        self._demand = demand
        self._off_lattice = off_lattice
        """Returns where vehicles without cells are."""
        self._closed: list[ClosedFormation] = []
        """Closed formations with vehicles on the road."""
        self._closed_to = closed_to
        """Block up to which all blocks are closed."""
        self._entered = 0
        self._left = 0
        self._announced: tuple[Announcement, ...] = ()
        self._sent_tick = -CENSUS_EVERY_TICKS
        self.obstacles: tuple[Obstacle, ...] = ()
        """Parts of lanes that are closed now."""
        self.cleared: tuple[Cleared, ...] = ()
        """Parts of lanes that are cleared now."""
        self._had_obstacles = False
        """Whether there have been any: messages may be lost, so that there are none is repeated."""
        self._changed = True
        """Whether a vehicle or formation has changed since the last census."""

    def on_changed(self, *, entered: int = 0, left: int = 0) -> None:
        """Count vehicles that have entered or left; the next tick has a census."""
        self._entered += entered
        self._left += left
        self._changed = True

    def on_closed(self, closed: Sequence[ClosedFormation], closed_to: int) -> None:
        """Add closed formations, and the block up to which all blocks are closed."""
        self._closed += closed
        if closed_to > self._closed_to:
            self._closed_to = closed_to
            self._changed = True

    def publish(
        self, tick: int, t_s: float, on_road: Collection[RoadVehicle], *, ended: bool = False
    ) -> Iterator[Effect]:
        """Publish the clock; publish the census on changes, every 10 ticks, and when a run ends."""
        yield Send(CLOCK, self.clock(tick, t_s, len(on_road), ended=ended))
        due = ended or tick >= self._sent_tick + CENSUS_EVERY_TICKS
        announced = self.update_announcements(t_s)
        if announced or due or self._changed:
            self._changed = False
            self._sent_tick = tick
            yield Send(CENSUS, self.census(t_s, on_road))
            self._had_obstacles |= bool(self.obstacles or self.cleared)
            if self._had_obstacles:
                message = Obstacles(t_s, self.obstacles, self._bridge, self.cleared)
                yield Send(OBSTACLES, message)

    def clock(self, tick: int, t_s: float, on_road: int, *, ended: bool = False) -> RoadClock:
        """Return the clock message of a tick, with counts of vehicles."""
        return RoadClock(
            tick=tick,
            t_s=t_s,
            demanded=self._demand.demanded,
            entered=self._entered,
            on_road=on_road,
            left=self._left,
            ended=ended,
            bridge=self._bridge,
        )

    def update_announcements(self, t_s: float) -> bool:
        """Update the announcements; return whether they have changed."""
        before = self._announced
        self._announced = self._demand.announcements(t_s)
        return self._announced != before

    def census(
        self,
        t_s: float,
        on_road: Iterable[RoadVehicle],
        at_entrance: Iterable[RoadVehicle] = (),
    ) -> Census:
        """Return the census: vehicles on the road, announcements and closed formations.

        Vehicles at the entrance, which enter with the next tick, are announced.
        """
        vehicles = tuple(on_road)
        off_lattice = self._off_lattice({vehicle.name: vehicle for vehicle in vehicles}, t_s)
        # A formation without members on the lattice counts as deserted; others may have joined it.
        present = {one.formation for one in vehicles if one.has_cell}
        self._closed = [closed for closed in self._closed if closed.first_block in present]
        return Census(
            t_s=t_s,
            on_road=tuple(
                CensusEntry(
                    vehicle=vehicle.name,
                    cell=vehicle.admission.cell,
                    preferred_lane=vehicle.admission.arrival.preferred_lane,
                    entered_s=vehicle.admission.t_s,
                    off_lattice=off_lattice.get(vehicle.name),
                    destination=Name(vehicle.admission.arrival.destination),
                    vehicle_type=Name(vehicle.admission.arrival.vehicle_type),
                    ready_s=vehicle.ready_s,
                    processes=vehicle.processes,
                )
                for vehicle in vehicles
            ),
            announced=(
                *(announcement_of(one.admission.arrival) for one in at_entrance),
                *self._announced,
            ),
            formations=tuple(self._closed),
            closed_to=self._closed_to,
            bridge=self._bridge,
            ends=self._outside.plans_end(),
        )
