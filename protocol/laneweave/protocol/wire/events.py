"""Names of the events that roles log (`LogEvent.kind`, and `kind` of a line in events.jsonl)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

LEADER_ELECTED: Final = "leader-elected"
"""Coordinator: the sender begins to lead."""
LEADER_STEPPED_DOWN: Final = "leader-stepped-down"
"""Coordinator: the sender no longer leads."""
LEADER: Final = "leader"
"""Bridge: heartbeats report a new leader."""
PLAN_MADE: Final = "plan-made"
"""Coordinator: a plan for a formation has been made."""
STREAM_PLANNED: Final = "stream-planned"
"""Coordinator, rolling operation: a plan for a slot has been made."""
PLAN_IN_FORCE: Final = "plan-in-force"
"""Coordinator: all vehicles of the roster have accepted a plan."""
PLANNING_FAILED: Final = "planning-failed"
"""Coordinator: a planning job failed or found no plan."""
PLANNING_LATE: Final = "planning-late"
"""Coordinator, rolling operation: a plan was ready too late for its slot and is not used."""
TRANSFER_ABORTED: Final = "handover-given-up"
"""Coordinator, rolling operation: a cell transfer is aborted."""
STRUCTURE_TOO_LATE: Final = "structure-too-late"
"""Coordinator: a formation skips a driving structure because sorting begins first."""
STRUCTURE_IMPOSSIBLE: Final = "structure-impossible"
"""Coordinator: a formation does not fit into a driving structure."""
FORMATION_TOO_LATE: Final = "formation-too-late"
"""Coordinator: no step fits before the end of the road, so the formation does not sort."""
FORMATIONS_JOINED: Final = "formations-joined"
"""Coordinator: formations are joined and share ballots from now on."""
ROOM_AWAITED: Final = "room-awaited"
"""Coordinator: a formation lacks room and waits until the one behind it can join."""
NEIGHBOURS_AWAITED: Final = "neighbours-awaited"
"""Coordinator: a plan pauses to avoid closing moves with a neighbouring formation."""
LANE_OUT_OF_REACH: Final = "lane-out-of-reach"
"""Coordinator: a plan leaves vehicles off their preferred lanes."""
VEHICLES_AWAITED: Final = "vehicles-awaited"
"""Coordinator: vehicles have not answered a ballot for 3 s, and so their formation has no plan."""
FORMATION_CLOSED: Final = "formation-closed"
"""Bridge: a formation accepts no more vehicles."""
ENTERED: Final = "entered"
"""Bridge: a vehicle has entered the road."""
LEFT: Final = "left"
"""Bridge: a vehicle has left the road."""
LEFT_OFF_LANE: Final = "left-off-lane"
"""Bridge: a vehicle has left the road in a lane other than its preferred one."""
LEFT_LATTICE: Final = "left-lattice"
"""Bridge: a vehicle has no cell any more, and stops before the end of its lane."""
MISSED_EXIT: Final = "missed-exit"
"""Bridge: a vehicle has begun a move into or out of an exit lane too late, and holds its cell."""
MOVE_TAKEN_BACK: Final = "move-taken-back"
"""Bridge: a vehicle in a formation has taken back a move into a lane that is now closed ahead."""
DRIVES_OUT: Final = "drives-out"
"""Bridge: a vehicle starts from the end of its lane into a gap in the neighbouring lane."""
ENTERED_LATTICE: Final = "entered-lattice"
"""Bridge: a vehicle that had stopped before the end of its lane has a cell again."""
PART_CLOSED: Final = "part-closed"
"""Bridge: a part of a lane is closed for a time, or ends elsewhere than was known before."""
PART_OPENED: Final = "part-opened"
"""Bridge: a part of a lane that was closed for a time is open again."""
AGENT_MISSING: Final = "agent-missing"
"""Bridge: the agent of a vehicle did not start in time."""
AGENT_SILENT: Final = "agent-silent"
"""Bridge: an agent has not answered for `runtime.agent_silent_s`."""
CARETAKER_TOOK_OVER: Final = "caretaker-took-over"
"""Bridge: the caretaker has taken charge of a vehicle."""
AGENT_TOOK_OVER: Final = "agent-took-over"
"""Bridge: an agent has taken charge of a vehicle from its caretaker or an earlier agent."""
COMMAND_REFUSED: Final = "command-refused"
"""Bridge: a motion controller has refused a command that no correct agent sends (or several)."""
SETTINGS_REFUSED: Final = "settings-refused"
"""Bridge: a process has other settings than the bridge, and so does not act on its road."""
OVERLAP: Final = "overlap"
"""Bridge: two bodies intersect; a closed part of a lane counts as a body, `closure-LANE-FROM`."""
FAULT_INJECTED: Final = "fault-injected"
"""Launcher, or `laneweave faults apply`: a fault has begun, ended, or affected a process."""
RUN_ENDED: Final = "run-ended"
"""Bridge: the run has ended."""

PLAN_EVENTS: Final = (PLAN_MADE, STREAM_PLANNED)
"""Events that report a plan for a formation or for the whole stream."""

FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    LEADER_ELECTED: ("term",),
    LEADER_STEPPED_DOWN: ("term",),
    LEADER: ("coordinator", "term", "leader_until_s"),
    PLAN_MADE: (
        *("formation", "vehicles", "status", "cost", "lower_bound", "steps", "solve_ms"),
        *("assignments_tried", "nodes_expanded", "solver", "fallback", "t0_s", "slot_s"),
    ),
    STREAM_PLANNED: (
        *("slot", "vehicles", "missed", "moves", "ballots", "largest", "status", "solve_ms"),
        "out_of_reach",
    ),
    PLAN_IN_FORCE: ("formation", "slot", "closed_s"),
    PLANNING_FAILED: ("formation", "slot", "status", "error"),
    PLANNING_LATE: ("slot",),
    TRANSFER_ABORTED: ("roster", "why", "unanswered"),
    STRUCTURE_TOO_LATE: ("formation", "stage"),
    STRUCTURE_IMPOSSIBLE: ("formation", "stage", "why"),
    FORMATION_TOO_LATE: ("formation", "vehicles", "reason", "closed_s", "since_s"),
    FORMATIONS_JOINED: ("formations", "why"),
    ROOM_AWAITED: ("formation",),
    NEIGHBOURS_AWAITED: ("formation", "slots"),
    LANE_OUT_OF_REACH: ("formation", "vehicles", "reasons", "blocked_by"),
    VEHICLES_AWAITED: ("formation", "vehicles", "phase"),
    FORMATION_CLOSED: ("formation", "vehicles", "columns"),
    ENTERED: ("vehicle", "lane", "preferred_lane", "destination", "formation"),
    LEFT: ("vehicle", "lane", "exit", "on_preferred_lane"),
    LEFT_OFF_LANE: (
        *("vehicle", "lane", "exit", "preferred_lane", "destination", "attended"),
        *("reason", "unattended_since_s", "leader_until_s"),
    ),
    LEFT_LATTICE: ("vehicle", "lane"),
    MISSED_EXIT: ("vehicle", "lane"),
    MOVE_TAKEN_BACK: ("vehicle", "lane"),
    DRIVES_OUT: ("vehicle", "lane"),
    ENTERED_LATTICE: ("vehicle", "lane"),
    PART_CLOSED: ("lane", "from_m", "to_m", "late_m", "cause", "vehicle", "since_s", "until_s"),
    PART_OPENED: ("lane", "from_m", "to_m", "late_m", "cause", "vehicle", "since_s", "until_s"),
    AGENT_MISSING: ("vehicle",),
    AGENT_SILENT: ("vehicle",),
    CARETAKER_TOOK_OVER: ("vehicle", "reason"),
    AGENT_TOOK_OVER: ("vehicle", "previous"),
    COMMAND_REFUSED: ("vehicle", "reason", "excess_m", "occupant"),
    SETTINGS_REFUSED: ("process", "incarnation", "settings"),
    OVERLAP: ("vehicles",),
    FAULT_INJECTED: ("fault", "action", "target", "run_s"),
    RUN_ENDED: ("ending", "leader_until_s"),
}
"""Data of each event, beside `COMMON_FIELDS`."""
COMMON_FIELDS: Final = ("t_s", "kind", "role", "name")
"""Keys of every line; `name` is absent from events of the bridge and of the launcher."""
MEANINGS: Final[Mapping[str, str]] = {
    "t_s": "road time [s]",
    "kind": "kind of the event",
    "role": "role of the sender: bridge, coordinator or launcher",
    "name": "name of the coordinator",
    "term": "term of the leader",
    "coordinator": "name of the leader",
    "formation": "number of the formation; of joined ones, of the foremost",
    "formations": "numbers of the joined formations",
    "vehicles": "number of vehicles in the plan; in other events, names of the vehicles",
    "status": "as in the response to a plan request",
    "cost": "sum over the vehicles of the number of steps until the final arrival",
    "lower_bound": "proven lower bound of the cost",
    "steps": "number of steps of the plan",
    "solve_ms": "time to make the plan [ms]",
    "assignments_tried": "number of assignments that the solver tried",
    "nodes_expanded": "number of nodes that the solver expanded",
    "solver": "name of the solver",
    "fallback": "whether it planned in place of the chosen solver",
    "t0_s": "road time at which the first step begins [s]",
    "slot_s": "T_F: duration of a step [s]",
    "slot": "number of the slot of the rolling operation",
    "slots": "number of slots in which the plan pauses",
    "missed": "number of vehicles that the plan leaves off their preferred lanes",
    "moves": "number of moves in the slot",
    "ballots": "number of cell transfers in the slot",
    "largest": "maximum number of vehicles in a cell transfer",
    "closed_s": "road time at which the formation closed, or the snapshot was taken [s]",
    "error": "why there is no plan",
    "roster": "names of the vehicles of the cell transfer",
    "why": "reason",
    "stage": "number of the driving structure on the road",
    "columns": "rearmost and foremost column of the formation",
    "vehicle": "name of the vehicle",
    "lane": "lane; 0 is the rightmost",
    "from_m": "beginning of the closed part [m]",
    "to_m": "end of the closed part [m]",
    "late_m": "length of the queue of vehicles that cannot stop at the stop line [m]",
    "cause": "breakdown or closed",
    "until_s": "road time at which the cause ends [s]; null: not known",
    "preferred_lane": "lane in which the vehicle wants to leave; -1: any",
    "destination": "name of the exit by which the vehicle wants to leave; end: end of the road",
    "exit": "name of the exit by which the vehicle left; end: end of the road",
    "on_preferred_lane": "whether the vehicle left where it wanted to",
    "attended": "whether its agent was in charge, not a caretaker",
    "reason": "why the lane was missed (wire/reasons.py); why the agent was not in charge; what is "
    "wrong with the command",
    "reasons": "reason of each vehicle (wire/reasons.py)",
    "blocked_by": "for each blocked vehicle, those that hold cells on its way, nearest first",
    "unanswered": "names of the vehicles that did not answer in time",
    "out_of_reach": "names of the vehicles that `missed` counts for the first time",
    "phase": "preparing: promises are missing; issuing: acceptances of the plan",
    "since_s": "road time since which the sender leads, or the part is closed [s]",
    "unattended_since_s": "road time since which no agent was in charge [s]; null: one was",
    "leader_until_s": "road time of the last heartbeat of a leader before [s]; null: none",
    "occupant": "vehicle, or gap for one, that occupies a cell on the way",
    "excess_m": "how far the command would have led the body out of its cells [m]",
    "previous": "which process was in charge before: caretaker or agent",
    "process": "role and name of the process that was refused",
    "incarnation": "incarnation of this process",
    "settings": "settings that differ: value of the bridge, value of the process",
    "fault": "table of the fault file, such as kill[0]",
    "action": "killed, restarted, paused or resumed; of rules, partitions, links: began or ended",
    "target": "process; senders and receivers of the rule (`c1 to v0002`, `v0001 and v0002`, "
    "`all to all`); groups of the partition (`bridge and others`); group of the "
    "link",
    "run_s": "time since the bridge was started, or since `faults apply` found the road [s, wall "
    "clock; simulated: virtual time]",
    "ending": "as in summary.json",
}
"""What each field means."""
