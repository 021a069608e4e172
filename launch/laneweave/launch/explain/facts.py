"""What the events of a run say about one vehicle and those on which it depends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping

from attrs import define, field

from laneweave.launch.recordings.closed_parts import RecordedClosure, RecordedClosures
from laneweave.launch.recordings.events import Event
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.wire import events as kinds

_OF_VEHICLE = frozenset(
    (
        kinds.ENTERED,
        kinds.LEFT,
        kinds.LEFT_OFF_LANE,
        kinds.LEFT_LATTICE,
        kinds.MISSED_EXIT,
        kinds.DRIVES_OUT,
        kinds.ENTERED_LATTICE,
        kinds.AGENT_MISSING,
        kinds.AGENT_SILENT,
        kinds.COMMAND_REFUSED,
    )
)
"""Kinds of events about one vehicle, but for changes of the process in charge."""
_OF_FORMATION = frozenset(
    (
        kinds.PLAN_MADE,
        kinds.PLAN_IN_FORCE,
        kinds.PLANNING_FAILED,
        kinds.FORMATION_TOO_LATE,
        kinds.ROOM_AWAITED,
        kinds.NEIGHBOURS_AWAITED,
        kinds.VEHICLES_AWAITED,
        kinds.STRUCTURE_TOO_LATE,
        kinds.STRUCTURE_IMPOSSIBLE,
    )
)
_OF_SEVERAL = {kinds.OVERLAP: "vehicles", kinds.TRANSFER_ABORTED: "roster"}
"""Kinds of events about several vehicles, with the field that names them."""
_RANKS = (
    kinds.PLAN_MADE,
    kinds.LANE_OUT_OF_REACH,
    kinds.PLAN_IN_FORCE,
    kinds.LEFT,
    kinds.LEFT_OFF_LANE,
    kinds.RUN_ENDED,
)
"""Order of events of the same time, after all others."""
LEADER_LOST = "leader-lost"
"""Kind of an entry of `Facts.events` that stands for the last heartbeat of a leader."""


@define
class Absence:
    """A time in which a caretaker was in charge of a vehicle."""

    since_s: float
    why: str
    """As in the event: absent, silent or late."""
    until_s: float = math.inf


@define
class Facts:
    """Facts about a vehicle, up to its departure or the end of the recording."""

    vehicle: str
    leaderless_after_s: float
    """Road time without a heartbeat of a leader after which there was none."""
    events: list[Event] = field(factory=list)
    """Events that concern it, in the order of time."""
    entered: Event | None = None
    left: Event | None = None
    run_ended: Event | None = None
    """The event `run-ended`, if it was on the road then."""
    off_lane: Event | None = None
    """The event `left-off-lane`, if there is one."""
    formations: set[int] = field(factory=set)
    """Numbers of its formation and of those joined with it."""
    members: set[str] = field(factory=set)
    """Vehicles of these formations."""
    closed_s: float | None = None
    """When its formation closed."""
    plan_made: Event | None = None
    """Newest plan for its formation."""
    in_force_s: float | None = None
    """When a plan of its formation came into force last."""
    out_of_reach: Event | None = None
    """The event that names it as out of reach of its lane, if the newest plan leaves it off."""
    too_late: Event | None = None
    """The newest `formation-too-late` of its formation since the last plan in force."""
    failed: list[Event] = field(factory=list)
    """Failures to plan since the last plan in force."""
    awaited: Event | None = None
    """Newest `vehicles-awaited` since the last plan in force."""
    rolling: bool = False
    """Whether the run plans in slots."""
    unanswered: bool = False
    """Whether its last ballot lacked its answer when a plan did not lead it to its lane."""
    silent_until_s: float = -math.inf
    """Time at which the last ballot without its answer was aborted."""
    slot_planned_s: float = -math.inf
    """Time of the newest plan of a slot."""
    late_slots: int = 0
    """Number of plans of slots that failed or were late while it was on the road."""
    lane_end: Event | None = None
    """The newest `left-lattice` or `missed-exit`."""
    drives_again: bool = False
    """Whether it has had a cell again after it had none."""
    stands: bool = False
    """Whether it has no cell: it has stopped before the end of its lane."""
    absences: list[Absence] = field(factory=list)
    """Times in which a caretaker was in charge of it."""
    without_agent: dict[str, Absence] = field(factory=dict)
    """Vehicles with caretakers in charge when the facts end."""
    last_absences: dict[str, Absence] = field(factory=dict)
    """The last time without an agent of every vehicle that has had one."""
    never_attended: bool = False
    """Whether its agent did not start in time."""
    closed: RecordedClosures = field(factory=RecordedClosures)
    """Closed parts that began before the end of the facts."""
    refused: list[Event] = field(factory=list)
    """Processes whose settings were refused."""
    leader_gaps: list[tuple[float, float]] = field(factory=list)
    """Times without a leader, the last one perhaps without an end."""
    leader: Event | None = None
    """The newest event `leader`."""
    end_s: float = 0.0
    """Time of the last event of the run up to its departure."""

    @property
    def breakdown(self) -> RecordedClosure | None:
        """Its own breakdown, if it has had one: the newest."""
        newest_first = reversed(self.closed.parts)
        return next((one for one in newest_first if self._is_own(one)), None)

    def closed_between(self, since_s: float, until_s: float) -> list[RecordedClosure]:
        """Return the parts that were closed in lanes that it had or wanted, in some time."""
        lanes = [
            int(event[key])
            for event in (self.entered, self.left)
            if event is not None
            for key in ("lane", "preferred_lane")
            if event.get(key, ANY_LANE) != ANY_LANE
        ]
        return [
            one
            for one in self.closed.parts
            if lanes
            and min(lanes) <= one.first["lane"] <= max(lanes)
            and one.meets(since_s, until_s)
        ]

    def stopped_before(self, event: Event) -> RecordedClosure | None:
        """Return the closed part before which it stopped, with its event `left-lattice`."""
        t_s = float(event["t_s"])
        found = [
            one
            for one in self.closed.parts
            if one.first["lane"] == event["lane"] and one.meets(t_s, t_s)
        ]
        own = (one for one in found if self._is_own(one) and one.since_s == t_s)
        others = (one for one in reversed(found) if not self._is_own(one))
        return next(own, next(others, None))

    def _is_own(self, part: RecordedClosure) -> bool:
        """Return whether a part is closed because the vehicle itself has broken down."""
        return part.first.get("vehicle") == self.vehicle

    @property
    def absence(self) -> Absence | None:
        """Time without an agent in which the facts end, if any."""
        return (
            self.absences[-1] if self.absences and self.absences[-1].until_s == math.inf else None
        )

    @property
    def leaderless_since_s(self) -> float | None:
        """Since when there was no leader when the facts end; None: there was one, or unknown."""
        last = self.leader_gaps[-1] if self.leader_gaps else (0.0, 0.0)
        return last[0] if last[1] == math.inf else None

    def gap_before(self, t_s: float) -> tuple[float, float] | None:
        """Return the last time without a leader that ended at a time or before."""
        ended = [gap for gap in self.leader_gaps if gap[1] <= t_s]
        return ended[-1] if ended else None


def facts_of(events: Iterable[Event], vehicle: str, leaderless_after_s: float) -> Facts:
    """Return the facts about a vehicle.

    Args:
        events: all events of a run; times need not ascend, as an event may be reported late.
        vehicle: name of the vehicle.
        leaderless_after_s: see `Facts`.
    """
    facts = Facts(vehicle, leaderless_after_s)
    for event in sorted(events, key=_order):
        # The event `left-off-lane` has the time of `left`.
        if facts.left is not None and float(event["t_s"]) > float(facts.left["t_s"]):
            break
        _add(facts, event)
    _add_end(facts)
    return facts


def _order(event: Event) -> tuple[float, int]:
    """Return the sort key of an event: time, and its place among those of the same time.

    Messages of a coordinator may be recorded in another order than they were sent.
    """
    kind = event["kind"]
    return float(event["t_s"]), _RANKS.index(kind) if kind in _RANKS else -1


def _add(facts: Facts, event: Event) -> None:
    facts.end_s = float(event["t_s"])
    kind, vehicle = event["kind"], event.get("vehicle")
    if kind in _OF_VEHICLE and vehicle == facts.vehicle:
        facts.events.append(event)
        _add_own(facts, event)
    elif kind in (kinds.CARETAKER_TOOK_OVER, kinds.AGENT_TOOK_OVER):
        _add_charge(facts, event)
    elif kind == kinds.LEFT:
        facts.without_agent.pop(str(vehicle), None)
    elif kind in (kinds.FORMATION_CLOSED, kinds.FORMATIONS_JOINED):
        _add_formation(facts, event)
    elif kind in _OF_FORMATION and event.get("formation") in facts.formations:
        facts.events.append(event)
        _add_plan(facts, event)
    elif kind == kinds.LANE_OUT_OF_REACH and facts.vehicle in event["vehicles"]:
        facts.events.append(event)
        facts.out_of_reach = event
    elif kind == kinds.RUN_ENDED:
        facts.run_ended = event
    elif kind == kinds.SETTINGS_REFUSED:
        facts.events.append(event)
        facts.refused.append(event)
    elif kind in _OF_ROAD:
        _OF_ROAD[kind](facts, event)
    elif _is_around(facts.vehicle, event):
        _add_around(facts, event)


def _add_around(facts: Facts, event: Event) -> None:
    facts.events.append(event)
    if facts.vehicle in event.get("unanswered", ()):
        facts.silent_until_s = float(event["t_s"])


def _is_around(vehicle: str, event: Event) -> bool:
    """Return whether an event concerns a vehicle among others.

    Faults do, but for those of the agents of other vehicles alone.
    """
    kind = event["kind"]
    if kind == kinds.FAULT_INJECTED:
        target = str(event["target"])
        return not target.startswith("agent-") or vehicle in target
    return kind in _OF_SEVERAL and vehicle in event[_OF_SEVERAL[kind]]


def _add_part(facts: Facts, event: Event) -> None:
    if facts.closed.add(event) and facts.entered is not None:
        facts.events.append(event)


def _add_own(facts: Facts, event: Event) -> None:
    match event["kind"]:
        case kinds.ENTERED:
            facts.entered = event
            facts.events += [one.first for one in facts.closed.active]
        case kinds.LEFT:
            facts.left = event
        case kinds.LEFT_OFF_LANE:
            facts.off_lane = event
        case kinds.LEFT_LATTICE | kinds.MISSED_EXIT:
            facts.lane_end = event
            facts.stands = event["kind"] == kinds.LEFT_LATTICE
        case kinds.ENTERED_LATTICE:
            facts.stands, facts.drives_again = False, True
        case kinds.AGENT_MISSING:
            facts.never_attended = True
        case _:
            pass


def _add_charge(facts: Facts, event: Event) -> None:
    vehicle, t_s = str(event["vehicle"]), float(event["t_s"])
    if event["kind"] == kinds.CARETAKER_TOOK_OVER:
        absence = Absence(t_s, str(event["reason"]))
        facts.without_agent[vehicle] = facts.last_absences[vehicle] = absence
        if vehicle == facts.vehicle:
            facts.absences.append(absence)
    else:
        over = facts.without_agent.pop(vehicle, None)
        if over is not None:
            over.until_s = t_s
        if vehicle == facts.vehicle:
            facts.never_attended = False
    if vehicle == facts.vehicle or vehicle in facts.members:
        facts.events.append(event)


def _add_formation(facts: Facts, event: Event) -> None:
    if event["kind"] == kinds.FORMATION_CLOSED:
        if facts.vehicle not in event["vehicles"]:
            return
        # A vehicle that waited at the end of a lane joins a later formation.
        facts.formations, facts.members = {int(event["formation"])}, {*event["vehicles"]}
        facts.closed_s = float(event["t_s"])
        # Only now is it known that these vehicles matter.
        facts.events += [
            {
                "t_s": absence.since_s,
                "kind": kinds.CARETAKER_TOOK_OVER,
                "vehicle": name,
                "reason": absence.why,
            }
            for name, absence in facts.without_agent.items()
            if name in facts.members and name != facts.vehicle
        ]
    elif facts.formations.isdisjoint(event["formations"]):
        return
    else:
        facts.formations.update(map(int, event["formations"]))
    facts.events.append(event)


def _add_plan(facts: Facts, event: Event) -> None:
    match event["kind"]:
        case kinds.PLAN_MADE:
            # The event that names vehicles out of reach of their lanes follows.
            facts.plan_made, facts.out_of_reach = event, None
        case kinds.PLAN_IN_FORCE:
            facts.in_force_s = float(event["t_s"])
            facts.too_late = facts.awaited = None
            facts.failed.clear()
        case kinds.FORMATION_TOO_LATE:
            if facts.vehicle in event.get("vehicles", (facts.vehicle,)):
                facts.too_late = event
        case kinds.VEHICLES_AWAITED:
            facts.awaited = event
        case kinds.PLANNING_FAILED:
            facts.failed.append(event)
        case _:
            pass


def _add_slot(facts: Facts, event: Event) -> None:
    if "slot" not in event:
        return
    facts.rolling = True
    if facts.entered is None:
        return
    if event["kind"] != kinds.STREAM_PLANNED:
        facts.late_slots += 1
    else:
        if facts.vehicle in event.get("out_of_reach", ()):
            facts.out_of_reach = event
            facts.unanswered = facts.silent_until_s >= facts.slot_planned_s
            facts.events.append(event)
        facts.slot_planned_s = float(event["t_s"])


def _add_leader(facts: Facts, event: Event) -> None:
    t_s = float(event["t_s"])
    if facts.entered is None:
        # Of the leaders before, only the newest matters.
        facts.events[:] = [one for one in facts.events if one["kind"] != kinds.LEADER]
    facts.events.append(event)
    facts.leader = event
    if "leader_until_s" in event:
        until_s = event["leader_until_s"]
        if until_s is None or t_s > until_s + facts.leaderless_after_s:
            facts.leader_gaps.append((until_s or 0.0, t_s))


_OF_ROAD: Mapping[str, Callable[[Facts, Event], None]] = {
    kinds.LEADER: _add_leader,
    kinds.PART_CLOSED: _add_part,
    kinds.PART_OPENED: _add_part,
    kinds.STREAM_PLANNED: _add_slot,
    kinds.PLANNING_FAILED: _add_slot,
    kinds.PLANNING_LATE: _add_slot,
}
"""What adds the events that concern all vehicles, by kind."""


def _add_end(facts: Facts) -> None:
    """Add the time without a leader in which the facts end, and entries for those times."""
    last = facts.off_lane or facts.run_ended or {}
    if "leader_until_s" in last:
        until_s = last["leader_until_s"]
        if until_s is None or facts.end_s > until_s + facts.leaderless_after_s:
            facts.leader_gaps.append((until_s or 0.0, math.inf))
    facts.events += _lost_leaders(facts)
    facts.events.sort(key=_order)


def _lost_leaders(facts: Facts) -> Iterator[Event]:
    entered_s = float(facts.entered["t_s"]) if facts.entered is not None else math.inf
    for since_s, until_s in facts.leader_gaps:
        if until_s > entered_s:
            yield {"t_s": since_s, "kind": LEADER_LOST, "until_s": until_s}
