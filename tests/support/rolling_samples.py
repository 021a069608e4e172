"""Vehicles, plans and states of the rolling operation, by hand."""

from __future__ import annotations

from collections.abc import Iterable

from laneweave.protocol.lattice import Cell
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.vehicle.territory import CellTerritory
from laneweave.protocol.wire.messages import (
    Ballot,
    CurrentMotion,
    Name,
    PendingTransfer,
    Plan,
    Sense,
    VehicleRecord,
    VehicleState,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from support.convoy import ROLLING
from support.road_vehicles import controller_in
from support.states import changed
from support.states import make_plan as plan_of

A, B, C = Name("A"), Name("B"), Name("C")
LOW, MID, HIGH = (Ballot(term, Name("c1"), 10, 1) for term in (1, 2, 3))
HOME: Cell = (0, 0)
TARGET: Cell = (0, 1)
BEFORE: dict[Name, tuple[Cell, ...]] = {A: (HOME, (1, 0)), B: (TARGET, (1, 1), (2, 1))}
"""A is at home, B in (2, 1); A is to move into a cell of B's."""
AFTER: dict[Name, tuple[Cell, ...]] = {A: (HOME, TARGET, (1, 0)), B: ((1, 1), (2, 1))}
SLOT_S, T0_S = 4.0, 100.0
INCARNATION = 7


def controller_of(cells: Iterable[Cell]) -> MotionController:
    """Return the controller of a vehicle that owns cells and holds in the first one."""
    first, *others = cells
    controller = controller_in(first, ROLLING)
    for cell in (first, *others):
        controller.store.assign_cell(cell)
    return controller


def make_plan(ballot: Ballot = MID) -> Plan:
    return plan_of(
        {A: HOME, B: (2, 1)},
        {A: ((0, HOME, TARGET),)},
        ballot=ballot,
        incarnations={A: INCARNATION, B: INCARNATION},
        t0_s=T0_S,
        slot_s=SLOT_S,
        before=BEFORE,
        after=AFTER,
    )


def pending(name: Name, ballot: Ballot = MID, roster: tuple[Name, ...] = (A, B)) -> PendingTransfer:
    return PendingTransfer(ballot, BEFORE[name], AFTER[name], roster)


def vehicle(name: Name = A, rules: RuleBook = VEHICLE_RULES) -> PlanExecution:
    cell = make_plan().start_cells[name]
    stored = VehicleRecord(incarnation=INCARNATION, owned=BEFORE[name])
    return PlanExecution(name, INCARNATION, cell, CellTerritory(), stored, rules)


def sense(
    name: Name = A,
    promised: Ballot | None = None,
    transfer: PendingTransfer | None = None,
    accepted: Ballot | None = None,
    owned: tuple[Cell, ...] | None = None,
) -> Sense:
    return Sense(
        name, 1, 1.0, (0.0,) * 6, HOME, CurrentMotion(HOME), 0,
        VehicleRecord(
            incarnation=INCARNATION, promised=promised, transfer=transfer, accepted=accepted,
            owned=BEFORE[name] if owned is None else owned,
        ),
        (),
    )  # fmt: skip


def state(
    name: Name = A,
    promised: Ballot | None = None,
    transfer: PendingTransfer | None = None,
    *,
    owned: tuple[Cell, ...] | None = None,
    accepted: bool = False,
    t_s: float = 1.0,
) -> VehicleState:
    """Return what a vehicle shows that holds in the cell where the plan begins."""
    if owned is None:
        owned = BEFORE.get(name, ((9, 2),))
    cell = make_plan().start_cells.get(name, owned[0] if owned else (9, 2))
    shown = vehicle().state(sense(), attended=True)
    return changed(
        shown, vehicle=name, hold_cell=cell, promised=promised, transfer=transfer, owned=owned,
        accepted=accepted, ready=accepted, t_s=t_s,
        s_m=ROLLING.lattice.cell_s_m(cell[0], t_s),
    )  # fmt: skip
