"""The contract of a transport, held by both: Zenoh with a real router, and the simulation."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
import zenoh
from attrs import define, field

from laneweave.protocol.runtime import node
from laneweave.protocol.runtime.transport import (
    Answer,
    Delivery,
    LinkDown,
    LinkUp,
    Query,
    Received,
    TokenDown,
    TokenUp,
    Transport,
)
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.zenoh.runner import run_core
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Heartbeat, Name
from laneweave.protocol.wire.topics import HEARTBEAT, SERVICE, VEHICLE_ALIVE, Keys, Quality
from support.refusals import refusal

REALM = "r"
KEYS = Keys(REALM)
LEASE_S = 0.5
WAIT_S = 60.0
"""Longest wait for what must come; what comes, comes in milliseconds."""
ASK_S = 3 * WAIT_S
"""An answer that comes only when the question is given up comes too late for every test."""
QUIET_S = 0.15
"""How long to wait for what must not come (Zenoh, wall-clock)."""

BEATS = KEYS.all_of(HEARTBEAT)
TOKENS = KEYS.all_of(VEHICLE_ALIVE)
PLAN_SERVICE = KEYS.key(SERVICE)


def beat_key(name: str) -> str:
    return KEYS.key(HEARTBEAT, coordinator=name)


def token_key(name: str) -> str:
    return KEYS.key(VEHICLE_ALIVE, process=name, vehicle=name)


FLOW = beat_key("flow")
SETTLED = token_key("settled")


def beat(name: str, number: int = 0) -> bytes:
    return encode(Heartbeat(Name(name), 1, number, leading=False, plans=0))


@define
class Party:
    """One participant: what it may call, and what it was handed."""

    transport: Transport
    got: list[Delivery]

    def received(self) -> list[Received]:
        return [item for item in self.all_received() if item.key != FLOW]

    def all_received(self) -> list[Received]:
        return [item for item in self.got if isinstance(item, Received)]

    def tokens(self) -> list[str]:
        signs = {TokenUp: "+", TokenDown: "-"}
        return [
            signs[type(item)] + item.key.rpartition("/")[2]
            for item in self.got
            if isinstance(item, (TokenUp, TokenDown)) and item.key != SETTLED
        ]

    def queries(self) -> list[Query]:
        return [item for item in self.got if isinstance(item, Query)]


Answers = list[Answer | None]


# --- the simulated network --------------------------------------------------------------------


@define
class Recorder:
    """A core that turns events back into the deliveries that they came from."""

    got: list[Delivery] = field(factory=list)
    first: tuple[node.Effect, ...] = ()
    wakeup_s: float | None = None

    def handle(self, event: node.Event, now_s: float) -> Iterable[node.Effect]:
        del now_s
        match event:
            case node.Started():
                return self.first
            case node.Arrived(topic, parameters, message):
                self.got.append(Received(KEYS.key(topic, **parameters), encode(message)))
            case node.PeerUp(topic, parameters):
                self.got.append(TokenUp(KEYS.key(topic, **parameters)))
            case node.PeerDown(topic, parameters):
                self.got.append(TokenDown(KEYS.key(topic, **parameters)))
            case node.QueryArrived(token, payload):
                self.got.append(Query(PLAN_SERVICE, payload, token))
            case LinkUp() | LinkDown():
                self.got.append(event)
            case _:
                pass
        return ()


@define
class SimulatedBed:
    """Virtual time; `ZenohBed` has the same methods."""

    network: SimulatedNetwork = field(factory=lambda: SimulatedNetwork(seed=1))
    _names: dict[int, str] = field(factory=dict)

    def join(self, name: str) -> Party:
        """Add a participant."""
        core = Recorder()
        party = Party(self.network.add(name, core, REALM)._transport, core.got)
        self._names[id(party)] = name
        return party

    def join_process(self, name: str) -> None:
        """Add a participant in its own process that serves and shows the token of its name."""
        core = Recorder(
            first=(
                node.Serve(SERVICE),
                node.Announce(VEHICLE_ALIVE, {"process": name, "vehicle": name}),
            )
        )
        self.network.add(name, core, REALM)
        self.network.run(self.network.now_s)

    def kill(self, name: str) -> None:
        """Kill such a process with SIGKILL."""
        self.network.kill(name)

    def ask(self, payload: bytes) -> Answers:
        """Ask the service; the list gets the answer, or None when there is no service."""
        answers: Answers = []
        self.network.query(PLAN_SERVICE, payload, answers.append)
        return answers

    def break_link(self, *parties: Party) -> None:
        """Take participants off the network."""
        for party in parties:
            self.network.disconnect(self._names[id(party)])

    def mend_link(self, *parties: Party) -> None:
        """Bring them back."""
        for party in parties:
            self.network.reconnect(self._names[id(party)])

    def until(self, condition: Callable[[], object]) -> None:
        """Let time pass until something holds; fail when it does not in time."""
        self.network.run(self.network.now_s + WAIT_S, stop=lambda: bool(condition()))
        assert condition()

    def quiet(self) -> None:
        """Let enough time pass for everything under way to arrive."""
        self.network.run(self.network.now_s + 1.0)


# --- Zenoh ------------------------------------------------------------------------------------

ROUTER = """
import sys
from laneweave.protocol.transports.zenoh.transport import run_router
run_router([sys.argv[1]], float(sys.argv[2]), ready=lambda: print("ready", flush=True))
"""
MEMBER = """
import sys, time
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.security.connection import Access
transport = ZenohTransport(Access(sys.argv[1], lease_s=float(sys.argv[2])), lambda delivery: None)
transport.serve(sys.argv[4])
transport.announce(sys.argv[3])
print("ready", flush=True)
time.sleep(60)
"""


def start_process(code: str, *arguments: str) -> subprocess.Popen[bytes]:
    """Start a Python process and wait until it says that it is ready."""
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE)
    assert process.stdout is not None
    if process.stdout.readline() != b"ready\n":
        process.kill()
        pytest.fail("the process did not get ready")
    return process


def end_process(process: subprocess.Popen[bytes]) -> int:
    """End a process in good order, or by force; return its exit status."""
    process.terminate()
    try:
        return process.wait(WAIT_S)
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


@define
class Router:
    """A router process at a unix socket."""

    socket: Path
    process: subprocess.Popen[bytes] = field(init=False)

    @property
    def endpoint(self) -> str:
        return f"unixsock-stream/{self.socket}"

    def start(self) -> None:
        self.process = start_process(ROUTER, self.endpoint, str(LEASE_S))

    def kill(self) -> None:
        self.process.kill()
        end_process(self.process)
        self.socket.unlink(missing_ok=True)


@define
class ZenohBed:
    """Real sessions; what runs in a process of its own is killed with SIGKILL."""

    router: Router
    _opened: list[ZenohTransport] = field(factory=list)
    _processes: dict[str, subprocess.Popen[bytes]] = field(factory=dict)

    def join(self, _: str) -> Party:
        got: list[Delivery] = []
        transport = ZenohTransport(Access(self.router.endpoint, lease_s=LEASE_S), got.append)
        self._opened.append(transport)
        return Party(transport, got)

    def join_process(self, name: str) -> None:
        self._processes[name] = start_process(
            MEMBER, self.router.endpoint, str(LEASE_S), token_key(name), PLAN_SERVICE
        )
        # The router may receive its declarations after the process has reported that it is ready.
        observer = self.join("observer")
        observer.transport.watch(token_key(name))
        self.until(observer.tokens)

    def kill(self, name: str) -> None:
        self._processes[name].kill()

    def ask(self, payload: bytes) -> Answers:
        answers: Answers = []
        client = self.join("client").transport
        assert isinstance(client, ZenohTransport)

        asked = client.query(PLAN_SERVICE, payload, ASK_S)
        asked.add_done_callback(lambda done: answers.append(done.result()))
        return answers

    def break_link(self, *_: Party) -> None:
        self.router.kill()

    def mend_link(self, *_: Party) -> None:
        self.router.start()

    def until(self, condition: Callable[[], object]) -> None:
        give_up_s = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < give_up_s, "it did not come"
            time.sleep(0.002)

    def quiet(self) -> None:
        time.sleep(QUIET_S)

    def close(self) -> None:
        for transport in self._opened:
            transport.close()
        for process in self._processes.values():
            end_process(process)


@pytest.fixture(scope="module")
def router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Router]:
    router = Router(tmp_path_factory.mktemp("router") / "s")
    router.start()
    yield router
    assert end_process(router.process) == 0, "the router does not end in good order"


Bed = SimulatedBed | ZenohBed
both = pytest.fixture(params=["simulated", pytest.param("zenoh", marks=pytest.mark.slow)])


@both
def bed(request: pytest.FixtureRequest) -> Iterator[Bed]:
    if request.param == "simulated":
        yield SimulatedBed()
        return
    with contextlib.closing(ZenohBed(request.getfixturevalue("router"))) as zenoh_bed:
        yield zenoh_bed


@both
def breakable_bed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bed]:
    if request.param == "simulated":
        yield SimulatedBed()
        return
    router = Router(tmp_path / "s")
    router.start()
    with contextlib.closing(ZenohBed(router)) as zenoh_bed:
        yield zenoh_bed
    router.kill()


def flow(bed: Bed, sender: Party, receiver: Party) -> None:
    """Wait until a new subscription is known to a sender: beats on a key of its own arrive."""
    count = len(receiver.all_received())

    def arrives() -> bool:
        sender.transport.publish(FLOW, beat("flow"), Quality.ASSURED)
        bed.quiet()
        return len(receiver.all_received()) > count

    bed.until(arrives)


def settle(bed: Bed, party: Party) -> None:
    """Wait until the network knows all that a participant has declared: a token declared last."""
    watcher = bed.join(f"watcher-{id(party)}")
    watcher.transport.watch(SETTLED)
    party.transport.announce(SETTLED)
    bed.until(lambda: TokenUp(SETTLED) in watcher.got)
    party.transport.withdraw(SETTLED)
    bed.until(lambda: TokenDown(SETTLED) in watcher.got)
    watcher.transport.close()


# --- publish and subscribe --------------------------------------------------------------------


@pytest.mark.parametrize("quality", Quality)
def test_what_is_published_reaches_subscribers(bed: Bed, quality: Quality) -> None:
    a, b, c = bed.join("a"), bed.join("b"), bed.join("c")
    for party in (b, c, c):
        party.transport.subscribe(BEATS)
        flow(bed, a, party)
    for party, name in ((a, "x"), (c, "y")):  # own messages come back
        party.transport.publish(beat_key(name), beat(name, 7), quality)
        bed.until(lambda: b.received() and c.received())
        bed.quiet()
        assert b.received() == c.received() == [Received(beat_key(name), beat(name, 7))]
        b.got.clear()
        c.got.clear()
    assert a.received() == []


def test_an_expression_selects_keys(bed: Bed) -> None:
    a, one, deep, exact, other = (bed.join(name) for name in "abcde")
    one.transport.subscribe(BEATS)
    deep.transport.subscribe(f"laneweave/{REALM}/**")
    exact.transport.subscribe(beat_key("x"))
    exact.transport.subscribe(FLOW)
    other.transport.subscribe("laneweave/other/**")
    for party in (one, deep, exact):
        flow(bed, a, party)
    for name in ("x", "y"):
        a.transport.publish(beat_key(name), beat(name), Quality.ASSURED)
    bed.until(lambda: len(one.received()) == len(deep.received()) == 2 and exact.received())
    bed.quiet()
    assert {item.key for item in one.received()} == {beat_key("x"), beat_key("y")}
    assert {item.key for item in deep.received()} == {beat_key("x"), beat_key("y")}
    assert [item.key for item in exact.received()] == [beat_key("x")]
    assert other.received() == []


def test_nothing_comes_after_unsubscribe(bed: Bed) -> None:
    a, b, c = bed.join("a"), bed.join("b"), bed.join("c")
    for party in (b, c):
        party.transport.subscribe(BEATS)
        flow(bed, a, party)
    b.transport.unsubscribe(BEATS)
    b.transport.unsubscribe(BEATS)
    b.transport.unsubscribe(TOKENS)
    bed.quiet()
    a.transport.publish(beat_key("a"), beat("a"), Quality.ASSURED)
    bed.until(c.received)
    bed.quiet()
    assert b.received() == []
    b.transport.subscribe(BEATS)
    flow(bed, a, b)


# --- tokens -----------------------------------------------------------------------------------


def test_a_watcher_begins_with_the_tokens_that_are_there(bed: Bed) -> None:
    a, b = bed.join("a"), bed.join("b")
    a.transport.announce(token_key("a1"))
    a.transport.announce(token_key("a2"))
    a.transport.announce(token_key("gone"))
    a.transport.withdraw(token_key("gone"))
    settle(bed, a)
    b.transport.watch(TOKENS)
    bed.until(lambda: len(b.tokens()) == 2)
    bed.quiet()
    assert sorted(b.tokens()) == ["+a1", "+a2"]


def test_a_watcher_sees_only_what_it_watches(bed: Bed) -> None:
    a, b, c = bed.join("a"), bed.join("b"), bed.join("c")
    b.transport.watch(token_key("a1"))
    c.transport.watch(TOKENS)
    a.transport.announce(token_key("a2"))
    a.transport.announce(token_key("a1"))
    bed.until(lambda: b.tokens() and len(c.tokens()) == 2)
    bed.quiet()
    assert b.tokens() == ["+a1"]


def news_of(party: Party, name: str) -> str:
    return "".join(token[0] for token in party.tokens() if token[1:] == name)


def test_news_of_a_token_come_by_turns(bed: Bed) -> None:
    a, b = bed.join("a"), bed.join("b")
    names = [f"t{number}" for number in range(20)]
    for name in names:
        a.transport.announce(token_key(name))
        a.transport.watch(token_key(name))
        b.transport.watch(token_key(name))
    bed.until(lambda: len(a.tokens()) >= len(names) and len(b.tokens()) >= len(names))
    for name in names:
        a.transport.withdraw(token_key(name))
    gone = {f"-{name}" for name in names}
    bed.until(lambda: gone <= set(a.tokens()) and gone <= set(b.tokens()))
    bed.quiet()
    bed.until(lambda: all(news_of(a, name).endswith("-") for name in names))
    assert {news_of(b, name) for name in names} == {"+-"}
    assert {news_of(a, name) for name in names} <= {"+-", "+-+-"}


def test_a_token_is_seen_to_appear_and_vanish_and_repeated_calls_change_nothing(bed: Bed) -> None:
    a, b = bed.join("a"), bed.join("b")
    for _ in range(2):
        b.transport.watch(TOKENS)
    for _ in range(2):
        a.transport.announce(token_key("a"))
    a.transport.withdraw(token_key("unknown"))
    bed.until(b.tokens)
    bed.quiet()
    assert b.tokens() == ["+a"]
    for _ in range(2):
        a.transport.withdraw(token_key("a"))
    bed.until(lambda: len(b.tokens()) == 2)
    bed.quiet()
    assert b.tokens() == ["+a", "-a"]
    a.transport.announce(token_key("a"))
    bed.until(lambda: b.tokens() == ["+a", "-a", "+a"])
    a.transport.close()
    bed.until(lambda: b.tokens() == ["+a", "-a", "+a", "-a"])


def test_a_token_of_two_vanishes_with_the_last(bed: Bed) -> None:
    a, b, c = bed.join("a"), bed.join("b"), bed.join("c")
    c.transport.watch(TOKENS)
    a.transport.announce(token_key("both"))
    b.transport.announce(token_key("both"))
    bed.until(c.tokens)
    settle(bed, b)
    a.transport.close()
    bed.quiet()
    assert c.tokens() == ["+both"]
    b.transport.withdraw(token_key("both"))
    bed.until(lambda: c.tokens() == ["+both", "-both"])


def test_a_killed_process_loses_its_token(bed: Bed) -> None:
    b = bed.join("b")
    b.transport.watch(TOKENS)
    bed.join_process("v")
    bed.until(lambda: b.tokens() == ["+v"])
    before = b.got.count(LinkDown())  # on a busy machine a connection may be made twice
    bed.kill("v")
    bed.until(lambda: b.tokens() == ["+v", "-v"])
    assert b.got.count(LinkDown()) == before


# --- queries ----------------------------------------------------------------------------------


def serving(bed: Bed, *names: str) -> list[Party]:
    """Return participants that serve, which the network knows of."""
    servers = [bed.join(name) for name in names]
    for server in servers:
        server.transport.serve(PLAN_SERVICE)
        settle(bed, server)
    return servers


def asked(bed: Bed, *servers: Party) -> tuple[Answers, list[int]]:
    """Ask a question and wait until all servers have it; return its answers and its tokens."""
    answers = bed.ask(b"?")
    bed.until(lambda: all(server.queries() for server in servers))
    return answers, [server.queries()[0].token for server in servers]


def payloads(answers: Answers) -> list[bytes | None]:
    return [None if answer is None else answer.payload for answer in answers]


@pytest.mark.parametrize("ok", [True, False])
def test_a_query_gets_its_answer(bed: Bed, *, ok: bool) -> None:
    (server,) = serving(bed, "server")
    server.transport.serve(PLAN_SERVICE)
    settle(bed, server)
    answers, (number,) = asked(bed, server)
    (query,) = server.queries()
    assert (query.key, query.payload) == (PLAN_SERVICE, b"?")
    assert answers == []
    server.transport.answer(number, b"that", ok=ok)
    server.transport.answer(number, b"again", ok=True)
    bed.until(lambda: answers)
    bed.quiet()
    assert [given and (given.payload, given.ok) for given in answers] == [(b"that", ok)]
    assert len(server.queries()) == 1


def test_queries_have_tokens_of_their_own_and_unknown_ones_are_ignored(bed: Bed) -> None:
    (server,) = serving(bed, "server")
    server.transport.answer(12345, b"x", ok=True)
    server.transport.answer(-1, b"x", ok=False)
    first, second = bed.ask(b"1"), bed.ask(b"2")
    bed.until(lambda: len(server.queries()) == 2)
    for query in reversed(server.queries()):
        server.transport.answer(query.token, b"to " + query.payload, ok=True)
    bed.until(lambda: first and second)
    assert payloads(first + second) == [b"to 1", b"to 2"]


def test_a_query_without_a_service_is_not_answered(bed: Bed) -> None:
    answers = bed.ask(b"?")
    bed.until(lambda: answers)
    assert answers == [None]


def test_a_server_that_hangs_does_not_delay_the_answer_of_another(bed: Bed) -> None:
    hangs, works = serving(bed, "hangs", "works")
    answers, (first, second) = asked(bed, hangs, works)
    works.transport.answer(second, b"!", ok=True)
    bed.until(lambda: answers)
    assert payloads(answers) == [b"!"]
    hangs.transport.answer(first, b"late", ok=True)
    bed.quiet()
    assert payloads(answers) == [b"!"]


@pytest.mark.parametrize("others_answer", [True, False])
def test_a_declined_query_is_answered_by_another_server(bed: Bed, *, others_answer: bool) -> None:
    declines, other = serving(bed, "declines", "other")
    answers, (first, second) = asked(bed, declines, other)
    for number in (first, first, -1):
        declines.transport.decline(number)
    declines.transport.answer(first, b"after all", ok=True)
    bed.quiet()
    assert answers == []
    if others_answer:
        other.transport.answer(second, b"!", ok=True)
    else:
        other.transport.decline(second)
    bed.until(lambda: answers)
    assert payloads(answers) == [b"!" if others_answer else None]


def test_a_query_ends_when_its_only_server_is_killed(bed: Bed) -> None:
    bed.join_process("server")
    answers = bed.ask(b"?")
    bed.quiet()
    assert answers == []
    bed.kill("server")
    bed.until(lambda: answers)
    assert answers == [None]


# --- the end ----------------------------------------------------------------------------------


def test_after_close_everything_is_harmless(bed: Bed) -> None:
    a, b = bed.join("a"), bed.join("b")
    b.transport.subscribe(BEATS)
    b.transport.watch(TOKENS)
    a.transport.subscribe(BEATS)
    a.transport.announce(token_key("a"))
    a.transport.serve(PLAN_SERVICE)
    bed.until(lambda: b.tokens() == ["+a"])
    for _ in range(2):
        a.transport.close()
    bed.until(lambda: b.tokens() == ["+a", "-a"])
    for _ in range(2):
        a.transport.publish(beat_key("a"), beat("a"), Quality.ASSURED)
        a.transport.unsubscribe(BEATS)
        a.transport.subscribe(BEATS)
        a.transport.withdraw(token_key("a"))
        a.transport.announce(token_key("a"))
        a.transport.announce(token_key("a2"))
        a.transport.watch(TOKENS)
        a.transport.serve(PLAN_SERVICE)
        a.transport.answer(1, b"", ok=True)
        a.transport.close()
    a.got.clear()
    b.transport.publish(beat_key("b"), beat("b"), Quality.ASSURED)
    bed.until(b.received)
    bed.quiet()
    assert a.got == []
    assert [item.key for item in b.received()] == [beat_key("b")]
    assert b.tokens() == ["+a", "-a"]


# --- the link ---------------------------------------------------------------------------------


def test_without_the_link_all_tokens_vanish_and_come_back(breakable_bed: Bed) -> None:
    bed = breakable_bed
    a, b = bed.join("a"), bed.join("b")
    a.transport.announce(token_key("a"))
    b.transport.announce(token_key("b"))
    b.transport.watch(TOKENS)
    b.transport.subscribe(BEATS)
    bed.until(lambda: sorted(b.tokens()) == ["+a", "+b"])
    b.got.clear()
    bed.break_link(a, b)
    bed.until(lambda: len(b.tokens()) == 2 and LinkDown() in b.got)
    assert sorted(b.tokens()) == ["-a", "-b"]
    assert LinkUp() not in b.got
    # No call raises meanwhile.
    a.transport.publish(beat_key("a"), beat("a", 1), Quality.ASSURED)
    a.transport.announce(token_key("meanwhile"))
    b.got.clear()
    bed.mend_link(a, b)
    bed.until(lambda: len(b.tokens()) == 3 and LinkUp() in b.got)
    assert sorted(b.tokens()) == ["+a", "+b", "+meanwhile"]
    flow(bed, a, b)


# --- what Zenoh alone has ---------------------------------------------------------------------


@pytest.mark.slow
def test_own_token_vanishes_with_the_link_before_the_router_knew_it(tmp_path: Path) -> None:
    router = Router(tmp_path / "s")
    router.start()
    with contextlib.ExitStack() as stack:
        stack.callback(router.kill)
        bed = stack.enter_context(contextlib.closing(ZenohBed(router)))
        party = bed.join("a")
        router.process.send_signal(signal.SIGSTOP)
        party.transport.announce(token_key("a"))
        party.transport.watch(TOKENS)
        bed.until(lambda: party.tokens() == ["+a"])
        router.kill()
        bed.until(lambda: party.tokens() == ["+a", "-a"])
        router.start()
        bed.until(lambda: party.tokens() == ["+a", "-a", "+a"])
        bed.quiet()
        assert party.tokens() == ["+a", "-a", "+a"]


@pytest.mark.slow
def test_after_close_nothing_of_the_closed_session_is_used(router: Router) -> None:
    transport = ZenohTransport(Access(router.endpoint), lambda _: None)
    transport.subscribe(BEATS)
    transport.announce(token_key("a"))
    declarations = [Mock(), Mock()]
    transport._subscriptions[BEATS], transport._tokens[token_key("a")] = declarations
    transport.close()
    transport.unsubscribe(BEATS)
    transport.withdraw(token_key("a"))
    for declaration in declarations:
        declaration.undeclare.assert_not_called()


@pytest.mark.parametrize(
    "endpoint",
    ["", "ws/127.0.0.1:1", "udp/127.0.0.1:1", "unixsock-stream", "tcp/", "tcp/nonsense",
     "tls/127.0.0.1", "unixsock-stream/no-router-here"],
)  # fmt: skip
def test_an_endpoint_that_is_malformed_or_without_a_router_is_refused(endpoint: str) -> None:
    error = refusal(ZenohTransport, Access(endpoint, lease_s=LEASE_S), lambda _: None)
    assert error.field == "network.endpoint"


@pytest.mark.slow
def test_a_service_that_does_not_answer_is_a_timeout(router: Router) -> None:
    with contextlib.closing(ZenohBed(router)) as bed:
        serving(bed, "server")
        client = bed.join("client").transport
        assert isinstance(client, ZenohTransport)
        with pytest.raises(TimeoutError, match="in time"):
            client.query(PLAN_SERVICE, b"", 0.2).result(WAIT_S)


class LateTokens(ZenohTransport):
    """Hands over tokens late, as a busy machine does: their callback has a thread of its own."""

    def _on_token(self, sample: zenoh.Sample) -> None:
        time.sleep(QUIET_S)
        super()._on_token(sample)


@pytest.mark.slow
def test_a_query_that_overtakes_its_token_is_declined(router: Router) -> None:
    with contextlib.closing(ZenohBed(router)) as bed:
        client, got = bed.join("client").transport, list[Delivery]()
        assert isinstance(client, ZenohTransport)
        with contextlib.closing(LateTokens(Access(router.endpoint), got.append)) as server:
            server.watch(TOKENS)
            server.serve(PLAN_SERVICE)
            bed.until(lambda: client.query(PLAN_SERVICE, b"", QUIET_S).exception(WAIT_S))
            got.clear()
            client.announce(token_key("v"))
            asked = client.query(PLAN_SERVICE, b"early", ASK_S, sender=token_key("v"))
            assert asked.result(WAIT_S) is None
            bed.until(lambda: got)
            client.query(PLAN_SERVICE, b"again", ASK_S, sender=token_key("v"))
            bed.until(lambda: len(got) == 2)
            token, again = got
            assert token == TokenUp(token_key("v"))
            assert isinstance(again, Query)
            assert (again.payload, again.sender) == (b"again", token_key("v"))


@define
class Errand:
    """A core that beats itself awake, computes, serves itself, and ends when all is done."""

    events: list[node.Event] = field(factory=list)
    wakeup_s: float | None = None

    def handle(self, event: node.Event, now_s: float) -> Iterator[node.Effect]:
        self.events.append(event)
        match event:
            case node.Started():
                yield node.Listen(HEARTBEAT)
                yield node.Watch(VEHICLE_ALIVE)
                yield node.Serve(SERVICE)
                yield node.Announce(VEHICLE_ALIVE, {"process": "errand", "vehicle": "errand"})
                self.wakeup_s = now_s + 0.05
            case node.Wakeup():
                self.wakeup_s = None
                message = Heartbeat(Name("errand"), 1, 1, leading=False, plans=0)
                yield node.Send(HEARTBEAT, message, {"coordinator": "errand"})
                yield node.Compute(1, lambda _: "done")
            case node.Computed(1, "done"):
                self.wakeup_s = None
            case node.QueryArrived(token):
                yield node.Reply(token, b"yes")
                yield node.End()
            case _:
                pass


@pytest.mark.slow
def test_a_core_runs_over_zenoh_until_it_ends(router: Router) -> None:
    core = Errand()
    answers: Answers = []
    watcher = ZenohBed(router)
    client = watcher.join("client")
    client.transport.watch(TOKENS)

    def ask_at_last() -> None:
        done = {node.Computed, node.Arrived}
        watcher.until(lambda: done <= {type(event) for event in core.events})
        assert isinstance(client.transport, ZenohTransport)
        answers.append(client.transport.query(PLAN_SERVICE, b"?", WAIT_S).result(WAIT_S))

    thread = threading.Thread(target=ask_at_last, daemon=True)
    thread.start()
    a_core: node.Core = core
    run_core(a_core, Access(router.endpoint, REALM, LEASE_S))
    thread.join(WAIT_S)
    watcher.until(lambda: client.tokens() == ["+errand", "-errand"])
    watcher.close()
    assert [given and (given.payload, given.ok) for given in answers] == [(b"yes", True)]
    kinds = [type(event) for event in core.events]
    assert kinds[0] is node.Started
    for kind in (node.Wakeup, node.Arrived, node.Computed, node.PeerUp, node.QueryArrived):
        assert kinds.count(kind) == 1


@define
class Busy:
    """A core that ends while its computation, which would take long, is under way."""

    begun: threading.Event = field(factory=threading.Event)
    ended: threading.Event = field(factory=threading.Event)
    wakeup_s: float | None = None

    def handle(self, event: node.Event, now_s: float) -> Iterator[node.Effect]:
        match event:
            case node.Started():
                yield node.Compute(1, self.compute)
                yield node.Compute(2, lambda _: self.begun.clear())
                self.wakeup_s = now_s
            case node.Wakeup():
                self.wakeup_s = None
                assert self.begun.wait(WAIT_S)
                yield node.End()
            case _:
                pass

    def compute(self, clock: node.Clock) -> None:
        self.begun.set()
        deadline_s = clock() + WAIT_S
        try:
            while clock() < deadline_s:
                time.sleep(1e-3)
        finally:
            self.ended.set()


@pytest.mark.slow
def test_no_computation_is_under_way_when_the_process_ends(router: Router) -> None:
    core, before = Busy(), set(threading.enumerate())
    a_core: node.Core = core
    run_core(a_core, Access(router.endpoint, REALM, LEASE_S))
    assert core.ended.is_set()
    assert core.begun.is_set()  # the second computation was discarded
    assert not {thread for thread in threading.enumerate() if thread not in before}
