"""Territory: what vehicles own, so that plans that run at the same time share no cell.

With formations, a formation owns blocks of columns, which its vehicles have joined. In the rolling
operation, each vehicle owns cells, which plans transfer. `territory_of` selects one of the two;
neither plan execution nor the motion controller asks which operation runs. docs/SAFETY.md has the
proofs. `sim_bridge.road.allocation` does the same for vehicles that enter.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

from attrs import frozen

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plans import ownership_problems
from laneweave.protocol.wire.messages import (
    Ballot,
    Name,
    PendingTransfer,
    Plan,
    Prepare,
    VehicleRecord,
)


@frozen
class Territory:
    """What plans may use. The default rules allow everything; operations override those they need.

    A vehicle has a record, of joined blocks or of owned cells.
    """

    stores_promises: ClassVar[bool] = False
    """Whether motion controllers store promises, which then bind later processes in charge."""
    given_up_cells_stay_free: ClassVar[bool] = False
    """Whether cells that a vehicle gives up stay free: no other member may use them."""

    def is_addressed(self, _record: VehicleRecord, _prepare: Prepare) -> bool:
        """Return whether a PREPARE whose roster contains the vehicle is for it."""
        return True

    def joined_by(self, joined: tuple[int, ...], _prepare: Prepare) -> tuple[int, ...]:
        """Return the blocks that a vehicle has joined once it promises a ballot."""
        return joined

    def contains(self, _plan: Plan) -> bool:
        """Return whether all cells of a plan lie in its blocks."""
        return True

    def is_joined(self, _record: VehicleRecord, _plan: Plan) -> bool:
        """Return whether the blocks of a plan are those that the vehicle has joined."""
        return True

    def may_transfer(self, _record: VehicleRecord, _plan: Plan, _vehicle: Name) -> bool:
        """Return whether the transfers are valid, and the vehicle owns what it gives."""
        return True

    def transfer_in(self, _plan: Plan, _vehicle: Name) -> PendingTransfer | None:
        """Return a vehicle's transfer in a plan; None: plans transfer no cells."""
        return None

    def may_accept(self, _record: VehicleRecord, _ballot: Ballot) -> bool:
        """Return whether what the acceptance of a ballot needs is stored."""
        return True

    def may_hold(self, _record: VehicleRecord, _cell: Cell) -> bool:
        """Return whether a vehicle may hold a cell."""
        return True

    def owned_among(self, _cells: Iterable[Cell]) -> Iterable[Cell]:
        """Return the reserved cells that a vehicle owns once it has entered again."""
        return ()

    def transfer_of_departed(self, record: VehicleRecord) -> PendingTransfer | None:
        """Return the transfer in the record of a vehicle that gives up its cells."""
        return record.transfer


@frozen
class BlockTerritory(Territory):
    """Formations own blocks of columns; no block is ever used by two."""

    lattice: Lattice

    def is_addressed(self, record: VehicleRecord, prepare: Prepare) -> bool:
        """Return whether a PREPARE is for a block that the vehicle has joined."""
        # A vehicle that waited at the end of a lane belongs to another formation than before.
        return not {*prepare.blocks}.isdisjoint(record.joined)

    def joined_by(self, joined: tuple[int, ...], prepare: Prepare) -> tuple[int, ...]:
        """Return these blocks and those of the ballot."""
        return tuple(sorted({*joined, *prepare.blocks}))

    def contains(self, plan: Plan) -> bool:
        """Return whether all cells of a plan lie in its blocks."""
        blocks, lattice = set(plan.blocks), self.lattice
        return all(
            lattice.block_of(column) in blocks and 0 <= lane < lattice.lanes
            for column, lane in plan.territory
        )

    def is_joined(self, record: VehicleRecord, plan: Plan) -> bool:
        """Return whether the blocks of a plan are those that the vehicle has joined."""
        return set(plan.blocks) == set(record.joined)


@frozen
class CellTerritory(Territory):
    """Each vehicle owns cells, which plans transfer (rolling operation)."""

    stores_promises: ClassVar[bool] = True
    given_up_cells_stay_free: ClassVar[bool] = True

    def may_transfer(self, record: VehicleRecord, plan: Plan, vehicle: Name) -> bool:
        """Return whether the transfers are valid, and the vehicle owns what it gives.

        The cells of its pending transfer count, too.
        """
        transfer = record.transfer
        owned = {*record.owned, *(transfer.after if transfer is not None else ())}
        return not ownership_problems(plan) and set(plan.before[vehicle]) <= owned

    def transfer_in(self, plan: Plan, vehicle: Name) -> PendingTransfer | None:
        """Return a vehicle's transfer in a plan."""
        return PendingTransfer(plan.ballot, plan.before[vehicle], plan.after[vehicle], plan.roster)

    def may_accept(self, record: VehicleRecord, ballot: Ballot) -> bool:
        """Return whether the transfer of the ballot is pending."""
        transfer = record.transfer
        return transfer is not None and transfer.ballot == ballot and not transfer.withdrawn

    def may_hold(self, record: VehicleRecord, cell: Cell) -> bool:
        """Return whether the vehicle owns a cell."""
        return cell in record.owned

    def owned_among(self, cells: Iterable[Cell]) -> Iterable[Cell]:
        """Return all of the cells."""
        return cells

    def transfer_of_departed(self, record: VehicleRecord) -> PendingTransfer | None:
        """Return a withdrawn transfer of the highest ballot in a record, if it has any.

        It tells leaders that the vehicle has left for all ballots so far.
        """
        transfer = record.transfer
        known = record.promised, record.accepted, transfer.ballot if transfer is not None else None
        ballots = [ballot for ballot in known if ballot is not None]
        return PendingTransfer(max(ballots)) if ballots else None


def territory_of(scenario: Scenario) -> Territory:
    """Return what vehicles own in the operation of a scenario."""
    if scenario.formation.traits.has_formations:
        return BlockTerritory(scenario.lattice)
    return CellTerritory()
