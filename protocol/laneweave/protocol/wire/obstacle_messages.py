"""Message about parts of lanes that are closed for a time."""

from __future__ import annotations

from typing import Final

from laneweave.protocol.names import Name
from laneweave.protocol.road_layout import ClearedPart, TemporaryClosure, TemporaryParts
from laneweave.protocol.wire.field_types import Int64, Message, Real

BREAKDOWN: Final = "breakdown"
CLOSED: Final = "closed"
PASSING: Final = "passing"


class Obstacle(Message, frozen=True):
    """Part of a lane that is closed for a time; part of `Obstacles`."""

    lane: Int64
    from_m: Real
    """Where it begins [m]."""
    to_m: Real
    """Where the lane is open again [m]."""
    late_m: Real = 0.0
    """Length of the queue of vehicles that cannot stop at the stop line, before the part [m]."""
    cause: str = CLOSED
    """`breakdown`: a vehicle has broken down; `closed`: an event of the road, or an operator;
    `passing`: a slow vehicle of another system is there now."""
    since_s: Real = 0.0
    """Road time at which the lane was closed."""
    until_s: Real | None = None
    """Road time at which the cause ends; None: not known. The part stays closed until no vehicle
    waits there any more."""
    vehicle: Name | None = None
    """The vehicle that has broken down, or that is passing."""
    speed_mps: Real = 0.0
    """Speed of a vehicle that is passing."""

    @property
    def identity(self) -> tuple[int, float, Name | None, float]:
        """What stays the same while the part becomes longer or shorter."""
        return self.lane, self.from_m, self.vehicle, self.since_s


class Cleared(Message, frozen=True):
    """Part of a lane that vehicles leave, and that none may enter; part of `Obstacles`."""

    lane: Int64
    from_m: Real
    """Where it begins at road time `at_s` [m]."""
    to_m: Real
    speed_mps: Real
    at_s: Real
    cause: str = CLOSED
    """`closed`: it will be closed; `passing`: for a vehicle of another system."""
    vehicle: Name | None = None
    """This vehicle."""
    front_m: Real = 0.0
    """Where its front is at `at_s` [m]."""
    length_m: Real = 0.0


class Obstacles(Message, frozen=True):
    """Bridge to coordinators, agents and observers: parts of lanes that are not open as always.

    Sent with each census, from the first part on. Missing: the receiver uses the older one. Motion
    controllers know all parts, so a move into a closed part does not begin, and a vehicle that
    brakes for a part that is open again is only late. Duplicated or older than the newest: ignored.
    """

    t_s: Real
    parts: tuple[Obstacle, ...] = ()
    bridge: Int64 = 0
    """Incarnation of the bridge [ns]; 0: not given."""
    cleared: tuple[Cleared, ...] = ()

    @property
    def temporary(self) -> TemporaryParts:
        """The parts, as lane ends are derived from them."""
        return TemporaryParts(
            tuple(
                TemporaryClosure(one.lane, one.from_m, one.to_m, one.late_m) for one in self.parts
            ),
            tuple(
                ClearedPart(one.lane, one.from_m, one.to_m, one.speed_mps, one.at_s)
                for one in self.cleared
            ),
        )
