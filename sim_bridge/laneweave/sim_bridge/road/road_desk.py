"""The operators' desk: closes parts of lanes on request, and opens them again.

A request to close a part waits until the part has been cleared. If vehicles are still in it then,
or could not stop before it, the request is refused, and the lane stays open.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import structlog
from attrs import define, field

from laneweave.protocol.config.road_checks import check_event
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import TemporaryClosure
from laneweave.protocol.runtime.node import QueryArrived, Reply
from laneweave.protocol.runtime.queries import (
    INVALID,
    OVERLOADED,
    REFUSED,
    Format,
    Refusal,
    format_of,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import RoadEvent
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.obstacle_messages import BREAKDOWN, CLOSED
from laneweave.protocol.wire.road_requests import (
    CLOSE,
    PartOfLane,
    RoadRequest,
    RoadResponse,
)
from laneweave.sim_bridge.road.obstacles import ActiveObstacle, Obstacles
from laneweave.sim_bridge.road.vehicle import RoadVehicle

log = structlog.get_logger(__name__)

HAS_ENDED = Refusal(REFUSED, "the road has ended", "")
MAX_WAITING = 32
"""Maximum number of requests that wait until their parts have been cleared."""


@define
class _Waiting:
    """A request whose part is being cleared."""

    token: int
    form: Format
    event: RoadEvent

    @property
    def part(self) -> TemporaryClosure:
        """The part."""
        return TemporaryClosure(self.event.lane, self.event.from_m, self.event.to_m)


@define
class RoadDesk:
    """Requests of operators."""

    _scenario: Scenario
    _obstacles: Obstacles
    _waiting: list[_Waiting] = field(factory=list)
    _ended: bool = False

    def take(self, query: QueryArrived, t_s: float) -> Iterator[Reply]:
        """Handle a query; it is answered now, or once its part is closed.

        Args:
            query: the query.
            t_s: road time.
        """
        form = format_of(query.payload, query.encoding)
        if self._ended:
            yield form.reply(query.token, HAS_ENDED)
            return
        try:
            request = RoadRequest.from_dict(form.read(query.payload))
            if request.action != CLOSE:
                yield form.reply(query.token, self._open(request, t_s))
                return
            event = self._event(request, t_s)
        except BadInputError as error:
            yield form.reply(query.token, Refusal(INVALID, str(error), error.field))
            return
        if len(self._waiting) >= MAX_WAITING:
            text = f"{MAX_WAITING} requests are waiting already"
            yield form.reply(query.token, Refusal(OVERLOADED, text, ""))
            return
        self._obstacles.request(event)
        self._waiting.append(_Waiting(query.token, form, event))

    def update(self, vehicles: Mapping[Name, RoadVehicle], t_s: float) -> Iterator[Reply]:
        """Answer the requests whose parts have been closed, or cannot be.

        Args:
            vehicles: the vehicles on the road.
            t_s: road time.
        """
        for one in list(self._waiting):
            answer = self._answer(one, vehicles, t_s)
            if answer is not None:
                self._waiting.remove(one)
                yield one.form.reply(one.token, answer)

    def close(self) -> Iterator[Reply]:
        """Refuse all requests that wait: the run ends."""
        self._ended = True
        waiting, self._waiting = self._waiting, []
        for one in waiting:
            yield one.form.reply(one.token, HAS_ENDED)

    def _event(self, request: RoadRequest, t_s: float) -> RoadEvent:
        """Return the event that a request asks for.

        Raises:
            BadInputError: the part cannot be closed there.
        """
        if self._scenario.sumo.config:
            raise BadInputError("action", request.action, "none in a corridor of a SUMO simulation")
        event = RoadEvent(
            lane=request.lane,
            from_m=request.from_m,
            to_m=request.to_m,
            at_s=t_s,
            for_s=request.for_s,
            clear_s=request.clear_s,
        )
        check_event(self._scenario, "", event)
        parts = [(one.part, one.kind) for one in self._obstacles.active]
        parts += [(one.part, "to be closed") for one in self._waiting]
        for part, kind in parts:
            if _overlaps(part, request):
                where = f"{part.from_m:g} to {part.to_m:g} m"
                text = f"a part that is open: lane {part.lane} is not, {where} ({kind})"
                raise BadInputError("from_m", request.from_m, text)
        return event

    def _answer(
        self, waiting: _Waiting, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> RoadResponse | Refusal | None:
        """Return the answer to a request; None: its part is still being cleared."""
        event = waiting.event
        closed = self._obstacles.closed_for(event)
        if closed is not None:
            leave_m = self._leave_m
            nearer = [
                vehicle.name
                for vehicle in vehicles.values()
                if event.lane in vehicle.lanes_used
                and event.from_m - leave_m < vehicle.state[0] < event.from_m
            ]
            log.info("an operator has closed a part of a lane", lane=event.lane, t_s=t_s)
            return RoadResponse(
                t_s=t_s, parts=(_part(closed),), leave_m=leave_m, nearer=tuple(nearer)
            )
        if not self._obstacles.is_pending(event):
            return Refusal(REFUSED, "it was opened again before it was closed", "")
        if t_s < event.at_s + event.clear_s:
            return None
        problem = self._obstacles.in_the_way(waiting.part, vehicles).problem
        self._obstacles.withdraw(event)
        return Refusal(REFUSED, f"lane {event.lane} stays open: {problem}", "from_m")

    @property
    def _leave_m(self) -> float:
        """Distance before a part from which vehicles can leave its lane before its stop line.

        A plan made now is for the slot after the next begins; a lane change takes a slot.
        """
        slots_m = 3.0 * self._scenario.timing.cycles_s[0] * self._scenario.lattice.speed_mps
        return re_entry(self._scenario).room_m + slots_m

    def _open(self, request: RoadRequest, t_s: float) -> RoadResponse | Refusal:
        """Open the closed parts that a request concerns."""
        found = [one for one in self._obstacles.active if _overlaps(one.part, request)]
        closed = [one for one in found if one.kind == CLOSED and not one.is_over(t_s)]
        withdrawn = [one.event for one in self._waiting if _overlaps(one.part, request)]
        for event in withdrawn:
            self._obstacles.withdraw(event)
        for one in closed:
            one.until_s = t_s
        if not closed and not withdrawn:
            text = f"no part of lane {request.lane} is closed there"
            if any(one.kind == BREAKDOWN for one in found):
                text += " but around a vehicle that has broken down"
            return Refusal(REFUSED, text, "lane")
        parts = [_part(one) for one in closed]
        parts += [
            PartOfLane(lane=one.lane, from_m=one.from_m, to_m=one.to_m, until_s=t_s)
            for one in withdrawn
        ]
        return RoadResponse(t_s=t_s, parts=tuple(parts))


def _overlaps(part: TemporaryClosure, request: RoadRequest) -> bool:
    return part.lane == request.lane and part.from_m < request.to_m and part.to_m > request.from_m


def _part(one: ActiveObstacle) -> PartOfLane:
    until_s = None if math.isinf(one.until_s) else one.until_s
    lane, from_m, to_m, _ = one.part
    return PartOfLane(lane=lane, from_m=from_m, to_m=to_m, until_s=until_s)
