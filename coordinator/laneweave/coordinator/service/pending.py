"""Pending requests of the planning service, and their order of service: clients in turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Self

from attrs import define, field, frozen

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.protocol.runtime.queries import Format
from laneweave.protocol.runtime.round_robin import RoundRobin


@frozen
class ClientSession:
    """One connection of a client; the network reports when it ends.

    Clients without a liveliness token are unknown: they count as one client, and nothing reports
    their end.
    """

    client: str = ""
    """Name of the client; empty: unknown."""
    session: str = ""
    """Unique for each connection; empty: unknown."""

    @classmethod
    def of(cls, parameters: Mapping[str, str]) -> Self:
        """Return the session that a token's parameters name."""
        return cls(parameters.get("client", ""), parameters.get("session", ""))


@frozen
class OpenQuery:
    """A query that waits for the answer to a request."""

    token: int
    form: Format
    session: ClientSession


@define(eq=False)
class PendingPlan:
    """A request that waits for a worker or is being planned."""

    request: PlanRequest
    arrived_s: float
    job: int
    client: str
    """Client that sent the request first."""
    queries: list[OpenQuery] = field(factory=list)
    """Queries for this request."""
    dropped: bool = False
    """Whether the request was answered or cancelled before its computation finished."""

    @property
    def deadline_s(self) -> float:
        """Deadline on the node clock [s]."""
        return self.arrived_s + self.request.deadline_s


class PendingPlans:
    """All pending requests; workers take the jobs handed to them in order."""

    def __init__(self, workers: int) -> None:
        """Create an empty queue.

        Args:
            workers: number of requests that are planned concurrently.
        """
        self._workers = workers
        self._waiting: RoundRobin[PendingPlan] = RoundRobin()
        self._planning: dict[int, PendingPlan] = {}
        """Requests handed to workers, by job."""

    def __len__(self) -> int:
        """Return the number of requests that still need an answer."""
        return len(list(self.unanswered))

    @property
    def unanswered(self) -> Iterator[PendingPlan]:
        """Requests that still need an answer."""
        yield from (entry for entry in self._planning.values() if not entry.dropped)
        yield from self._waiting

    @property
    def waiting(self) -> int:
        """Number of requests that wait for a worker."""
        return len(self._waiting)

    @property
    def planning(self) -> int:
        """Number of requests handed to workers."""
        return len(self._planning)

    @property
    def not_begun(self) -> Iterator[PendingPlan]:
        """Requests on which no worker has begun."""
        ahead = islice(self._planning.values(), self._workers, None)
        yield from (entry for entry in ahead if not entry.dropped)
        yield from self._waiting

    def of_session(self, session: ClientSession) -> list[PendingPlan]:
        """Return the requests for which a session waits."""
        return [
            entry
            for entry in self.unanswered
            if any(query.session == session for query in entry.queries)
        ]

    def count(self, client: str) -> int:
        """Return the number of a client's requests that still need an answer."""
        return sum(entry.client == client for entry in self.unanswered)

    @property
    def clients(self) -> int:
        """Number of clients with pending requests."""
        return len({entry.client for entry in self.unanswered})

    def owns(self, job: int) -> bool:
        """Return whether a computation belongs to a request."""
        return job in self._planning

    def add(self, entry: PendingPlan) -> None:
        """Add a request that waits for a worker."""
        self._waiting.append(entry.client, entry)

    def displaced_by(self, client: str) -> PendingPlan | None:
        """Remove and return the newest request of the client that has the most waiting.

        Returns:
            The request; None if `client` would then have as many waiting requests or more, so that
            nothing is removed.
        """
        if not self._waiting:
            return None
        largest = self._waiting.largest_sender
        if self._waiting.count(largest) <= self._waiting.count(client) + 1:
            return None
        return self._waiting.pop_newest(largest)

    def next_for_worker(self, ahead: int) -> PendingPlan | None:
        """Move the next waiting request to the workers and return it, if there is one to move.

        Args:
            ahead: number of jobs that each worker may have in addition to its current one.
        """
        if not self._waiting or len(self._planning) >= self._workers * (1 + ahead):
            return None
        entry = self._waiting.pop()
        self._planning[entry.job] = entry
        return entry

    def drop(self, entry: PendingPlan) -> bool:
        """Drop a request; return whether a worker has its job, which must be stopped."""
        if entry.job in self._planning:
            entry.dropped = True
            return True
        self._waiting.remove(entry.client, entry)
        return False

    def finish(self, job: int) -> PendingPlan:
        """Remove and return a request whose computation has finished."""
        return self._planning.pop(job)
