"""The planning service: answers plan requests of anyone on the network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from typing import Any

import msgpack
from attrs import define, field

from laneweave.coordinator.planning import PlanRequest, PlanResponse, checked_plan
from laneweave.protocol.codec import MAX_BYTES
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.node import Compute, Effect, Reply

MAX_WAITING = 64
"""Requests in hand beyond which new ones are refused."""


@define
class PlanningService:
    """Requests in hand; a request and its answer use the same encoding, JSON or MessagePack."""

    _waiting: dict[int, tuple[int, bool]] = field(factory=dict)

    def owns(self, job: int) -> bool:
        """Tell whether a computation belongs to a request."""
        return job in self._waiting

    def take(self, token: int, payload: bytes, job: int) -> Iterator[Effect]:
        """Check a request and order its computation, or refuse it."""
        is_json = payload.lstrip()[:1] == b"{"
        try:
            self._check_load()
            request = PlanRequest.from_dict(_unpack(payload, is_json=is_json))
        except BadInputError as error:
            yield Reply(token, _error(error.field, str(error), is_json=is_json), ok=False)
            return
        self._waiting[job] = (token, is_json)
        yield Compute(job, partial(checked_plan, request), background=True)

    def _check_load(self) -> None:
        if len(self._waiting) >= MAX_WAITING:
            raise BadInputError("service", f"{MAX_WAITING} requests in hand", "a retry later")

    def finish(self, job: int, result: object, error: str) -> Iterator[Effect]:
        """Answer a request whose computation has ended."""
        token, is_json = self._waiting.pop(job)
        if isinstance(result, PlanResponse):
            yield Reply(token, _pack(result.to_dict(), is_json=is_json))
        else:
            yield Reply(token, _error("", error, is_json=is_json), ok=False)


def _unpack(payload: bytes, *, is_json: bool) -> dict[str, Any]:
    if len(payload) > MAX_BYTES:
        raise BadInputError("request", f"{len(payload)} bytes", f"at most {MAX_BYTES} bytes")
    try:
        data = json.loads(payload) if is_json else msgpack.unpackb(payload)
    except Exception as error:
        raise BadInputError("request", payload[:16], "a map in JSON or MessagePack") from error
    if not isinstance(data, dict):
        raise BadInputError("request", type(data).__name__, "a map in JSON or MessagePack")
    return data


def _pack(data: dict[str, Any], *, is_json: bool) -> bytes:
    if is_json:
        return json.dumps(data).encode()
    packed = msgpack.packb(data)
    assert isinstance(packed, bytes)  # noqa: S101 (narrows msgpack's untyped result)
    return packed


def _error(name: str, message: str, *, is_json: bool) -> bytes:
    return _pack({"field": name, "message": message}, is_json=is_json)
