"""State machines that run from a table of transitions.

A machine is an object with a `phase`; its `RuleBook` is the table of its transitions, which name
guards and actions as functions of (machine, message). The first transition whose event, source
phase and guards fit is taken. docs/PROTOCOL.md is generated from the tables: the first line of a
function's docstring is its meaning there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

from attrs import frozen

Function = Callable[..., Any]
"""A guard or an action, of (machine, message)."""


@frozen
class Transition:
    """One row: on this event, in these phases, if all guards hold, do the actions."""

    rule: str
    """Name of the rule in docs/PROTOCOL.md; several transitions may belong to one rule."""
    event: str
    sources: tuple[Enum, ...]
    """Phases in which it may be taken."""
    guards: tuple[Function, ...]
    """Must all return true."""
    actions: tuple[Function, ...]
    """Called in this order."""
    target: Enum | None = None
    """Phase afterwards; None: the phase stays."""


class RuleBook:
    """The transitions of one kind of machine."""

    def __init__(self, table: Iterable[Transition]) -> None:
        """Index the transitions by event."""
        self.table = tuple(table)
        self._rows: dict[str, list[Transition]] = {}
        """Few enough for each event to be searched; phases are slow to hash."""
        for row in self.table:
            self._rows.setdefault(row.event, []).append(row)

    @property
    def functions(self) -> set[Function]:
        """All guards and actions of the table."""
        return {function for row in self.table for function in (*row.guards, *row.actions)}

    def take(self, machine: Any, event: str, message: Any) -> Transition | None:  # noqa: ANN401
        """Take the first transition that fits and return it; None: nothing changes."""
        phase = machine.phase
        for row in self._rows.get(event, ()):
            if phase not in row.sources:
                continue
            for guard in row.guards:
                if not guard(machine, message):
                    break
            else:
                for action in row.actions:
                    action(machine, message)
                if row.target is not None:
                    machine.phase = row.target
                return row
        return None
