"""Cancellation of a plan request."""

from __future__ import annotations

from typing import Any, Final

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.queries import Format

CANCEL_SCHEMA: Final = "laneweave.plan.cancel/1"
"""Schema of a cancellation: a map with `schema` and the `id` of the request to cancel."""


def cancel_request(request_id: str) -> dict[str, Any]:
    """Return the cancellation of a request as a map."""
    return {"schema": CANCEL_SCHEMA, "id": request_id}


def cancelled_id(form: Format, payload: bytes) -> str:
    """Return the id of the request that a payload cancels; empty if it is no cancellation."""
    try:
        data = form.read(payload)
    except BadInputError:
        return ""
    return str(data.get("id", "")) if data.get("schema") == CANCEL_SCHEMA else ""
