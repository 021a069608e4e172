"""Times of fault events, drawn from the seed, and reports of faults without effect."""

from __future__ import annotations

from itertools import islice

from laneweave.launch.faults.fault_file import FaultSpec, Kill, Partition, Pause
from laneweave.launch.faults.schedule import FaultEvent, FaultSchedule
from laneweave.protocol.runtime.message_faults import MessageRule
from support.tables import for_each


def events(faults: FaultSpec, seed: int = 1, until_s: float = 1e6) -> list[FaultEvent]:
    return list(FaultSchedule(faults, seed).due(until_s))


def times_s(faults: FaultSpec, seed: int = 1) -> list[float]:
    return [event.due_s for event in events(faults, seed)]


def test_an_event_is_due_once() -> None:
    early, late = Kill(at_s=1.0), Kill(at_s=2.0, target="c1")
    schedule = FaultSchedule(FaultSpec(kill=(late, early)), 1)

    assert list(schedule.due(0.9)) == []
    assert [event.fault for event in schedule.due(1.0)] == [early]
    assert list(schedule.due(1.5)) == []
    assert [event.fault for event in schedule.due(9.0)] == [late]
    assert list(schedule.due(99.0)) == []


def test_a_fault_may_repeat_until_the_end_of_the_run() -> None:
    schedule = FaultSchedule(FaultSpec(pause=(Pause(at_s=1.0, every_s=1.0, for_s=0.5),)), 1)
    assert [event.due_s for event in schedule.due(3.0)] == [1.0, 2.0, 3.0]
    assert [event.due_s for event in islice(schedule.due(1e6), 2)] == [4.0, 5.0]


def test_a_fault_repeats_evenly_or_hits_several_targets_at_one_time() -> None:
    evenly = Kill(at_s=5.0, every_s=2.5, times=4)
    assert times_s(FaultSpec(kill=(evenly,))) == [5.0, 7.5, 10.0, 12.5]
    assert times_s(FaultSpec(kill=(Kill(at_s=5.0, target="agent", count=3),))) == [5.0] * 3


def test_times_are_drawn_between_bounds_in_order() -> None:
    faults = FaultSpec(kill=(Kill(between_s=(10.0, 50.0), target="agent", count=20, times=2),))
    drawn = times_s(faults)
    assert len(set(drawn)) == 40
    assert drawn == sorted(drawn)
    assert 10.0 <= drawn[0] < 20.0
    assert 40.0 < drawn[-1] <= 50.0


def test_equal_seeds_draw_equal_times() -> None:
    faults = FaultSpec(
        kill=(Kill(between_s=(0.0, 9.0), times=5),),
        pause=(Pause(between_s=(0.0, 9.0), times=5, for_s=(0.1, 15.0)),),
    )
    assert events(faults, 1) == events(faults, 1)
    assert times_s(faults, 1) != times_s(faults, 2)
    own = FaultSpec(seed=2, kill=faults.kill, pause=faults.pause)
    assert events(own, 1) == events(faults, 2)


def test_another_fault_does_not_change_the_times_of_the_first() -> None:
    drawn = Kill(between_s=(0.0, 9.0), times=5)
    alone = times_s(FaultSpec(kill=(drawn,)))
    among = [
        event.due_s
        for event in events(FaultSpec(kill=(drawn, Kill(between_s=(0.0, 9.0), times=3))))
        if event.fault_name == "kill[0]"
    ]
    assert among == alone


def test_a_pause_lasts_as_long_as_drawn() -> None:
    faults = FaultSpec(pause=(Pause(between_s=(0.0, 9.0), times=50, for_s=(0.1, 15.0)),))
    drawn = [event.for_s for event in events(faults)]
    assert all(for_s is not None and 0.1 <= for_s <= 15.0 for for_s in drawn)
    assert len(set(drawn)) == 50
    (fixed,) = events(FaultSpec(pause=(Pause(at_s=1.0, for_s=2.0),)))
    assert (fixed.for_s, fixed.restart_after_s) == (2.0, None)


@for_each(("share", "restarted"), [(0.0, 0), (0.29, 29), (0.5, 50), (1.0, 100)])
def test_exactly_the_share_is_restarted(share: float, restarted: int) -> None:
    kill = Kill(
        target="agent", count=100, between_s=(0.0, 9.0), restart_after_s=2.0, restart_share=share
    )
    found = [event.restart_after_s for event in events(FaultSpec(kill=(kill,)))]
    assert found.count(2.0) == restarted
    assert found.count(None) == 100 - restarted


def test_faults_without_effect_are_reported() -> None:
    faults = FaultSpec(
        kill=(Kill(at_s=5.0), Kill(at_s=90.0, target="c1")),
        pause=(Pause(between_s=(70.0, 80.0), target="agent", for_s=1.0),),
        messages=(MessageRule(loss=0.1), MessageRule(loss=1.0, from_s=60.0)),
        partition=(Partition(between=("bridge", "others"), from_s=65.0),),
    )
    schedule = FaultSchedule(faults, 1)
    list(schedule.due(60.0))
    assert schedule.unused_faults({"kill[0]"}) == [
        "kill[1]: the run ended before c1 was killed at 90 s",
        "pause[0]: the run ended before agent was paused at 70 s",
        "partition[0]: the run ended before it came into force at 65 s",
    ]


def test_one_event_of_a_repeated_fault_is_enough() -> None:
    schedule = FaultSchedule(FaultSpec(kill=(Kill(at_s=5.0, every_s=5.0),)), 1)
    list(schedule.due(6.0))
    assert schedule.unused_faults({"kill[0]"}) == []
