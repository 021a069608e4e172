"""Recent answers of the planning service, so that a repeated request gets the same answer."""

from __future__ import annotations

from hashlib import blake2b

from attrs import define, field, frozen

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.service.format import JSON, MSGPACK
from laneweave.protocol.scenario.deployment_fields import Service

CACHE_BYTES = 1 << 26
"""Upper bound on the total size of cached answers."""


@frozen
class CachedAnswer:
    """A cached answer, packed: as Python objects it would take 20 times as much memory."""

    packed: bytes
    """The answer as MessagePack."""
    _request: bytes
    """Digest of the request."""
    answered_s: float

    @classmethod
    def of(cls, request: PlanRequest, response: PlanResponse, now_s: float) -> CachedAnswer:
        """Pack an answer."""
        return cls(MSGPACK.write(response.to_dict()), _digest(request), now_s)

    def is_for(self, request: PlanRequest) -> bool:
        """Return whether this answers a request."""
        return self._request == _digest(request)


@define
class CachedAnswers:
    """Answers by request id: limited in number, size and age."""

    _settings: Service
    _answers: dict[str, CachedAnswer] = field(factory=dict)
    """The oldest first."""
    _bytes: int = 0

    def get(self, request_id: str) -> CachedAnswer | None:
        """Return the answer to the request with an id, if it is known."""
        return self._answers.get(request_id)

    def add(self, request: PlanRequest, response: PlanResponse, now_s: float) -> None:
        """Cache the answer to a request, whose id is not cached yet."""
        cached = CachedAnswer.of(request, response, now_s)
        self._answers[request.id] = cached
        self._bytes += len(cached.packed)
        self.expire(now_s)

    def expire(self, now_s: float) -> None:
        """Remove the oldest answers while they are too many, too large or too old."""
        answers, settings = self._answers, self._settings
        while answers:
            oldest = next(iter(answers))
            old = answers[oldest].answered_s <= now_s - settings.cache_s
            many = len(answers) > settings.cache_entries or self._bytes > CACHE_BYTES
            if not many and not old:
                return
            self._bytes -= len(answers.pop(oldest).packed)


def _digest(request: PlanRequest) -> bytes:
    # MessagePack cannot encode every text that JSON can represent.
    return blake2b(JSON.write(request.to_dict()), digest_size=16).digest()
