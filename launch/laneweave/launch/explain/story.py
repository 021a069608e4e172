"""Events in words: the lines of a vehicle's story."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import groupby
from typing import Any

from attrs import frozen

from laneweave.launch.explain.facts import LEADER_LOST, Facts
from laneweave.launch.recordings.closed_parts import RecordedClosure
from laneweave.launch.recordings.events import Event
from laneweave.protocol.names import first_names
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.wire import events as kinds
from laneweave.protocol.wire import obstacle_messages

MAX_NAMES = 6
"""Maximum number of vehicles that a line names."""


@frozen
class StoryLine:
    """What happened at a road time."""

    t_s: float
    kind: str
    """Kind of the event; `leader-lost` for the last heartbeat of a leader."""
    text: str


def names(vehicles: Collection[str]) -> str:
    """Return the names of vehicles, the first ones if they are many."""
    return first_names(vehicles, MAX_NAMES)


def seconds(t_s: float) -> str:
    """Return a road time as text."""
    return f"{t_s:.1f} s"


def wanted(entered: Event) -> str:
    """Return where a vehicle wants to leave the road."""
    lane, destination = entered["preferred_lane"], entered.get("destination", END_OF_ROAD)
    if destination != END_OF_ROAD:
        return f"exit {destination}"
    return "any lane to the end of the road" if lane == ANY_LANE else f"lane {lane}"


def story_of(facts: Facts) -> tuple[StoryLine, ...]:
    """Return the lines of a story; equal ones that follow one another are merged."""
    lines = list[StoryLine]()
    for text, group in groupby(_lines(facts), key=lambda line: line.text):
        first, *others = group
        again = f" ({len(others)} more until {seconds(others[-1].t_s)})" if others else ""
        lines.append(StoryLine(first.t_s, first.kind, f"{text}{again}"))
    return tuple(lines)


def _lines(facts: Facts) -> Iterator[StoryLine]:
    """Yield a line for each event, or for those of several vehicles at the same time."""
    for (t_s, kind, _), group in groupby(facts.events, key=lambda event: _key(facts, event)):
        events = list(group)
        if kind in _CHARGE and events[0]["vehicle"] != facts.vehicle:
            text = _of_others(kind, events)
        elif kind == kinds.LEFT_LATTICE:
            text = _stops(facts, events[0])
        elif kind == kinds.PART_CLOSED and events[0].get("vehicle") == facts.vehicle:
            text = f"breaks down in lane {events[0]['lane']}"
        else:
            text = _TEXTS[kind](events[0]) if kind in _TEXTS else ""
        if text:
            yield StoryLine(t_s, kind, text)


def _key(facts: Facts, event: Event) -> tuple[float, str, object]:
    kind, t_s = event["kind"], float(event["t_s"])
    if kind in _CHARGE and event["vehicle"] != facts.vehicle:
        return t_s, kind, event.get("reason")
    return t_s, kind, id(event)


def _of_others(kind: str, events: list[Event]) -> str:
    vehicles = names([event["vehicle"] for event in events])
    if kind == kinds.CARETAKER_TOOK_OVER:
        return f"no agent for {vehicles} of its formation: {ABSENCE[events[0]['reason']]}"
    return f"agent in charge of {vehicles} again"


def _entered(event: Event) -> str:
    return f"entered in lane {event['lane']}; wants {wanted(event)}"


def _left(event: Event) -> str:
    by = "" if event["exit"] == END_OF_ROAD else f" by exit {event['exit']}"
    return f"left in lane {event['lane']}{by}"


def _closed(event: Event) -> str:
    vehicles = event["vehicles"]
    return f"formation {event['formation']} closed: {names(vehicles)}"


def _joined(event: Event) -> str:
    return f"formations joined: blocks {', '.join(map(str, event['formations']))}"


def _leader(event: Event) -> str:
    return f"{event['coordinator']} leads"


def _leader_lost(event: Event) -> str:
    return "no leader from here on" if event["t_s"] > 0.0 else "no leader yet"


def _plan_made(event: Event) -> str:
    begins = f", from {seconds(event['t0_s'])} on" if "t0_s" in event else ""
    return f"plan made for {event['vehicles']} vehicles: {event['steps']} steps{begins}"


def _planning_failed(event: Event) -> str:
    return f"planning failed: {event.get('error') or event.get('status')}"


def _awaited(event: Event) -> str:
    what = "acceptance of the plan" if event["phase"] == "issuing" else "promise"
    return f"the leader waits for the {what} of {names(event['vehicles'])}"


def _refused_settings(event: Event) -> str:
    return f"{event['process']} refused: other settings ({', '.join(event['settings'])})"


def _fault(event: Event) -> str:
    return f"fault injected ({event['fault']}): {event['target']} {event['action']}"


def _stops(facts: Facts, event: Event) -> str:
    part = facts.stopped_before(event)
    if part is None:
        return f"stops before the end of lane {event['lane']}"
    if part.first.get("vehicle") == facts.vehicle:
        return ""  # it is the part
    return f"stops before {described(part)}"


def described(part: RecordedClosure) -> str:
    """Return a description of a closed part and of its cause."""
    event = part.newest
    lane, vehicle = event["lane"], event.get("vehicle")
    if event.get("cause") == obstacle_messages.PASSING:
        return f"{vehicle}, a vehicle of another system, in lane {lane}"
    where = f"lane {lane}, closed from {event['from_m']:.0f} to {event['to_m']:.0f} m"
    broken = event.get("cause") == obstacle_messages.BREAKDOWN
    return f"{where} ({vehicle} had broken down)" if broken else where


def _part_closed(event: Event) -> str:
    lane, vehicle = event["lane"], event.get("vehicle")
    match event.get("cause"):
        case obstacle_messages.PASSING:
            speed = f"at {event.get('speed_mps', 0.0):.1f} m/s"
            return f"{vehicle}, a vehicle of another system, enters lane {lane} {speed}"
        case obstacle_messages.BREAKDOWN:
            return (
                f"{vehicle} breaks down in lane {lane}, which is closed at {event['from_m']:.0f} m"
            )
        case _:
            return f"lane {lane} closed from {event['from_m']:.0f} to {event['to_m']:.0f} m"


def _part_opened(event: Event) -> str:
    if event.get("cause") == obstacle_messages.PASSING:
        return f"{event.get('vehicle')} has left lane {event['lane']}"
    return f"lane {event['lane']} open again from {event['from_m']:.0f} m on"


def _caretaker(event: Event) -> str:
    return f"caretaker in charge: {ABSENCE[event['reason']]}"


ABSENCE: Mapping[str, str] = {
    "absent": "its agent is gone",
    "silent": "its agent does not answer",
    "late": "its agent always answers too late",
}
"""Why a caretaker is in charge, by reason of the event."""
_CHARGE = (kinds.CARETAKER_TOOK_OVER, kinds.AGENT_TOOK_OVER)
_TOO_LATE = "too late for any step: the formation does not sort its lanes"
_OUT_OF_REACH = "the plan does not lead it to its lane"
_TEXTS: Mapping[str, Callable[[Event], str]] = {
    kinds.ENTERED: _entered,
    kinds.LEFT: _left,
    kinds.FORMATION_CLOSED: _closed,
    kinds.FORMATIONS_JOINED: _joined,
    kinds.LEADER: _leader,
    LEADER_LOST: _leader_lost,
    kinds.PLAN_MADE: _plan_made,
    kinds.PLAN_IN_FORCE: lambda _: "plan in force: all vehicles have accepted it",
    kinds.PLANNING_FAILED: _planning_failed,
    kinds.FORMATION_TOO_LATE: lambda _: _TOO_LATE,
    kinds.LANE_OUT_OF_REACH: lambda _: _OUT_OF_REACH,
    kinds.STREAM_PLANNED: lambda _: _OUT_OF_REACH,
    kinds.VEHICLES_AWAITED: _awaited,
    kinds.ROOM_AWAITED: lambda _: "the formation lacks room, and waits for the one behind",
    kinds.NEIGHBOURS_AWAITED: lambda _: "the plan pauses for a neighbouring formation",
    kinds.STRUCTURE_TOO_LATE: lambda _: "too late for a driving structure",
    kinds.STRUCTURE_IMPOSSIBLE: lambda _: "the formation does not fit into a driving structure",
    kinds.TRANSFER_ABORTED: lambda event: f"cell transfer aborted: {event['why']}",
    kinds.SETTINGS_REFUSED: _refused_settings,
    kinds.FAULT_INJECTED: _fault,
    kinds.AGENT_MISSING: lambda _: "its agent has not started in time",
    kinds.AGENT_SILENT: lambda _: "its agent has stopped answering",
    kinds.CARETAKER_TOOK_OVER: _caretaker,
    kinds.AGENT_TOOK_OVER: lambda event: f"agent in charge, after the {event['previous']}",
    kinds.COMMAND_REFUSED: lambda event: f"command refused: {event['reason']}",
    kinds.OVERLAP: lambda event: f"bodies overlap: {' and '.join(event['vehicles'])}",
    kinds.MISSED_EXIT: lambda event: f"missed its exit; stays in lane {event['lane']}",
    kinds.DRIVES_OUT: lambda event: f"drives into a gap in lane {event['lane']}",
    kinds.PART_CLOSED: _part_closed,
    kinds.PART_OPENED: _part_opened,
    kinds.ENTERED_LATTICE: lambda event: f"has a cell again, in lane {event['lane']}",
}
"""Text of an event, by kind; `left-off-lane` repeats `left`."""


def to_dict(line: StoryLine) -> dict[str, Any]:
    """Return a line as JSON values."""
    return {"t_s": line.t_s, "kind": line.kind, "text": line.text}
