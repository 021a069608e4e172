"""The planning service: encodings, refusals, deadlines, limits, repeated requests, shared load."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest
from attrs import define, field
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.solve import plan
from laneweave.coordinator.service import server as service
from laneweave.coordinator.service.format import FAILED, INVALID, LATE, OVERLOADED
from laneweave.coordinator.service.rendezvous import is_assigned_to
from laneweave.coordinator.service.server import PlanningService, ServiceMetrics
from laneweave.protocol.runtime.node import (
    Computed,
    Decline,
    Delegate,
    Effect,
    Reply,
    run_delegated,
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
SETTINGS = Service(queue_limit=8, max_request_bytes=4096, cache_entries=4, cache_s=60.0)


@define
class Desk:
    """A service with one worker, its clock, and its replies so far."""

    service: PlanningService = field(factory=lambda: PlanningService("c1", SETTINGS, 1, plan))
    now_s: float = 100.0
    replies: dict[int, Reply] = field(factory=dict)
    orders: list[Delegate] = field(factory=list)
    left: list[int] = field(factory=list)
    _tokens: int = 0

    def ask(self, data: object, *, encoding: str = "", others: tuple[str, ...] = ()) -> int:
        """Ask something; return the token."""
        payload = data if isinstance(data, bytes) else json.dumps(data).encode()
        self._tokens += 1
        job = 1000 + self._tokens
        self._note(self.service.take(self._tokens, payload, encoding, job, others, self.now_s))
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
        self._note(self.service.drop_late(self.now_s))

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


# --- the same request again -------------------------------------------------------------------


def test_a_repeated_request_gets_the_plan_that_was_made(desk: Desk) -> None:
    first = desk.ask(named("r"))
    desk.work()
    again = desk.ask(named("r"))
    assert desk.orders == []
    assert desk.answer(again) == desk.answer(first)
    packed = desk.ask(msgpack.packb(named("r")))
    assert msgpack.unpackb(desk.replies[packed].payload) == desk.answer(first)


def test_a_repeated_request_waits_for_the_plan_under_way(desk: Desk) -> None:
    tokens = [desk.ask(named("r")) for _ in range(3)]
    assert len(desk.orders) == 1
    desk.work()
    assert desk.answer(tokens[0]) == desk.answer(tokens[1]) == desk.answer(tokens[2])
    assert desk.service.metrics.repeated_total == 2


def test_any_text_may_be_an_id(desk: Desk) -> None:
    first = desk.ask(named("\ud800"))
    desk.work()
    again = desk.ask(named("\ud800"))
    assert desk.answer(first) == desk.answer(again)


def test_a_failure_is_not_kept(desk: Desk) -> None:
    desk.ask(named("r"))
    desk.end(Computed(desk.orders.pop().job, None, "broken"))
    token = desk.ask(named("r"))
    desk.work()
    assert desk.answer(token)["status"] == "optimal"


@pytest.mark.parametrize("answered", [True, False])
def test_an_id_names_one_request(desk: Desk, *, answered: bool) -> None:
    desk.ask(named("r"))
    if answered:
        desk.work()
    refusal = desk.answer(desk.ask(named("r", mode=2)))
    assert (refusal["code"], refusal["field"]) == (INVALID, "id")


def test_requests_without_an_id_are_planned_each(desk: Desk) -> None:
    desk.ask(REQUEST)
    desk.ask(REQUEST)
    assert len(desk.orders) == 2


def test_answers_are_forgotten_by_age_and_by_number(desk: Desk) -> None:
    desk.ask(named("old"))
    desk.work()
    desk.wait(SETTINGS.cache_s + 1.0)
    desk.ask(named("old"))
    assert len(desk.orders) == 1
    desk.work()
    for number in range(SETTINGS.cache_entries):
        desk.ask(named(f"r{number}"))
        desk.work()
    desk.ask(named("old"))
    assert len(desk.orders) == 1
    desk.ask(named("r3"))
    assert len(desk.orders) == 1


def test_no_answers_are_kept_where_none_may_be() -> None:
    desk = Desk(PlanningService("c1", Service(cache_entries=0), 1, plan))
    for _ in range(2):
        desk.ask(named("r"))
        desk.work()
    assert desk.service.metrics.answered_total == 2


def test_answers_are_forgotten_when_they_are_long(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(3):
        desk.ask(named(str(number)))
        desk.work()
    monkeypatch.setattr(service, "CACHE_BYTES", 300)
    desk.ask(named("3"))
    desk.work()
    desk.ask(named("3"))
    assert not desk.orders
    desk.ask(named("0"))
    assert desk.orders


@pytest.mark.slow
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
