"""The trace of a simulated network: equal runs have equal digests, others have not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from laneweave.protocol.runtime.node import (
    Arrived,
    Computed,
    PeerDown,
    PeerUp,
    Started,
    Stopping,
    Wakeup,
)
from laneweave.protocol.runtime.transport import (
    LinkDown,
    LinkUp,
    Question,
    Received,
    TokenDown,
    TokenUp,
)
from laneweave.protocol.transports.simulated.virtual_time import Conditions, Item, TraceDigest
from support.node_recorder import CALM, STORM, chatter

TESTS = Path(__file__).parents[3]


@pytest.mark.parametrize("conditions", [CALM, STORM], ids=["calm", "storm"])
def test_equal_seeds_give_equal_traces_in_any_process(conditions: Conditions) -> None:
    digest = TraceDigest()
    chatter(5, conditions, digest)
    code = (
        "from support.node_recorder import *\n"
        "from laneweave.protocol.transports.simulated.virtual_time import TraceDigest\n"
        "digest = TraceDigest()\n"
        f"chatter(5, {'STORM' if conditions == STORM else 'CALM'}, digest)\n"
        "print(digest.hexdigest())"
    )
    for hash_seed in ("0", "1", "4711"):
        path = os.pathsep.join([str(TESTS), *sys.path])
        environment = os.environ | {"PYTHONHASHSEED": hash_seed, "PYTHONPATH": path}
        shown = subprocess.check_output([sys.executable, "-c", code], env=environment, timeout=60)
        assert shown.decode().strip() == digest.hexdigest()
    assert digest.events > 500


def test_other_seeds_give_other_traces() -> None:
    digests = [TraceDigest() for _ in range(8)]
    for seed, digest in enumerate(digests):
        chatter(seed, STORM, digest)
    assert len({digest.hexdigest() for digest in digests}) == 8


@pytest.mark.parametrize("conditions", [CALM, STORM], ids=["calm", "storm"])
def test_a_trace_changes_nothing_and_misses_nothing(conditions: Conditions) -> None:
    events: list[tuple[float, str, Item]] = []
    traced_run = chatter(5, conditions, lambda *event: events.append(event))
    assert traced_run == chatter(5, conditions)
    seen, _ = traced_run
    assert len(events) == sum(len(core) for core in seen)
    for name, core in zip(("a", "b"), seen, strict=False):
        mine = [(now_s, item) for now_s, to, item in events if to == name]
        for (now_s, item), (seen_s, event) in zip(mine, core, strict=True):
            assert now_s == seen_s
            assert TRANSLATED[type(item)] is type(event)


TRANSLATED: dict[type, type] = {
    Received: Arrived,
    TokenUp: PeerUp,
    TokenDown: PeerDown,
} | {kind: kind for kind in (Started, Stopping, Wakeup, Computed, LinkUp, LinkDown)}

ITEMS: list[Item] = [
    Received("k", b"p"),
    Received("k", b"q"),
    Received("kp", b""),
    TokenUp("k"),
    TokenDown("k"),
    TokenDown("q"),
    LinkUp(),
    LinkDown(),
    Question("k", b"p", 1),
    Question("k", b"p", 2),
    Question("k", b"q", 1),
    Question("q", b"p", 1),
    Computed(1, None),
    Computed(2, None),
    Computed(1, None, "no"),
    Started(),
    Stopping(),
    Wakeup(),
]


def digest_of(*events: tuple[float, str, Item]) -> str:
    digest = TraceDigest()
    for event in events:
        digest(*event)
    assert digest.events == len(events)
    return digest.hexdigest()


def test_a_digest_tells_all_events_their_times_nodes_and_order_apart() -> None:
    runs: list[tuple[tuple[float, str, Item], ...]] = [((0.1, "a", item),) for item in ITEMS]
    runs += [((0.2, "a", ITEMS[0]),), ((0.1, "b", ITEMS[0]),), ()]
    first, second = (0.1, "a", ITEMS[0]), (0.1, "a", ITEMS[1])
    more = [(first, second), (second, first), (first, first), (first, second, second)]
    digests = [digest_of(*run) for run in runs] + [digest_of(*run) for run in more]
    assert len(set(digests)) == len(digests)
    assert [digest_of(*run) for run in runs] == digests[: len(runs)]


def test_a_digest_is_not_fooled_by_a_payload_that_looks_like_an_event() -> None:
    empty = (0.1, "a", Received("k", b""))
    looks_like_it = repr((0.1, "a", "Received", "k", 0)).encode()
    assert digest_of(empty, empty) != digest_of((0.1, "a", Received("k", looks_like_it)))


def test_a_digest_leaves_the_result_of_a_computation_out() -> None:
    """It may be anything, even something that prints its address."""
    assert digest_of((0.1, "a", Computed(1, object()))) == digest_of((0.1, "a", Computed(1, 2)))
