"""State of a deployment, and health checks of the deployment and of individual processes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import attrs
from attrs import frozen

from laneweave.launch.observe.road_view import Coordinator, RoadView, claims_of
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COORDINATOR_ALIVE,
    TOPICS,
    VEHICLE_ALIVE,
    Quality,
)

SCHEMA = "laneweave.status/1"
LISTENED = tuple(
    topic for topic in TOPICS if topic.kind is not None and topic.quality is Quality.LATEST
)
"""Topics whose publishers do not wait for slow subscribers, so the observer cannot delay them."""
TOKENS = (COORDINATOR_ALIVE, VEHICLE_ALIVE, BRIDGE_ALIVE)

COORDINATOR, BRIDGE, AGENT = "coordinator", "bridge", "agent"


@frozen
class Plans:
    """The plans in force."""

    in_force: int
    """Number of plans in force, as published by the leader."""
    operation: str | None
    """`formations` or `rolling`, derived from vehicle states; None: unknown."""
    formations: int | None
    """Number of closed formations in the census; None: unknown."""
    formations_with_plan: int | None
    """Number of these formations in which a vehicle has accepted a plan."""


@frozen
class Road:
    """The road of the newest bridge."""

    t_s: float
    advanced_s: float
    """Road time between the first and the last received clock."""
    pace: float | None
    """Road seconds per second."""
    ended: bool
    demanded: int
    entered: int
    on_road: int
    left: int


@frozen
class Vehicles:
    """Vehicle counts in the census, by the sender of the vehicles' states."""

    attended: int
    """Vehicles driven by an agent."""
    unattended: int
    """Vehicles without an agent; caretakers publish their states."""
    unheard: int
    """Vehicles from which no state was received."""
    agents: int
    """Agents with a token, including those of announced vehicles."""


@frozen
class Status:
    """Observed state and health of a deployment."""

    healthy: bool
    problem: str | None
    """Why the deployment is unhealthy; None: it is healthy."""
    endpoint: str
    realm: str
    listened_s: float
    leader: str | None
    term: int | None
    """Term of the leader."""
    claims: tuple[str, ...]
    """Coordinators that claim to lead; several until they have received each other's heartbeats."""
    candidates: tuple[Coordinator, ...]
    plans: Plans
    road: Road | None
    vehicles: Vehicles
    messages_per_s: dict[str, float]
    """Rate of received messages by topic."""

    def to_dict(self) -> dict[str, Any]:
        """Return the status as a JSON object."""
        return {"schema": SCHEMA} | attrs.asdict(self)


def status_of(
    view: RoadView,
    began_s: float,
    now_s: float,
    election_s: float,
    endpoint: str = "",
    realm: str = "",
) -> Status:
    """Return the status of a deployment.

    Args:
        view: observed state.
        began_s: when observation began, on the clock of the observer.
        now_s: current time on this clock.
        election_s: time without a heartbeat after which a coordinator no longer leads.
        endpoint: endpoint of the router.
        realm: realm of the deployment.
    """
    candidates = [
        one
        for one in view.coordinators(now_s, election_s)
        if one.token or one.is_active(election_s)
    ]
    claims = claims_of(candidates)
    leader = claims[0] if claims else None
    listened_s = now_s - began_s
    problem = _problem(view, candidates, leader, listened_s, election_s)
    return Status(
        healthy=problem is None,
        problem=problem,
        endpoint=endpoint,
        realm=realm,
        listened_s=round(listened_s, 3),
        leader=leader.coordinator if leader else None,
        term=leader.term if leader else None,
        claims=tuple(one.coordinator for one in claims),
        candidates=tuple(candidates),
        plans=_plans(view, leader),
        road=_road(view),
        vehicles=_vehicles(view),
        messages_per_s={
            topic: round(count / listened_s, 2) if listened_s > 0 else 0.0
            for topic, count in sorted(view.message_counts.items())
        },
    )


@frozen
class RoleHealth:
    """Health check of a process or of the agents of a shard."""

    role: str
    """`COORDINATOR`, `BRIDGE` or `AGENT`."""
    name: str = ""
    """Name of the coordinator, the vehicle or the shard."""
    in_shard: Callable[[str], bool] | None = None
    """Returns whether a vehicle belongs to the shard; None: not the check of a shard."""

    def problem(
        self, view: RoadView, began_s: float, now_s: float, election_s: float
    ) -> str | None:
        """Return a description of the problem, or None; arguments as in `status_of`."""
        if not view.linked:
            return LINK_LOST
        if self.role == COORDINATOR:
            return self._coordinator_problem(view, now_s, election_s)
        if self.role == BRIDGE:
            if not view.bridge_tokens:
                return "no bridge found"
            return _road_problem(view, now_s - began_s)
        if self.in_shard is not None:
            return self._shard_problem(view, self.in_shard)
        return None if self.name in view.agent_tokens else f"no agent of {self.name} found"

    def may_end_early(self, view: RoadView) -> bool:
        """Return whether the observed state suffices to conclude that there is no problem."""
        return self.in_shard is None or view.census is not None

    def _coordinator_problem(self, view: RoadView, now_s: float, election_s: float) -> str | None:
        found = [
            one
            for one in view.coordinators(now_s, election_s)
            if one.token and one.coordinator == self.name
        ]
        if not found:
            return f"no coordinator {self.name} found"
        if any(one.is_active(election_s) for one in found):
            return None
        return f"no heartbeat of coordinator {self.name} for {election_s:g} s"

    def _shard_problem(self, view: RoadView, in_shard: Callable[[str], bool]) -> str | None:
        """Return the problem of a shard; a shard without vehicles on the road is healthy."""
        unattended = [
            entry.vehicle
            for entry in (view.census.on_road if view.census is not None else ())
            if in_shard(entry.vehicle)
            and (
                entry.vehicle not in view.agent_tokens
                or (entry.vehicle in view.states and not view.states[entry.vehicle].attended)
            )
        ]
        if not unattended:
            return None
        count = len(unattended)
        vehicles = "1 vehicle" if count == 1 else f"{count} vehicles"
        return f"shard {self.name}: {vehicles} without an agent, such as {unattended[0]}"


LINK_LOST = "the connection to the router was lost"


def _problem(
    view: RoadView,
    candidates: list[Coordinator],
    leader: Coordinator | None,
    listened_s: float,
    election_s: float,
) -> str | None:
    if not view.linked:
        return LINK_LOST
    if leader is None:
        count = len(candidates)
        found = "one coordinator" if count == 1 else f"{count or 'no'} coordinators"
        return f"there is no leader: {found} found"
    # The token of a killed process may persist, so only processes with heartbeats count.
    active = Counter(one.coordinator for one in candidates if one.is_active(election_s))
    for name, processes in active.items():
        if processes > 1:
            return f"{processes} coordinators have the name {name}, which must be unique"
    return _road_problem(view, listened_s)


def _road_problem(view: RoadView, listened_s: float) -> str | None:
    """Return the problem of the road; None if there is no problem or no road."""
    first, newest = view.first_clock, view.clock
    if first is None or newest is None:
        if view.bridge_tokens:
            return f"no clock of the bridge for {listened_s:.1f} s"
        return None
    if newest.ended:
        return None
    if newest.tick == first.tick:
        return f"the road clock has not advanced beyond {newest.t_s:.1f} s for {listened_s:.1f} s"
    if not view.bridge_tokens:
        return f"the bridge disappeared at {newest.t_s:.1f} s, before the end of its road"
    return None


def _plans(view: RoadView, leader: Coordinator | None) -> Plans:
    in_force = (leader.plans_in_force if leader else None) or 0
    states = view.states.values()
    if not states:
        return Plans(in_force, None, None, None)
    # Vehicles own cells and transfer them only in the rolling operation.
    if any(state.record.owned or state.record.transfer for state in states):
        return Plans(in_force, "rolling", None, None)
    if view.census is None:
        return Plans(in_force, "formations", None, None)
    closed = view.census.formations
    accepted = {state.block for state in states if state.accepted}
    planned = sum(
        any(one.first_block <= block <= one.last_block for block in accepted) for one in closed
    )
    return Plans(in_force, "formations", len(closed), planned)


def _road(view: RoadView) -> Road | None:
    first, clock = view.first_clock, view.clock
    if first is None or clock is None:
        return None
    advanced_s = clock.t_s - first.t_s
    lasted_s = view.clock_received_s - view.first_clock_received_s
    return Road(
        t_s=round(clock.t_s, 3),
        advanced_s=round(advanced_s, 3),
        pace=round(advanced_s / lasted_s, 2) if lasted_s > 0 else None,
        ended=clock.ended,
        demanded=clock.demanded,
        entered=clock.entered,
        on_road=clock.on_road,
        left=clock.left,
    )


def _vehicles(view: RoadView) -> Vehicles:
    entries = view.census.on_road if view.census is not None else ()
    states = [view.states.get(entry.vehicle) for entry in entries]
    return Vehicles(
        attended=sum(state is not None and state.attended for state in states),
        unattended=sum(state is not None and not state.attended for state in states),
        unheard=sum(state is None for state in states),
        agents=len(view.agent_tokens),
    )
