"""When faults are due: drawn from the seed, in order, and reported when they never came."""

from __future__ import annotations

from itertools import islice

import pytest

from laneweave.launch.faults.schedule import Blow, FaultSchedule
from laneweave.launch.faults.specification import Faults, Kill, Partition, Pause
from laneweave.protocol.runtime.message_faults import MessageRule


def blows(faults: Faults, seed: int = 1, until_s: float = 1e6) -> list[Blow]:
    return list(FaultSchedule(faults, seed).due(until_s))


def times_s(faults: Faults, seed: int = 1) -> list[float]:
    return [blow.due_s for blow in blows(faults, seed)]


def test_a_blow_is_due_once() -> None:
    early, late = Kill(at_s=1.0), Kill(at_s=2.0, target="c1")
    schedule = FaultSchedule(Faults(kill=(late, early)), 1)

    assert list(schedule.due(0.9)) == []
    assert [blow.strike for blow in schedule.due(1.0)] == [early]
    assert list(schedule.due(1.5)) == []
    assert [blow.strike for blow in schedule.due(9.0)] == [late]
    assert list(schedule.due(99.0)) == []


def test_a_strike_repeats_evenly() -> None:
    assert times_s(Faults(kill=(Kill(at_s=5.0, every_s=2.5, times=4),))) == [5.0, 7.5, 10.0, 12.5]


def test_a_strike_may_repeat_to_the_end_of_the_run() -> None:
    schedule = FaultSchedule(Faults(pause=(Pause(at_s=1.0, every_s=1.0, for_s=0.5),)), 1)
    assert [blow.due_s for blow in schedule.due(3.0)] == [1.0, 2.0, 3.0]
    assert [blow.due_s for blow in islice(schedule.due(1e6), 2)] == [4.0, 5.0]


def test_several_targets_of_one_time_are_several_blows() -> None:
    assert times_s(Faults(kill=(Kill(at_s=5.0, target="agent", count=3),))) == [5.0, 5.0, 5.0]


def test_times_are_drawn_between_bounds_in_order() -> None:
    faults = Faults(kill=(Kill(between_s=(10.0, 50.0), target="agent", count=20, times=2),))
    drawn = times_s(faults)
    assert len(set(drawn)) == 40
    assert drawn == sorted(drawn)
    assert 10.0 <= drawn[0] < 20.0
    assert 40.0 < drawn[-1] <= 50.0


def test_equal_seeds_draw_equal_times_and_others_others() -> None:
    faults = Faults(
        kill=(Kill(between_s=(0.0, 9.0), times=5),),
        pause=(Pause(between_s=(0.0, 9.0), times=5, for_s=(0.1, 15.0)),),
    )
    assert blows(faults, 1) == blows(faults, 1)
    assert times_s(faults, 1) != times_s(faults, 2)
    own = Faults(seed=2, kill=faults.kill, pause=faults.pause)
    assert blows(own, 1) == blows(faults, 2)


def test_choices_are_drawn_from_the_seed() -> None:
    faults = Faults(kill=(Kill(at_s=1.0, every_s=1.0, times=20, target="agent"),))

    def choices(seed: int) -> list[int]:
        return [blow.draw.randrange(1000) for blow in blows(faults, seed)]

    assert choices(1) == choices(1)
    assert choices(1) != choices(2)


def test_another_strike_does_not_change_the_times_of_the_first() -> None:
    drawn = Kill(between_s=(0.0, 9.0), times=5)
    alone = times_s(Faults(kill=(drawn,)))
    among = [
        blow.due_s
        for blow in blows(Faults(kill=(drawn, Kill(between_s=(0.0, 9.0), times=3))))
        if blow.strike_name == "kill[0]"
    ]
    assert among == alone


def test_a_pause_lasts_as_long_as_drawn() -> None:
    faults = Faults(pause=(Pause(between_s=(0.0, 9.0), times=50, for_s=(0.1, 15.0)),))
    drawn = [blow.for_s for blow in blows(faults)]
    assert all(for_s is not None and 0.1 <= for_s <= 15.0 for for_s in drawn)
    assert len(set(drawn)) == 50
    (fixed,) = blows(Faults(pause=(Pause(at_s=1.0, for_s=2.0),)))
    assert (fixed.for_s, fixed.restart_after_s) == (2.0, None)


@pytest.mark.parametrize(("share", "restarted"), [(0.0, 0), (0.29, 29), (0.5, 50), (1.0, 100)])
def test_exactly_the_share_is_started_again(share: float, restarted: int) -> None:
    kill = Kill(
        target="agent", count=100, between_s=(0.0, 9.0), restart_after_s=2.0, restart_share=share
    )
    found = [blow.restart_after_s for blow in blows(Faults(kill=(kill,)))]
    assert found.count(2.0) == restarted
    assert found.count(None) == 100 - restarted


def test_what_never_happened_is_told() -> None:
    faults = Faults(
        kill=(Kill(at_s=5.0), Kill(at_s=90.0, target="c1")),
        pause=(Pause(between_s=(70.0, 80.0), target="agent", for_s=1.0),),
        messages=(MessageRule(loss=0.1), MessageRule(loss=1.0, from_s=60.0)),
        partition=(Partition(between=("bridge", "others"), from_s=65.0),),
    )
    schedule = FaultSchedule(faults, 1)
    list(schedule.due(60.0))
    assert schedule.never_happened({"kill[0]"}) == [
        "the run ended before c1 was killed at 90 s",
        "the run ended before agent was paused at 70 s",
        "the run ended before partition[0] came into force at 65 s",
    ]


def test_one_blow_of_a_repeated_strike_is_enough() -> None:
    schedule = FaultSchedule(Faults(kill=(Kill(at_s=5.0, every_s=5.0),)), 1)
    list(schedule.due(6.0))
    assert schedule.never_happened({"kill[0]"}) == []
