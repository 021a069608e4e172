"""The status of a deployment: coordinators, road, vehicles."""

from __future__ import annotations

import json

import pytest

from laneweave.launch.observe.status import LISTENED, Plans
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.messages import Ballot, ClosedFormation, Name
from support.observing import Listener


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture
def healthy(listener: Listener) -> Listener:
    """A deployment that is healthy: c1 leads, and one vehicle drives."""
    listener.coordinator("c1")
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.bridge()
    listener.agent("a")
    for tick in range(100, 121):
        listener.clock(tick)
        if tick == 110:
            listener.census(tick, a=1.0)
        listener.states("a", [tick])
    return listener


def test_an_observer_does_not_slow_publishers_down() -> None:
    assert {topic.quality for topic in LISTENED} == {topics.Quality.LATEST}
    assert {topics.STATE, topics.CLOCK, topics.CENSUS, topics.HEARTBEAT} <= set(LISTENED)


def test_a_healthy_deployment(healthy: Listener) -> None:
    found = healthy.status()
    assert (found.healthy, found.problem) == (True, None)
    assert (found.leader, found.term, found.claims) == ("c1", 3, ("c1",))
    assert found.road is not None
    assert (found.road.t_s, found.road.advanced_s, found.road.pace) == (12.0, 2.0, 1.0)
    assert (found.vehicles.attended, found.vehicles.agents) == (1, 1)
    assert found.messages_per_s["clock"] == 10.5
    found_json = json.loads(json.dumps(found.to_dict()))
    assert found_json["schema"] == "laneweave.status/1"
    assert found_json["plans"] == {
        "in_force": 2, "operation": "formations", "formations": 0, "formations_with_plan": 0,
    }  # fmt: skip


def test_two_claims_to_lead_are_shown(listener: Listener) -> None:
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.heartbeat("c2", 4, 1.9, leading=True)
    found = listener.status()
    assert (found.leader, found.term, found.claims) == ("c2", 4, ("c2", "c1"))
    assert not any(one.token for one in found.candidates)


def test_a_coordinator_whose_token_vanished_is_no_candidate(listener: Listener) -> None:
    listener.coordinator("c1")
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.coordinator("c1", up=False)
    assert listener.status().candidates == ()
    listener.coordinator("c1")
    assert listener.status().leader == "c1"


def test_a_road_that_has_ended_is_healthy(listener: Listener) -> None:
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.clock(5, ended=True)
    assert listener.status().healthy


def test_attended_and_unattended_vehicles(healthy: Listener) -> None:
    healthy.census(112, a=1.0, b=1.0, c=1.0)
    healthy.states("b", [112], attended=False, accepted=True, promised=Ballot(1, Name("c"), 1, 1))
    vehicles = healthy.status().vehicles
    assert (vehicles.attended, vehicles.unattended, vehicles.unheard) == (1, 1, 1)
    healthy.states("b", [113], owned=((0, 0),))
    assert healthy.status().plans.operation == "rolling"


def test_formations_are_counted_by_their_number(healthy: Listener) -> None:
    assert healthy.status().plans == Plans(2, "formations", 0, 0)
    closed = (ClosedFormation(0, 2, 3.0), ClosedFormation(3, 7, 9.0))
    vehicles = dict.fromkeys("abcd", 1.0)
    healthy.census(112, closed, **vehicles)
    # Vehicles show the column in which they entered; the last one's formation is still open.
    for name, column in zip(vehicles, (0, 2, 5, 8), strict=True):
        healthy.states(name, [112], block=column)
    assert healthy.status().plans == Plans(2, "formations", 2, 0)
    promised = Ballot(1, Name("c"), 1, 1)
    for name, column in (("a", 0), ("b", 2), ("d", 8)):
        healthy.states(name, [113], block=column, accepted=True, promised=promised)
    assert healthy.status().plans == Plans(2, "formations", 2, 1)
    healthy.states("c", [113], block=5, accepted=True, promised=promised)
    assert healthy.status().plans == Plans(2, "formations", 2, 2)
