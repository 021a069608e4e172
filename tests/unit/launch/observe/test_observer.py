"""The launcher's view of a run: newer news wins, nonsense is ignored."""

import queue

from laneweave.launch.observe.observer import Observer, View
from laneweave.protocol.runtime.transport import LinkDown, Received, TokenUp
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Census, Heartbeat, Name, RoadClock
from laneweave.protocol.wire.topics import HEARTBEAT, Keys


def clock(tick: int) -> RoadClock:
    return RoadClock(tick, tick / 10, demanded=0, entered=0, on_road=0, left=0, ended=False)


def heartbeat(name: str, term: int, *, leading: bool = True) -> Heartbeat:
    return Heartbeat(Name(name), 1, term, leading=leading, formations=0)


def test_a_view_of_nothing() -> None:
    view = View()
    assert (view.clock, view.census, view.leader, view.term) == (None, None, None, 0)
    assert view.t_s == 0.0


def test_road_time_does_not_go_back() -> None:
    view = View()
    for tick in (5, 7, 6, 7):
        view.take(clock(tick))
    assert view.t_s == 0.7


def test_an_older_census_is_ignored() -> None:
    view = View()
    for t_s in (2.0, 1.0):
        view.take(Census(t_s, (), ()))
    assert view.census == Census(2.0, (), ())


def test_the_highest_term_leads() -> None:
    view = View()
    view.take(heartbeat("c2", 3))
    view.take(heartbeat("c1", 2))
    view.take(heartbeat("c3", 9, leading=False))
    assert (view.leader, view.term) == ("c2", 3)
    view.take(heartbeat("c1", 4))
    assert (view.leader, view.term) == ("c1", 4)


def test_other_messages_do_not_matter() -> None:
    view = View()
    view.take(object())
    assert view == View()


def test_an_observer_reads_what_is_well_formed() -> None:
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


def test_an_observer_does_not_wait_for_ever() -> None:
    observer = Observer(Keys("here"))
    observer.wait(0.001)
    assert observer.view == View()
