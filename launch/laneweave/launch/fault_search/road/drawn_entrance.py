"""Drawn entrances: vehicles appear in drawn cells, formations and owners of empty cells are drawn.

The roadside admits vehicles one after another, which takes long. With a drawn entrance many
vehicles are on the road at the start; all else is the roadside's work.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from attrs import frozen

from laneweave.launch.fault_search.road.light_vehicle import Visit
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import ClosedFormation, Name
from laneweave.sim_bridge.road.allocation import BlockAllocation, CellAllocation
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.demand_queue import OutsideTraffic
from laneweave.sim_bridge.road.entry import Admission, EntryMeter
from laneweave.sim_bridge.road.formation_building import formation_builder
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle

NONE_CLOSED = -(2**31)
"""Less than all block numbers: no formation has closed."""
TOLERANCE_S = 1e-6


@frozen
class Grant:
    """Assignment of an empty cell to an owner (rolling operation)."""

    t_s: float
    owner: Name
    cell: Cell


class DrawnTraffic(OutsideTraffic):
    """Vehicles that enter in drawn cells, at drawn times."""

    def __init__(self, visits: Iterable[Visit], preferred_lanes: Mapping[Name, int]) -> None:
        """Prepare the vehicles with their preferred lanes at the entry."""
        self.t_s = 0.0
        """Road time of the newest call."""
        self._visits = sorted(visits, key=lambda visit: (visit.enters_s, visit.vehicle))
        self._preferred_lanes = preferred_lanes

    @property
    def exhausted(self) -> bool:
        """Return False: the road goes on without vehicles."""
        return False

    def admit(self, t_s: float, meter: EntryMeter, occupied: Iterable[Cell]) -> list[Admission]:
        """Return the vehicles that have entered since the last call."""
        del meter, occupied
        self.t_s, admissions = t_s, []
        while self._visits and self._visits[0].enters_s <= t_s + TOLERANCE_S:
            visit = self._visits.pop(0)
            lane = self._preferred_lanes[visit.vehicle]
            arrival = Arrival(visit.vehicle, visit.cell[1], lane, visit.enters_s)
            admissions.append(Admission(arrival, visit.cell, visit.enters_s))
        return admissions


class DrawnBlocks(BlockAllocation):
    """Blocks of drawn formations."""

    def __init__(self, scenario: Scenario, formations: Iterable[ClosedFormation]) -> None:
        """Begin before the first formation closes."""
        builder = formation_builder(scenario)
        if builder is None:
            raise ValueError("the rolling operation has no formations")
        super().__init__(builder)
        self._open = sorted(formations, key=lambda closed: closed.first_block)
        self._closed_to = NONE_CLOSED

    @property
    def closed_to(self) -> int:
        """Block up to which all blocks are closed."""
        return self._closed_to

    def close_formations(self, t_s: float, gaps: Sequence[range]) -> list[ClosedFormation]:
        """Return the formations closed since the last call."""
        del gaps
        closed = []
        while self._open and self._open[0].closed_s <= t_s + TOLERANCE_S:
            closed.append(self._open.pop(0))
            self._closed_to = closed[-1].last_block
        return closed


class DrawnCells(CellAllocation):
    """Empty cells that are assigned to drawn owners, if these are on the road."""

    def __init__(self, scenario: Scenario, grants: Iterable[Grant], traffic: DrawnTraffic) -> None:
        """Begin before the first assignment; the road time is that of the traffic."""
        super().__init__(scenario, lambda _: False)
        self._traffic = traffic
        self._grants = sorted(grants, key=lambda grant: (grant.t_s, grant.cell))

    def assign_empty_cells(
        self, vehicles: Mapping[Name, RoadVehicle], closed: Sequence[int]
    ) -> None:
        """Assign the cells whose time has come."""
        del closed
        while self._grants and self._grants[0].t_s <= self._traffic.t_s + TOLERANCE_S:
            grant = self._grants.pop(0)
            if grant.owner in vehicles:
                vehicles[grant.owner].controller.store.assign_cell(grant.cell)


def drawn_roadside(
    scenario: Scenario,
    traffic: DrawnTraffic,
    formations: Iterable[ClosedFormation] = (),
    grants: Iterable[Grant] = (),
    bridge: int = 0,
) -> Roadside:
    """Return a roadside with drawn traffic, formations, and owners of empty cells."""
    if scenario.formation.traits.has_formations:
        return Roadside(scenario, (), bridge, traffic, DrawnBlocks(scenario, formations))
    return Roadside(scenario, (), bridge, traffic, DrawnCells(scenario, grants, traffic))
