"""Message loss is what was expected and did not come, and nothing else."""

from __future__ import annotations

import random

from laneweave.launch.watch.message_loss import GRACE_TICKS, WINDOW_TICKS, LossMeter
from laneweave.protocol.wire.messages import Name
from support.convoy import Convoy

CONVOY = Convoy(6)
START = 100


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


def test_nothing_is_expected_before_a_tick_is_over() -> None:
    meter = LossMeter(0.1)
    drive(meter, range(START, START + GRACE_TICKS))
    assert (meter.expected, meter.lost) == (0, 0)


def test_nothing_is_lost() -> None:
    meter = LossMeter(0.1)
    drive(meter, range(START, START + 61))
    # From the tick after the first one that was heard.
    assert (meter.expected, meter.lost) == ((60 - GRACE_TICKS) * CONVOY.count, 0)


def test_what_is_lost_is_counted_once() -> None:
    generator = random.Random(4)
    lost = frozenset(
        (generator.randrange(6), generator.randrange(START + 1, START + 50)) for _ in range(40)
    )
    meter = LossMeter(0.1)
    drive(meter, range(START, START + 61), lost=lost)
    assert meter.lost == len(lost)


def test_doubles_and_late_ones_are_no_loss() -> None:
    meter = LossMeter(0.1)
    late = (2, START + 5)
    drive(meter, range(START, START + 8), lost=frozenset({late}))
    for _ in range(2):
        meter.on_state(CONVOY.state(*late))
    drive(meter, range(START + 8, START + 61))
    assert meter.lost == 0


def test_only_the_last_ticks_count() -> None:
    meter = LossMeter(0.1)
    silent = frozenset((number, tick) for number in range(6) for tick in range(100, 200))
    drive(meter, range(START, 200), lost=silent)
    assert meter.lost == meter.expected > 0
    drive(meter, range(200, 200 + WINDOW_TICKS + GRACE_TICKS))
    assert (meter.expected, meter.lost) == (WINDOW_TICKS * CONVOY.count, 0)


def test_a_gap_of_the_clock_is_a_loss_of_states() -> None:
    meter = LossMeter(0.1)
    drive(meter, range(START, START + 30))
    drive(meter, range(START + 40, START + 70))
    assert meter.lost == 10 * CONVOY.count


def test_who_leaves_is_not_expected_any_more_and_who_enters_is_from_when_it_is_heard() -> None:
    meter, name = LossMeter(0.1), CONVOY.names[0]
    without = frozenset({name})
    for tick in range(START, START + 60):
        meter.on_clock(CONVOY.clock(tick))
        there = tick >= START + 20 and tick < START + 40
        if tick in (START, START + 18, START + 40):
            away = without if tick != START + 18 else frozenset[Name]()
            census = CONVOY.census(tick, without=away)
            meter.on_census(census)
        for number in range(0 if there else 1, CONVOY.count):
            meter.on_state(CONVOY.state(number, tick))
    # Listed two ticks before it speaks for the first time. It entered long ago, so these are lost.
    assert meter.lost == 2


def test_after_a_long_silence_old_ticks_are_not_gone_through() -> None:
    meter = LossMeter(0.1)
    drive(meter, range(START, START + 10))
    meter.on_clock(CONVOY.clock(10**9))
    assert meter.expected <= WINDOW_TICKS * CONVOY.count
