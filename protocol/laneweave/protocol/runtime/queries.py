"""Queries and their answers as maps in JSON or MessagePack; answers use their query's encoding."""

from __future__ import annotations

import codecs
import json
import math
from collections.abc import Callable
from typing import Any, Final, Protocol

import msgpack
from attrs import frozen

from laneweave.protocol.errors import BadInputError, one_line
from laneweave.protocol.runtime.node import Reply

INVALID: Final = "invalid"
"""The request is not valid; sending it again does not help."""
OVERLOADED: Final = "overloaded"
"""The server is overloaded; sending the request again later may help."""
LATE: Final = "late"
"""The deadline passed before a worker was free."""
CANCELLED: Final = "cancelled"
"""The client has cancelled the request."""
FAILED: Final = "failed"
"""It failed because of an error in the server."""
REFUSED: Final = "refused"
"""It is not possible now."""
CODES: Final = (INVALID, OVERLOADED, LATE, CANCELLED, FAILED, REFUSED)


@frozen
class Refusal:
    """Error reply: the reason why the request is not fulfilled."""

    code: str
    """One of `CODES`."""
    message: str
    """One readable line."""
    field: str
    """The invalid field of the request; empty: no particular field."""
    retry_after_s: float | None = None
    """Time after which the request should be sent again [s]; None: unknown, or never."""

    def to_dict(self) -> dict[str, Any]:
        """Return the error reply as a map."""
        data = {"field": self.field, "message": self.message, "code": self.code}
        if self.retry_after_s is None:
            return data
        return data | {"retry_after_s": self.retry_after_s}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Refusal:
        """Read an error reply; a missing code is `INVALID` if a field is named, else `FAILED`."""
        field = one_line(str(data.get("field", "")))
        message = one_line(str(data.get("message", "")))
        code = str(data.get("code", INVALID if field else FAILED))
        return cls(code, message, field, _seconds(data.get("retry_after_s")))


def _seconds(value: object) -> float | None:
    """Return a positive, finite number of seconds; None for anything else."""
    if isinstance(value, int | float) and math.isfinite(value) and value > 0:
        return float(value)
    return None


class Answer(Protocol):
    """Answer to a query, which can be sent as a map."""

    def to_dict(self) -> dict[str, Any]:
        """Return the answer as a map."""


@frozen
class Format:
    """One of the two encodings of a map."""

    encoding: str
    """MIME type."""
    write: Callable[[dict[str, Any]], bytes]
    parse: Callable[[bytes], object]

    def read(self, payload: bytes, name: str = "request") -> dict[str, Any]:
        """Return the map in a payload.

        Args:
            payload: bytes of a message.
            name: what the payload is, for errors.

        Raises:
            BadInputError: the payload is not a map in this encoding.
        """
        try:
            data = self.parse(payload)
        except Exception as error:
            # Parsers raise many kinds of errors: not text, too deep, too many digits, truncated.
            raise BadInputError(name, payload[:16], f"a map in {self.encoding}") from error
        if not isinstance(data, dict):
            raise BadInputError(name, type(data).__name__, f"a map in {self.encoding}")
        return data

    def reply(self, token: int, answer: Answer) -> Reply:
        """Return the effect that answers a query."""
        ok = not isinstance(answer, Refusal)
        return Reply(token, self.write(answer.to_dict()), ok=ok, encoding=self.encoding)


JSON: Final = Format("application/json", lambda data: json.dumps(data).encode(), json.loads)
MSGPACK: Final = Format("application/msgpack", msgpack.packb, msgpack.unpackb)


def format_of(payload: bytes, encoding: str) -> Format:
    """Return the format of a payload, from its encoding if known, else from its first byte."""
    kind = encoding.partition(";")[0]
    for form in (JSON, MSGPACK):
        if kind == form.encoding:
            return form
    # Only with a byte-order mark can JSON text begin like a MessagePack map.
    looks_packed = payload[:1] >= b"\x80" and not payload.startswith(codecs.BOM_UTF8)
    return MSGPACK if looks_packed else JSON
