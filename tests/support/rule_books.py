"""Rule books for tests: with planted bugs, or recording which rows have been taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import evolve

from laneweave.protocol.state_machine import Function, RuleBook, Transition


def replacing(book: RuleBook, others: Mapping[Function, Function]) -> RuleBook:
    """Return a book in which other functions replace some, to plant a bug.

    Raises:
        ValueError: a function to be replaced is not in the table.
    """
    for function in others.keys() - book.functions:
        raise ValueError(f"no rule uses {function.__name__}")

    def replaced(functions: tuple[Function, ...]) -> tuple[Function, ...]:
        return tuple(others.get(function, function) for function in functions)

    return RuleBook(
        evolve(row, guards=replaced(row.guards), actions=replaced(row.actions))
        for row in book.table
    )


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
