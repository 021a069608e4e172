"""Failover times until the next plan, measured on hand-made histories.

test_injection has the times until the next leader.
"""

from __future__ import annotations

import pytest

from laneweave.launch.faults.failover import IN_FORCE, Failover
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.wire.messages import Heartbeat, Name, RoadClock
from laneweave.protocol.wire.process_messages import LogEvent

C1, C2 = Name("c1"), Name("c2")
START_S = 100.0


class History:
    """A road clock that started at 100 s of the wall clock, and messages of the coordinators."""

    def __init__(self, pace: float = 1.0) -> None:
        """Start with c1 as leader."""
        self.view = RoadView()
        self.failover = Failover(lease_s=1.0)
        self.pace = pace
        self.leads(C1, 1, START_S)

    def look(self, now_s: float) -> None:
        road_s = round((now_s - START_S) * self.pace, 1)
        self.view.update(RoadClock(round(road_s * 10), road_s, 0, 0, 0, 0, ended=False), 0.0)
        self.failover.update(self.view, now_s)

    def look_until(self, now_s: float) -> None:
        for index in range(round((now_s - START_S) * 10) + 1):
            self.look(START_S + index / 10)

    def leads(self, name: Name, term: int, now_s: float) -> None:
        self.view.update(Heartbeat(name, 1, term, leading=True, plans=0), 0.0)
        self.look(now_s)

    def plan(self, name: Name, closed_s: float, now_s: float) -> None:
        data = {"closed_s": closed_s}
        self.view.update(LogEvent(Name("coordinator"), name, 0.0, Name(IN_FORCE), data), 0.0)
        self.look(now_s)


def leader_fault(at_s: float, for_s: float | None = None, pace: float = 1.0) -> History:
    history = History(pace)
    history.look_until(at_s)
    history.failover.on_leader_fault(history.view, at_s, for_s)
    return history


def test_the_next_plan_counts_from_the_fault() -> None:
    history = leader_fault(110.0)
    history.leads(C2, 2, 110.03)
    history.plan(C2, 9.0, 110.25)
    history.plan(C2, 9.0, 110.5)
    assert history.failover.recovery_s == [pytest.approx(0.03)]
    assert history.failover.plan_recovery_s == [pytest.approx(0.25)]


@pytest.mark.parametrize("pace", [1.0, 4.0])
def test_time_counts_from_the_closing_of_a_formation_that_closes_later(pace: float) -> None:
    history = leader_fault(101.0, pace=pace)
    history.leads(C2, 2, 101.05)
    closing_s = START_S + 30.0 / pace
    history.look_until(closing_s)
    history.plan(C2, 30.0, closing_s + 0.2)
    assert history.failover.plan_recovery_s == [pytest.approx(0.2, abs=0.11)]


def test_messages_in_flight_of_a_killed_leader_do_not_count() -> None:
    history = leader_fault(110.0)
    history.plan(C1, 9.0, 110.3)
    assert history.failover.plan_recovery_s == []
    history.leads(C2, 2, 110.4)
    history.plan(C2, 9.0, 110.5)
    assert history.failover.plan_recovery_s == [pytest.approx(0.5)]


def test_a_leader_that_was_paused_shortly_continues() -> None:
    history = leader_fault(110.0, for_s=0.2)
    history.plan(C1, 9.0, 110.01)
    history.plan(C1, 9.0, 110.3)
    assert history.failover.plan_recovery_s == [pytest.approx(0.3)]
    assert history.failover.recovery_s == []


def test_other_events_are_ignored() -> None:
    history = leader_fault(110.0)
    history.view.update(LogEvent(Name("coordinator"), C2, 0.0, Name("plan-made"), {}), 0.0)
    history.look(110.2)
    assert history.failover.plan_recovery_s == []
