"""The planning service: answers plan requests from clients on the network.

Every coordinator receives every request and accepts those that are assigned to it (`rendezvous`),
so any number of coordinators can share the load without exchanging messages. A request waits for a
free worker until its deadline at the latest, and is answered in the remaining time. A repeated
request with the same id gets the same answer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from functools import partial
from hashlib import blake2b
from itertools import islice
from typing import ClassVar

import attrs
from attrs import define, field, frozen

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanFunction, PlanResponse
from laneweave.coordinator.service.format import (
    FAILED,
    INVALID,
    JSON,
    LATE,
    MSGPACK,
    OVERLOADED,
    Format,
    Refusal,
    format_of,
)
from laneweave.coordinator.service.rendezvous import is_assigned_to
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import metric
from laneweave.protocol.runtime.node import TOO_LATE, Decline, Delegate, Effect, Reply
from laneweave.protocol.scenario.deployment_fields import Service
from laneweave.protocol.scenario.fields import DEFAULT_SOLVER

HANDED_OUT_AHEAD = 1
"""Jobs queued for each worker in addition to its current one, so that it is never idle."""
CACHE_BYTES = 1 << 26
"""Upper bound on the total size of cached answers."""


@frozen
class ServiceMetrics:
    """Counters of the service, and its current load."""

    ABOUT: ClassVar[str] = "service"

    taken_total: int = metric("Requests assigned to this coordinator", default=0)
    left_total: int = metric("Requests assigned to other coordinators", default=0)
    answered_total: int = metric("Requests answered", default=0)
    repeated_total: int = metric(
        "Repeated requests (same id) that got the earlier answer", default=0
    )
    invalid_total: int = metric("Requests refused because they are not valid", default=0)
    overloaded_total: int = metric("Requests refused because of overload", default=0)
    late_total: int = metric(
        "Requests dropped because no worker was free before the deadline", default=0
    )
    failed_total: int = metric("Requests whose planning failed", default=0)
    planning_seconds_total: float = metric("Time spent in solvers", default=0.0)
    service_seconds_total: float = metric(
        "Time from the arrival of requests to their answers, excluding solvers", default=0.0
    )
    waiting: int = metric("Requests waiting for a worker", default=0)
    planning: int = metric("Requests handed to workers", default=0)


@define(eq=False)
class _Entry:
    """A request that waits for a worker or is being answered."""

    request: PlanRequest
    arrived_s: float
    job: int
    clients: list[tuple[int, Format]] = field(factory=list)
    """Token and format of each query that waits for the answer."""
    dropped: bool = False
    """Whether the request was answered before its computation finished."""

    @property
    def deadline_s(self) -> float:
        return self.arrived_s + self.request.deadline_s


@frozen
class _CachedAnswer:
    """A cached answer, packed: as Python objects it would take 20 times as much memory."""

    request: bytes
    """Digest of the request."""
    answer: bytes
    answered_s: float


class PlanningService:
    """Pure core of the service; its coordinator passes in queries, results and the time."""

    def __init__(
        self,
        name: str,
        settings: Service,
        workers: int,
        plan: PlanFunction,
        solver: str = DEFAULT_SOLVER,
    ) -> None:
        """Make a service without requests.

        Args:
            name: name of the coordinator.
            settings: limits.
            workers: number of requests to answer concurrently.
            plan: answers a request, in a worker process.
            solver: solver for requests that name none.
        """
        self._name = name
        self._solver = solver
        self._plan = plan
        self._settings = settings
        self._workers = workers
        self._waiting: deque[_Entry] = deque()
        self._planning: dict[int, _Entry] = {}
        self._pending: dict[str, _Entry] = {}
        """Unanswered requests by id; requests without an id are not included."""
        self._answers: dict[str, _CachedAnswer] = {}
        """Cached answers by request id, oldest first."""
        self._cached_bytes = 0
        self._metrics = ServiceMetrics()

    @property
    def metrics(self) -> ServiceMetrics:
        """Counters and current load."""
        return attrs.evolve(self._metrics, waiting=len(self._waiting), planning=len(self._planning))

    @property
    def wakeup_s(self) -> float | None:
        """Earliest deadline of a waiting request."""
        return min((entry.deadline_s for entry in self._not_begun()), default=None)

    def _not_begun(self) -> Iterator[_Entry]:
        """Yield the requests on which no worker has begun; workers take jobs in order."""
        ahead = islice(self._planning.values(), self._workers, None)
        yield from (entry for entry in ahead if not entry.dropped)
        yield from self._waiting

    # --- queries ------------------------------------------------------------------------------

    def take(
        self,
        token: int,
        payload: bytes,
        encoding: str,
        job: int,
        others: Iterable[str],
        now_s: float,
    ) -> Iterator[Effect]:
        """Accept a request, decline it for another coordinator, or refuse it.

        Args:
            token: token of the query.
            payload: encoded request.
            encoding: MIME type given by the client, if any.
            job: id for the computation of the request.
            others: names of the other live coordinators.
            now_s: node clock.
        """
        if not is_assigned_to(self._name, others, payload):
            self._count("left_total")
            yield Decline(token)
            return
        self._count("taken_total")
        form = format_of(payload, encoding)
        try:
            request = self._read(form, payload)
            self._expire_answers(now_s)
            entry, cached = self._known(request)
        except BadInputError as error:
            self._count("invalid_total")
            yield form.reply(token, Refusal(INVALID, str(error), error.field))
            return
        if entry is not None:
            self._count("repeated_total")
            entry.clients.append((token, form))
            return
        if cached is not None:
            self._count("repeated_total")
            yield Reply(token, form.write(MSGPACK.read(cached.answer)), encoding=form.encoding)
            return
        if len(self._waiting) + len(self._planning) >= self._settings.queue_limit:
            self._count("overloaded_total")
            yield form.reply(token, self._overloaded())
            return
        entry = _Entry(request, now_s, job, [(token, form)])
        if request.id:
            self._pending[request.id] = entry
        self._waiting.append(entry)
        yield from self._hand_out(now_s)

    def _read(self, form: Format, payload: bytes) -> PlanRequest:
        max_bytes = self._settings.max_request_bytes
        if len(payload) > max_bytes:
            raise BadInputError(
                "request", f"{len(payload)} bytes or more", f"at most {max_bytes} bytes"
            )
        request = PlanRequest.from_dict(form.read(payload))
        if request.deadline_s > self._settings.max_deadline_s:
            allowed = f"at most {self._settings.max_deadline_s:g} at this service"
            raise BadInputError("deadline_s", request.deadline_s, allowed)
        return request

    def _known(self, request: PlanRequest) -> tuple[_Entry | None, _CachedAnswer | None]:
        """Return the entry or the cached answer of a repeated request."""
        entry, cached = self._pending.get(request.id), self._answers.get(request.id)
        another = (entry is not None and entry.request != request) or (
            cached is not None and cached.request != _digest(request)
        )
        if another:
            raise BadInputError("id", request.id, "an id that no other recent request has")
        return entry, cached

    def _overloaded(self) -> Refusal:
        limit = self._settings.queue_limit
        text = (
            f"service.queue_limit: got {limit} pending requests; allowed: {limit}; try again later"
        )
        return Refusal(OVERLOADED, text, "")

    # --- planning -----------------------------------------------------------------------------

    def owns(self, job: int) -> bool:
        """Return whether a computation belongs to a request."""
        return job in self._planning

    def _hand_out(self, now_s: float) -> Iterator[Effect]:
        """Hand waiting requests to workers, in order of arrival."""
        max_planning = self._workers * (1 + HANDED_OUT_AHEAD)
        while self._waiting and len(self._planning) < max_planning:
            entry = self._waiting.popleft()
            if entry.deadline_s <= now_s:
                yield from self._end(entry, self._late(entry, now_s), now_s)
                continue
            self._planning[entry.job] = entry
            solver = entry.request.solver or self._solver
            memory_mb = self._settings.worker_memory_mb
            plan = partial(self._plan, solver=solver, max_memory_mb=memory_mb)
            job = partial(plan_in_time, plan, entry.request)
            yield Delegate(entry.job, job, entry.deadline_s)

    def finish(self, job: int, result: object, error: str, now_s: float) -> Iterator[Effect]:
        """Answer a request whose computation has finished."""
        entry = self._planning.pop(job)
        if not entry.dropped:
            yield from self._end(entry, self._outcome(entry, result, error, now_s), now_s)
        yield from self._hand_out(now_s)

    def _outcome(
        self, entry: _Entry, result: object, error: str, now_s: float
    ) -> PlanResponse | Refusal:
        if isinstance(result, PlanResponse):
            return result
        if error == TOO_LATE:
            return self._late(entry, now_s)
        self._count("failed_total")
        return Refusal(FAILED, f"planning failed: {error}", "")

    def drop_late(self, now_s: float) -> Iterator[Effect]:
        """Drop requests whose deadlines passed while they waited."""
        late = [entry for entry in self._not_begun() if entry.deadline_s <= now_s]
        for entry in late:
            if entry.job in self._planning:
                entry.dropped = True
            else:
                self._waiting.remove(entry)
            yield from self._end(entry, self._late(entry, now_s), now_s)

    def _late(self, entry: _Entry, now_s: float) -> Refusal:
        self._count("late_total")
        waited_s, deadline_s = now_s - entry.arrived_s, entry.request.deadline_s
        text = (
            f"deadline_s: got {deadline_s:g}; allowed: longer than the {waited_s:.3f} s for which "
            "requests currently wait for a worker"
        )
        return Refusal(LATE, text, "deadline_s")

    def _end(self, entry: _Entry, answer: PlanResponse | Refusal, now_s: float) -> Iterator[Effect]:
        """Answer all queries for a request; if the answer is a plan, cache it."""
        if isinstance(answer, PlanResponse):
            self._count("answered_total")
            planned_s = answer.solve_ms / 1e3
            self._count("planning_seconds_total", planned_s)
            self._count("service_seconds_total", max(0.0, now_s - entry.arrived_s - planned_s))
        for token, form in entry.clients:
            yield form.reply(token, answer)
        if self._pending.pop(entry.request.id, None) and isinstance(answer, PlanResponse):
            cached = _CachedAnswer(_digest(entry.request), MSGPACK.write(answer.to_dict()), now_s)
            self._answers[entry.request.id] = cached
            self._cached_bytes += len(cached.answer)
            self._expire_answers(now_s)

    def _expire_answers(self, now_s: float) -> None:
        """Remove the oldest answers while they are too many, too large or too old."""
        answers, settings = self._answers, self._settings
        while answers:
            oldest = next(iter(answers))
            old = answers[oldest].answered_s <= now_s - settings.cache_s
            many = len(answers) > settings.cache_entries or self._cached_bytes > CACHE_BYTES
            if not many and not old:
                return
            self._cached_bytes -= len(answers.pop(oldest).answer)

    def _count(self, name: str, by: float = 1) -> None:
        counted = getattr(self._metrics, name) + by
        self._metrics = attrs.evolve(self._metrics, **{name: counted})


def _digest(request: PlanRequest) -> bytes:
    # MessagePack cannot encode every text that JSON can represent.
    return blake2b(JSON.write(request.to_dict()), digest_size=16).digest()


def plan_in_time(plan: PlanFunction, request: PlanRequest, left_s: float) -> PlanResponse:
    """Answer a request in the time left until its deadline."""
    left_s = min(left_s, request.deadline_s)
    response = plan(attrs.evolve(request, deadline_s=left_s))
    waited_ms = round(1e3 * (request.deadline_s - left_s), 3)
    return attrs.evolve(response, waited_ms=waited_ms)
