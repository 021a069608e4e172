"""State machines defined by tables of transitions.

A machine is an object with a `phase`; a `RuleBook` is the table of its transitions. Guards and
actions are functions of (machine, message). The first transition whose event, source phase and
guards match is taken. The tables of docs/PROTOCOL.md are generated from the rule books, with the
first line of each function's docstring as its description.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

from attrs import frozen

Function = Callable[..., Any]
"""A guard or an action: a function of (machine, message)."""


@frozen
class Transition:
    """Row of a table: on `event` in one of `sources`, if all guards hold, call the actions."""

    rule: str
    """Name of the rule in docs/PROTOCOL.md; several transitions may belong to one rule."""
    event: str
    sources: tuple[Enum, ...]
    """Phases in which the transition may be taken."""
    guards: tuple[Function, ...]
    """Conditions that must all hold."""
    actions: tuple[Function, ...]
    """Called in this order."""
    target: Enum | None = None
    """Phase after the actions; None: unchanged."""


class RuleBook:
    """Transition table of one kind of machine."""

    def __init__(self, table: Iterable[Transition]) -> None:
        """Index the transitions by event."""
        self.table = tuple(table)
        self._rows: dict[str, list[Transition]] = {}
        """Transitions by event. Phases are slow to hash, so `take` searches these short lists."""
        for row in self.table:
            self._rows.setdefault(row.event, []).append(row)

    @property
    def functions(self) -> set[Function]:
        """All guards and actions of the table."""
        return {function for row in self.table for function in (*row.guards, *row.actions)}

    def take(self, machine: Any, event: str, message: Any) -> Transition | None:  # noqa: ANN401
        """Take and return the first transition that matches, or return None if there is none."""
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
