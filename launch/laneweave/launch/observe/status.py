"""State of a deployment, as `laneweave status` prints it; `findings` says what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
from attrs import frozen

from laneweave.launch.observe.findings import Finding
from laneweave.launch.observe.road_view import Coordinator, RoadView, claims_of
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COORDINATOR_ALIVE,
    PROCESS_ALIVE,
    TOPICS,
    VEHICLE_ALIVE,
    Quality,
)

SCHEMA = "laneweave.status/1"
LISTENED = tuple(
    topic for topic in TOPICS if topic.kind is not None and topic.quality is Quality.LATEST
)
"""Topics whose publishers do not wait for slow subscribers, so the observer cannot delay them."""
TOKENS = (COORDINATOR_ALIVE, VEHICLE_ALIVE, BRIDGE_ALIVE, PROCESS_ALIVE)


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
    """The gravest finding; None: the deployment is healthy."""
    findings: tuple[Finding, ...]
    """All findings."""
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
    findings: Sequence[Finding],
    began_s: float,
    now_s: float,
    election_s: float,
    endpoint: str = "",
    realm: str = "",
) -> Status:
    """Return the status of a deployment.

    Args:
        view: observed state.
        findings: what is wrong, the gravest first.
        began_s: when observation began, on the clock of the observer.
        now_s: current time on this clock.
        election_s: time without a heartbeat after which a coordinator no longer leads.
        endpoint: endpoint of the router.
        realm: realm of the deployment.
    """
    candidates = view.candidates(now_s, election_s)
    claims = claims_of(candidates)
    leader = claims[0] if claims else None
    listened_s = now_s - began_s
    return Status(
        healthy=not findings,
        problem=findings[0].what if findings else None,
        findings=tuple(findings),
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
