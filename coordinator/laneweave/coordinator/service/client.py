"""Clients of the planning service of a network's coordinators.

    with PlanClient("tcp/127.0.0.1:7447") as client:
        response = client.plan(request, timeout_s=10.0)

    async with AsyncPlanClient("tcp/127.0.0.1:7447") as client:
        response = await client.plan(request, timeout_s=10.0)

On a network that is described by a file, secured or not, a client is named:

    PlanClient(client_access(Path("deployment.toml"), "dispatch"))

A client may be used by many threads, or tasks, at a time. A request is sent again, under its id,
when the coordinator that had it dies.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType
from typing import Self

import attrs

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.service.query import (
    ABSENT_S,
    AskAgain,
    DeadlinePassedError,
    Inquiry,
    PlanError,
    PlanningFailedError,
    RequestRefusedError,
    ServiceOverloadedError,
    ServiceUnavailableError,
)
from laneweave.protocol.config.loading import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.transport import Answer
from laneweave.protocol.security.access import Access
from laneweave.protocol.security.rights import access_of
from laneweave.protocol.transports.zenoh.transport import connect_patiently
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.topics import SERVICE, Keys, Party

__all__ = [
    "AsyncPlanClient",
    "DeadlinePassedError",
    "PlanClient",
    "PlanError",
    "PlanningFailedError",
    "RequestRefusedError",
    "ServiceOverloadedError",
    "ServiceUnavailableError",
    "client_access",
]

DEFAULT_TIMEOUT_S = 10.0
LONGEST_ATTEMPT_S = 86_400.0
"""Zenoh does not accept arbitrarily long timeouts."""


def client_access(config: Path, name: str = "plan", endpoint: str | None = None) -> Access:
    """Return the access of a client to the network of a deployment, secured or not.

    Args:
        config: the DEPLOYMENT.toml.
        name: of the client, whose certificate is `client.NAME` where the deployment is secured.
        endpoint: of the router; overrides that of the file.

    Raises:
        BadInputError: the file is not valid, or there is no endpoint.
    """
    scenario = load_scenario(config, network__endpoint=endpoint)
    if not scenario.network.endpoint:
        raise BadInputError("network.endpoint", "", "an endpoint, in the file or beside it")
    return access_of(scenario, Identity(Party.CLIENT, name).common_name)


class _Connection:
    """A session with a router, and the key of the service."""

    def __init__(self, access: Access | str, patience_s: float = ABSENT_S) -> None:
        """Connect.

        Args:
            access: to the network, or only the endpoint of its router.
            patience_s: without any answer for so long, there is no service.

        Raises:
            BadInputError: no router answers there.
        """
        access = Access(access) if isinstance(access, str) else access
        self._patience_s = patience_s
        self._key = Keys(access.realm).key(SERVICE)
        self._transport = connect_patiently(access, lambda _: None)
        self._closed = False

    def _begin(self, request: PlanRequest, timeout_s: float) -> Inquiry:
        if not request.id:
            request = attrs.evolve(request, id=uuid.uuid4().hex)
        return Inquiry(request, timeout_s, time.monotonic(), patience_s=self._patience_s)

    def _ask(self, inquiry: Inquiry) -> Future[Answer | None]:
        if self._closed:
            raise ServiceUnavailableError("this client is closed")
        left_s = min(max(0.0, inquiry.left_s(time.monotonic())), LONGEST_ATTEMPT_S)
        encoding = inquiry.form.encoding
        return self._transport.ask(self._key, inquiry.payload, left_s, encoding)

    def _close(self) -> None:
        self._closed = True
        self._transport.close()


class PlanClient(_Connection):
    """Blocking client."""

    def plan(self, request: PlanRequest, timeout_s: float = DEFAULT_TIMEOUT_S) -> PlanResponse:
        """Send a request and return the plan.

        Args:
            request: what to plan; one without an id gets one.
            timeout_s: how long to wait, all attempts together.

        Raises:
            RequestRefusedError: the request is not valid.
            ServiceUnavailableError: there is no coordinator, or this client is closed.
            ServiceOverloadedError: the coordinators were overloaded at every attempt.
            DeadlinePassedError: no worker was free before its deadline.
            PlanningFailedError: the service made an error.
            TimeoutError: no answer within `timeout_s`.
        """
        inquiry = self._begin(request, timeout_s)
        while True:
            answer = self._ask(inquiry).result()
            outcome = inquiry.after(answer, time.monotonic())
            if not isinstance(outcome, AskAgain):
                return outcome
            time.sleep(outcome.pause_s)

    def close(self) -> None:
        """Leave the network; calls that wait for a plan raise `ServiceUnavailableError`."""
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
        """Leave the network."""
        self.close()


class AsyncPlanClient(_Connection):
    """Client for asyncio."""

    async def plan(
        self, request: PlanRequest, timeout_s: float = DEFAULT_TIMEOUT_S
    ) -> PlanResponse:
        """Send a request and return the plan; as `PlanClient.plan`."""
        inquiry = self._begin(request, timeout_s)
        while True:
            answer = await asyncio.wrap_future(self._ask(inquiry))
            outcome = inquiry.after(answer, time.monotonic())
            if not isinstance(outcome, AskAgain):
                return outcome
            await asyncio.sleep(outcome.pause_s)

    async def close(self) -> None:
        """Leave the network; calls that wait for a plan raise `ServiceUnavailableError`."""
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
        """Leave the network."""
        await self.close()
