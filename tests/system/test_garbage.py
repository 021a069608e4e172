"""Malformed and forged messages on every key of the network."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import msgpack
import pytest
from msgspec import to_builtins
from msgspec.structs import replace

from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.codec import KINDS, MAX_BYTES, VERSION, encode
from laneweave.protocol.wire.field_types import Message
from laneweave.protocol.wire.messages import Census, Heartbeat, Name, RoadClock
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COORDINATOR_ALIVE,
    SERVICE,
    STATE,
    TOPICS,
    VEHICLE_ALIVE,
    Keys,
    Quality,
    Topic,
)
from support.harness import (
    DEMAND,
    END_S,
    Lab,
    check_safe_and_complete,
    events,
    final_lanes,
    log_lines,
    plans,
    summary,
)
from support.wire_samples import filled, same
from system.conftest import FinishedRun

KEYS = Keys("default")
GHOST = Name("ghost")
HUGE = 2**63 - 1
FORGED = ((0, 0.0), (-(2**63), -1e9), (HUGE, 1e9))
"""Numbers and reals in forged messages."""
NOISE: dict[str, Any] = {
    "role": "r", "name": "n", "self": 1, "t_s": "soon", "kind": [], "data": {}, "vehicles": HUGE,
    "status": {}, "formation": "\n\x00",
}  # fmt: skip
"""Fields of an event with values that are not allowed."""


def messages(vehicle: Name, *, number: int, real: float) -> dict[type, Any]:
    """Return a well-formed message of each kind, with this number and this real in every place."""
    leaf = same(name=vehicle, number=number, real=real, raw=b"\xff\xff\x7f\x7f" * 80, data=NOISE)
    made = {kind: filled(kind, leaf) for kind in KINDS.values()}
    agent = {"role": Name("agent"), "name": vehicle}
    special: dict[type, dict[str, Any]] = {
        Heartbeat: {"coordinator": Name("zz"), "leading": False},
        Report: {**agent, "process": GHOST, "solve_ms": b"\x00\x00\xc0\x7f" * 9},
        LogEvent: {**agent, "kind": Name("plan-made"), "data": NOISE | {"solve_ms": real}},
    }
    return made | {kind: replace(made[kind], **special[kind]) for kind in special}


def parameters_of(vehicle: str) -> dict[str, Any]:
    """Return parameters of keys, of a vehicle and of processes that are there."""
    return {
        "process": vehicle, "vehicle": vehicle, "block": 0, "stretch": 0, "coordinator": "c1",
        "role": "agent", "name": vehicle, "incarnation": 1,
        "session": "s1", "client": "client", "drives": "0-of-1", "digests": "0-0-0-0",
    }  # fmt: skip


def own_key(topic: Topic, message: Message, vehicle: str) -> str:
    """Return the key that has the names in a message; on others it is refused."""
    own = {name: getattr(message, name) for name in topic.named_in_key}
    return KEYS.key(topic, **(parameters_of(vehicle) | own))


def keys_of(topic: Topic, vehicle: str) -> Iterator[str]:
    """Return keys of a topic: of processes that are there and of others that are not."""
    there = parameters_of(vehicle)
    nobody = dict.fromkeys(topic.parameters, "ghost") | {"block": 99, "stretch": 99}
    yield KEYS.key(topic, **there)
    yield KEYS.key(topic, **nobody)


def nonsense(topic: Topic, rng: random.Random) -> Iterator[bytes]:
    """Return payloads that are no message of a topic."""
    good = messages(GHOST, number=1, real=1.0)
    yield b""
    yield b"\xc1"
    yield rng.randbytes(200)
    yield b"\x91" * 400  # lists in lists
    yield msgpack.packb([VERSION, "Nonsense", []])
    for kind, message in good.items():
        whole = encode(message)
        if kind is not topic.kind:
            yield whole
            continue
        yield whole[: len(whole) // 2]
        yield whole[:-1]
        yield whole + b"\x00"
        body = list(to_builtins(message, builtin_types=(bytes,)))
        yield msgpack.packb([VERSION + 1, kind.__name__, body])
        yield msgpack.packb([VERSION, kind.__name__, []])
        yield msgpack.packb([VERSION, kind.__name__, [float("nan")] * len(body)])
        yield msgpack.packb([VERSION, kind.__name__, [2**64 - 1] * len(body)])


def huge_payloads() -> Iterator[bytes]:
    yield bytes(MAX_BYTES + 1)
    yield encode(Report(Name("agent"), GHOST, solve_ms=bytes(MAX_BYTES)))


@pytest.fixture
def talk(lab: Lab) -> Iterator[Callable[[Callable[[ZenohTransport], None]], None]]:
    """Return what repeats something on the run's network, beside the test, until its end."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def start(say: Callable[[ZenohTransport], None]) -> None:
        transport = ZenohTransport(Access(lab.router_endpoint), lambda _: None)

        def work() -> None:
            try:
                while not stop.is_set():
                    say(transport)
                    stop.wait(0.3)
            finally:
                transport.close()

        threads.append(threading.Thread(target=work, daemon=True))
        threads[-1].start()

    yield start
    stop.set()
    for thread in threads:
        thread.join(END_S)
        assert not thread.is_alive()


def say_nonsense(transport: ZenohTransport) -> None:
    """Publish nonsense on all keys, and what is well formed in the name of nobody."""
    rng = random.Random(1)
    for topic in TOPICS:
        for key in keys_of(topic, "v0001"):
            for payload in nonsense(topic, rng):
                transport.publish(key, payload, Quality.ASSURED)
    for topic in TOPICS:
        for number, real in ((-1, -1e9), (HUGE, -1e308)):
            forged = messages(GHOST, number=number, real=real)
            # Who leads and what time it is can be forged: that is for access control to stop.
            harmless = messages(GHOST, number=-1, real=-1e9)
            if topic.kind in (Heartbeat, RoadClock, Census):
                forged = harmless
            if topic.kind is not None:
                message = forged[topic.kind]
                for key in (*keys_of(topic, "v0001"), own_key(topic, message, "v0001")):
                    transport.publish(key, encode(message), Quality.ASSURED)
    transport.publish("laneweave/default/nothing", b"", Quality.ASSURED)
    transport.publish("laneweave/default/sense/v0001/v0001/more", b"", Quality.ASSURED)
    transport.publish("laneweave/default/command/" + "v" * 1000, b"", Quality.ASSURED)


def show_tokens(transport: ZenohTransport) -> None:
    """Show tokens of processes that are none, and take them back."""
    alive = "laneweave/default/alive"
    keys = [
        f"{alive}/coordinator/zz/{incarnation}"
        for incarnation in ("x", "-1", "1.5", "٣", "9" * 60, "9" * 5000, "0x10", "%00")
    ]
    keys += [f"{alive}/coordinator/c0/not-a-number", f"{alive}/vehicle/{'v' * 500}"]
    keys += [
        KEYS.key(VEHICLE_ALIVE, process=GHOST, vehicle=GHOST),
        KEYS.key(BRIDGE_ALIVE, incarnation=GHOST),
    ]
    keys += [KEYS.key(COORDINATOR_ALIVE, coordinator=GHOST, incarnation=7)]
    keys += [KEYS.key(STATE, block=0, vehicle=GHOST), f"{alive}/x", KEYS.key(SERVICE)]
    for key in keys:
        transport.announce(key)
    for key in keys:
        transport.withdraw(key)


@pytest.mark.more
def test_nonsense_changes_nothing(
    finished_run: FinishedRun,
    lab: Lab,
    road: Path,
    talk: Callable[[Callable[[ZenohTransport], None]], None],
) -> None:
    folder = lab.folder / "out"
    process = lab.start(
        *("run", road, *DEMAND, "--vehicles-per-process", "8"), *("--pace", "8", "--out", folder)
    )
    lab.wait_until(lambda: len(events(folder, "entered")) > 0)
    large = huge_payloads()
    answers: list[bool] = []

    def say(transport: ZenohTransport) -> None:
        say_nonsense(transport)
        show_tokens(transport)
        for payload in large:  # once
            for topic in TOPICS:
                for key in keys_of(topic, "v0001"):
                    transport.publish(key, payload, Quality.ASSURED)
        for question in (b"", b"{", b"\xc1", b"{}", b"[" * 5000, bytes(MAX_BYTES + 1)):
            given = transport.query(KEYS.key(SERVICE), question, END_S).result(END_S)
            if given is not None:  # else the run is over
                answers.append(given.ok)

    talk(say)
    ended = lab.finish(process)

    lab.check_nothing_left()
    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    assert final_lanes(folder) == final_lanes(finished_run("simulated"))
    assert summary(folder)["messages"]["rejected"] > 0
    assert [line for line in log_lines(folder) if line["level"] == "error"] == []
    assert answers
    assert not any(answers)
    # What was recorded in other names than those of the run's own processes is still readable.
    assert any(event.get("name") == GHOST for event in events(folder, "plan-made"))


@pytest.mark.more
def test_forged_messages_crash_no_process(
    lab: Lab, road: Path, talk: Callable[[Callable[[ZenohTransport], None]], None]
) -> None:
    folder = lab.folder / "out"
    process = lab.start(
        *("run", road, *DEMAND, "--vehicles-per-process", "4"), *("--pace", "10", "--out", folder)
    )
    lab.wait_until(lambda: len(plans(folder)) > 0)
    known = [Name(event["vehicle"]) for event in events(folder, "entered")]

    def say(transport: ZenohTransport) -> None:
        for vehicle, (number, real) in product(known, FORGED):
            forged = messages(vehicle, number=number, real=real)
            for topic in TOPICS:
                if topic.kind is not None:
                    message = forged[topic.kind]
                    for key in (*keys_of(topic, vehicle), own_key(topic, message, vehicle)):
                        transport.publish(key, encode(message), Quality.ASSURED)

    def recorded() -> bool:
        """Return whether the bridge has recorded three rounds, so that others received them, too.

        In a round there is one event for each vehicle, forgery, and key with its names, of which
        there are two: one of the vehicle, and the message's own, which is the same.
        """
        forged = [event for event in events(folder, "plan-made") if event["role"] == "agent"]
        return len(forged) >= 3 * 2 * len(known) * len(FORGED)

    talk(say)
    lab.wait_until(lambda: recorded() or process.poll() is not None, END_S)
    process.terminate()
    ended = lab.finish(process, END_S)

    # The run may fail, because forged messages can end it; no process may fail.
    assert [line for line in log_lines(folder) if line["level"] == "error"] == []
    assert "ended with status" not in ended.out
    assert summary(folder)["vehicles"]["entered"] > 0
    lab.wait_until(lambda: not lab.processes(), END_S)
