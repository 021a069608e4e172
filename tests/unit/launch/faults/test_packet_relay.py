"""The queue of packets that a link delays."""

from __future__ import annotations

import random

from laneweave.launch.faults.packet_relay import DelayQueue


def packets(count: int) -> list[bytes]:
    return [b"%d" % number for number in range(count)]


def queue(delay_s: float = 0.0, jitter_s: float = 0.0) -> DelayQueue:
    return DelayQueue(random.Random(1), delay_s, jitter_s)


def test_a_packet_waits_for_the_delay() -> None:
    delays = queue(delay_s=0.5)
    assert delays.next_s is None
    assert delays.add(b"one", 1.0)
    assert delays.next_s == 1.5
    assert list(delays.due(1.4)) == []
    assert list(delays.due(1.5)) == [b"one"]
    assert delays.next_s is None


def test_packets_without_jitter_keep_their_order() -> None:
    delays = queue(delay_s=0.5)
    sent = packets(100)
    for packet in sent:
        delays.add(packet, 1.0)
    assert list(delays.due(2.0)) == sent


def test_jitter_is_additional_and_reorders() -> None:
    delays = queue(delay_s=0.5, jitter_s=0.2)
    sent = packets(100)
    for number, packet in enumerate(sent):
        delays.add(packet, number / 1000)
    assert delays.next_s is not None
    assert delays.next_s >= 0.5
    came = list(delays.due(0.099 + 0.7))
    assert sorted(came) == sorted(sent)
    assert came != sent


def test_equal_seeds_give_equal_delays() -> None:
    one, other = queue(jitter_s=1.0), queue(jitter_s=1.0)
    for packet in packets(10):
        one.add(packet, 0.0)
        other.add(packet, 0.0)
    assert list(one.due(1.0)) == list(other.due(1.0))


def test_a_change_of_the_delay_affects_later_packets_only() -> None:
    delays = queue(delay_s=0.5)
    delays.add(b"early", 0.0)
    delays.delay_s = 0.0
    delays.add(b"late", 0.1)
    assert list(delays.due(0.1)) == [b"late"]
    assert list(delays.due(0.5)) == [b"early"]


def test_packets_beyond_the_limit_are_lost() -> None:
    delays = DelayQueue(random.Random(1), delay_s=0.5, limit=2)
    assert [delays.add(packet, 0.0) for packet in packets(3)] == [True, True, False]
    assert list(delays.due(0.5)) == packets(2)
    assert delays.add(b"next", 0.5)
