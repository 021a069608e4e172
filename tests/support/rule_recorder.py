"""A book of rules that remembers which of its rows have been taken."""

from __future__ import annotations

from typing import Any

from laneweave.protocol.state_machine import RuleBook, Transition


class RuleRecorder(RuleBook):
    """The same rules as those of another book."""

    def __init__(self, book: RuleBook) -> None:
        """Begin with nothing taken."""
        super().__init__(book.table)
        self.taken: list[int] = []
        """Indices of rows in the table, in the order in which they were taken."""

    def take(self, machine: Any, event: str, message: Any) -> Transition | None:  # noqa: ANN401
        """Take a transition as the other book does, and remember its row."""
        row = super().take(machine, event, message)
        if row is not None:
            self.taken.append(next(i for i, each in enumerate(self.table) if each is row))
        return row
