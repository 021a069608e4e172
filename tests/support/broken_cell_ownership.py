"""Broken methods for the bugs of the rolling operation in `planted_bugs`."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import pytest
from msgspec.structs import replace

from laneweave.coordinator.rolling import ownership, transfer
from laneweave.coordinator.rolling.ownership import States
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle import territory
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
from laneweave.sim_bridge.bodies.record_store import RecordStore
from laneweave.sim_bridge.road.attendance import Attendance
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.states import changed, set_record

Patch = pytest.MonkeyPatch


def obey(patch: Patch) -> None:
    accept_command = MotionController.accept_command

    def mutant(self: MotionController, command: Command) -> bool:
        owned = self.record.owned
        set_record(self.store, owned=tuple(sorted({*owned, command.hold_cell})))
        taken = accept_command(self, command)
        set_record(self.store, owned=owned)
        return taken

    patch.setattr(MotionController, "accept_command", mutant)


def own_at_once(patch: Patch) -> None:
    begin_transfer = RecordStore.begin_transfer

    def mutant(self: RecordStore, transfer: PendingTransfer) -> None:
        begin_transfer(self, transfer)
        self.complete_transfer(transfer.ballot)

    patch.setattr(RecordStore, "begin_transfer", mutant)


def note_any_transfer(patch: Patch) -> None:
    def mutant(self: RecordStore, transfer: PendingTransfer) -> None:
        if transfer != self.record.transfer:
            set_record(self, transfer=transfer, owned=transfer.before)

    patch.setattr(RecordStore, "begin_transfer", mutant)


def forget_promise(patch: Patch) -> None:
    put_in_charge = RecordStore.put_in_charge

    def mutant(self: RecordStore, incarnation: int) -> None:
        put_in_charge(self, incarnation)
        set_record(self, promised=None)

    patch.setattr(RecordStore, "put_in_charge", mutant)


def forget_owned_cells(patch: Patch) -> None:
    accept_command, take_charge = MotionController.accept_command, Attendance._put_caretaker

    def forget(controller: MotionController, before: int) -> None:
        if before not in (0, controller.record.incarnation):
            set_record(controller.store, owned=(controller.hold_cell,))

    def claimed(self: MotionController, command: Command) -> bool:
        before = self.record.incarnation
        taken = accept_command(self, command)
        forget(self, before)
        return taken

    def cared_for(self: Attendance, vehicle: RoadVehicle, tick: int) -> None:
        before = vehicle.controller.record.incarnation
        take_charge(self, vehicle, tick)
        forget(vehicle.controller, before)

    patch.setattr(MotionController, "accept_command", claimed)
    patch.setattr(Attendance, "_put_caretaker", cared_for)


def show_owned_cells_at_once(patch: Patch) -> None:
    state = PlanExecution.state

    def mutant(self: PlanExecution, sense: Sense, *, attended: bool) -> VehicleState:
        return state(self, changed(sense, promised=self.promised), attended=attended)

    patch.setattr(PlanExecution, "state", mutant)


def cancel_closed_transfers(patch: Patch) -> None:
    patch.setattr(transfer, "owned_cells", lambda state, *_: frozenset(state.record.owned))


def cancel_on_common_promise(patch: Patch) -> None:
    owned_cells = ownership.owned_cells

    def mutant(
        state: VehicleState, states: States, gone: Collection[Name]
    ) -> frozenset[Cell] | None:
        transfer = state.record.transfer
        if transfer is not None and not transfer.open:
            promised = {states[name].record.promised for name in transfer.roster if name in states}
            if promised == {state.record.promised} and state.record.promised != transfer.ballot:
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
    for module in (transfer, territory):
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
