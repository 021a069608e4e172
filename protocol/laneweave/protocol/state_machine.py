"""State machines from one table of transitions.

A machine is an object with a `phase`. Its `RuleBook` is the table of its transitions and the named
guards and actions that the table is made of. The code runs from the table, docs/PROTOCOL.md is
generated from it, and a test that wants to know whether a rule matters replaces one name
(`planted`). The first transition whose event, source and guards fit is taken.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any

from attrs import frozen

Function = Callable[..., Any]
_Row = tuple[tuple[Enum, ...], tuple[Function, ...], tuple[Function, ...], "Transition"]


@frozen
class Transition:
    """One row: on this event, in these phases, if all guards hold, do the actions."""

    rule: str
    """Name of the rule in docs/PROTOCOL.md; several transitions may belong to one rule."""
    event: str
    sources: tuple[Enum, ...]
    """Phases in which it may be taken."""
    guards: tuple[str, ...]
    """Names of functions of (machine, message) that must all return true."""
    actions: tuple[str, ...]
    """Names of functions of (machine, message) that are called in this order."""
    target: Enum | None = None
    """Phase after it; None: the phase stays."""


class RuleBook:
    """The transitions of one kind of machine."""

    def __init__(self, table: Iterable[Transition], functions: Mapping[str, Function]) -> None:
        """Check that the table names nothing that does not exist.

        Raises:
            ValueError: a guard or an action has no function.
        """
        self.table = tuple(table)
        self.functions = dict(functions)
        self._rows: dict[str, tuple[_Row, ...]] = {}
        """Of each event (sources, guards, actions, transition); few enough to be looked through,
        and phases are slow to hash."""
        for transition in self.table:
            for name in (*transition.guards, *transition.actions):
                if name not in self.functions:
                    raise ValueError(f"rule {transition.rule}: no function {name}")
            row = (
                transition.sources,
                tuple(self.functions[name] for name in transition.guards),
                tuple(self.functions[name] for name in transition.actions),
                transition,
            )
            event = transition.event
            self._rows[event] = (*self._rows.get(event, ()), row)

    def take(self, machine: Any, event: str, message: Any) -> Transition | None:  # noqa: ANN401
        """Take the first transition that fits and return it; None: nothing changes."""
        phase = machine.phase
        for sources, guards, actions, transition in self._rows.get(event, ()):
            if phase not in sources:
                continue
            for guard in guards:
                if not guard(machine, message):
                    break
            else:
                for action in actions:
                    action(machine, message)
                if transition.target is not None:
                    machine.phase = transition.target
                return transition
        return None

    def planted(self, **functions: Function) -> RuleBook:
        """Return a book in which some functions are others: for tests that plant a bug.

        Raises:
            ValueError: this book has no function of such a name.
        """
        for name in functions:
            if name not in self.functions:
                raise ValueError(f"there is no rule {name} to plant a bug in")
        return RuleBook(self.table, self.functions | functions)

    def words(self, name: str) -> str:
        """Return what a guard or an action means: the first line of its docstring."""
        text = inspect.getdoc(self.functions[name]) or name
        return text.splitlines()[0].rstrip(".")


def named(*functions: Function) -> dict[str, Function]:
    """Return functions by their names, without a leading underscore."""
    return {function.__name__.lstrip("_"): function for function in functions}


def markdown_table(book: RuleBook) -> str:
    """Return a book's table for docs/PROTOCOL.md."""
    lines = ["| rule | event | in phase | guard | action | then |", "|---|---|---|---|---|---|"]
    for row in book.table:
        every = tuple(type(row.sources[0]))
        phases = "any" if set(row.sources) == set(every) else ", ".join(_all(row.sources))
        guards = "; ".join(book.words(name) for name in row.guards)
        actions = "; ".join(book.words(name) for name in row.actions) or "nothing"
        target = row.target.value if row.target is not None else ""
        lines.append(f"| {row.rule} | {row.event} | {phases} | {guards} | {actions} | {target} |")
    return "\n".join(lines)


def mermaid_diagram(book: RuleBook, start: Enum) -> str:
    """Return a book's diagram of phases for docs/PROTOCOL.md."""
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


def _all(phases: tuple[Enum, ...]) -> tuple[str, ...]:
    return tuple(str(phase.value) for phase in phases)


def _node(phase: Enum) -> str:
    return str(phase.value).replace(" ", "_").replace("-", "_")
