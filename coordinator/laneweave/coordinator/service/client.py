"""Clients of the planning service.

    with PlanClient("tcp/127.0.0.1:7447") as client:
        response = client.plan(request, timeout_s=10.0)

    async with AsyncPlanClient("tcp/127.0.0.1:7447") as client:
        response = await client.plan(request, timeout_s=10.0)

A client of a deployment, secured or not, reads the deployment's configuration and has a name:

    PlanClient(client_access(Path("deployment.toml"), "dispatch"))

Several threads, or tasks, may share a client. If a coordinator exits before it has answered, or
none is running, the client sends the request again under the same id until its timeout. A request
whose call ends without an answer (timeout, Ctrl-C, cancelled task) is cancelled, as are all
requests of a client that disconnects.

Coordinators serve clients in turn. A client is a certificate's name; on a network that is not
secured, each connection is a client of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType
from typing import Self

from attrs import define

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.service.cancellation import cancel_request
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.queries import (
    CANCELLED,
    INVALID,
    JSON,
    LATE,
    OVERLOADED,
    Refusal,
    format_of,
)
from laneweave.protocol.runtime.transport import Answer
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import connect_blocking
from laneweave.protocol.wire.identities import Identity, parse_identity
from laneweave.protocol.wire.topics import CLIENT_ALIVE, SERVICE, SERVICE_CANCEL, Keys, Party

DEFAULT_TIMEOUT_S = 10.0
LONGEST_ATTEMPT_S = 86_400.0
"""Longest timeout of a query, since Zenoh does not accept arbitrarily long ones."""
FIRST_PAUSE_S = 0.02
"""First pause before a request is sent again; it doubles with each attempt."""
LONGEST_PAUSE_S = 0.5
"""Longest pause, unless a coordinator asks for a longer one."""
CANCEL_S = 1.0
"""Timeout of a cancellation."""


class PlanError(Exception):
    """There is no plan; the message gives the reason in one line."""


class RequestRefusedError(PlanError):
    """The request is not valid."""

    def __init__(self, message: str, field_name: str) -> None:
        """Store the message and the name of the invalid field."""
        super().__init__(message)
        self.field = field_name


class ServiceUnavailableError(PlanError):
    """No coordinator on this network has answered."""


class ServiceOverloadedError(PlanError):
    """The coordinators were overloaded at every attempt."""


class DeadlinePassedError(PlanError):
    """The request's deadline passed before a worker was free."""


class RequestCancelledError(PlanError):
    """The request was cancelled."""


class PlanningFailedError(PlanError):
    """An error occurred in the service."""


@define
class PendingRequest:
    """One plan request over all attempts: decides what to do after each; pure, without a clock.

    A request may be sent repeatedly: planning it twice is harmless. It is sent again if there is no
    answer (its coordinator has exited or is disconnected, and the others have not noticed yet), or
    if its coordinator is overloaded.
    """

    payload: bytes
    """Encoded request; equal bytes are assigned to the same coordinator."""
    timeout_s: float
    begun_s: float
    network: str
    """Endpoint and realm, for errors."""
    _pause_s: float = FIRST_PAUSE_S

    def left_s(self, now_s: float) -> float:
        """Return the remaining time [s]."""
        return self.begun_s + self.timeout_s - now_s

    @property
    def _unavailable(self) -> ServiceUnavailableError:
        """Error of a request for which no coordinator was found in time."""
        awaited = f"no coordinator has answered at {self.network} within {self.timeout_s:g} s"
        return ServiceUnavailableError(awaited)

    @property
    def unanswered(self) -> TimeoutError:
        """Error of a request that a coordinator has received and did not answer in time."""
        return TimeoutError(f"no plan from {self.network} within {self.timeout_s:g} s")

    def after(self, answer: Answer | None, now_s: float) -> PlanResponse | float:
        """Return the plan in an answer, or the pause [s] before sending the request again.

        Raises:
            PlanError: there will be no plan.
        """
        if answer is None:
            # A coordinator may start at any moment, so the last attempt is just before the end.
            left_s = self.left_s(now_s) - FIRST_PAUSE_S
            if left_s <= 0:
                raise self._unavailable
            return min(self._next_pause_s(), left_s)
        if answer.ok:
            return self._read(answer)
        refusal = self._refusal(answer)
        if refusal.code == OVERLOADED:
            pause_s = max(self._next_pause_s(), refusal.retry_after_s or 0.0)
            if self.left_s(now_s) <= pause_s:
                raise ServiceOverloadedError(refusal.message)
            return pause_s
        if refusal.code == INVALID:
            raise RequestRefusedError(refusal.message, refusal.field)
        if refusal.code == LATE:
            raise DeadlinePassedError(refusal.message)
        if refusal.code == CANCELLED:
            raise RequestCancelledError(refusal.message)
        raise PlanningFailedError(refusal.message)

    def _next_pause_s(self) -> float:
        pause_s, self._pause_s = self._pause_s, min(2 * self._pause_s, LONGEST_PAUSE_S)
        return pause_s

    @staticmethod
    def _read(answer: Answer) -> PlanResponse:
        try:
            return PlanResponse.from_dict(_parse(answer))
        except BadInputError as error:
            raise PlanningFailedError(f"the answer is not a plan: {error}") from error

    @staticmethod
    def _refusal(answer: Answer) -> Refusal:
        try:
            return Refusal.from_dict(_parse(answer))
        except BadInputError as error:
            raise PlanningFailedError(f"the answer is not an error reply: {error}") from error


def _parse(answer: Answer) -> dict[str, object]:
    return format_of(answer.payload, answer.encoding).read(answer.payload, "response")


def client_access(config: Path, name: str = "plan", endpoint: str | None = None) -> Access:
    """Return a client's access to the network of a deployment, secured or not.

    Args:
        config: path of DEPLOYMENT.toml.
        name: name of the client; in a secured deployment its certificate is `client.NAME`.
        endpoint: the router's endpoint; overrides the one in the file.

    Raises:
        BadInputError: the file is not valid, or there is no endpoint.
    """
    scenario = load_scenario(config, network__endpoint=endpoint)
    if not scenario.network.endpoint:
        raise BadInputError("network.endpoint", "", "an endpoint, in the file or as an argument")
    return access_of(scenario, Identity(Party.CLIENT, name).common_name)


def _token_key(access: Access, keys: Keys) -> str:
    """Return a new key for the liveliness token of a client."""
    session = uuid.uuid4().hex
    secured = access.credentials is not None
    name = parse_identity(access.identity).name if secured else session
    return keys.key(CLIENT_ALIVE, session=session, client=name)


class _Connection:
    """A session with a router, its liveliness token, and the keys of the service."""

    def __init__(self, access: Access | str) -> None:
        """Connect.

        Args:
            access: access to the network, or just the endpoint of its router.

        Raises:
            BadInputError: no router answers there.
        """
        access = Access(access) if isinstance(access, str) else access
        self._network = f"{access.endpoint}, realm {access.realm},"
        keys = Keys(access.realm)
        self._key = keys.key(SERVICE)
        self._cancel_key = keys.key(SERVICE_CANCEL)
        self._token_key = _token_key(access, keys)
        self._transport = connect_blocking(access, lambda _: None)
        self._transport.announce(self._token_key)
        self._closed = False

    def cancel(self, request_id: str) -> None:
        """Cancel a request of this client, if it is pending; does not wait.

        Its calls of `plan` raise `RequestCancelledError`.

        Args:
            request_id: `id` of the request.
        """
        payload = JSON.write(cancel_request(request_id))
        self._transport.query(self._cancel_key, payload, CANCEL_S, JSON.encoding, self._token_key)

    @contextlib.contextmanager
    def _pending(self, request: PlanRequest, timeout_s: float) -> Iterator[PendingRequest]:
        """Provide a request to send; cancel it if the block ends without an answer."""
        request_id = request.id or uuid.uuid4().hex
        payload = JSON.write(request.to_dict() | {"id": request_id})
        pending = PendingRequest(payload, timeout_s, time.monotonic(), self._network)
        try:
            yield pending
        except PlanError:
            raise
        except TimeoutError:
            self.cancel(request_id)
            raise pending.unanswered from None
        except BaseException:
            self.cancel(request_id)
            raise

    def _ask(self, pending: PendingRequest) -> Future[Answer | None]:
        if self._closed:
            raise ServiceUnavailableError("this client is closed")
        left_s = min(max(0.0, pending.left_s(time.monotonic())), LONGEST_ATTEMPT_S)
        return self._transport.query(
            self._key, pending.payload, left_s, JSON.encoding, self._token_key
        )

    def _close(self) -> None:
        self._closed = True
        self._transport.close()


class PlanClient(_Connection):
    """Blocking client of the planning service."""

    def plan(self, request: PlanRequest, timeout_s: float = DEFAULT_TIMEOUT_S) -> PlanResponse:
        """Send a request and return the plan.

        Args:
            request: the request; if it has no id, it gets one.
            timeout_s: timeout for all attempts together; a coordinator may start meanwhile.

        Raises:
            RequestRefusedError: the request is not valid.
            ServiceUnavailableError: no coordinator has answered within `timeout_s`, or this client
                is closed.
            ServiceOverloadedError: the coordinators were overloaded at every attempt.
            DeadlinePassedError: no worker was free before the request's deadline.
            RequestCancelledError: the request was cancelled.
            PlanningFailedError: an error occurred in the service.
            TimeoutError: a coordinator has the request, and has not answered within `timeout_s`.
        """
        with self._pending(request, timeout_s) as pending:
            while True:
                answer = self._ask(pending).result()
                outcome = pending.after(answer, time.monotonic())
                if isinstance(outcome, PlanResponse):
                    return outcome
                time.sleep(outcome)

    def close(self) -> None:
        """Disconnect; waiting calls raise `ServiceUnavailableError`."""
        self._close()

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect."""
        self.close()


class AsyncPlanClient(_Connection):
    """Client of the planning service for asyncio."""

    async def plan(
        self, request: PlanRequest, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> PlanResponse:
        """Send a request and return the plan; see `PlanClient.plan`."""
        with self._pending(request, timeout_s) as pending:
            while True:
                answer = await asyncio.wrap_future(self._ask(pending))
                outcome = pending.after(answer, time.monotonic())
                if isinstance(outcome, PlanResponse):
                    return outcome
                await asyncio.sleep(outcome)

    async def close(self) -> None:
        """Disconnect; waiting calls raise `ServiceUnavailableError`."""
        await asyncio.to_thread(self._close)

    async def __aenter__(self) -> Self:
        """Return the client."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnect."""
        await self.close()
