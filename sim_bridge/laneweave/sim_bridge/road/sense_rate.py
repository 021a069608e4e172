"""When a vehicle gets its next SENSE.

A vehicle gets a SENSE in every tick, unless its agent has answered the last one that it holds its
cell undisturbed (`Command.undisturbed_ticks`). Then the next one follows after so many ticks, or in
the tick in which anything has changed: what the motion controller stores, how it drives, or a
vehicle in the same lane. Nothing that is safe depends on this: a vehicle without SENSE holds its
cell, and its motion controller brakes on its own.
"""

from __future__ import annotations

from attrs import define, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import CurrentMotion, Neighbour, VehicleRecord
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Neighbours

GAP_M, SPEED_MPS, ACCEL_MPS2 = 0.5, 0.3, 1.5
"""Changes of the gap to a vehicle in the same lane, of its speed and its acceleration from which
the next SENSE does not wait."""


@frozen
class Situation:
    """What is around a vehicle that holds, as far as it may disturb it."""

    record: VehicleRecord
    cell: Cell
    motion: CurrentMotion
    ahead: tuple[Neighbour, ...]
    """Neighbours ahead in its lane."""
    behind: tuple[Neighbour, ...]
    """Neighbours behind in its lane."""

    @classmethod
    def of(
        cls, record: VehicleRecord, cell: Cell, motion: CurrentMotion, neighbours: Neighbours
    ) -> Situation:
        """Return the situation of a vehicle with some record, cell, motion and neighbours."""
        ahead, behind = (
            tuple(other for other in others if other.lane == cell[1]) for others in neighbours
        )
        return cls(record, cell, motion, ahead, behind)

    def is_like(self, before: Situation) -> bool:
        """Return whether only measurements differ, by at most the changes at the top."""
        return (
            self.record == before.record
            and self.cell == before.cell
            and self.motion == before.motion
            and _are_like(self.ahead, before.ahead)
            and _are_like(self.behind, before.behind)
        )


@define
class SenseRate:
    """The tick of the next SENSE to one vehicle."""

    _held: Situation | None = None
    """Situation in which its agent has said that it holds undisturbed; None: it has not."""
    _until_tick: int = 0

    @property
    def full(self) -> bool:
        """Whether the vehicle gets a SENSE in every tick."""
        return self._held is None

    def hold(self, situation: Situation, until_tick: int) -> None:
        """Register that the vehicle holds undisturbed, and needs no SENSE before a tick."""
        self._held, self._until_tick = situation, until_tick

    def disturb(self) -> None:
        """Let the vehicle get a SENSE in every tick again."""
        self._held = None

    def is_over(self, tick: int) -> bool:
        """Return whether the ticks without SENSE are over."""
        return tick >= self._until_tick

    def is_disturbed_by(self, situation: Situation) -> bool:
        """Return whether a situation differs from the one in which the vehicle began to hold."""
        return self._held is None or not situation.is_like(self._held)


def _are_like(now: tuple[Neighbour, ...], before: tuple[Neighbour, ...]) -> bool:
    return len(now) == len(before) and all(
        abs(one.gap_m - was.gap_m) <= GAP_M
        and abs(one.speed_mps - was.speed_mps) <= SPEED_MPS
        and abs(one.accel_mps2 - was.accel_mps2) <= ACCEL_MPS2
        for one, was in zip(now, before, strict=True)
    )
