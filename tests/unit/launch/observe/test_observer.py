"""What an observer knows: newer messages replace older ones, malformed ones are ignored."""

import queue

from msgspec.structs import replace

from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.runtime.node import PeerDown, PeerUp
from laneweave.protocol.runtime.transport import LinkDown, Received, TokenUp
from laneweave.protocol.wire.bounds import Bounds
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Census, Heartbeat, Name, RoadClock
from laneweave.protocol.wire.topics import COORDINATOR_ALIVE, HEARTBEAT, Keys

HUGE = 2**63 - 1


def clock(tick: int) -> RoadClock:
    return RoadClock(tick, tick / 10, demanded=0, entered=0, on_road=0, left=0, ended=False)


def heartbeat(name: str, term: int, *, leading: bool = True) -> Heartbeat:
    return Heartbeat(Name(name), 1, term, leading=leading, plans=0)


def test_older_clocks_and_censuses_are_ignored() -> None:
    view = RoadView()
    for tick in (5, 7, 6, 7):
        view.update(clock(tick), 0.0)
        view.update(Census(tick / 10, (), ()), 0.0)
    assert view.t_s == 0.7
    assert view.census == Census(0.7, (), ())


def test_a_view_with_bounds_keeps_its_road_whatever_is_forged() -> None:
    """Otherwise the launcher would not start the agents of announced vehicles."""
    view = RoadView(bounds=Bounds(1000, 0.1, 3600.0))
    for tenth in range(1, 30):
        now_s = tenth / 10
        view.update(replace(clock(tenth), bridge=7), now_s)
        view.update(Census(now_s, (), (), closed_to=tenth, bridge=7), now_s)
        view.update(replace(clock(tenth), bridge=HUGE), now_s)
        view.update(Census(now_s, (), (), bridge=HUGE), now_s)
        view.update(Census(1e12, (), (), bridge=7), now_s)
        assert (view.roads, view.bridge, view.t_s) == (1, 7, tenth / 10)
        assert view.census is not None
        assert view.census.closed_to == tenth


def test_the_highest_term_leads() -> None:
    view = RoadView()
    view.update(heartbeat("c2", 3), 0.0)
    view.update(heartbeat("c1", 2), 0.0)
    view.update(heartbeat("c3", 9, leading=False), 0.0)
    assert (view.leader, view.term) == ("c2", 3)
    view.update(heartbeat("c1", 4), 0.0)
    assert (view.leader, view.term) == ("c1", 4)


def test_terms_begin_anew_if_the_leader_and_all_others_are_restarted() -> None:
    view = RoadView()
    for name, term in (("c1", 1), ("c2", 2)):
        parameters = {"coordinator": name, "incarnation": "1"}
        view.update(PeerUp(COORDINATOR_ALIVE, parameters), 0.0)
        view.update(heartbeat(name, term), 0.0)
    view.leader = None  # as `Failover` does
    view.update(PeerDown(COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": "1"}), 1.0)
    view.update(heartbeat("c1", 1), 1.0)
    led = [view.leader]  # the highest term is that of a process that runs
    view.update(PeerDown(COORDINATOR_ALIVE, {"coordinator": "c2", "incarnation": "1"}), 1.0)
    view.update(replace(heartbeat("c1", 1), incarnation=2), 2.0)
    assert [*led, view.leader] == [None, "c1"]
    assert view.term == 1


def test_an_observer_ignores_malformed_messages() -> None:
    observer = Observer(Keys("here"), queue.SimpleQueue())
    key = Keys("here").key(HEARTBEAT, coordinator="c1")
    for delivery in (
        LinkDown(),
        TokenUp(key),
        Received(key, b"nonsense"),
        Received(key, encode(clock(3))),  # of another kind than its key
        Received("laneweave/here/no/such/topic", encode(heartbeat("c8", 8))),
        Received(Keys("there").key(HEARTBEAT, coordinator="c9"), encode(heartbeat("c9", 9))),
        Received(key, encode(heartbeat("c1", 1))),
    ):
        observer.inbox.put(delivery)

    observer.wait(0.0)

    assert (observer.view.leader, observer.view.term) == ("c1", 1)
    assert observer.view.clock is None
    assert observer.inbox.empty()
