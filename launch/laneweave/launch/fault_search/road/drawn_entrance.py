"""Entrances of the simplified road: the real roadside, or one with drawn cells.

The real roadside admits vehicles one after another, which takes long. On a drawn entrance, many
vehicles are on the road at the start, in drawn cells, formations and owners of empty cells.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from attrs import frozen

from laneweave.launch.fault_search.road.stand_ins import Visit
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.wire.messages import Census, CensusEntry, ClosedFormation, Name, RoadClock
from laneweave.protocol.wire.topics import CENSUS, CLOCK
from laneweave.sim_bridge.road.census import CENSUS_EVERY_TICKS
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.lane_end_control import LaneEndChange
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle

CLOCK_EVERY_TICKS = 2
NONE_CLOSED = -(2**31)
"""Less than all block numbers: no formation has closed."""
TOLERANCE_S = 1e-6


@frozen
class Grant:
    """Assignment of an empty cell to an owner (rolling operation)."""

    t_s: float
    owner: Name
    cell: Cell


class DrawnEntrance:
    """Entrance at which vehicles appear in drawn cells, at drawn times."""

    def __init__(
        self,
        visits: Iterable[Visit],
        preferred_lanes: Mapping[Name, int],
        formations: Iterable[ClosedFormation] = (),
        grants: Iterable[Grant] = (),
        bridge: int = 0,
    ) -> None:
        """Begin at road time 0.

        Args:
            visits: the vehicles with their times of entry.
            preferred_lanes: preferred lane of each vehicle at its entry.
            formations: the formations with their blocks and closing times.
            grants: assignments of the empty cells to owners.
            bridge: incarnation of the bridge.
        """
        self._visits = sorted(visits, key=lambda visit: (visit.enters_s, visit.vehicle))
        self._preferred_lanes = preferred_lanes
        self._open = sorted(formations, key=lambda closed: closed.first_block)
        self._grants = sorted(grants, key=lambda grant: (grant.t_s, grant.cell))
        self._bridge = bridge
        self._now_s = 0.0
        self._closed: list[ClosedFormation] = []
        self._closed_to = NONE_CLOSED
        self._census_due_tick = 0

    def admit(self, t_s: float) -> list[Admission]:
        """Return the vehicles that have entered since the last call."""
        self._now_s, admissions = t_s, []
        while self._visits and self._visits[0].enters_s <= t_s + TOLERANCE_S:
            visit = self._visits.pop(0)
            lane = self._preferred_lanes[visit.vehicle]
            arrival = Arrival(visit.vehicle, visit.cell[1], lane, visit.enters_s)
            admissions.append(Admission(arrival, visit.cell, visit.enters_s))
            self._census_due_tick = 0
        return admissions

    def close_formations(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations closed since the last call."""
        closed = []
        while self._open and self._open[0].closed_s <= t_s + TOLERANCE_S:
            closed.append(self._open.pop(0))
            self._closed_to = closed[-1].last_block
            self._census_due_tick = 0
        self._closed += closed
        return closed

    def assign_empty_cells(self, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Assign empty cells to the drawn owners, if these are on the road."""
        while self._grants and self._grants[0].t_s <= self._now_s + TOLERANCE_S:
            grant = self._grants.pop(0)
            if grant.owner in vehicles:
                vehicles[grant.owner].controller.store.assign_cell(grant.cell)

    def control_lane_ends(
        self, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> Sequence[LaneEndChange]:
        """Do nothing: these roads have no lanes that end."""
        del vehicles, t_s
        return ()

    def on_left(
        self, vehicle: RoadVehicle, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> None:
        """Publish a census soon."""
        del vehicle, vehicles, t_s
        self._census_due_tick = 0

    def publish(self, tick: int, t_s: float, on_road: Collection[RoadVehicle]) -> Iterator[Effect]:
        """Publish the clock every 2 ticks, and the census every 10 ticks and on changes."""
        count = len(on_road)
        if tick % CLOCK_EVERY_TICKS == 0:
            clock = RoadClock(tick, t_s, count, count, count, 0, ended=False, bridge=self._bridge)
            yield Send(CLOCK, clock)
        if tick >= self._census_due_tick:
            self._census_due_tick = tick + CENSUS_EVERY_TICKS
            entries = tuple(
                CensusEntry(
                    each.name,
                    each.admission.cell,
                    each.admission.arrival.preferred_lane,
                    each.admission.t_s,
                )
                for each in on_road
            )
            present = {each.formation for each in on_road}
            closed = tuple(one for one in self._closed if one.first_block in present)
            yield Send(CENSUS, Census(t_s, entries, (), closed, self._closed_to, self._bridge))


Entrance = DrawnEntrance | Roadside
