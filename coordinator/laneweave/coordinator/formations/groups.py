"""Which formations are joined: their vehicles plan under one ballot (joint ballots).

A plan may use the blocks of the formations of its ballot, and its roster is everybody who entered
in them. Once a plan has used two blocks, a vehicle of either may be in the other one, so no later
plan may use one of them without the vehicles of both: formations that have been joined stay joined
until their vehicles have left. Every vehicle remembers with what its formation is joined
(`VehicleState.joined`), so any leader learns it from the promises that it needs anyway.
"""

from __future__ import annotations

from collections.abc import Iterable

from attrs import define, field

Numbers = tuple[int, ...]
"""Numbers of joined formations, ascending."""


@define
class Groups:
    """What one leader knows of joined formations; it only grows."""

    _group: dict[int, Numbers] = field(factory=dict)

    def of(self, number: int) -> Numbers:
        """Return all formations that are joined with one, itself included."""
        return self._group.get(number, (number,))

    def join(self, numbers: Iterable[int]) -> bool:
        """Take note that formations are joined; true when that is new."""
        union = tuple(sorted({other for number in numbers for other in self.of(number)}))
        if not union or self.of(union[0]) == union:
            return False
        for number in union:
            self._group[number] = union
        return True

    def forget(self) -> None:
        """Begin anew: another road has other formations."""
        self._group.clear()
