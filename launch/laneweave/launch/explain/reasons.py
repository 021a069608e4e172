"""The reason why a vehicle missed its lane, from the facts about it.

What happened last counts: a plan that leaves the vehicle off its lane explains it only if no later
plan was made, and a lost agent only if the vehicle was still without one. If a vehicle has stopped
before the end of its lane or missed its exit, the sentence also says why it was still there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum

from attrs import frozen

from laneweave.launch.explain.facts import Absence, Facts
from laneweave.launch.explain.story import ABSENCE, described, names, seconds
from laneweave.protocol.wire import events as kinds
from laneweave.protocol.wire import reasons


class Reason(StrEnum):
    """Why a vehicle missed its lane."""

    NO_LEADER = "no-leader"
    """No coordinator led when its formation needed a plan."""
    LATE_LEADER = "late-leader"
    """A coordinator led again only when it was too late for any step."""
    NO_AGENT = "no-agent"
    """Its agent was gone."""
    AGENT_SILENT = "agent-silent"
    """Its agent did not answer."""
    AGENT_LATE = "agent-late"
    """Its agent always answered too late."""
    SETTINGS_REFUSED = "settings-refused"
    """The process that would have led, or driven it, had other settings than the bridge."""
    BLOCKED = "blocked"
    """Vehicles that only held their cells were on its way."""
    NO_ROOM = "no-room"
    """The lanes that lead to its destination had too few cells."""
    CLOSED_LANE = "closed-lane"
    """No lane change was possible from its lane."""
    ROAD_TOO_SHORT = "road-too-short"
    """When its formation closed, it was too late for any step."""
    TOO_LATE = "too-late"
    """When its formation could be planned, it was too late."""
    PLANNING_FAILED = "planning-failed"
    """Planning failed."""
    NO_ANSWER = "no-answer"
    """Vehicles did not answer the leader, so its formation had no plan."""
    NO_PLAN = "no-plan"
    """There was no plan for it; the events do not say why."""
    NOT_COMPLETED = "not-completed"
    """It had a plan but did not complete it; the events do not say why."""
    MISSED_EXIT = "missed-exit"
    """It began its move into or out of an exit lane too late."""
    STOPPED = "stopped-at-lane-end"
    """It stopped before the end of its lane."""
    BROKE_DOWN = "broke-down"
    """It had broken down itself."""
    CLOSED_PART = "closed-part"
    """A part of a lane was closed for a time, or a vehicle of another system was there."""
    METHOD = "method"
    """A reference method drove it, which makes no plans."""


@frozen
class Finding:
    """A reason, and the sentence that states it."""

    reason: Reason
    text: str


_OF_ABSENCE: Mapping[str, Reason] = {
    "absent": Reason.NO_AGENT,
    "silent": Reason.AGENT_SILENT,
    "late": Reason.AGENT_LATE,
}


def reason_of(facts: Facts) -> Finding:
    """Return why a vehicle that has left the road missed its lane."""
    breakdown = facts.breakdown
    if breakdown is not None and not facts.drives_again:
        first = breakdown.first
        text = f"it broke down at {seconds(first['t_s'])}, in lane {first['lane']}"
        return Finding(Reason.BROKE_DOWN, text)
    cause = _cause(facts)
    end = facts.lane_end
    if end is None:
        return cause
    at = f"at {seconds(end['t_s'])}"
    part = facts.stopped_before(end)
    if end["kind"] == kinds.MISSED_EXIT:
        text = f"it began its move to or from the exit lane too late {at}, in lane {end['lane']}"
        reason = Reason.MISSED_EXIT
    elif part is not None:
        text, reason = f"it stopped {at} before {described(part)}", Reason.CLOSED_PART
    else:
        text = f"it stopped before the end of lane {end['lane']} {at}"
        reason = Reason.STOPPED
    known = cause.reason not in (Reason.NOT_COMPLETED, Reason.NO_PLAN, reason)
    return Finding(reason, f"{text}: {cause.text}" if known else text)


def _cause(facts: Facts) -> Finding:
    """Return why no plan brought the vehicle into its lane in time."""
    found = (
        _other_method(facts)
        or _settings(facts)
        or _unreached(facts)
        or _too_late(facts)
        or _own_agent(facts)
        or (_unplanned(facts) if facts.in_force_s is None and not facts.rolling else None)
        or _stalled(facts)
        or _closed(facts)
    )
    return found or Finding(Reason.NOT_COMPLETED, "it had a plan, but has not completed it")


def _other_method(facts: Facts) -> Finding | None:
    off = facts.off_lane
    if off is None or facts.formations or facts.rolling or facts.leader is not None:
        return None
    if "reason" in off or not off.get("attended", True):
        return None
    return Finding(Reason.METHOD, "no plans were made for it: the run's method makes none")


def _settings(facts: Facts) -> Finding | None:
    """Return the reason if a refused process leaves the vehicle without agent or leader."""
    for event in facts.refused:
        role, different = event["process"].split(" ")[0], ", ".join(event["settings"])
        why = f"{event['process']} has other settings than the bridge ({different})"
        if role == "coordinator" and facts.leader is None:
            return Finding(Reason.SETTINGS_REFUSED, f"no coordinator leads: {why}")
        if role != "coordinator" and facts.never_attended:
            return Finding(Reason.SETTINGS_REFUSED, f"it has no agent: {why}")
    return None


def _unreached(facts: Facts) -> Finding | None:
    """Return the reason if the newest plan does not lead the vehicle to its lane."""
    event = facts.out_of_reach
    if event is None:
        return None
    planned = f"the plan of {seconds(event['t_s'])}"
    reason = event.get("reasons", {}).get(facts.vehicle)
    match reason:
        case reasons.NO_AGENT:
            return _absence(_absence_at(facts, event["t_s"]))
        case reasons.BLOCKED:
            by = event["blocked_by"][facts.vehicle]
            return Finding(Reason.BLOCKED, f"blocked by {_with_absences(facts, by)} in {planned}")
        case reasons.NO_ROOM:
            text = f"{planned} had no room for it in its lane: too many vehicles want this lane"
            return Finding(Reason.NO_ROOM, text)
        case reasons.CLOSED_LANE:
            return Finding(
                Reason.CLOSED_LANE, f"no lane change was possible from its lane in {planned}"
            )
        case reasons.TOO_LATE:
            return Finding(Reason.TOO_LATE, f"it was too late for its lane change in {planned}")
        case _:
            pass
    # A plan of the rolling operation, or of an earlier version: other facts say more.
    if facts.absence is not None:
        return _absence(facts.absence)
    if facts.rolling and facts.leaderless_since_s is not None:
        return _no_leader(facts.leaderless_since_s)
    if facts.unanswered and (facts.off_lane or {}).get("reason") == reasons.NO_PLAN:
        return Finding(Reason.NO_ANSWER, "it has accepted none of the plans of the leader")
    if facts.without_agent:
        by = _with_absences(facts, facts.without_agent)
        text = f"{planned} did not reach its lane; without agents, and perhaps on its way: {by}"
        return Finding(Reason.BLOCKED, text)
    no_path = f"{planned} had no path to its lane"
    parts = facts.closed_between(event["t_s"], event["t_s"])
    if parts:
        return Finding(Reason.CLOSED_PART, f"{no_path} because of {described(parts[-1])}")
    return Finding(Reason.NO_ROOM, no_path)


def _closed(facts: Facts) -> Finding | None:
    """Return the reason if a part was closed while a plan was not completed."""
    if facts.entered is None:
        return None
    planned_s = facts.entered["t_s"] if facts.in_force_s is None else facts.in_force_s
    parts = facts.closed_between(planned_s, facts.end_s)
    if not parts:
        return None
    text = f"it had a plan, but has not completed it in the time of {described(parts[-1])}"
    return Finding(Reason.CLOSED_PART, text)


def _too_late(facts: Facts) -> Finding | None:
    """Return the reason if the leader found that no step fits before the end of the road."""
    event = facts.too_late
    if event is None:
        return None
    at = f"at {seconds(event['t_s'])} it was too late for any step"
    reason = event.get("reason")
    if reason == reasons.ROAD_TOO_SHORT:
        closed = f"its formation closed at {seconds(event['closed_s'])}"
        text = f"the road is too short: {closed}, too late for any step"
        return Finding(Reason.ROAD_TOO_SHORT, text)
    if reason == reasons.NO_LEADER:
        gap = facts.gap_before(event["t_s"])
        since = f" from {seconds(gap[0])}" if gap is not None and gap[0] > 0.0 else ""
        text = f"no leader{since} until {seconds(event['since_s'])}, and {at}"
        return Finding(Reason.LATE_LEADER, text)
    absence = facts.absence or _absence_at(facts, event["t_s"])
    if absence is not None:
        # The agent was lost while a plan was under way, and the next plan was too late.
        return _absence(absence)
    if reason == reasons.PLANNING_FAILED:
        return Finding(Reason.PLANNING_FAILED, f"{_planning_failed(facts)}, and {at}")
    others = [name for name in facts.without_agent if name in facts.members]
    if others:
        by = _with_absences(facts, others)
        text = f"{at}: the plan before could not be completed because of {by}"
        return Finding(Reason.BLOCKED, text)
    if facts.awaited is not None:
        waited = names(facts.awaited["vehicles"])
        return Finding(Reason.NO_ANSWER, f"the leader waited for answers of {waited}, and {at}")
    # With a plan in force before, the question is why that was not completed.
    return Finding(Reason.TOO_LATE, at) if facts.in_force_s is None else None


def _own_agent(facts: Facts) -> Finding | None:
    """Return the reason if the vehicle had no agent at the end, and a leader would have planned."""
    absence = facts.absence
    if absence is None or (facts.in_force_s is None and facts.leaderless_since_s is not None):
        return None
    return _absence(absence)


def _unplanned(facts: Facts) -> Finding:
    """Return the reason if no plan for the formation has come into force."""
    since_s = facts.leaderless_since_s
    never_led = facts.leader is None
    if since_s is not None and (facts.closed_s is None or since_s <= facts.closed_s + 1.0):
        return _no_leader(since_s)
    if facts.awaited is not None:
        waited = names(facts.awaited["vehicles"])
        text = f"its formation had no plan: {waited} did not answer the leader"
        return Finding(Reason.NO_ANSWER, text)
    if facts.failed:
        return Finding(Reason.PLANNING_FAILED, _planning_failed(facts))
    if since_s is not None or never_led:
        return _no_leader(since_s or 0.0)
    return Finding(Reason.NO_PLAN, "no plan for it has come into force")


def _planning_failed(facts: Facts) -> str:
    last = facts.failed[-1] if facts.failed else {}
    error = last.get("error") or last.get("status")
    return "planning failed for its formation" + (f" ({error})" if error else "")


def _stalled(facts: Facts) -> Finding | None:
    """Return the reason if a plan was in force, and was not completed."""
    others = [name for name in facts.without_agent if name in facts.members]
    since_s = facts.leaderless_since_s
    if since_s is not None and (others or facts.rolling):
        because = f", and its plan waited for {_with_absences(facts, others)}" if others else ""
        return Finding(Reason.NO_LEADER, f"{_no_leader(since_s).text}{because}")
    if others:
        return Finding(Reason.BLOCKED, f"its plan waited for {_with_absences(facts, others)}")
    if facts.awaited is not None:
        waited = names(facts.awaited["vehicles"])
        return Finding(
            Reason.NO_ANSWER, f"its last plan came not into force: {waited} did not answer"
        )
    gap = facts.gap_before(facts.in_force_s or 0.0)
    if gap is not None and facts.closed_s is not None and gap[1] > facts.closed_s + 1.0:
        since = f" from {seconds(gap[0])}" if gap[0] > 0.0 else ""
        text = f"no leader{since} until {seconds(gap[1])}; the plan after that was not completed"
        return Finding(Reason.LATE_LEADER, text)
    plan = facts.plan_made
    if plan is not None and facts.left is not None and "t0_s" in plan:
        ends_s = plan["t0_s"] + plan["steps"] * plan["slot_s"]
        if ends_s > facts.left["t_s"]:
            steps = f"its plan of {plan['steps']} steps until {seconds(ends_s)}"
            return Finding(Reason.ROAD_TOO_SHORT, f"the road is too short for {steps}")
    if facts.late_slots:
        text = f"{facts.late_slots} plans failed or were late while it was on the road"
        return Finding(Reason.PLANNING_FAILED, text)
    if facts.absences:
        last = facts.absences[-1]
        text = f"{ABSENCE[last.why]} from {seconds(last.since_s)} to {seconds(last.until_s)}"
        return Finding(_OF_ABSENCE[last.why], text)
    return None


def _no_leader(since_s: float) -> Finding:
    when = f"from {seconds(since_s)} on" if since_s > 0.0 else "before it left"
    return Finding(Reason.NO_LEADER, f"no coordinator led {when}")


def _absence_at(facts: Facts, t_s: float) -> Absence | None:
    """Return the newest time without an agent that began before a road time."""
    begun = [one for one in facts.absences if one.since_s <= t_s]
    return begun[-1] if begun else None


def _absence(absence: Absence | None) -> Finding:
    if absence is None:
        return Finding(Reason.NO_AGENT, "no agent drove it when the plan was made")
    until = f" until {seconds(absence.until_s)}" if absence.until_s < float("inf") else ""
    since = f"since {seconds(absence.since_s)}" if not until else f"from {seconds(absence.since_s)}"
    text = f"no agent {since}{until}: {ABSENCE[absence.why]}"
    return Finding(_OF_ABSENCE[absence.why], text)


def _with_absences(facts: Facts, vehicles: Iterable[str]) -> str:
    """Return the names of vehicles, each with the time since which it has no agent."""
    named = []
    for name in vehicles:
        absence = facts.last_absences.get(name)
        named.append(
            name if absence is None else f"{name} (no agent since {seconds(absence.since_s)})"
        )
    return names(named)
