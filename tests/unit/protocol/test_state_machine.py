"""Machines from one table: which row is taken, what a book refuses, and the tables it prints."""

from __future__ import annotations

from enum import Enum

import pytest
from attrs import define, field

from laneweave.protocol.state_machine import (
    RuleBook,
    Transition,
    markdown_table,
    mermaid_diagram,
    named,
)
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES, Stage


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


def _is_powered(machine: Machine, _: object) -> bool:
    """There is current.

    A second paragraph is for the reader of the code.
    """
    return machine.powered


def _is_rough(_: Machine, message: object) -> bool:
    """The switch is hit hard."""
    return message == "hard"


def _glow(machine: Machine, _: object) -> None:
    """Glow."""
    machine.done.append("glow")


def _click(machine: Machine, message: object) -> None:
    """Click."""
    machine.done.append(f"click {message}")


def _unused(_: Machine, __: object) -> None:
    """Be of no use to the table."""


TABLE = (
    Transition(
        "S1", "switch", (Lamp.OFF, Lamp.ON), ("is_powered", "is_rough"), ("click",), Lamp.BROKEN
    ),
    Transition("S2", "switch", (Lamp.OFF,), ("is_powered",), ("click", "glow"), Lamp.ON),
    Transition("S3", "switch", (Lamp.ON,), (), (), Lamp.OFF),
    Transition("S4", "switch", tuple(Lamp), (), ("click",)),
    Transition("S5", "replace", (Lamp.BROKEN, Lamp.OFF), (), (), Lamp.OFF),
)
FUNCTIONS = named(_is_powered, _is_rough, _glow, _click, _unused)
BOOK = RuleBook(TABLE, FUNCTIONS)


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


def test_the_order_of_the_table_decides() -> None:
    backwards = RuleBook(TABLE[::-1], FUNCTIONS)
    machine = Machine()
    taken = backwards.take(machine, "switch", "softly")
    assert taken is TABLE[3]
    assert machine.phase is Lamp.OFF


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

    book = BOOK.planted(is_rough=never, click=look)
    book.take(Machine(powered=False), "switch", None)
    assert seen == [Lamp.OFF]
    RuleBook([Transition("X", "go", (Lamp.OFF,), (), ("look",), Lamp.ON)], {"look": look}).take(
        Machine(), "go", None
    )
    assert seen == [Lamp.OFF, Lamp.OFF]


# --- what a book refuses ----------------------------------------------------------------------


@pytest.mark.parametrize("missing", ["is_powered", "is_rough", "glow", "click"])
def test_a_table_that_names_what_does_not_exist_is_refused(missing: str) -> None:
    functions = {name: function for name, function in FUNCTIONS.items() if name != missing}
    with pytest.raises(ValueError, match=rf"rule S\d: no function {missing}"):
        RuleBook(TABLE, functions)


def test_names_have_no_leading_underscore() -> None:
    assert set(FUNCTIONS) == {"is_powered", "is_rough", "glow", "click", "unused"}


# --- planted bugs -----------------------------------------------------------------------------


def test_a_planted_function_replaces_one_name_in_a_copy_only() -> None:
    book = BOOK.planted(is_powered=lambda machine, message: True)  # noqa: ARG005
    machine = Machine(powered=False)
    taken = book.take(machine, "switch", "softly")
    assert taken is TABLE[1]
    assert book.table == BOOK.table
    assert book.functions["click"] is BOOK.functions["click"]
    machine = Machine(powered=False)
    assert BOOK.take(machine, "switch", "softly") is TABLE[3]


def test_functions_beside_the_table_can_be_planted_too() -> None:
    def other(_: Machine, __: object) -> None:
        """Do something else."""

    assert BOOK.planted(unused=other).functions["unused"] is other


@pytest.mark.parametrize("name", ["is_power", "_is_powered", "S1"])
def test_a_bug_cannot_be_planted_where_there_is_no_rule(name: str) -> None:
    with pytest.raises(ValueError, match=f"no rule {name}"):
        BOOK.planted(**{name: _click})


# --- printed tables ---------------------------------------------------------------------------


def test_words_are_the_first_line_without_a_full_stop() -> None:
    assert BOOK.words("is_powered") == "There is current"
    assert BOOK.words("glow") == "Glow"
    silent = BOOK.planted(glow=lambda machine, message: None)  # noqa: ARG005
    assert silent.words("glow") == "glow"


def test_the_markdown_table_has_a_line_for_each_row_in_order() -> None:
    assert markdown_table(BOOK).splitlines() == [
        "| rule | event | in phase | guard | action | then |",
        "|---|---|---|---|---|---|",
        "| S1 | switch | off, on | There is current; The switch is hit hard | Click | broken |",
        "| S2 | switch | off | There is current | Click; Glow | on |",
        "| S3 | switch | on |  | nothing | off |",
        "| S4 | switch | any |  | Click |  |",
        "| S5 | replace | broken, off |  | nothing | off |",
    ]


def test_the_diagram_has_an_arrow_for_each_change_of_phase() -> None:
    assert mermaid_diagram(BOOK, Lamp.OFF).splitlines() == [
        "stateDiagram-v2",
        "  [*] --> off",
        "  off --> broken: S1 switch",
        "  on --> broken: S1 switch",
        "  off --> on: S2 switch",
        "  on --> off: S3 switch",
        "  broken --> off: S5 replace",
    ]


def test_the_diagram_writes_phases_as_single_words() -> None:
    class Odd(Enum):
        TWO_WORDS = "backing off"
        HYPHEN = "half-done"

    book = RuleBook([Transition("O", "go", (Odd.TWO_WORDS,), (), (), Odd.HYPHEN)], {})
    assert "  backing_off --> half_done: O go" in mermaid_diagram(book, Odd.HYPHEN).splitlines()


def test_rows_with_the_same_arrow_share_it_and_are_named_once() -> None:
    rows = [
        Transition("T1", "push", (Lamp.OFF,), (), (), Lamp.ON),
        Transition("T1", "push", (Lamp.OFF,), (), (), Lamp.ON),
        Transition("T2", "pull", (Lamp.OFF,), (), (), Lamp.ON),
    ]
    assert mermaid_diagram(RuleBook(rows, {}), Lamp.ON).splitlines()[1:] == [
        "  [*] --> on",
        "  off --> on: T1 push, T2 pull",
    ]


def test_the_vehicles_rules_print_with_every_rule_and_phase() -> None:
    lines = markdown_table(VEHICLE_RULES).splitlines()[2:]
    assert len(lines) == len(VEHICLE_RULES.table)
    assert {line.split("|")[1].strip() for line in lines} == {f"V{n}" for n in range(2, 8)}
    assert all(line.count("|") == 7 for line in lines)
    diagram = mermaid_diagram(VEHICLE_RULES, Stage.FREE)
    for stage in Stage:
        assert stage.value in diagram
