"""Planted bugs: what one is, and how it is made from the function that breaks a rule.

Tests that plant a bug and fail unless it is noticed carry the marker `catches` with its name;
`tests/simulation/kill_matrix.py` lists them, and other tests that the bug makes fail.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from attrs import field, frozen

from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.launch.fault_search.coverage import Rules
from laneweave.protocol.state_machine import Function, RuleBook, Transition
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from support.rule_books import replacing

Plant = Callable[[pytest.MonkeyPatch], None]


def unchanged(_: pytest.MonkeyPatch) -> None:
    """Change nothing outside the rule books."""


@frozen(eq=False)
class Bug:
    """One broken rule."""

    name: str
    rule: str
    """Of docs/PROTOCOL.md, one of `planted_bugs.ROWS_OF_OTHERS`, or a subject."""
    text: str
    """What is broken."""
    scenario: str = ""
    """A scenario of tests/scenarios that it makes fail; empty: none is written for it."""
    collides: bool = True
    """That scenario ends with two vehicles in one cell (in the rolling operation also: with two
    owners of one, or with a body in a cell that is not its own)."""
    replaced: Mapping[Function, Function] = field(factory=dict)
    """Guards and actions of a vehicle or a leader, and their replacements."""
    vehicle_row: Callable[[Transition], Transition] | None = None
    """Changes rows of a vehicle's table."""
    plant: Plant = unchanged
    """Changes what is in no rule book."""

    @property
    def vehicle_rules(self) -> RuleBook:
        """A vehicle's rules with this bug."""
        book = self._broken(VEHICLE_RULES)
        return book if self.vehicle_row is None else RuleBook(map(self.vehicle_row, book.table))

    @property
    def leader_rules(self) -> RuleBook:
        """A leader's rules with this bug."""
        return self._broken(LEADER_RULES)

    @property
    def rules(self) -> Rules:
        """All rule books with this bug, for the fault search."""
        return Rules(self.vehicle_rules, self.leader_rules, self._broken(TRANSFER_RULES))

    def _broken(self, book: RuleBook) -> RuleBook:
        used = book.functions
        return replacing(book, {rule: bug for rule, bug in self.replaced.items() if rule in used})


def instead_of(owner: object, *names: str) -> Callable[[Callable[..., Any]], Plant]:
    """Make a plant from a function that gets the method (or function) that it replaces first.

    Args:
        owner: class or module.
        names: of the methods; the same function replaces all of them.
    """

    def decorate(broken: Callable[..., Any]) -> Plant:
        def plant(patch: pytest.MonkeyPatch) -> None:
            for name in names:
                patch.setattr(owner, name, _with_original(broken, getattr(owner, name)))

        return plant

    return decorate


def _with_original(broken: Callable[..., Any], original: object) -> Callable[..., Any]:
    def replaced(*given: object, **named: object) -> object:
        return broken(original, *given, **named)

    return replaced


def breaks(
    rule: str,
    *where: Any,  # noqa: ANN401 (classes, modules, names, rules)
    collides: bool = True,
) -> Callable[[Callable[..., Any]], Bug]:
    """Make a bug from a function, with its name and docstring.

    Args:
        rule: that is broken.
        where: nothing: the function plants the bug; a guard or an action of a rule book, or a
            class (or module) and a name: the function replaces it, see `instead_of`.
        collides: see `Bug`.
    """

    def decorate(broken: Callable[..., Any]) -> Bug:
        text = " ".join((inspect.getdoc(broken) or "").split())
        name = broken.__name__.replace("_", "-")
        if len(where) == 1:
            return Bug(name, rule, text, collides=collides, replaced={where[0]: broken})
        plant = instead_of(*where)(broken) if where else broken
        return Bug(name, rule, text, collides=collides, plant=plant)

    return decorate


def catches(*bugs: Bug) -> pytest.MarkDecorator:
    """Return the mark of a test that fails unless it notices these bugs, which it plants."""
    return pytest.mark.catches(*(bug.name for bug in bugs))
