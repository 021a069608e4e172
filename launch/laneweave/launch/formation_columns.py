"""Columns occupied by formations, in a census or a recorded run."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable

from attrs import field, frozen

from laneweave.protocol.lattice import Lattice
from laneweave.protocol.wire.messages import ClosedFormation


@frozen
class FormationColumns:
    """The columns of a formation on the lattice."""

    number: int
    rear: int
    """First column."""
    front: int
    """Last column."""
    closed_s: float = -math.inf
    """Road time at which the formation closed; -inf: unknown."""

    @classmethod
    def of(cls, closed: ClosedFormation, lattice: Lattice) -> FormationColumns:
        """Return the columns of a formation in a census."""
        columns = closed.columns(lattice)
        return cls(closed.first_block, columns.start, columns.stop - 1, closed.closed_s)


def _rearmost_first(found: Iterable[FormationColumns]) -> tuple[FormationColumns, ...]:
    return tuple(sorted(found, key=lambda one: one.front))


@frozen
class Formations:
    """Formations with disjoint columns."""

    listed: tuple[FormationColumns, ...] = field(converter=_rearmost_first, default=())
    """Formations, rearmost first."""

    @classmethod
    def of_census(cls, closed: Iterable[ClosedFormation], lattice: Lattice) -> Formations:
        """Return the formations of a census."""
        return cls(FormationColumns.of(one, lattice) for one in closed)

    @property
    def by_number(self) -> dict[int, FormationColumns]:
        """Formations by number, foremost first."""
        return {one.number: one for one in reversed(self.listed)}

    def at(self, column: int) -> FormationColumns | None:
        """Return the formation that contains a column, or None."""
        return next((one for one in self.listed if one.rear <= column <= one.front), None)

    def joined(self, groups: Iterable[Collection[int]], lattice: Lattice) -> list[list[int]]:
        """Return the numbers of formations that plan together, in groups of at least two.

        Args:
            groups: groups of block numbers that plan together; groups may overlap.
            lattice: lattice with the blocks.
        """
        found: list[set[int]] = []
        for blocks in groups:
            owners = (self.at(lattice.block_range(block).start) for block in blocks)
            together = {owner.number for owner in owners if owner is not None}
            if len(together) > 1:
                apart = [group for group in found if group.isdisjoint(together)]
                touched = [group for group in found if not group.isdisjoint(together)]
                found = [*apart, together.union(*touched)]
        return sorted(sorted(group) for group in found)
