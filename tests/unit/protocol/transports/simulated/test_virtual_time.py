"""Virtual time: clocks, conditions, actions, and the trace of a run, equal for equal seeds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

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
    Query,
    Received,
    TokenDown,
    TokenUp,
)
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import (
    Clock,
    Conditions,
    Item,
    TraceDigest,
)
from support.node_recorder import CALM, REALM, STORM, Recorder, chatter, network_of
from support.variants import variants

TESTS = Path(__file__).parents[4]

# --- clocks and conditions --------------------------------------------------------------------


@given(
    st.floats(-1e4, 1e4), st.floats(0.5, 2.0), st.floats(-1e5, 1e5) | st.sampled_from([0.0, 1e-300])
)
def test_a_wakeup_is_never_early_and_hardly_late(
    offset_s: float, rate: float, local_s: float
) -> None:
    clock = Clock(offset_s, rate)
    shown_s = clock.local_s(clock.virtual_s(local_s))
    assert local_s <= shown_s <= local_s + 1e-9


@pytest.mark.parametrize(
    ("offset_s", "rate"),
    [(0.0, 0.0), (0.0, -1.0), (float("nan"), 1.0), (float("inf"), 1.0), (0.0, float("nan"))],
)
def test_a_clock_that_is_none_is_refused(offset_s: float, rate: float) -> None:
    network = network_of(a=Recorder())
    with pytest.raises(ValueError, match="must be"):
        network.set_clock("a", offset_s, rate)


@pytest.mark.parametrize(
    ("name", "value"),
    [("loss", 1.1), ("loss", -0.1), ("duplication", 2.0), ("compute_failure", float("nan")),
     ("delay_s", -1.0), ("jitter_s", float("inf")), ("lease_s", float("nan")),
     ("compute_s", -0.1), ("compute_jitter_s", -0.1)],
)  # fmt: skip
def test_conditions_that_cannot_be_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Conditions(**{name: value})


# --- time passes ------------------------------------------------------------------------------


def test_time_passes_without_events_and_an_action_in_the_past_happens_now() -> None:
    network = SimulatedNetwork(1)
    assert not network.step()
    network.run(5.0)
    assert network.now_s == 5.0
    times: list[float] = []
    network.at(0.0, lambda: times.append(network.now_s))
    network.run(5.2)
    assert times == [5.0]


def test_a_run_stops_when_it_is_told_to() -> None:
    core = Recorder()
    core.wakeup_s = 0.2
    network = SimulatedNetwork(1, CALM)
    network.add("a", core, REALM)
    network.run(5.0, stop=lambda: len(core.of(Wakeup)) == 3)
    assert len(core.of(Wakeup)) == 3
    assert network.now_s < 0.3


# --- traces -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "conditions", variants([pytest.param(STORM, id="storm"), pytest.param(CALM, id="calm")])
)
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
        shown = subprocess.check_output([sys.executable, "-c", code], env=environment, timeout=120)
        assert shown.decode().strip() == digest.hexdigest()
    assert digest.events > 500


def test_other_seeds_give_other_traces() -> None:
    digests = [TraceDigest() for _ in range(8)]
    for seed, digest in enumerate(digests):
        chatter(seed, STORM, digest)
    assert len({digest.hexdigest() for digest in digests}) == 8


@pytest.mark.parametrize("conditions", [CALM, STORM], ids=["calm", "storm"])
@pytest.mark.parametrize("seed", [1, 5])
def test_a_run_is_the_same_with_a_trace_and_with_messages_in_kind(
    conditions: Conditions, seed: int
) -> None:
    events: list[tuple[float, str, Item]] = []
    run = chatter(seed, conditions, lambda *event: events.append(event))
    assert run == chatter(seed, conditions)
    assert run == chatter(seed, conditions, skip_codec=True)
    seen, _ = run
    assert len(events) == sum(len(core) for core in seen) > 300
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
    Query("k", b"p", 1),
    Query("k", b"p", 2),
    Query("k", b"q", 1),
    Query("q", b"p", 1),
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
