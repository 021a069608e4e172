"""State machines from a table: which row is taken, and what a book with planted bugs refuses."""

from __future__ import annotations

from enum import Enum

import pytest
from attrs import define, field

from laneweave.protocol.state_machine import (
    RuleBook,
    Transition,
)
from support.rule_books import replacing


class Lamp(Enum):
    """Phases of a small machine."""

    OFF = "off"
    ON = "on"
    BROKEN = "broken"


@define
class Machine:
    """A lamp that burns through after some switching, and what was done to it."""

    phase: Lamp = Lamp.OFF
    done: list[str] = field(factory=list)
    powered: bool = True


def is_powered(machine: Machine, _: object) -> bool:
    """There is current."""
    return machine.powered


def is_rough(_: Machine, message: object) -> bool:
    """The switch is hit hard."""
    return message == "hard"


def glow(machine: Machine, _: object) -> None:
    """Glow."""
    machine.done.append("glow")


def click(machine: Machine, message: object) -> None:
    """Click."""
    machine.done.append(f"click {message}")


def unused(_: Machine, __: object) -> None:
    """Be of no use to the table."""


TABLE = (
    Transition("S1", "switch", (Lamp.OFF, Lamp.ON), (is_powered, is_rough), (click,), Lamp.BROKEN),
    Transition("S2", "switch", (Lamp.OFF,), (is_powered,), (click, glow), Lamp.ON),
    Transition("S3", "switch", (Lamp.ON,), (), (), Lamp.OFF),
    Transition("S4", "switch", tuple(Lamp), (), (click,)),
    Transition("S5", "replace", (Lamp.BROKEN, Lamp.OFF), (), (), Lamp.OFF),
)
BOOK = RuleBook(TABLE)


# --- which row --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("phase", "powered", "message", "rule", "done", "then"),
    [
        (Lamp.OFF, True, "hard", "S1", ["click hard"], Lamp.BROKEN),
        (Lamp.OFF, True, "softly", "S2", ["click softly", "glow"], Lamp.ON),
        (Lamp.OFF, False, "hard", "S4", ["click hard"], Lamp.OFF),
        (Lamp.ON, True, "hard", "S1", ["click hard"], Lamp.BROKEN),
        (Lamp.ON, True, "softly", "S3", [], Lamp.OFF),
        (Lamp.BROKEN, True, "hard", "S4", ["click hard"], Lamp.BROKEN),
    ],
)
def test_the_first_row_whose_source_and_guards_fit_is_taken_and_no_other(
    phase: Lamp, powered: bool, message: str, rule: str, done: list[str], then: Lamp
) -> None:
    machine = Machine(phase, powered=powered)
    taken = BOOK.take(machine, "switch", message)
    assert taken is not None
    assert taken.rule == rule
    assert (machine.done, machine.phase) == (done, then)


@pytest.mark.parametrize(
    ("event", "phase"), [("replace", Lamp.ON), ("repaint", Lamp.OFF), ("", Lamp.BROKEN)]
)
def test_where_nothing_fits_nothing_changes(event: str, phase: Lamp) -> None:
    machine = Machine(phase)
    assert BOOK.take(machine, event, None) is None
    assert machine == Machine(phase)


def test_actions_see_the_phase_before_and_guards_stop_at_the_first_that_fails() -> None:
    seen: list[Lamp] = []

    def never(_: Machine, __: object) -> bool:
        pytest.fail("asked, though the guard before it had failed")

    def look(machine: Machine, _: object) -> None:
        seen.append(machine.phase)

    book = replacing(BOOK, {is_rough: never, click: look})
    book.take(Machine(powered=False), "switch", None)
    assert seen == [Lamp.OFF]
    RuleBook([Transition("X", "go", (Lamp.OFF,), (), (look,), Lamp.ON)]).take(Machine(), "go", None)
    assert seen == [Lamp.OFF, Lamp.OFF]


# --- other functions in the places of some ----------------------------------------------------


def test_a_function_that_no_rule_uses_cannot_be_replaced() -> None:
    with pytest.raises(ValueError, match="no rule uses unused"):
        replacing(BOOK, {unused: click})
