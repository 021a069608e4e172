"""Broken methods for the bugs of the rolling operation in `planted_bugs`."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import pytest
from msgspec.structs import replace

from laneweave.coordinator.rolling import ownership, transfer
from laneweave.coordinator.rolling.ownership import States
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle import plan_execution as vehicle_rules
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.wire.messages import (
    Command,
    Name,
    PendingTransfer,
    Plan,
    Sense,
    VehicleState,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController

Patch = pytest.MonkeyPatch


def obey(patch: Patch) -> None:
    accept_command = MotionController.accept_command

    def mutant(self: MotionController, command: Command) -> bool:
        owned = self.owned
        self.owned = tuple(sorted({*owned, command.hold_cell}))
        taken = accept_command(self, command)
        self.owned = owned
        return taken

    patch.setattr(MotionController, "accept_command", mutant)


def own_at_once(patch: Patch) -> None:
    begin_transfer = MotionController.begin_transfer

    def mutant(self: MotionController, transfer: PendingTransfer) -> None:
        begin_transfer(self, transfer)
        self.complete_transfer(transfer.ballot)

    patch.setattr(MotionController, "begin_transfer", mutant)


def note_any_transfer(patch: Patch) -> None:
    def mutant(self: MotionController, transfer: PendingTransfer) -> None:
        if transfer != self.transfer:
            self.transfer, self.owned = transfer, transfer.before

    patch.setattr(MotionController, "begin_transfer", mutant)


def forget_promise(patch: Patch) -> None:
    put_in_charge = MotionController.put_in_charge

    def mutant(self: MotionController, incarnation: int) -> None:
        put_in_charge(self, incarnation)
        self.promised = None

    patch.setattr(MotionController, "put_in_charge", mutant)


def forget_owned_cells(patch: Patch) -> None:
    put_in_charge = MotionController.put_in_charge

    def mutant(self: MotionController, incarnation: int) -> None:
        first = self.attendant == 0
        put_in_charge(self, incarnation)
        if not first:
            self.owned = (self.hold_cell,)

    patch.setattr(MotionController, "put_in_charge", mutant)


def show_owned_cells_at_once(patch: Patch) -> None:
    state = PlanExecution.state

    def mutant(self: PlanExecution, sense: Sense, *, attended: bool) -> VehicleState:
        return state(self, replace(sense, promised=self.promised), attended=attended)

    patch.setattr(PlanExecution, "state", mutant)


def cancel_closed_transfers(patch: Patch) -> None:
    patch.setattr(transfer, "owned_cells", lambda state, *_: frozenset(state.owned))


def cancel_on_common_promise(patch: Patch) -> None:
    owned_cells = ownership.owned_cells

    def mutant(
        state: VehicleState, states: States, gone: Collection[Name]
    ) -> frozenset[Cell] | None:
        transfer = state.transfer
        if transfer is not None and not transfer.open:
            promised = {states[name].promised for name in transfer.roster if name in states}
            if promised == {state.promised} and state.promised != transfer.ballot:
                return frozenset(transfer.before)
        return owned_cells(state, states, gone)

    patch.setattr(transfer, "owned_cells", mutant)


def forget_motion(patch: Patch) -> None:
    owned_cells = ownership.owned_cells

    def mutant(
        state: VehicleState, states: States, gone: Collection[Name]
    ) -> frozenset[Cell] | None:
        return owned_cells(replace(state, moving=False), states, gone)

    patch.setattr(transfer, "owned_cells", mutant)


def skip_ownership_checks(patch: Patch) -> None:
    for module in (transfer, vehicle_rules):
        patch.setattr(module, "ownership_problems", lambda plan: [])  # noqa: ARG005


def keep_what_is_given(patch: Patch) -> None:
    make = CellTransfer._plan

    def mutant(self: CellTransfer, before: Mapping[Name, frozenset[Cell]]) -> Plan:
        plan = make(self, before)
        after = {
            name: tuple(sorted({*cells, *plan.before[name]})) for name, cells in plan.after.items()
        }
        return replace(plan, after=after)

    patch.setattr(CellTransfer, "_plan", mutant)
    skip_ownership_checks(patch)
