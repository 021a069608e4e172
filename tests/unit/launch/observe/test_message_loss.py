"""Message loss: expected messages that did not arrive."""

from __future__ import annotations

import random

import pytest

from laneweave.launch.observe.message_loss import GRACE_TICKS, LossMeter
from laneweave.protocol.wire.messages import Name
from support.convoy import Convoy

CONVOY = Convoy(6)
START = 100
WINDOW_TICKS = 100


@pytest.fixture
def meter() -> LossMeter:
    return LossMeter(WINDOW_TICKS)


def drive(
    meter: LossMeter, ticks: range, *, lost: frozenset[tuple[int, int]] = frozenset()
) -> None:
    for tick in ticks:
        meter.on_clock(CONVOY.clock(tick))
        if tick % 10 == 0:
            meter.on_census(CONVOY.census(tick))
        for number in range(CONVOY.count):
            if (number, tick) not in lost:
                meter.on_state(CONVOY.state(number, tick))


def test_nothing_is_expected_before_a_tick_is_over(meter: LossMeter) -> None:
    drive(meter, range(START, START + GRACE_TICKS))
    assert (meter.expected, meter.lost) == (0, 0)


def test_no_loss(meter: LossMeter) -> None:
    drive(meter, range(START, START + 61))
    # Counted from the tick after the first clock.
    assert (meter.expected, meter.lost) == ((60 - GRACE_TICKS) * CONVOY.count, 0)


def test_lost_states_are_counted_once(meter: LossMeter) -> None:
    generator = random.Random(4)
    lost = frozenset(
        (generator.randrange(6), generator.randrange(START + 1, START + 50)) for _ in range(40)
    )
    drive(meter, range(START, START + 61), lost=lost)
    assert meter.lost == len(lost)


def test_duplicate_and_late_states_are_not_lost(meter: LossMeter) -> None:
    late = (2, START + 5)
    drive(meter, range(START, START + 8), lost=frozenset({late}))
    for _ in range(2):
        meter.on_state(CONVOY.state(*late))
    drive(meter, range(START + 8, START + 61))
    assert meter.lost == 0


def test_only_the_last_ticks_count(meter: LossMeter) -> None:
    silent = frozenset((number, tick) for number in range(6) for tick in range(100, 200))
    drive(meter, range(START, 200), lost=silent)
    assert meter.lost == meter.expected > 0
    drive(meter, range(200, 200 + WINDOW_TICKS + GRACE_TICKS))
    assert (meter.expected, meter.lost) == (WINDOW_TICKS * CONVOY.count, 0)


def test_states_are_expected_in_ticks_whose_clock_was_lost(meter: LossMeter) -> None:
    drive(meter, range(START, START + 30))
    drive(meter, range(START + 40, START + 70))
    assert meter.lost == 10 * CONVOY.count


def test_loss_of_clocks(meter: LossMeter) -> None:
    assert (meter.clock_loss, meter.state_loss) == (None, None)
    for tick in (100, 101, 104, 103, 104, 109, 115):
        meter.on_clock(CONVOY.clock(tick))
    # Ticks 101 to 110 are over; 101, 103, 104 and 109 arrived.
    assert meter.clock_loss == pytest.approx(0.6)


def test_ticks_before_the_first_census_count_the_vehicles_that_it_lists(meter: LossMeter) -> None:
    for tick in range(START, START + 21):
        meter.on_clock(CONVOY.clock(tick))
        if tick == START + 4:
            meter.on_census(CONVOY.census(tick))
        for number in range(1, CONVOY.count):
            meter.on_state(CONVOY.state(number, tick))
    assert (meter.lost, meter.expected) == (15, 15 * CONVOY.count)
    assert meter.state_loss == pytest.approx(1 / CONVOY.count)


def test_vehicles_that_leave_and_enter(meter: LossMeter) -> None:
    without = frozenset({CONVOY.names[0]})
    for tick in range(START, START + 60):
        meter.on_clock(CONVOY.clock(tick))
        there = tick >= START + 20 and tick < START + 40
        if tick in (START, START + 18, START + 40):
            away = without if tick != START + 18 else frozenset[Name]()
            census = CONVOY.census(tick, without=away)
            meter.on_census(census)
        for number in range(0 if there else 1, CONVOY.count):
            meter.on_state(CONVOY.state(number, tick))
    # It entered long ago, so two states are expected between its first listing and first state.
    assert meter.lost == 2


def test_after_a_long_silence_only_the_window_is_counted(meter: LossMeter) -> None:
    drive(meter, range(START, START + 10))
    meter.on_clock(CONVOY.clock(10**9))
    assert meter.expected <= WINDOW_TICKS * CONVOY.count
