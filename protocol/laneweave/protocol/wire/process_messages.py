"""Messages about processes: their settings, counters and events. See `messages`."""

from __future__ import annotations

from typing import Any

from msgspec import field

from laneweave.protocol.names import Name
from laneweave.protocol.wire.field_types import Int64, Message, Real


class ProcessSettings(Message, frozen=True):
    """Bridge to all, every second (wall clock): the settings that all processes must share.

    Also from any other process whose settings differ from those of the bridge, to the bridge and
    observers, as long as they differ. Missing: a process that may not act cannot say which of its
    settings differ; whether they do, it knows from the bridge's token. Late or duplicated: no
    effect, since settings never change. From an earlier bridge: ignored.
    """

    role: Name
    name: Name
    incarnation: Int64
    """Incarnation of the sender [ns]."""
    values: dict[str, str]
    """Value of each setting as JSON text, by its name in the scenario file."""


class RoadStatus(Message, frozen=True):
    """Bridge to observers, every second (wall clock): what keeps the road from driving as planned.

    Missing for 3 s, although the bridge has its token: the bridge hangs. Late: shown until the next
    one. Duplicated: no effect. From an earlier bridge: shows that there are two bridges.
    """

    bridge: Int64
    """Incarnation of the bridge [ns]."""
    clock_s: Real
    """Wall-clock time of the bridge [s since 1970]."""
    standing_s: Real = 0.0
    """Time for which the current tick has waited for agents at the entrance [s, wall clock]."""
    awaited: tuple[Name, ...] = ()
    """Vehicles at the entrance whose agents the tick waits for."""
    unattended: dict[Name, Real] = field(default_factory=dict)
    """Vehicles on the road without an agent in charge, and for how long [s, wall clock]."""
    overlaps: Int64 = 0
    """Number of pairs of bodies that have intersected."""
    recording: bool = True
    """Whether the run is still recorded."""


class Report(Message, frozen=True):
    """Any role to the recorder: the sender's counters.

    Sent by agents when their vehicle has left or they are stopped, by the bridge when its run ends,
    and by coordinators every 2 s and when they are stopped. Missing: not included in the
    summary; when a run ends, the bridge waits up to 2 s for the reports from all agents. Late: not
    recorded. Duplicated: the newest report from a sender counts. Impossible numbers: refused. The
    summary takes the maximum of `published` and of `rejected` over the senders of a process, and
    sums all other counters.
    """

    role: Name
    name: Name
    process: Name = Name("unknown")
    """Process of the sender, set by the node; several vehicles may share one."""
    published: Int64 = 0
    """Number of messages published by the process, including this one; set by the node."""
    rejected: Int64 = 0
    """Number of malformed messages received by the process; set by the node."""
    solves: Int64 = 0
    """Number of ticks at which a reference was tracked."""
    unusable: Int64 = 0
    """Number of solves without a usable solution."""
    osqp_solves: Int64 = 0
    """Number of solves with OSQP; the others used `tracking.shortcut`."""
    solve_ms: bytes = b""
    """CPU time of each solve [ms], little-endian float32."""
    sidelink: Int64 = 0
    """Number of messages from other vehicles to this one by radio, including lost ones; 0 without
    a radio."""
    sidelink_lost: Int64 = 0
    """Number of those that were lost."""
    cellular: Int64 = 0
    """Number of messages sent to this process over the cellular network, including lost ones; only
    with a radio."""
    cellular_lost: Int64 = 0
    """Number of those that were lost."""


class LogEvent(Message, frozen=True):
    """Any role to the recorder, for each event: a line in `events.jsonl`.

    Currently only coordinators send events; the bridge writes its own directly. Missing, or
    late because the run has ended: not recorded. Duplicated: recorded twice.
    """

    role: Name
    name: Name
    t_s: Real
    kind: Name
    """One of the names in `wire.events`."""
    data: dict[str, Any] = field(default_factory=dict)
    """Details, as JSON values."""
