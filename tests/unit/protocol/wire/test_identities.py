"""Names of those who take part; incarnations rise and are different in all processes."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.wire.identities import (
    Incarnations,
    above,
    parse_identity,
    process_id_of,
)
from support.refusals import refusal
from support.tables import for_each

STEP = 1 << 22
NUMBERS = st.integers(0, 1 << 62)

# --- incarnations -----------------------------------------------------------------------------


@given(number=NUMBERS, floor=NUMBERS)
def test_above_is_the_least_number_of_the_same_process_that_will_do(
    number: int, floor: int
) -> None:
    result = above(number, floor)
    assert result > floor
    assert result >= number
    assert result % STEP == number % STEP
    assert result == number or result - STEP <= floor


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The time in ns, which the test sets."""
    now_ns = [1_700_000_000_000_000_000]
    monkeypatch.setattr(time, "time_ns", lambda: now_ns[0])
    return now_ns


def test_numbers_rise_also_when_the_clock_stands_still_or_goes_back(clock: list[int]) -> None:
    incarnations = Incarnations()
    numbers = []
    for passed_ns in (0, 0, 1, STEP, -10 * STEP, 0, 1_000_000_000):
        clock[0] += passed_ns
        numbers.append(incarnations())
    assert numbers == sorted(set(numbers))
    assert len({number % STEP for number in numbers}) == 1


def test_numbers_are_times(clock: list[int]) -> None:
    """So that a process that starts later has the greater one."""
    assert abs(Incarnations()() - clock[0]) < STEP
    before = Incarnations()()
    clock[0] += STEP
    assert Incarnations()() == before + STEP


def test_processes_of_the_same_moment_have_different_numbers(
    clock: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = set[int]()
    for process in (4321, 4322, STEP - 1):
        monkeypatch.setattr(os, "getpid", lambda process=process: process)
        incarnations = Incarnations()
        numbers |= {incarnations() for _ in range(5)}
    assert len(numbers) == 15
    assert {abs(number - clock[0]) < 6 * STEP for number in numbers} == {True}


def test_processes_of_different_machines_and_containers_have_different_numbers(
    clock: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though both have the process id 1, and begin at the same moment."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    here = Incarnations()()
    for name, value in (("read_text", "another boot"), ("stat", os.stat(os.devnull))):  # noqa: PTH116
        with monkeypatch.context() as patch:
            patch.setattr(Path, name, lambda *_, value=value, **__: value)
            there = Incarnations()()
        assert there != here
        assert abs(there - clock[0]) < STEP


# --- identities -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["router", "bridge", "coordinator.c1", "vehicle.v0001", "fleet.a.b", "client.-",
             "observer." + "x" * 55]
)  # fmt: skip
def test_an_identity_is_read_back(text: str) -> None:
    assert parse_identity(text).common_name == text


@for_each("text", ["", "router.", "router.x", "bridge.b", "coordinator", "coordinator.",
             "vehicle.a/b", "Vehicle.a", "tram.a", "vehicle.a b", "vehicle.*",
             "observer." + "x" * 56,
             "vehicle.é",
             "vehicle.a\n", " bridge"])  # fmt: skip
def test_what_is_no_identity_is_refused(text: str) -> None:
    assert refusal(parse_identity, text).field == "identity"


@given(st.text(max_size=70))
def test_any_text_is_an_identity_or_refused(text: str) -> None:
    try:
        identity = parse_identity(text)
    except BadInputError:
        return
    assert identity.common_name == text
    assert len(text) <= 64


def test_an_incarnation_contains_the_process_id() -> None:
    incarnation = Incarnations()()
    assert process_id_of(incarnation) == os.getpid()
    assert process_id_of(above(incarnation, incarnation + 10 * STEP)) == os.getpid()
