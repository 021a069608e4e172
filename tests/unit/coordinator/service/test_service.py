"""The planning service: encodings, refusals, deadlines, limits, repeated requests, shared load."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import attrs
import msgpack
import pytest
from attrs import define, field
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.coordinator.service import refusals
from laneweave.coordinator.service.cancellation import CANCEL_SCHEMA, cancel_request
from laneweave.coordinator.service.pending import ClientSession
from laneweave.coordinator.service.rendezvous import is_assigned_to
from laneweave.coordinator.service.server import PlanningService, ServiceMetrics
from laneweave.protocol.runtime.node import (
    STOPPED,
    Computed,
    Decline,
    Delegate,
    Effect,
    Reply,
    StopJob,
    run_delegated,
)
from laneweave.protocol.runtime.queries import (
    CANCELLED,
    FAILED,
    INVALID,
    LATE,
    OVERLOADED,
)
from laneweave.protocol.scenario.deployment_fields import Service

REQUEST: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 3, "lanes": 2},
    "mode": 1,
    "vehicles": [{"id": "a", "cell": [0, 0], "lane": 1}, {"id": "b", "cell": [2, 1]}],
    "targets": [[1, 1], [2, 0]],
}
Pack = Callable[[Any], bytes]
Unpack = Callable[[bytes], Any]
CODECS = pytest.mark.parametrize(
    ("pack", "unpack", "encoding"),
    [
        (lambda data: json.dumps(data).encode(), json.loads, "application/json"),
        (msgpack.packb, msgpack.unpackb, "application/msgpack"),
    ],
    ids=["JSON", "MessagePack"],
)
UNKNOWN = ClientSession()
SETTINGS = Service(queue_limit=8, max_request_bytes=4096)


@define
class Desk:
    """A service with one worker, its clock, and its replies so far."""

    service: PlanningService = field(factory=lambda: PlanningService("c1", SETTINGS, 1, plan))
    now_s: float = 100.0
    replies: dict[int, Reply] = field(factory=dict)
    orders: list[Delegate] = field(factory=list)
    left: list[int] = field(factory=list)
    stopped: list[int] = field(factory=list)
    """Jobs that workers should stop."""
    _tokens: int = 0

    def ask(
        self,
        data: object,
        *,
        encoding: str = "",
        others: tuple[str, ...] = (),
        session: ClientSession = UNKNOWN,
    ) -> int:
        """Ask something; return the token."""
        payload = data if isinstance(data, bytes) else json.dumps(data).encode()
        self._tokens += 1
        job = 1000 + self._tokens
        self._note(
            self.service.take(self._tokens, payload, encoding, session, job, others, self.now_s)
        )
        return self._tokens

    def work(self) -> None:
        """Do the oldest order."""
        order = self.orders.pop(0)
        self.end(run_delegated(order, lambda: self.now_s))

    def end(self, done: Computed) -> None:
        """Hand over the result of an order."""
        assert self.service.owns(done.job)
        self._note(self.service.finish(done.job, done.result, done.error, self.now_s))
        assert not self.service.owns(done.job)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.now_s += seconds
        self._note(self.service.wake(self.now_s))

    def retire(self) -> None:
        """Begin the end of the process."""
        self._note(self.service.retire())

    def leave(self, session: ClientSession) -> None:
        """End a client's session."""
        self._note(self.service.close_session(session))

    def cancel(self, data: object, *, session: ClientSession = UNKNOWN) -> int:
        """Cancel a request; return the token."""
        self._tokens += 1
        payload = json.dumps(data).encode()
        self._note(self.service.cancel(self._tokens, payload, "", session))
        return self._tokens

    def answer(self, token: int) -> dict[str, Any]:
        """Return what a question was answered, in JSON."""
        found: dict[str, Any] = json.loads(self.replies[token].payload)
        return found

    def _note(self, effects: Iterator[Effect]) -> None:
        for effect in effects:
            match effect:
                case Reply(token):
                    assert token not in self.replies, "answered twice"
                    self.replies[token] = effect
                case Delegate():
                    self.orders.append(effect)
                case Decline(token):
                    self.left.append(token)
                case StopJob(job):
                    self.stopped.append(job)
                case _:
                    raise AssertionError(effect)


@pytest.fixture
def desk() -> Desk:
    return Desk()


def named(name: str, **changes: object) -> dict[str, Any]:
    return REQUEST | {"id": name} | changes


# --- encodings and refusals -------------------------------------------------------------------


@CODECS
@pytest.mark.parametrize("told", [True, False])
def test_an_answer_has_the_encoding_of_its_request(
    desk: Desk, pack: Pack, unpack: Unpack, encoding: str, *, told: bool
) -> None:
    token = desk.ask(pack(REQUEST), encoding=encoding if told else "zenoh/bytes")
    desk.work()
    reply = desk.replies[token]
    assert (reply.ok, reply.encoding) == (True, encoding)
    assert unpack(reply.payload)["status"] == "optimal"


@pytest.mark.parametrize(
    ("setting", "asked", "planned"),
    [
        ("tappa", None, "tappa"),
        ("branching", None, "branching"),
        ("branching", "tappa", "tappa"),
        ("tappa", "branching", "branching"),
    ],
)
def test_a_request_without_a_solver_gets_the_coordinators(
    setting: str, asked: str | None, planned: str
) -> None:
    desk = Desk(PlanningService("c1", SETTINGS, 1, plan, setting))
    token = desk.ask(REQUEST | ({} if asked is None else {"solver": asked}))
    desk.work()
    assert desk.answer(token)["solver"] == planned


@CODECS
def test_a_structure_is_answered_with_its_targets(
    desk: Desk, pack: Pack, unpack: Unpack, encoding: str
) -> None:
    request = {name: value for name, value in REQUEST.items() if name != "targets"}
    vehicles = [
        {name: value for name, value in vehicle.items() if name != "eligible"}
        for vehicle in REQUEST["vehicles"]
    ]
    request |= {"vehicles": vehicles, "structure": "parallel"}
    token = desk.ask(pack(request), encoding=encoding)
    desk.work()
    answer = unpack(desk.replies[token].payload)
    assert answer["status"] == "optimal"
    assert [path[-1] for path in answer["paths"]] == [
        answer["targets"][target] for target in answer["assignment"]
    ]
    twice = desk.ask(pack(request | {"targets": []}), encoding=encoding)
    assert unpack(desk.replies[twice].payload)["field"] == "structure"


def test_white_space_before_json_is_fine(desk: Desk) -> None:
    desk.ask(b"\n  " + json.dumps(REQUEST).encode())
    assert desk.orders


def test_a_json_request_gets_a_json_answer(desk: Desk) -> None:
    token = desk.ask(msgpack.packb(REQUEST), encoding="application/json")
    assert desk.answer(token)["field"] == "request"


def spoiled(*path: str | int, value: object) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(json.dumps(REQUEST))
    at: Any = data
    for step in path[:-1]:
        at = at[step]
    at[path[-1]] = value
    return data


@CODECS
@pytest.mark.parametrize(
    ("data", "name"),
    [
        ({}, "schema"),
        (spoiled("", value=1), "''"),
        (spoiled("a\nb", value=1), "a b"),
        (spoiled("grid", "\n", value=1), "grid.'\\n'"),
        (spoiled("id", value="x" * 101), "id"),
        (spoiled("targets", 1, value=[9, 9]), "targets[1]"),
        (spoiled("vehicles", 1, "cell", value=[0, 0]), "vehicles[1].cell"),
        (spoiled("deadline_s", value=float("nan")), "deadline_s"),
        (spoiled("deadline_s", value=601.0), "deadline_s"),
        (spoiled("solver", value="magic"), "solver"),
    ],
)
def test_a_malformed_request_is_refused_with_the_fields_name(
    desk: Desk, pack: Pack, unpack: Unpack, encoding: str, data: dict[str, Any], name: str
) -> None:
    reply = desk.replies[desk.ask(pack(data))]
    assert (reply.ok, reply.encoding) == (False, encoding)
    error = unpack(reply.payload)
    assert (error["field"], error["code"]) == (name, INVALID)
    assert name in error["message"]
    assert "\n" not in error["message"]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"{" * 4000,
        b'{"a": \xff}',
        b"\xc1",
        b"\x81" * 4000,
        msgpack.packb([1, 2]),
        msgpack.packb("text"),
        msgpack.packb({1: 2}),
        b"x" * (SETTINGS.max_request_bytes + 1),
        b"{" + b" " * SETTINGS.max_request_bytes + b"}",
        b"[]",
        b"\xef\xbb\xbf[]",
    ],
    ids=[
        "empty", "open brace", "deep", "not UTF-8", "not MessagePack", "deep MessagePack", "list",
        "text", "number as key", "too long", "too long JSON", "JSON list", "JSON list after a mark",
    ],
)  # fmt: skip
def test_what_is_not_a_map_is_refused(desk: Desk, payload: bytes) -> None:
    reply = desk.replies[desk.ask(payload)]
    packed = payload[:1] >= b"\x80" and payload[:1] != b"\xef"
    unpack: Unpack = msgpack.unpackb if packed else json.loads
    assert not reply.ok
    assert unpack(reply.payload)["field"]


@given(st.binary(max_size=300))
def test_no_bytes_raise(payload: bytes) -> None:
    desk = Desk()
    assert not desk.replies[desk.ask(payload)].ok


# --- deadlines --------------------------------------------------------------------------------


def test_a_request_is_planned_in_the_time_that_is_left(desk: Desk) -> None:
    token = desk.ask(REQUEST | {"deadline_s": 5.0})
    (order,) = desk.orders
    assert order.deadline_s == desk.now_s + 5.0
    desk.wait(4.9)
    desk.work()
    assert desk.answer(token)["status"] == "optimal"


def test_what_a_worker_begins_after_the_deadline_is_late(desk: Desk) -> None:
    token = desk.ask(REQUEST | {"deadline_s": 5.0})
    desk.wait(5.1)
    desk.work()
    refusal = desk.answer(token)
    assert (refusal["code"], refusal["field"]) == (LATE, "deadline_s")
    assert "5.1" in refusal["message"]


def test_what_waits_until_its_deadline_is_dropped(desk: Desk) -> None:
    for _ in range(2):
        desk.ask(REQUEST | {"deadline_s": 50.0})
    token = desk.ask(REQUEST | {"deadline_s": 5.0})
    assert desk.service.metrics.waiting == 1
    assert desk.service.wakeup_s == desk.now_s + 5.0
    desk.wait(4.9)
    assert token not in desk.replies
    desk.wait(0.2)
    assert desk.answer(token)["code"] == LATE
    assert desk.service.metrics.waiting == 0
    assert desk.service.wakeup_s == desk.now_s - 5.1 + 50.0  # of the one that is handed out ahead


def test_what_was_handed_out_ahead_is_dropped_at_its_deadline(desk: Desk) -> None:
    busy = desk.ask(REQUEST | {"deadline_s": 50.0})
    ahead = desk.ask(named("ahead", deadline_s=5.0))
    assert len(desk.orders) == 2
    assert desk.service.wakeup_s == desk.now_s + 5.0
    desk.wait(5.1)
    assert desk.answer(ahead)["code"] == LATE
    assert busy not in desk.replies
    assert desk.service.wakeup_s is None
    # Asked again, it is another request; the result of the first one is dropped.
    again = desk.ask(named("ahead", deadline_s=5.0))
    for _ in range(3):
        desk.work()
    assert desk.answer(busy)["status"] == desk.answer(again)["status"] == "optimal"
    assert desk.service.metrics.late_total == 1


def test_what_is_being_planned_is_not_dropped_at_its_deadline(desk: Desk) -> None:
    token = desk.ask(REQUEST | {"deadline_s": 5.0})
    (order,) = desk.orders
    done = run_delegated(order, lambda: desk.now_s)
    desk.wait(5.1)
    assert token not in desk.replies
    desk.end(done)
    assert desk.answer(token)["status"] == "optimal"


@pytest.mark.parametrize("error", ["the worker was killed: it exceeded its deadline", "it died"])
def test_a_failed_computation_is_an_error_reply_and_is_not_called_late(
    desk: Desk, error: str
) -> None:
    token = desk.ask(REQUEST | {"deadline_s": 5.0})
    desk.wait(10.1)
    desk.end(Computed(desk.orders.pop().job, None, error))
    refusal = desk.answer(token)
    assert (refusal["code"], refusal["field"]) == (FAILED, "")
    assert error in refusal["message"]


# --- limits -----------------------------------------------------------------------------------


def test_workers_get_one_ahead_and_the_rest_waits_in_order(desk: Desk) -> None:
    tokens = [desk.ask(REQUEST) for _ in range(5)]
    assert len(desk.orders) == 2
    for token in tokens:
        assert token not in desk.replies
        desk.work()
        assert token in desk.replies
    assert desk.service.metrics.answered_total == 5


def test_too_many_requests_in_hand_are_refused_until_one_is_done(desk: Desk) -> None:
    for _ in range(SETTINGS.queue_limit):
        desk.ask(REQUEST)
    token = desk.ask(REQUEST)
    refusal = desk.answer(token)
    assert refusal["code"] == OVERLOADED
    assert "service.queue_limit" in refusal["message"]
    desk.work()
    assert desk.ask(REQUEST) not in desk.replies


def opened(desk: Desk, client: str, session: str = "1") -> ClientSession:
    session_of = ClientSession(client, session)
    desk.service.open_session(session_of)
    return session_of


def make_desk(**settings: Any) -> Desk:  # noqa: ANN401 (any setting)
    return Desk(PlanningService("c1", Service(**settings), 1, plan))


def test_a_client_over_its_limit_is_refused_and_others_are_not() -> None:
    desk = make_desk(client_queue_limit=3)
    flood, quiet = opened(desk, "flood"), opened(desk, "quiet")
    tokens = [desk.ask(REQUEST, session=flood) for _ in range(4)]
    assert not set(tokens[:3]) & set(desk.replies)
    refusal = desk.answer(tokens[3])
    assert (refusal["code"], refusal["field"]) == (OVERLOADED, "")
    assert refusal["message"] == (
        "service.client_queue_limit: got 3 pending requests of this client; allowed: 3; "
        f"try again in {refusal['retry_after_s']:g} s"
    )
    assert desk.ask(REQUEST, session=quiet) not in desk.replies
    # All sessions of a client count together.
    assert desk.ask(REQUEST, session=opened(desk, "flood", "2")) in desk.replies


def test_unknown_clients_count_as_one() -> None:
    desk = make_desk(client_queue_limit=2)
    tokens = [desk.ask(REQUEST) for _ in range(3)]
    assert tokens[2] in desk.replies


def test_the_advice_when_to_send_again_follows_the_time_of_plans() -> None:
    desk = make_desk(client_queue_limit=1)
    desk.ask(REQUEST)
    assert desk.answer(desk.ask(REQUEST))["retry_after_s"] == refusals.MIN_RETRY_S
    for _ in range(50):
        answered_in(desk, 4000.0)
        desk.ask(REQUEST)
    assert desk.answer(desk.ask(REQUEST))["retry_after_s"] == pytest.approx(2.0, rel=0.02)


def refused_at_s(desk: Desk, count: int, every_s: float, client: ClientSession) -> list[float]:
    """Let a client over its limit ask again and again; return when each request was refused."""
    asked, refused_s = list[int](), dict[int, float]()
    for number in range(100_000):
        if number < count:
            asked.append(desk.ask(REQUEST, session=client))
            desk.wait(every_s)
        else:
            wakeup_s = desk.service.wakeup_s
            assert wakeup_s is not None
            desk.wait(max(0.0, wakeup_s - desk.now_s))
        for token in asked:
            if token in desk.replies:
                refused_s.setdefault(token, desk.now_s)
        if len(refused_s) == count:
            break
    return list(refused_s.values())


def test_a_flooding_client_is_refused_at_a_limited_rate() -> None:
    desk = make_desk(client_queue_limit=1, max_deadline_s=600.0)
    flood, quiet = opened(desk, "flood"), opened(desk, "quiet")
    desk.ask(REQUEST | {"deadline_s": 600.0}, session=flood)
    desk.ask(REQUEST | {"deadline_s": 600.0}, session=quiet)
    begun_s = desk.now_s
    many = refusals.PROMPT + 100
    refused_s = refused_at_s(desk, many, 0.0, flood)
    prompt = [at_s for at_s in refused_s if at_s == begun_s]
    assert len(prompt) == refusals.PROMPT
    assert refused_s[-1] - begun_s == pytest.approx(100 / refusals.RATE_PER_S)
    # This client has used up its rate; another one has not.
    token = desk.ask(REQUEST, session=flood)
    assert token not in desk.replies
    assert desk.ask(REQUEST, session=quiet) in desk.replies
    # After a while without refusals, they are prompt again.
    desk.wait(refusals.PROMPT / refusals.RATE_PER_S)
    assert token in desk.replies
    assert desk.ask(REQUEST, session=flood) in desk.replies


@pytest.mark.more
def test_a_refusal_is_held_back_for_at_most_the_longest_advice() -> None:
    desk = make_desk(client_queue_limit=1)
    flood = opened(desk, "flood")
    desk.ask(REQUEST | {"deadline_s": 600.0}, session=flood)
    begun_s = desk.now_s
    refused_s = refused_at_s(desk, 900, 0.0, flood)
    assert refused_s[-1] == begun_s + refusals.MAX_RETRY_S
    # However long the flood was, the next refusals are not later.
    for _ in range(20):
        refused_at_s(desk, 900, 0.0, flood)
    (soon_s,) = refused_at_s(desk, 1, 0.0, flood)
    assert soon_s <= desk.now_s + refusals.MAX_RETRY_S
    desk.wait(2 * refusals.MAX_RETRY_S)
    assert desk.ask(REQUEST, session=flood) in desk.replies


def test_a_held_refusal_advises_the_rest_of_the_time() -> None:
    desk = make_desk(client_queue_limit=1)
    desk.ask(REQUEST | {"deadline_s": 600.0})
    for _ in range(200):
        answered_in(desk, 4000.0)
        desk.ask(REQUEST | {"deadline_s": 600.0})
    advised = [
        desk.answer(token)["retry_after_s"]
        for token in [desk.ask(REQUEST) for _ in range(refusals.PROMPT)]
    ]
    assert set(advised) == {2.0}
    token = desk.ask(REQUEST)
    desk.wait(0.5)
    rest_s = desk.answer(token)["retry_after_s"]
    assert rest_s == pytest.approx(1.5)
    assert desk.answer(token)["message"].endswith(f"try again in {rest_s:g} s")


def test_held_refusals_do_not_use_up_all_open_queries() -> None:
    desk = make_desk(client_queue_limit=1)
    floods = [opened(desk, f"flood-{number}") for number in range(8)]
    for flood in floods:
        desk.ask(REQUEST | {"deadline_s": 600.0}, session=flood)
    tokens = [desk.ask(REQUEST, session=flood) for _ in range(300) for flood in floods]
    held = [token for token in tokens if token not in desk.replies]
    assert len(held) == refusals.MAX_HELD
    desk.wait(refusals.MAX_RETRY_S)
    assert set(held) <= set(desk.replies)


def test_a_service_that_ends_leaves_requests_that_it_would_refuse_to_others() -> None:
    desk = make_desk(client_queue_limit=1)
    flood = opened(desk, "flood")
    pending = desk.ask(REQUEST, session=flood)
    tokens = [desk.ask(REQUEST, session=flood) for _ in range(refusals.PROMPT + 5)]
    held = [token for token in tokens if token not in desk.replies]
    assert len(held) == 5
    desk.retire()
    assert desk.left == held
    assert desk.ask(REQUEST) in desk.left
    assert not desk.service.idle
    desk.work()
    assert desk.answer(pending)["status"] == "optimal"
    assert desk.service.idle


def answered_in(desk: Desk, solve_ms: float) -> None:
    """Finish the oldest order with a plan that took this long."""
    answer = plan(PlanRequest.from_dict(REQUEST))
    order = desk.orders.pop(0)
    desk.end(Computed(order.job, attrs.evolve(answer, solve_ms=solve_ms)))


def test_workers_get_none_ahead_while_plans_take_long(desk: Desk) -> None:
    for _ in range(6):
        desk.ask(REQUEST)
    assert len(desk.orders) == 2
    answered_in(desk, 1000.0)
    assert len(desk.orders) == 1
    for _ in range(50):
        answered_in(desk, 1.0)
        desk.ask(REQUEST)
    assert len(desk.orders) == 2


def test_clients_are_served_in_turn(desk: Desk) -> None:
    flood, quiet = opened(desk, "flood"), opened(desk, "quiet")
    tokens = [desk.ask(REQUEST, session=flood) for _ in range(6)]
    late = desk.ask(REQUEST, session=quiet)
    order = []
    for _ in range(7):
        desk.work()
        order += [token for token in desk.replies if token not in order]
    # Two are with the worker, and one more is next in turn.
    assert order == [*tokens[:3], late, *tokens[3:]]


def test_a_full_queue_displaces_the_newest_of_the_client_with_the_most(desk: Desk) -> None:
    flood, quiet = opened(desk, "flood"), opened(desk, "quiet")
    tokens = [desk.ask(named(f"f{n}"), session=flood) for n in range(SETTINGS.queue_limit)]
    token = desk.ask(REQUEST, session=quiet)
    assert token not in desk.replies
    assert list(desk.replies) == tokens[-1:]
    refusal = desk.answer(tokens[-1])
    assert refusal["code"] == OVERLOADED
    assert "service.queue_limit: got 8 pending requests; allowed: 8" in refusal["message"]
    # Its id is free again.
    assert desk.ask(named("f7", mode=2), session=quiet) not in desk.replies
    # The shares are now nearly equal: of the flood three wait, of the other one three.
    desk.ask(REQUEST, session=quiet)
    assert desk.answer(desk.ask(REQUEST, session=quiet))["code"] == OVERLOADED
    for _ in range(SETTINGS.queue_limit):
        desk.work()
    assert desk.orders == []


# --- cancelled requests -----------------------------------------------------------------------


def test_a_cancelled_request_frees_its_worker(desk: Desk) -> None:
    first, second = desk.ask(named("r")), desk.ask(REQUEST)
    done = desk.cancel(cancel_request("r"))
    assert desk.answer(done) == {"id": "r"}
    assert desk.answer(first)["code"] == CANCELLED
    (job,) = desk.stopped
    desk.end(Computed(job, None, STOPPED))
    del desk.orders[0]
    desk.work()
    assert desk.answer(second)["status"] == "optimal"
    metrics = desk.service.metrics
    assert (metrics.cancelled_total, metrics.answered_total, metrics.failed_total) == (1, 1, 0)


def test_a_cancelled_request_that_waits_is_not_planned(desk: Desk) -> None:
    for number in range(4):
        desk.ask(named(f"r{number}"))
    desk.cancel(cancel_request("r3"))
    assert not desk.stopped
    assert desk.service.metrics.waiting == 1
    for _ in range(3):
        desk.work()
    assert not desk.orders


def test_the_result_of_a_cancelled_request_is_discarded(desk: Desk) -> None:
    desk.ask(named("r"))
    desk.cancel(cancel_request("r"))
    again = desk.ask(named("r"))
    desk.work()  # the first one was complete before it could be stopped
    assert again not in desk.replies
    desk.work()
    assert desk.answer(again)["status"] == "optimal"


@pytest.mark.parametrize(
    "data",
    [
        cancel_request("another"),
        cancel_request(""),
        {"schema": CANCEL_SCHEMA},
        named("r"),
        {"id": "r"},
        [],
    ],
    ids=["unknown", "empty", "no id", "request", "no schema", "list"],
)
def test_what_cancels_no_request_is_declined(desk: Desk, data: object) -> None:
    token, anonymous = desk.ask(named("r")), desk.ask(REQUEST)
    assert desk.cancel(data) in desk.left
    assert not {token, anonymous} & set(desk.replies)


def test_a_client_cannot_cancel_the_request_of_another(desk: Desk) -> None:
    session, other = opened(desk, "a"), opened(desk, "b")
    token = desk.ask(named("r"), session=session)
    for attempt in (UNKNOWN, other):
        assert desk.cancel(cancel_request("r"), session=attempt) in desk.left
    assert token not in desk.replies
    # Another session of the same client can.
    desk.cancel(cancel_request("r"), session=opened(desk, "a", "2"))
    assert desk.answer(token)["code"] == CANCELLED


def test_a_request_is_planned_while_anyone_waits_for_it(desk: Desk) -> None:
    session, other = opened(desk, "a"), opened(desk, "b")
    first, second = (desk.ask(named("r"), session=each) for each in (session, other))
    desk.leave(session)
    assert desk.left == [first]
    assert not desk.stopped
    desk.work()
    assert desk.answer(second)["status"] == "optimal"


def test_all_requests_of_a_closed_session_are_dropped(desk: Desk) -> None:
    # A coordinator cannot tell whether the client or itself was disconnected: a client that is
    # still there must ask again, and not be told that it has cancelled.
    session, other = opened(desk, "a"), opened(desk, "a", "2")
    tokens = [desk.ask(REQUEST, session=session) for _ in range(5)]
    kept = desk.ask(REQUEST, session=other)
    desk.leave(session)
    assert desk.left == tokens
    assert not desk.replies
    assert len(desk.stopped) == 2
    for job in desk.stopped:
        desk.end(Computed(job, None, STOPPED))
    del desk.orders[:2]
    desk.work()
    assert desk.answer(kept)["status"] == "optimal"
    assert desk.service.metrics.cancelled_total == 5


def test_a_late_request_is_not_cancelled_again(desk: Desk) -> None:
    session = opened(desk, "a")
    desk.ask(REQUEST | {"deadline_s": 50.0})
    late = desk.ask(named("r", deadline_s=5.0), session=session)
    desk.wait(5.1)
    assert desk.answer(late)["code"] == LATE
    again = desk.ask(named("r", deadline_s=5.0))
    desk.leave(session)
    assert not desk.stopped
    assert again not in desk.replies


def test_a_request_that_arrives_after_its_client_left_is_declined(desk: Desk) -> None:
    session = opened(desk, "a")
    desk.leave(session)
    assert desk.ask(REQUEST, session=session) in desk.left
    assert not desk.orders


def test_cancelled_requests_do_not_count(desk: Desk) -> None:
    session = opened(desk, "a")
    for _ in range(SETTINGS.queue_limit):
        desk.ask(REQUEST, session=session)
    desk.leave(session)
    tokens = [desk.ask(REQUEST) for _ in range(SETTINGS.queue_limit)]
    assert not set(tokens) & set(desk.replies)


# --- the same request again -------------------------------------------------------------------


def test_a_repeated_request_waits_for_the_plan_under_way(desk: Desk) -> None:
    tokens = [desk.ask(named("r")) for _ in range(3)]
    assert len(desk.orders) == 1
    desk.work()
    assert desk.answer(tokens[0]) == desk.answer(tokens[1]) == desk.answer(tokens[2])
    assert desk.service.metrics.repeated_total == 2


def test_any_printable_text_may_be_an_id(desk: Desk) -> None:
    tokens = [desk.ask(named("Übung 1, 試験")) for _ in range(2)]
    desk.work()
    assert desk.answer(tokens[0])["status"] == "optimal"
    assert desk.answer(tokens[0]) == desk.answer(tokens[1])


@pytest.mark.parametrize("name", ["a\nb", "\x1b[2J", "\x00", "\u202e", "\ud800"])
def test_an_id_that_would_control_a_terminal_is_refused(desk: Desk, name: str) -> None:
    refusal = desk.answer(desk.ask(named(name)))
    assert (refusal["code"], refusal["field"]) == (INVALID, "id")


def test_a_failure_is_not_kept(desk: Desk) -> None:
    desk.ask(named("r"))
    desk.end(Computed(desk.orders.pop().job, None, "broken"))
    token = desk.ask(named("r"))
    desk.work()
    assert desk.answer(token)["status"] == "optimal"


def test_an_id_names_one_pending_request(desk: Desk) -> None:
    desk.ask(named("r"))
    refusal = desk.answer(desk.ask(named("r", mode=2)))
    assert (refusal["code"], refusal["field"]) == (INVALID, "id")
    desk.work()
    again = desk.ask(named("r", mode=2))
    desk.work()
    assert desk.answer(again)["status"] == "optimal"


def test_requests_without_an_id_are_planned_each(desk: Desk) -> None:
    desk.ask(REQUEST)
    desk.ask(REQUEST)
    assert len(desk.orders) == 2


@pytest.mark.slow
@pytest.mark.more
def test_large_requests_leave_little_behind() -> None:
    grid = {
        "columns": 100,
        "lanes": 16,
        "blocked": [[c, n] for c in range(3, 100) for n in range(16)],
    }
    desk = Desk(PlanningService("c1", Service(), 1, plan))
    tracemalloc.start()
    try:
        for number in range(20):
            desk.ask(named(str(number), grid=grid))
            desk.work()
        desk.replies.clear()
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_bytes < 1_500_000


# --- shared load ------------------------------------------------------------------------------

NAMES = tuple(f"c{number}" for number in range(5))


def owners(payload: bytes, names: tuple[str, ...]) -> list[str]:
    return [
        name for name in names if is_assigned_to(name, (n for n in names if n != name), payload)
    ]


@given(st.binary(), st.sets(st.sampled_from(NAMES), min_size=1))
def test_each_request_is_assigned_to_one_coordinator(payload: bytes, names: set[str]) -> None:
    assert len(owners(payload, tuple(names))) == 1


@given(st.binary(), st.sampled_from(NAMES))
def test_when_one_dies_only_its_requests_are_assigned_anew(payload: bytes, dead: str) -> None:
    (before,) = owners(payload, NAMES)
    (after,) = owners(payload, tuple(name for name in NAMES if name != dead))
    assert after == before or before == dead


def test_the_load_is_shared_evenly() -> None:
    payloads = [json.dumps(named(str(number))).encode() for number in range(5000)]
    counts = dict.fromkeys(NAMES, 0)
    for payload in payloads:
        counts[owners(payload, NAMES)[0]] += 1
    # A share of a fifth has a standard deviation of 28 in 5000.
    assert all(abs(count - 1000) < 170 for count in counts.values())


def test_requests_of_another_coordinator_are_declined(desk: Desk) -> None:
    tokens = [desk.ask(named(str(n)), others=("c2",)) for n in range(40)]
    metrics = desk.service.metrics
    assert desk.left
    assert metrics.left_total == len(desk.left)
    assert metrics.taken_total == len(tokens) - len(desk.left) > 0
    assert not set(desk.left) & set(desk.replies)


# --- metrics ----------------------------------------------------------------------------------


def test_metrics_count_what_was_done(desk: Desk) -> None:
    assert desk.service.metrics == ServiceMetrics()
    desk.ask(named("r"))
    desk.ask(named("r"))
    desk.ask({})
    desk.wait(2.0)
    desk.work()
    metrics = desk.service.metrics
    assert (metrics.taken_total, metrics.answered_total) == (3, 1)
    assert (metrics.repeated_total, metrics.invalid_total) == (1, 1)
    assert metrics.planning_seconds_total > 0
    assert metrics.planning_seconds_total + metrics.service_seconds_total == pytest.approx(2.0)
    assert (metrics.waiting, metrics.planning) == (0, 0)
