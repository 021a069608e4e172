"""The comparison of settings: which bridges a core sees, and when others see the core."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from attrs import define, field
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Send,
    Started,
    Unlisten,
    Wakeup,
    Withdraw,
)
from laneweave.protocol.runtime.settings_check import WAIT_S, CheckedCore, Process, SettingsMetrics
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.messages import RoadClock
from laneweave.protocol.wire.process_messages import ProcessSettings
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CLOCK,
    PROCESS_ALIVE,
    SETTINGS,
    VEHICLE_ALIVE,
    Party,
)

OWN = settings_of(parse_scenario({}))
OTHER = settings_of(parse_scenario({"formation": {"gap_m": 20.0}}))
FITS, DIFFERS, UNKNOWN = 5, 7, 9
"""Incarnations of bridges; the last one is of the release before, and declares no settings."""
SETTINGS_OF = {FITS: OWN, DIFFERS: OTHER}
TOKEN = Announce(VEHICLE_ALIVE, {"process": "v1", "vehicle": "v1"})


@define
class Inner:
    """A core that records what it sees, and sends something at each event."""

    seen: list[Event] = field(factory=list)
    wakeup_s: float | None = None

    def handle(self, event: Event, _: float) -> Iterable[Effect]:
        self.seen.append(event)
        if isinstance(event, Started):
            yield TOKEN
        yield Send(CLOCK, clock(0))


def clock(bridge: int) -> RoadClock:
    return RoadClock(1, 0.1, 0, 0, 0, 0, ended=False, bridge=bridge)


def process_token(bridge: int) -> dict[str, Any]:
    process = Process.of(Identity(Party.BRIDGE), bridge)
    token = process.token(SETTINGS_OF[bridge])
    return {name: str(value) for name, value in token.items()}


def alive(bridge: int) -> dict[str, str]:
    return {"incarnation": str(bridge)}


def fits(core: CheckedCore) -> bool:
    (metrics,) = (one for one in core.metrics if isinstance(one, SettingsMetrics))
    return metrics.fit


def make(inner: Inner, party: Party = Party.FLEET) -> CheckedCore:
    process = Process.of(Identity(party, "f"), 1, "0-of-1")
    return CheckedCore(inner, process, OWN, CLOCK)


def message(bridge: int) -> Arrived:
    return Arrived(CLOCK, {}, clock(bridge))


def test_a_process_declares_its_settings_and_acts_on_a_road_that_fits() -> None:
    inner = Inner()
    core = make(inner)
    started = list(core.handle(Started(), 0.0))
    assert started[0] == Announce(PROCESS_ALIVE, core._process.token(OWN))
    assert TOKEN in started
    list(core.handle(PeerUp(PROCESS_ALIVE, process_token(FITS)), 0.0))
    list(core.handle(message(FITS), 0.0))
    assert inner.seen[-1] == message(FITS)
    assert core.wakeup_s is None


def test_no_message_is_acted_on_before_the_comparison_but_those_of_the_release_before() -> None:
    inner = Inner()
    core = make(inner)
    list(core.handle(PeerUp(BRIDGE_ALIVE, alive(UNKNOWN)), 10.0))
    list(core.handle(message(UNKNOWN), 10.0 + 0.9 * WAIT_S))
    assert message(UNKNOWN) not in inner.seen
    list(core.handle(message(UNKNOWN), 10.0 + WAIT_S))
    assert inner.seen[-1] == message(UNKNOWN)
    list(core.handle(message(0), 0.0))  # simulated runs name no bridge
    assert inner.seen[-1] == message(0)


def test_a_process_that_does_not_fit_is_hidden_and_says_what_differs() -> None:
    inner = Inner()
    core = make(inner)
    list(core.handle(Started(), 0.0))
    effects = list(core.handle(PeerUp(PROCESS_ALIVE, process_token(DIFFERS)), 1.0))
    assert Listen(SETTINGS, {"role": "bridge"}) in effects
    assert Withdraw(TOKEN.topic, TOKEN.parameters) in effects
    assert isinstance(inner.seen[-1], LinkDown)
    (sent,) = [each for each in effects if isinstance(each, Send) and each.topic is SETTINGS]
    assert sent.message == ProcessSettings("fleet", "f", 1, dict(OWN.values))  # type: ignore[arg-type]
    assert core.wakeup_s == 2.0
    assert list(core.handle(Wakeup(), 1.5)) == []
    assert [type(each) for each in core.handle(Wakeup(), 2.0)] == [Send]
    before = len(inner.seen)
    list(core.handle(message(DIFFERS), 2.1))
    list(core.handle(PeerUp(BRIDGE_ALIVE, alive(DIFFERS)), 2.1))
    assert len(inner.seen) == before

    effects = list(core.handle(PeerDown(PROCESS_ALIVE, process_token(DIFFERS)), 3.0))
    assert isinstance(inner.seen[-1], LinkUp)
    assert effects[:2] == [Unlisten(SETTINGS, {"role": "bridge"}), TOKEN]


def test_only_the_groups_that_a_role_uses_must_agree() -> None:
    other = settings_of(parse_scenario({"formation": {"max_vehicles": 8}}))
    token = process_token(FITS) | {"digests": other.digests, "incarnation": "11"}
    roles = (Party.VEHICLE, True), (Party.FLEET, True), (Party.COORDINATOR, False)
    for party, fits in roles:
        inner = Inner()
        core = make(inner, party)
        list(core.handle(PeerUp(PROCESS_ALIVE, token), 0.0))
        list(core.handle(message(11), 0.0))
        assert (message(11) in inner.seen) == fits


def test_a_forged_token_of_a_bridge_excludes_no_process_that_fits() -> None:
    forged = process_token(FITS) | {"digests": OTHER.digests}
    for tokens in ((forged, process_token(FITS)), (process_token(FITS), forged)):
        inner = Inner()
        core = make(inner)
        for token in tokens:
            list(core.handle(PeerUp(PROCESS_ALIVE, token), 0.0))
        list(core.handle(message(FITS), 0.0))
        assert inner.seen[-1] == message(FITS)


EVENTS = st.one_of(
    st.sampled_from([LinkUp(), LinkDown()]),
    st.builds(
        lambda kind, bridge: kind(BRIDGE_ALIVE, alive(bridge)),
        st.sampled_from([PeerUp, PeerDown]),
        st.sampled_from([FITS, DIFFERS, UNKNOWN]),
    ),
    st.builds(
        lambda kind, bridge: kind(PROCESS_ALIVE, process_token(bridge)),
        st.sampled_from([PeerUp, PeerDown]),
        st.sampled_from([FITS, DIFFERS]),
    ),
    st.builds(message, st.sampled_from([FITS, DIFFERS, UNKNOWN])),
)


@given(st.lists(EVENTS, max_size=25))
def test_in_any_order_of_events_the_core_never_acts_where_it_does_not_fit(
    events: list[Event],
) -> None:
    inner = Inner()
    core = make(inner)
    declared: set[str] = set()
    subscribed = 0
    known: set[int] = set()
    now_s = 0.0
    for event in [Started(), *events]:
        now_s += 0.1
        before = len(inner.seen)
        for effect in core.handle(event, now_s):
            match effect:
                case Announce(topic):
                    declared.add(topic.name)
                case Withdraw(topic):
                    declared.discard(topic.name)
                case Listen(topic) | Unlisten(topic) if topic is SETTINGS:
                    subscribed += 1 if isinstance(effect, Listen) else -1
                case _:
                    pass
        if isinstance(event, PeerUp) and event.topic is PROCESS_ALIVE:
            known.add(int(event.parameters["incarnation"]))
        if event == message(DIFFERS) and DIFFERS in known:
            assert len(inner.seen) == before
        if event == message(FITS) and FITS in known:
            assert inner.seen[-1] == event
        hidden = not fits(core)
        assert (TOKEN.topic.name in declared) is not hidden
        assert subscribed == hidden
        links = [each for each in inner.seen if isinstance(each, (LinkUp, LinkDown))]
        if hidden:
            assert links[-1] == LinkDown()
    for topic, token in ((PROCESS_ALIVE, process_token(DIFFERS)), (BRIDGE_ALIVE, alive(DIFFERS))):
        list(core.handle(PeerDown(topic, token), now_s))
    list(core.handle(LinkUp(), now_s))
    links = [each for each in inner.seen if isinstance(each, (LinkUp, LinkDown))]
    assert links[-1] == LinkUp()
    assert fits(core)
