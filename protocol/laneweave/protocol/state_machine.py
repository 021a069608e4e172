"""State machines that run from a table of transitions.

A machine is an object with a `phase`; its `RuleBook` is the table of its transitions, which name
guards and actions as functions of (machine, message). The first transition whose event, source
phase and guards fit is taken. docs/PROTOCOL.md is generated from the tables: the first line of a
function's docstring is its meaning there.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any

from attrs import evolve, frozen

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

    def replacing(self, others: Mapping[Function, Function]) -> RuleBook:
        """Return a book in which other functions stand for some: for tests that plant a bug.

        Raises:
            ValueError: a function to be replaced is not in the table.
        """
        for function in others.keys() - self.functions:
            raise ValueError(f"no rule uses {function.__name__}")

        def replaced(functions: tuple[Function, ...]) -> tuple[Function, ...]:
            return tuple(others.get(function, function) for function in functions)

        return RuleBook(
            evolve(row, guards=replaced(row.guards), actions=replaced(row.actions))
            for row in self.table
        )


def meaning(function: Function) -> str:
    """Return what a guard or an action means: the first line of its docstring."""
    text = inspect.getdoc(function) or function.__name__
    return text.splitlines()[0].rstrip(".")


def markdown_table(book: RuleBook) -> str:
    """Return the table of a book for docs/PROTOCOL.md."""
    lines = ["| rule | event | in phase | guard | action | then |", "|---|---|---|---|---|---|"]
    for row in book.table:
        every = set(row.sources) == set(type(row.sources[0]))
        phases = "any" if every else ", ".join(str(phase.value) for phase in row.sources)
        guards = "; ".join(map(meaning, row.guards))
        actions = "; ".join(map(meaning, row.actions)) or "nothing"
        target = row.target.value if row.target is not None else ""
        lines.append(f"| {row.rule} | {row.event} | {phases} | {guards} | {actions} | {target} |")
    return "\n".join(lines)


def mermaid_diagram(book: RuleBook, start: Enum) -> str:
    """Return the diagram of the phases of a book for docs/PROTOCOL.md."""
    lines = ["stateDiagram-v2", f"  [*] --> {_node(start)}"]
    arrows: dict[tuple[Enum, Enum], list[str]] = {}
    for row in book.table:
        for source in row.sources:
            if row.target is not None and row.target is not source:
                labels = arrows.setdefault((source, row.target), [])
                label = f"{row.rule} {row.event}"
                if label not in labels:
                    labels.append(label)
    for (source, target), labels in arrows.items():
        lines.append(f"  {_node(source)} --> {_node(target)}: {', '.join(labels)}")
    return "\n".join(lines)


def _node(phase: Enum) -> str:
    return str(phase.value).replace(" ", "_").replace("-", "_")
