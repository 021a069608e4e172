"""One plan request of a client, and what to do after each attempt: pure, without a clock.

A request may be sent repeatedly: coordinators recognise it by its id, and planning it twice does no
harm. It is sent again if there is no answer (its coordinator was killed or is cut off, and the
others do not know yet), or if its coordinator is overloaded.
"""

from __future__ import annotations

from attrs import define, field, frozen

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.service.format import (
    INVALID,
    JSON,
    LATE,
    OVERLOADED,
    Format,
    Refusal,
    format_of,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.transport import Answer

FIRST_PAUSE_S = 0.02
LONGEST_PAUSE_S = 0.5
ABSENT_S = 3.0
"""A coordinator that is killed is given up at once, one that hangs after `network.lease_s`, and a
new router is found in less than a second."""


class PlanError(Exception):
    """A request was not planned; the message says why, in one line."""


class RequestRefusedError(PlanError):
    """The request is not valid."""

    def __init__(self, message: str, field_name: str) -> None:
        """Store the line and the field that it is about."""
        super().__init__(message)
        self.field = field_name


class ServiceUnavailableError(PlanError):
    """No answer: no coordinator can be reached on this network."""


class ServiceOverloadedError(PlanError):
    """The coordinators were overloaded at every attempt."""


class DeadlinePassedError(PlanError):
    """The request's deadline passed before a worker was free."""


class PlanningFailedError(PlanError):
    """The service made an error."""


@frozen
class AskAgain:
    """Send the request again after a pause."""

    pause_s: float


@define
class Inquiry:
    """State of a request over all attempts."""

    request: PlanRequest
    timeout_s: float
    begun_s: float
    form: Format = JSON
    patience_s: float = ABSENT_S
    """Without any answer for so long there is no service [s]."""
    _pause_s: float = FIRST_PAUSE_S
    _absent_since_s: float | None = field(default=None)

    @property
    def payload(self) -> bytes:
        """Bytes of the request; the same each time, so the same coordinator is assigned to it."""
        return self.form.write(self.request.to_dict())

    def left_s(self, now_s: float) -> float:
        """Return the time left [s]."""
        return self.begun_s + self.timeout_s - now_s

    def after(self, answer: Answer | None, now_s: float) -> PlanResponse | AskAgain:
        """Return the plan, or that the request should be sent again.

        Args:
            answer: to the newest attempt; None: there was none.
            now_s: on the clock of `begun_s`.

        Raises:
            PlanError: there will be no plan.
        """
        if answer is None:
            return self._after_silence(now_s)
        self._absent_since_s = None
        if answer.ok:
            return self._read(answer)
        refusal = self._refusal(answer)
        if refusal.code == OVERLOADED:
            return self._pause(now_s, ServiceOverloadedError(refusal.message))
        if refusal.code == INVALID:
            raise RequestRefusedError(refusal.message, refusal.field)
        if refusal.code == LATE:
            raise DeadlinePassedError(refusal.message)
        raise PlanningFailedError(refusal.message)

    def _after_silence(self, now_s: float) -> AskAgain:
        since_s = now_s if self._absent_since_s is None else self._absent_since_s
        self._absent_since_s = since_s
        absent = ServiceUnavailableError("no coordinator answers on this network and realm")
        if now_s >= since_s + self.patience_s:
            raise absent
        return self._pause(now_s, absent)

    def _pause(self, now_s: float, otherwise: PlanError) -> AskAgain:
        """Try again after a growing pause, unless no time is left for it."""
        pause_s, self._pause_s = self._pause_s, min(2 * self._pause_s, LONGEST_PAUSE_S)
        if self.left_s(now_s) <= pause_s:
            raise otherwise
        return AskAgain(pause_s)

    @staticmethod
    def _read(answer: Answer) -> PlanResponse:
        try:
            return PlanResponse.from_dict(_parse(answer))
        except BadInputError as error:
            raise PlanningFailedError(f"the answer is no plan: {error}") from error

    @staticmethod
    def _refusal(answer: Answer) -> Refusal:
        try:
            return Refusal.from_dict(_parse(answer))
        except BadInputError as error:
            raise PlanningFailedError(f"the answer is no error reply: {error}") from error


def _parse(answer: Answer) -> dict[str, object]:
    return format_of(answer.payload, answer.encoding).read(answer.payload)
