"""The planning service: both encodings, refusals that name the field, and the load limit."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import msgpack
import pytest

from laneweave.coordinator.service import MAX_WAITING, PlanningService
from laneweave.protocol.codec import MAX_BYTES
from laneweave.protocol.node import Compute, Reply, run_job

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
    ("pack", "unpack"),
    [(lambda data: json.dumps(data).encode(), json.loads), (msgpack.packb, msgpack.unpackb)],
    ids=["JSON", "MessagePack"],
)


def ask(service: PlanningService, payload: bytes, job: int = 1, token: int = 7) -> Compute | Reply:
    (effect,) = service.take(token, payload, job)
    assert isinstance(effect, Compute | Reply)
    return effect


def refused(payload: bytes) -> Reply:
    reply = ask(PlanningService(), payload)
    assert isinstance(reply, Reply)
    assert (reply.token, reply.ok) == (7, False)
    return reply


@CODECS
def test_an_answer_has_the_encoding_of_its_request(pack: Pack, unpack: Unpack) -> None:
    service = PlanningService()
    order = ask(service, pack(REQUEST), job=3)
    assert isinstance(order, Compute)
    assert service.owns(3)
    done = run_job(order)
    (reply,) = service.finish(3, done.result, done.error)
    assert isinstance(reply, Reply)
    assert (reply.token, reply.ok) == (7, True)
    answer = unpack(reply.payload)
    assert answer["status"] == "optimal"
    assert not service.owns(3)


def test_white_space_before_json_is_fine() -> None:
    assert isinstance(ask(PlanningService(), b"\n  " + json.dumps(REQUEST).encode()), Compute)


def spoiled(*path: str | int, value: object) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(json.dumps(REQUEST))
    at: Any = data
    for step in path[:-1]:
        at = at[step]
    at[path[-1]] = value
    return data


@CODECS
@pytest.mark.parametrize(
    ("data", "field"),
    [
        ({}, "schema"),
        (spoiled("schema", value="x"), "schema"),
        (spoiled("mode", value=3), "mode"),
        (spoiled("mode", value=True), "mode"),
        (spoiled("typo", value=1), "typo"),
        (spoiled("grid", "columns", value=0), "grid.columns"),
        (spoiled("grid", "columns", value="3"), "grid.columns"),
        (spoiled("targets", 1, value=[9, 9]), "targets[1]"),
        (spoiled("targets", value=[]), "targets"),
        (spoiled("vehicles", value=None), "vehicles"),
        (spoiled("vehicles", 1, "cell", value=[0, 0]), "vehicles[1].cell"),
        (spoiled("vehicles", 0, "lane", value=5), "vehicles[0].lane"),
        (spoiled("vehicles", 0, "colour", value=5), "vehicles[0].colour"),
        (spoiled("conflicts", value=["nodes"]), "conflicts[0]"),
        (spoiled("deadline_s", value=-1), "deadline_s"),
        (spoiled("deadline_s", value=float("nan")), "deadline_s"),
    ],
)
def test_a_malformed_request_is_refused_with_the_fields_name(
    pack: Pack, unpack: Unpack, data: dict[str, Any], field: str
) -> None:
    error = unpack(refused(pack(data)).payload)
    assert error["field"] == field
    assert field in error["message"]
    assert "\n" not in error["message"]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"{" * 100_000,
        b'{"a": \xff}',
        b"\xc1",
        msgpack.packb([1, 2]),
        msgpack.packb("text"),
        msgpack.packb({1: 2}),
        b"x" * (MAX_BYTES + 1),
        b"{" + b" " * MAX_BYTES + b"}",
    ],
    ids=[
        "empty", "open brace", "deep", "not UTF-8", "not MessagePack", "list", "text",
        "number as key", "too long", "too long JSON",
    ],
)  # fmt: skip
def test_what_is_not_a_map_is_refused(payload: bytes) -> None:
    reply = refused(payload)
    unpack: Unpack = json.loads if payload.lstrip()[:1] == b"{" else msgpack.unpackb
    assert unpack(reply.payload)["field"]


def test_too_many_requests_in_hand_are_refused_until_one_is_done() -> None:
    service, payload = PlanningService(), json.dumps(REQUEST).encode()
    orders = [ask(service, payload, job) for job in range(MAX_WAITING)]
    assert all(isinstance(order, Compute) for order in orders)
    reply = ask(service, payload, 1000)
    assert isinstance(reply, Reply)
    assert not reply.ok
    assert json.loads(reply.payload)["field"] == "service"
    assert not service.owns(1000)
    assert isinstance(orders[0], Compute)
    done = run_job(orders[0])
    list(service.finish(0, done.result, done.error))
    assert isinstance(ask(service, payload, 1001), Compute)


@CODECS
def test_a_failed_computation_is_an_error_reply(pack: Pack, unpack: Unpack) -> None:
    service = PlanningService()
    ask(service, pack(REQUEST))
    (reply,) = service.finish(1, None, "ValueError: broken")
    assert isinstance(reply, Reply)
    assert not reply.ok
    assert unpack(reply.payload) == {"field": "", "message": "ValueError: broken"}
