"""The planning service: answers plan requests from clients on the network.

Every coordinator receives every request and accepts those that are assigned to it (`rendezvous`),
so any number of coordinators can share the load without exchanging messages. A request waits for a
free worker until its deadline at the latest, and is answered in the remaining time. Clients are
served in turn. A request that its client cancels, or whose client is gone, is dropped, and its
worker stops. A request that is repeated under the same id while it is pending is planned once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import ClassVar

import attrs
from attrs import define

from laneweave.coordinator.planning.plug_ins.registry import check_solver
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanFunction, PlanResponse
from laneweave.coordinator.service.cancellation import cancelled_id
from laneweave.coordinator.service.pending import (
    ClientSession,
    OpenQuery,
    PendingPlan,
    PendingPlans,
)
from laneweave.coordinator.service.refusals import PacedRefusals
from laneweave.coordinator.service.rendezvous import is_assigned_to
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import metric
from laneweave.protocol.runtime.node import (
    TOO_LATE,
    Clock,
    Decline,
    Delegate,
    Effect,
    Reply,
    StopJob,
)
from laneweave.protocol.runtime.queries import (
    CANCELLED,
    FAILED,
    INVALID,
    LATE,
    Format,
    Refusal,
    format_of,
)
from laneweave.protocol.scenario.deployment_fields import Service

AHEAD_BELOW_S = 0.02
"""Mean time of plans below which each worker has one job ahead, so that it is not idle between two.
With longer plans, idle time matters less than the delay of the next client in turn."""
FIRST_MEAN_S = 0.01
"""Assumed mean time of a plan before the first one."""
MEAN_WEIGHT = 0.1
"""Weight of the newest plan in the mean time of plans."""


@define
class ServiceMetrics:
    """Counters of the service, and its current load."""

    ABOUT: ClassVar[str] = "service"

    taken_total: int = metric("Requests assigned to this coordinator", default=0)
    left_total: int = metric("Requests left to other coordinators", default=0)
    answered_total: int = metric("Requests answered", default=0)
    repeated_total: int = metric(
        "Requests repeated (same id) while they were pending, and planned once", default=0
    )
    invalid_total: int = metric("Requests refused because they are not valid", default=0)
    overloaded_total: int = metric("Requests refused because of overload", default=0)
    late_total: int = metric(
        "Requests dropped because no worker was free before the deadline", default=0
    )
    cancelled_total: int = metric(
        "Requests dropped because their clients cancelled them or are gone", default=0
    )
    failed_total: int = metric("Requests whose planning failed", default=0)
    planning_seconds_total: float = metric("Time spent in solvers", default=0.0)
    service_seconds_total: float = metric(
        "Time from the arrival of requests to their answers, excluding solvers", default=0.0
    )
    waiting: int = metric("Requests waiting for a worker", default=0)
    planning: int = metric("Requests handed to workers", default=0)


class PlanningService:
    """Pure core of the service; its coordinator passes in queries, results and the time."""

    def __init__(
        self,
        name: str,
        settings: Service,
        workers: int,
        plan: PlanFunction,
        solver: str | None = None,
    ) -> None:
        """Make a service without requests.

        Args:
            name: name of the coordinator.
            settings: limits.
            workers: number of requests to answer concurrently.
            plan: answers a request, in a worker process.
            solver: solver for requests that name none; None: the planner chooses.
        """
        self._name = name
        self._solver = solver
        self._plan = plan
        self._settings = settings
        self._workers = workers
        self._pending = PendingPlans(workers)
        self._by_id: dict[str, PendingPlan] = {}
        """Pending requests by id; requests without an id are not included."""
        self._sessions: set[ClientSession] = {ClientSession()}
        """Live sessions; that of unknown clients is never closed."""
        self._mean_s = FIRST_MEAN_S
        """Mean time of recent plans."""
        self._refusals = PacedRefusals()
        self._retired = False
        """Whether new requests are left to other coordinators."""
        self._metrics = ServiceMetrics()

    @property
    def metrics(self) -> ServiceMetrics:
        """Counters and current load."""
        pending = self._pending
        return attrs.evolve(self._metrics, waiting=pending.waiting, planning=pending.planning)

    @property
    def wakeup_s(self) -> float | None:
        """Earliest deadline of a waiting request, or time at which a refusal is due."""
        times = [entry.deadline_s for entry in self._pending.not_begun]
        if (refusal_s := self._refusals.wakeup_s) is not None:
            times.append(refusal_s)
        return min(times, default=None)

    # --- queries ------------------------------------------------------------------------------

    def take(
        self,
        token: int,
        payload: bytes,
        encoding: str,
        session: ClientSession,
        job: int,
        others: Iterable[str],
        now_s: float,
    ) -> Iterator[Effect]:
        """Accept a request, decline it, or refuse it.

        Requests of other coordinators and of clients that are gone are declined, and all requests
        after `retire`.

        Args:
            token: token of the query.
            payload: encoded request.
            encoding: MIME type given by the client, if any.
            session: session of the client.
            job: id for the computation of the request.
            others: names of the other live coordinators.
            now_s: node clock.
        """
        if self._retired or not is_assigned_to(self._name, others, payload):
            self._count("left_total")
            yield Decline(token)
            return
        self._count("taken_total")
        if session not in self._sessions:
            self._count("cancelled_total")
            yield Decline(token)
            return
        query = OpenQuery(token, format_of(payload, encoding), session)
        count = self._pending.count(session.client)
        if count >= self._settings.client_queue_limit:
            # Without reading the request: a flood should cost little.
            yield from self._refuse_over_limit(query, count, now_s)
            return
        yield from self._take(query, payload, job, now_s)

    def _take(self, query: OpenQuery, payload: bytes, job: int, now_s: float) -> Iterator[Effect]:
        """Read a request and answer, refuse or queue it."""
        form = query.form
        try:
            request = self._read(form, payload)
            entry = self._pending_under_id(request)
        except BadInputError as error:
            self._count("invalid_total")
            yield form.reply(query.token, Refusal(INVALID, str(error), error.field))
            return
        if entry is not None:
            self._count("repeated_total")
            entry.queries.append(query)
            return
        client = query.session.client
        count = len(self._pending)
        if count >= self._settings.queue_limit:
            displaced = self._pending.displaced_by(client)
            if displaced is None:
                yield from self._refuse_in_total(query, count, now_s)
                return
            self._forget(displaced)
            for each in displaced.queries:
                yield from self._refuse_in_total(each, count, now_s)
        entry = PendingPlan(request, now_s, job, client, [query])
        if request.id:
            self._by_id[request.id] = entry
        self._pending.add(entry)
        yield from self._hand_out(now_s)

    def _read(self, form: Format, payload: bytes) -> PlanRequest:
        max_bytes = self._settings.max_request_bytes
        if len(payload) > max_bytes:
            raise BadInputError(
                "request", f"{len(payload)} bytes or more", f"at most {max_bytes} bytes"
            )
        request = PlanRequest.from_dict(form.read(payload))
        if request.solver is not None:
            check_solver(request.solver)
        if request.deadline_s > self._settings.max_deadline_s:
            allowed = f"at most {self._settings.max_deadline_s:g} at this service"
            raise BadInputError("deadline_s", request.deadline_s, allowed)
        return request

    def _pending_under_id(self, request: PlanRequest) -> PendingPlan | None:
        """Return the entry of a repeated request that is pending."""
        entry = self._by_id.get(request.id)
        if entry is not None and entry.request != request:
            raise BadInputError("id", request.id, "an id that no other pending request has")
        return entry

    # --- overload -----------------------------------------------------------------------------

    def _refuse_over_limit(self, query: OpenQuery, count: int, now_s: float) -> Iterator[Effect]:
        """Refuse a request of a client that has too many."""
        what = f"{count} pending requests of this client"
        ahead = count * self._pending.clients
        yield from self._refuse(query, "client_queue_limit", what, ahead, now_s)

    def _refuse_in_total(self, query: OpenQuery, count: int, now_s: float) -> Iterator[Effect]:
        """Refuse a request because there are too many of all clients."""
        what = f"{count} pending requests"
        yield from self._refuse(query, "queue_limit", what, count, now_s)

    def _refuse(
        self, query: OpenQuery, limit: str, what: str, ahead: int, now_s: float
    ) -> Iterator[Effect]:
        """Refuse a request; half of the requests ahead should be planned before it comes again."""
        self._count("overloaded_total")
        reason = f"service.{limit}: got {what}; allowed: {getattr(self._settings, limit)}"
        planned_s = ahead / 2 * self._mean_s / self._workers
        yield from self._refusals.refuse(query, reason, planned_s, now_s)

    # --- cancellation -------------------------------------------------------------------------

    def open_session(self, session: ClientSession) -> None:
        """Register a session of a client."""
        self._sessions.add(session)

    def close_session(self, session: ClientSession) -> Iterator[Effect]:
        """Drop all requests of a session that has ended.

        Its queries are declined: if this coordinator was disconnected, and not the client, the
        client asks again.
        """
        self._sessions.discard(session)
        for entry in self._pending.of_session(session):
            ended = [query for query in entry.queries if query.session == session]
            yield from self._withdraw(entry, ended)
            yield from (Decline(query.token) for query in ended)

    def cancel(
        self, token: int, payload: bytes, encoding: str, session: ClientSession
    ) -> Iterator[Effect]:
        """Cancel a client's request, or decline if this service does not have it.

        Args:
            token: token of the query that cancels the request.
            payload: encoded cancellation.
            encoding: MIME type given by the client, if any.
            session: session of the client; only the client's own queries are cancelled.
        """
        form = format_of(payload, encoding)
        entry = self._by_id.get(cancelled_id(form, payload))
        queries = [] if entry is None else entry.queries
        own = [query for query in queries if query.session.client == session.client]
        if entry is None or not own:
            yield Decline(token)
            return
        yield from self._withdraw(entry, own)
        refusal = Refusal(CANCELLED, "cancelled by the client", "")
        yield from (query.form.reply(query.token, refusal) for query in own)
        yield Reply(token, form.write({"id": entry.request.id}), encoding=form.encoding)

    def _withdraw(self, entry: PendingPlan, queries: list[OpenQuery]) -> Iterator[Effect]:
        """Remove queries from a request, and drop the request if there are no others for it."""
        for query in queries:
            entry.queries.remove(query)
        if not entry.queries:
            self._count("cancelled_total")
            self._forget(entry)
            if self._pending.drop(entry):
                yield StopJob(entry.job)

    def _forget(self, entry: PendingPlan) -> None:
        """Remove a request from those known by id."""
        self._by_id.pop(entry.request.id, None)

    # --- the end ------------------------------------------------------------------------------

    @property
    def idle(self) -> bool:
        """Whether all requests have been answered."""
        return len(self._pending) == 0

    def retire(self) -> Iterator[Effect]:
        """Leave new requests to other coordinators, and those that would only be refused."""
        self._retired = True
        yield from (Decline(query.token) for query in self._refusals.withdraw())

    def give_up(self) -> Iterator[Effect]:
        """Leave all pending requests to other coordinators: this process ends."""
        for entry in self._pending.unanswered:
            yield from (Decline(query.token) for query in entry.queries)

    # --- planning -----------------------------------------------------------------------------

    def owns(self, job: int) -> bool:
        """Return whether a computation belongs to a request."""
        return self._pending.owns(job)

    def _hand_out(self, now_s: float) -> Iterator[Effect]:
        """Hand waiting requests to workers, clients in turn."""
        yield from self._drop_late(now_s)
        ahead = int(self._mean_s < AHEAD_BELOW_S)
        while (entry := self._pending.next_for_worker(ahead)) is not None:
            solver = entry.request.solver or self._solver
            memory_mb = self._settings.worker_memory_mb
            plan = partial(self._plan, solver=solver, max_memory_mb=memory_mb)
            job = partial(plan_in_time, plan, entry.request)
            yield Delegate(entry.job, job, entry.deadline_s)

    def finish(self, job: int, result: object, error: str, now_s: float) -> Iterator[Effect]:
        """Answer a request whose computation has finished."""
        entry = self._pending.finish(job)
        if not entry.dropped:
            yield from self._end(entry, self._outcome(entry, result, error, now_s), now_s)
        yield from self._hand_out(now_s)

    def _outcome(
        self, entry: PendingPlan, result: object, error: str, now_s: float
    ) -> PlanResponse | Refusal:
        if isinstance(result, PlanResponse):
            return result
        if error == TOO_LATE:
            return self._late(entry, now_s)
        self._count("failed_total")
        return Refusal(FAILED, f"planning failed: {error}", "")

    def wake(self, now_s: float) -> Iterator[Effect]:
        """Do what is due: see `wakeup_s`."""
        yield from self._drop_late(now_s)
        yield from self._refusals.release(now_s)

    def _drop_late(self, now_s: float) -> Iterator[Effect]:
        """Drop requests whose deadlines passed while they waited."""
        late = [entry for entry in self._pending.not_begun if entry.deadline_s <= now_s]
        for entry in late:
            self._pending.drop(entry)  # a worker does not begin a late job
            yield from self._end(entry, self._late(entry, now_s), now_s)

    def _late(self, entry: PendingPlan, now_s: float) -> Refusal:
        self._count("late_total")
        waited_s, deadline_s = now_s - entry.arrived_s, entry.request.deadline_s
        text = (
            f"deadline_s: got {deadline_s:g}; allowed: longer than the {waited_s:.3f} s for which "
            "requests currently wait for a worker"
        )
        return Refusal(LATE, text, "deadline_s")

    def _end(
        self, entry: PendingPlan, answer: PlanResponse | Refusal, now_s: float
    ) -> Iterator[Effect]:
        """Answer all queries for a request."""
        if isinstance(answer, PlanResponse):
            self._count("answered_total")
            planned_s = answer.solve_ms / 1e3
            self._mean_s += MEAN_WEIGHT * (planned_s - self._mean_s)
            self._count("planning_seconds_total", planned_s)
            self._count("service_seconds_total", max(0.0, now_s - entry.arrived_s - planned_s))
        for query in entry.queries:
            yield query.form.reply(query.token, answer)
        self._forget(entry)

    def _count(self, name: str, by: float = 1) -> None:
        setattr(self._metrics, name, getattr(self._metrics, name) + by)


def plan_in_time(
    plan: PlanFunction, request: PlanRequest, left_s: float, clock: Clock
) -> PlanResponse:
    """Answer a request in the time left until its deadline [s]; `clock` may stop the planner."""
    left_s = min(left_s, request.deadline_s)
    response = plan(attrs.evolve(request, deadline_s=left_s), clock=clock)
    waited_ms = round(1e3 * (request.deadline_s - left_s), 3)
    return attrs.evolve(response, waited_ms=waited_ms)
