"""Which messages go by radio, who hears them, and when."""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any

import pytest
from attrs import define, field

from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.radio.radio_core import DSRC_DELAY_S, RadioCore, RadioMetrics, over_radio
from laneweave.protocol.radio.reception import DISTANCES_M, MESSAGE_BYTES, sidelink_of
from laneweave.protocol.runtime import node
from laneweave.protocol.runtime.transport import LinkUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.radio_table import C_V2X, DSRC
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Motion, Name
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import Party
from support.node_recorder import Recorder, no_effects
from support.states import A, B, C, holding, sense_in


def with_radio(**values: object) -> Scenario:
    quiet = {"burst_share": 0.0, "cellular_loss": 0.0} | values
    radio = {f"radio__{name}": value for name, value in quiet.items()}
    return load_scenario(None, radio__technology=radio.pop("radio__technology", C_V2X), **radio)


@define
class Process:
    """A wrapped core with the vehicles that hear others."""

    scenario: Scenario
    party: Party = Party.VEHICLE
    hearing: tuple[Name, ...] = (A,)
    listener: Recorder = field(factory=Recorder)

    @cached_property
    def core(self) -> RadioCore:
        core = over_radio(self.listener, self.scenario, self.party, "p", lambda _: self.hearing)
        assert isinstance(core, RadioCore)
        return core

    def put(self, vehicle: Name, s_m: float, t_s: float = 0.0, **more: Any) -> None:  # noqa: ANN401 (fields)
        """Tell the vehicle where it is."""
        sense = sense_in(
            (0, 1), vehicle=vehicle, t_s=t_s, measured=(s_m, 15.0, 0.0, 5.0, 0.0, 0.0), **more
        )
        self.hand(topics.SENSE, sense, 0.0, vehicle=vehicle)

    def hand(self, topic: topics.Topic, message: object, now_s: float, **parameters: str) -> None:
        list(self.core.handle(node.Arrived(topic, parameters, message), now_s))

    def wake(self, until_s: float) -> None:
        while (wakeup_s := self.core.wakeup_s) is not None and wakeup_s <= until_s:
            list(self.core.handle(node.Wakeup(), wakeup_s))

    def arrived(self, topic: topics.Topic) -> list[tuple[float, node.Arrived]]:
        return [
            (now_s, event)
            for now_s, event in self.listener.events
            if isinstance(event, node.Arrived) and event.topic is topic
        ]

    def hear(self, count: int, s_m: float, **more: Any) -> float:  # noqa: ANN401 (fields)
        """Send states from a position; return the share that arrives."""
        before = len(self.arrived(topics.STATE))
        for number in range(count):
            state = holding(B, s_m=s_m, t_s=0.0, **more)
            self.hand(topics.STATE, state, 10.0 + 0.01 * number, vehicle=B)
        self.wake(1e6)
        return (len(self.arrived(topics.STATE)) - before) / count


@pytest.mark.parametrize("technology", [C_V2X, DSRC])
@pytest.mark.parametrize("distance_m", [10.0, 205.0, 400.0])
@pytest.mark.parametrize("senders_per_km", [20.0, 200.0])
def test_states_of_other_vehicles_arrive_by_the_curve(
    technology: str, distance_m: float, senders_per_km: float
) -> None:
    process = Process(with_radio(technology=technology))
    process.put(A, 1000.0, senders_per_km=senders_per_km)
    curve = sidelink_of(technology, 23.0, 10.0).arrival(senders_per_km)
    expected = float(curve[distance_m >= DISTANCES_M][-1])
    assert process.hear(3000, 1000.0 - distance_m) == pytest.approx(expected, abs=0.04)


def test_senders_beyond_the_road_add_to_the_load() -> None:
    process = Process(with_radio(other_senders_per_km=280.0))
    process.put(A, 1000.0, senders_per_km=20.0)
    expected = sidelink_of(C_V2X, 23.0, 10.0).arrival(300.0)[DISTANCES_M == 300.0]
    assert process.hear(3000, 700.0) == pytest.approx(float(expected[0]), abs=0.04)


def test_a_receiver_extrapolates_its_own_position() -> None:
    process = Process(with_radio(technology=DSRC, power_dbm=0.0))
    process.put(A, 100.0, t_s=0.0, senders_per_km=20.0)
    state = holding(B, s_m=100.0 + 15.0 * 40.0, t_s=40.0)
    for number in range(200):
        process.hand(topics.STATE, state, 0.01 * number, vehicle=B)
    process.wake(1e6)
    assert len(process.arrived(topics.STATE)) > 180
    assert process.hear(200, 100.0 + 15.0 * 40.0) == 0.0  # at time 0, far away


def test_of_several_vehicles_only_those_that_hear_receive() -> None:
    process = Process(with_radio(technology=DSRC, power_dbm=0.0), hearing=(A, C))
    process.put(A, 1000.0, senders_per_km=20.0)
    process.put(C, 300.0, senders_per_km=20.0)
    assert process.hear(300, 990.0) > 0.9
    assert {event.vehicles for _, event in process.arrived(topics.STATE)} == {frozenset({A})}
    process.put(C, 995.0, senders_per_km=20.0)
    process.hear(300, 990.0)
    heard = {event.vehicles for _, event in process.arrived(topics.STATE)}
    assert {frozenset({A, C}), frozenset({A}), frozenset({C})} <= heard


def test_a_vehicle_that_is_not_on_the_road_hears_nobody() -> None:
    process = Process(with_radio())
    assert process.hear(50, 0.0) == 0.0
    process.put(A, 0.0)
    assert process.hear(50, 0.0) > 0.5
    process.put(A, 0.0, left=True)
    assert process.hear(50, 0.0) == 0.0


def test_long_messages_need_several_packets() -> None:
    process = Process(with_radio())
    process.put(A, 1000.0, senders_per_km=200.0)
    cells = tuple((1000 + number, 0) for number in range(120))
    assert 2 * MESSAGE_BYTES < len(encode(holding(B, owned=cells))) <= 4 * MESSAGE_BYTES
    short, long = process.hear(3000, 700.0), process.hear(3000, 700.0, owned=cells)
    assert 0.0 < long < short**3 + 0.05


def test_motions_come_from_where_they_began() -> None:
    scenario = with_radio(technology=DSRC, power_dbm=0.0)
    process = Process(scenario)
    process.put(A, 700.0, t_s=50.0, senders_per_km=20.0)
    near = round((700.0 - scenario.lattice.speed_mps * 50.0) / scenario.lattice.pitch_m)
    for column, hears in ((near, True), (near + 40, False)):
        motion = Motion(
            vehicle=B, incarnation=1, stretch=0, origin=(column, 0), target=(column, 1),
            begin_tick=480, ticks=40, tick=round(50.0 / scenario.runtime.tick_s),
        )  # fmt: skip
        before = len(process.arrived(topics.MOTION))
        for number in range(100):
            process.hand(topics.MOTION, motion, 0.01 * number, vehicle=B)
        process.wake(1e6)
        assert (len(process.arrived(topics.MOTION)) - before > 80) == hears


@pytest.mark.parametrize(("technology", "longest_s"), [(C_V2X, 0.1), (DSRC, DSRC_DELAY_S)])
def test_delay_of_the_sidelink(technology: str, longest_s: float) -> None:
    process = Process(with_radio(technology=technology))
    process.put(A, 0.0)
    for number in range(400):
        process.hand(topics.STATE, holding(B, s_m=0.0, t_s=0.0), float(number), vehicle=B)
        process.wake(number + 0.9)
    delays_s = [now_s % 1.0 for now_s, _ in process.arrived(topics.STATE)]
    assert 0.9 * longest_s < max(delays_s) <= longest_s
    assert min(delays_s) < 0.1 * longest_s


@pytest.mark.parametrize(
    ("party", "topic", "parameters"),
    [
        (Party.VEHICLE, topics.PREPARE, {"vehicle": "A"}),
        (Party.VEHICLE, topics.PLAN, {"vehicle": "A"}),
        (Party.VEHICLE, topics.OBSTACLES, {}),
        (Party.COORDINATOR, topics.STATE, {"vehicle": "A"}),
        (Party.BRIDGE, topics.PREPARE, {"vehicle": "A"}),
        (Party.BRIDGE, topics.PLAN, {"vehicle": "A"}),
    ],
)
def test_messages_by_the_cellular_network(
    party: Party, topic: topics.Topic, parameters: dict[str, str]
) -> None:
    settings = with_radio(
        cellular_loss=0.2, cellular_delay_s=0.05, cellular_jitter_s=0.02, power_dbm=0.0
    )
    process = Process(settings, party)
    for number in range(2000):
        process.hand(topic, holding(A, s_m=1e5), float(number), **parameters)
        process.wake(number + 0.9)
    delays_s = [now_s % 1.0 for now_s, _ in process.arrived(topic)]
    assert len(delays_s) == pytest.approx(1600, abs=60)
    assert min(delays_s) >= 0.05 - 1e-9
    assert 0.068 < max(delays_s) <= 0.07 + 1e-9


@pytest.mark.parametrize("party", [Party.VEHICLE, Party.COORDINATOR, Party.BRIDGE])
def test_all_other_messages_are_lossless(party: Party) -> None:
    by_radio = {
        Party.VEHICLE: {"state", "motion", "prepare", "plan", "obstacles"},
        Party.COORDINATOR: {"state"},
        Party.BRIDGE: {"prepare", "plan"},
    }[party]
    settings = with_radio(cellular_loss=1.0, burst_share=0.9, burst_s=60.0)
    process = Process(settings, party, hearing=())
    others = [one for one in topics.TOPICS if one.kind is not None and one.name not in by_radio]
    for topic in others:
        message = sense_in((0, 1), vehicle=A) if topic is topics.SENSE else object()
        for number in range(20):
            process.hand(topic, message, float(number))
        assert [now_s for now_s, _ in process.arrived(topic)] == list(map(float, range(20)))


def test_bursts_affect_both_channels_of_a_vehicle() -> None:
    process = Process(with_radio(burst_share=0.5, burst_s=30.0))
    process.put(A, 0.0)
    for number in range(4000):
        process.hand(topics.STATE, holding(B, s_m=0.0, t_s=0.0), 0.1 * number, vehicle=B)
        process.hand(topics.PLAN, None, 0.1 * number, vehicle=A)
    process.wake(1e6)
    for topic in (topics.STATE, topics.PLAN):
        times_s = [now_s for now_s, _ in process.arrived(topic)]
        silent_s = max(after - before for before, after in pairwise(times_s))
        assert silent_s > 5.0
        assert 0.15 < len(times_s) / 4000 < 0.85


def test_reports_have_the_counts_of_their_sender() -> None:
    scenario = with_radio(technology=DSRC, power_dbm=0.0, cellular_loss=0.5)
    process = Process(scenario, hearing=(A, C))

    def report(_: node.Event, __: float) -> list[node.Effect]:
        sent = [node.Send(topics.REPORT, Report(Name("agent"), name)) for name in (A, C)]
        return [*sent, node.Withdraw(topics.VEHICLE_ALIVE)]

    process.put(A, 0.0)
    process.put(C, 500.0)
    process.hear(100, 0.0)
    for number in range(100):
        process.hand(topics.PLAN, None, float(number), vehicle=C)
    process.listener.on_event = report
    effects = list(process.core.handle(LinkUp(), 0.0))
    near, far = (one.message for one in effects[:2] if isinstance(one, node.Send))
    assert (near.sidelink, near.cellular) == (100, 0)
    assert near.sidelink_lost < 20
    assert (far.sidelink, far.sidelink_lost, far.cellular) == (100, 100, 100)
    assert 30 < far.cellular_lost < 70
    assert isinstance(effects[2], node.Withdraw)
    process.listener.on_event = no_effects
    process.put(A, 0.0, left=True)
    process.listener.on_event = report
    last = next(iter(process.core.handle(LinkUp(), 0.0)))
    assert isinstance(last, node.Send)
    assert last.message == near
    again = next(iter(process.core.handle(LinkUp(), 0.0)))
    assert isinstance(again, node.Send)
    assert again.message.sidelink == 0  # the counters of a vehicle that has left are dropped


def test_equal_seeds_give_equal_losses() -> None:
    def fates(seed: int) -> list[float]:
        scenario = load_scenario(None, seed=seed, radio__technology=C_V2X)
        process = Process(scenario)
        process.put(A, 1000.0, senders_per_km=300.0)
        process.hear(300, 700.0)
        return [now_s for now_s, _ in process.arrived(topics.STATE)]

    assert fates(1) == fates(1) != fates(2)


def test_without_a_radio_the_core_is_not_wrapped() -> None:
    listener = Recorder()
    assert over_radio(listener, load_scenario(None), Party.VEHICLE, "p") is listener


def test_metrics() -> None:
    process = Process(with_radio(cellular_loss=1.0))
    process.hand(topics.PLAN, None, 0.0, vehicle=A)
    (found,) = process.core.metrics
    assert isinstance(found, RadioMetrics)
    assert found.messages_total == {"cellular": 1} == found.lost_total
