"""The state of a deployment, made of what an observer heard, and whether it is healthy."""

from __future__ import annotations

from collections import Counter
from typing import Any

import attrs
from attrs import frozen

from laneweave.launch.observe.tally import RoadTally, Tally

SCHEMA = "laneweave.status/1"


@frozen
class Candidate:
    """A coordinator."""

    coordinator: str
    incarnation: int
    leading: bool
    """It claims to lead, and was heard within `network.election_s`."""
    term: int | None
    """None, as in the next two: no heartbeat was heard."""
    plans_in_force: int | None
    heard_s_ago: float | None
    token: bool
    """Its liveliness token is there."""


@frozen
class Plans:
    """What is in force."""

    in_force: int
    """As the leader says."""
    operation: str | None
    """`formations` or `rolling`, by what vehicles show; None: they show too little."""
    formations: int | None
    """Closed formations on the road, as the census lists them; None: there is no such list."""
    formations_with_plan: int | None
    """Those of them of which a vehicle shows that it has accepted a plan."""


@frozen
class Road:
    """The road of the newest bridge."""

    t_s: float
    advanced_s: float
    """Road time between the first and the last clock that were heard."""
    pace: float | None
    """Road seconds per second."""
    ended: bool
    demanded: int
    entered: int
    on_road: int
    left: int


@frozen
class Vehicles:
    """Who is on the road, by the census, and who speaks for them, by their states."""

    attended: int
    """An agent drives it."""
    unattended: int
    """Its caretaker speaks for it."""
    unheard: int
    """No state of it was heard."""
    agents: int
    """Agents whose tokens are there, of vehicles on the road or announced."""


@frozen
class Loss:
    """Shares of expected messages that did not reach this observer; None: none was expected."""

    clock: float | None
    state: float | None


@frozen
class Status:
    """A deployment as one observer sees it."""

    healthy: bool
    problem: str | None
    """Why it is not."""
    endpoint: str
    realm: str
    listened_s: float
    leader: str | None
    term: int | None
    """The leader's."""
    claims: tuple[str, ...]
    """Who claims to lead; more than one: they have not heard each other yet."""
    candidates: tuple[Candidate, ...]
    plans: Plans
    road: Road | None
    vehicles: Vehicles
    messages_per_s: dict[str, float]
    """By topic, of those that are listened to."""
    loss: Loss

    def to_dict(self) -> dict[str, Any]:
        """Return the status as JSON has it."""
        return {"schema": SCHEMA} | attrs.asdict(self)


def status_of(
    tally: Tally, now_s: float, election_s: float, endpoint: str = "", realm: str = ""
) -> Status:
    """Return what a tally says.

    Args:
        tally: what was heard.
        now_s: the end of listening, on the tally's clock.
        election_s: a coordinator that was not heard for this long does not lead.
        endpoint: where the observer listened.
        realm: in which realm.
    """
    candidates = _candidates(tally, now_s, election_s)
    # As everybody does: the highest term leads; the lowest name among equals.
    claims = sorted(
        (one for one in candidates if one.leading),
        key=lambda one: (-(one.term or 0), one.coordinator),
    )
    leader = claims[0] if claims else None
    road = _road(tally.road)
    listened_s = now_s - tally.began_s
    problem = _problem(tally, candidates, leader, listened_s, election_s)
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
        plans=_plans(tally.road, leader),
        road=road,
        vehicles=_vehicles(tally),
        messages_per_s={
            topic: round(count / listened_s, 2) if listened_s > 0 else 0.0
            for topic, count in sorted(tally.counts.items())
        },
        loss=Loss(_rounded(tally.road.clock_loss), _rounded(tally.road.state_loss)),
    )


def road_problem(tally: Tally, listened_s: float) -> str | None:
    """Return what is wrong with the road, if there is one."""
    first, newest = tally.road.first, tally.road.newest
    if first is None or newest is None:
        if tally.bridges:
            return f"a bridge is there, but its clock was not heard for {listened_s:.1f} s"
        return None
    if newest.ended:
        return None
    if newest.tick == first.tick:
        return f"the road stands still at {newest.t_s:.1f} s for {listened_s:.1f} s"
    if not tally.bridges:
        return f"the bridge has gone at {newest.t_s:.1f} s, before its road had ended"
    return None


def _problem(
    tally: Tally,
    candidates: list[Candidate],
    leader: Candidate | None,
    listened_s: float,
    election_s: float,
) -> str | None:
    if not tally.linked:
        return "the connection to the router was lost"
    if leader is None:
        count = len(candidates)
        there = f"{count} coordinators are there" if count != 1 else "one is there"
        return f"nobody leads: {there if count else 'no coordinator is there'}"
    # One that was killed is silent, however long its token stays.
    heard = Counter(
        one.coordinator
        for one in candidates
        if one.heard_s_ago is not None and one.heard_s_ago < election_s
    )
    for name, processes in heard.items():
        if processes > 1:
            return f"{processes} coordinators are called {name}: names must differ"
    return road_problem(tally, listened_s)


def _candidates(tally: Tally, now_s: float, election_s: float) -> list[Candidate]:
    found = []
    for process in sorted(tally.candidates | (tally.heartbeats.keys() - tally.gone)):
        heartbeat, heard_s = tally.heartbeats.get(process, (None, 0.0))
        fresh = heartbeat is not None and now_s - heard_s < election_s
        if not fresh and process not in tally.candidates:
            continue
        found.append(
            Candidate(
                coordinator=process[0],
                incarnation=process[1],
                leading=heartbeat is not None and fresh and heartbeat.leading,
                term=None if heartbeat is None else heartbeat.term,
                plans_in_force=None if heartbeat is None else heartbeat.formations,
                heard_s_ago=None if heartbeat is None else round(now_s - heard_s, 3),
                token=process in tally.candidates,
            )
        )
    return found


def _plans(road: RoadTally, leader: Candidate | None) -> Plans:
    in_force = (leader.plans_in_force if leader else None) or 0
    states = road.states.values()
    if not states:
        return Plans(in_force, None, None, None)
    # Only in the rolling operation vehicles own cells, or have deeds.
    if any(state.estate or state.deed for state in states):
        return Plans(in_force, "rolling", None, None)
    if road.census is None:
        return Plans(in_force, "formations", None, None)
    closed = road.census.formations
    accepted = {state.formation for state in states if state.accepted}
    planned = sum(
        any(one.first_block <= block <= one.last_block for block in accepted) for one in closed
    )
    return Plans(in_force, "formations", len(closed), planned)


def _road(road: RoadTally) -> Road | None:
    if road.first is None or road.newest is None:
        return None
    clock, advanced_s = road.newest, road.newest.t_s - road.first.t_s
    lasted_s = road.newest_heard_s - road.first_heard_s
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


def _vehicles(tally: Tally) -> Vehicles:
    census = tally.road.census
    names = [entry.vehicle for entry in census.on_road] if census is not None else []
    states = [tally.road.states.get(name) for name in names]
    return Vehicles(
        attended=sum(state is not None and state.attended for state in states),
        unattended=sum(state is not None and not state.attended for state in states),
        unheard=sum(state is None for state in states),
        agents=len(tally.agents),
    )


def _rounded(share: float | None) -> float | None:
    return None if share is None else round(share, 5)
