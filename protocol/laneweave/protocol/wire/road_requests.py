"""Requests of operators to close parts of lanes, or to open them again (`laneweave.road.*/1`)."""

from __future__ import annotations

from typing import Any, Final

from attrs import field, frozen
from attrs.validators import optional

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import one_of, within
from laneweave.protocol.road_layout import LONGEST_ROAD_M
from laneweave.protocol.structuring import json_form, structure

REQUEST_SCHEMA: Final = "laneweave.road.request/1"
RESPONSE_SCHEMA: Final = "laneweave.road.response/1"
CLOSE: Final = "close"
OPEN: Final = "open"
LONGEST_CLEAR_S = 600.0
"""Longest time for which a lane is cleared."""

_position = within(0.0, LONGEST_ROAD_M)
_time = within(0.0, 1e6, open_low=True)


@frozen(kw_only=True)
class RoadRequest:
    """Request to close a part of a lane, or to open all closed parts that overlap one."""

    action: str = field(validator=one_of(CLOSE, OPEN))
    lane: int = field(validator=within(0, 7))
    from_m: float = field(default=0.0, validator=_position)
    to_m: float = field(default=LONGEST_ROAD_M, validator=_position)
    for_s: float | None = field(default=None, validator=optional(_time))
    """Time for which it is closed [s of road time]; None: until it is opened."""
    clear_s: float = field(default=20.0, validator=within(0.0, LONGEST_CLEAR_S))
    """Time for which it is cleared at most, until no vehicle need brake hard for it."""

    def to_dict(self) -> dict[str, Any]:
        """Return the request as a map."""
        return {"schema": REQUEST_SCHEMA, **json_form(self)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> RoadRequest:
        """Read a request.

        Raises:
            BadInputError: names the field that is wrong.
        """
        return structure(_content(data, REQUEST_SCHEMA), cls)


@frozen(kw_only=True)
class PartOfLane:
    """A part of a lane that is closed, or open again."""

    lane: int
    from_m: float
    to_m: float
    until_s: float | None = None
    """Road time at which it is opened; None: when an operator opens it."""


@frozen(kw_only=True)
class RoadResponse:
    """What has been done."""

    t_s: float
    """Road time."""
    parts: tuple[PartOfLane, ...]
    """The parts that are closed, or open again."""
    leave_m: float | None = None
    """Distance before a closed part from which vehicles can leave the lane without braking."""
    nearer: tuple[str, ...] = ()
    """Vehicles in the lane that are nearer, and may have to stop."""

    def to_dict(self) -> dict[str, Any]:
        """Return the response as a map."""
        return {"schema": RESPONSE_SCHEMA, **json_form(self)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> RoadResponse:
        """Read a response.

        Raises:
            BadInputError: names the field that is wrong.
        """
        return structure(_content(data, RESPONSE_SCHEMA), cls)


def _content(data: dict[str, Any], schema: str) -> dict[str, Any]:
    if data.get("schema") != schema:
        raise BadInputError("schema", data.get("schema"), repr(schema))
    return {key: value for key, value in data.items() if key != "schema"}
