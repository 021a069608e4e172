"""Every message that travels, with units, sender, rate, and what its loss means.

All are frozen attrs classes; `codec` turns them into MessagePack and back. `t_s` is road time, the
clock that all vehicles share and that the lattice moves with. A *ballot* names one attempt of one
leader process to have one plan executed. Field types are checked on receipt, so a core never sees
a malformed message.
"""

from __future__ import annotations

from typing import Any, NamedTuple, NewType

from attrs import field, frozen

from laneweave.protocol.lattice import Cell, Lattice, PlannedMove

Name = NewType("Name", str)
"""Name of a vehicle, coordinator or role: letters, digits, `_`, `-`, `.`; at most 64."""


class Ballot(NamedTuple):
    """(term, coordinator, incarnation, seq), compared in this order.

    Unique for ever: an incarnation is the start time of a coordinator process in ns, and `seq`
    counts the ballots of that process. It is never used for two plans.
    """

    term: int
    coordinator: Name
    incarnation: int
    seq: int


@frozen
class Heartbeat:
    """Coordinator to coordinators and observers, every `network.heartbeat_s`.

    Missing for `network.election_s`: its sender is not a candidate any more. Late or duplicated:
    harmless, leading twice is safe. From a process whose liveliness token is gone: ignored.
    """

    coordinator: Name
    incarnation: int
    term: int
    leading: bool
    formations: int
    """Plans in force, for observers."""


@frozen
class Deed:
    """How cells change hands with one plan of the rolling operation, as one vehicle keeps it.

    The vehicle owns `before` until it knows that the start gate is open, then `after`.
    """

    ballot: Ballot
    before: tuple[Cell, ...] = ()
    after: tuple[Cell, ...] = ()
    roster: tuple[Name, ...] = ()
    """Who has a deed of this ballot."""
    open: bool = False
    """The start gate is open; the other fields say nothing any more."""


@frozen
class Prepare:
    """Leader to each vehicle of the roster that has not promised, every `network.resend_s`.

    Missing: sent again. Duplicated or late: a vehicle that promised this ballot answers with its
    state again; one that promised a higher ballot changes nothing and shows that ballot.
    """

    ballot: Ballot
    formations: tuple[int, ...]
    """Whose blocks the plan may use, ascending; more than one: a joint ballot."""
    roster: tuple[Name, ...]
    """All vehicles on the road that entered in these blocks."""


@frozen
class Plan:
    """Leader to each vehicle of the roster that has not accepted, every `network.resend_s`.

    One and only one per ballot. Missing: sent again; nobody moves before all have it (start gate).
    Duplicated, late, or from a ballot that is not the promised one: ignored. Dependencies between
    moves are not sent, they are a pure function of this message (`dependencies`).
    """

    ballot: Ballot
    formations: tuple[int, ...]
    """Whose blocks the territory lies in; those of the ballot."""
    roster: tuple[Name, ...]
    incarnations: dict[Name, int]
    """Incarnation of each vehicle's agent when it promised."""
    start_cells: dict[Name, Cell]
    moves: dict[Name, tuple[PlannedMove, ...]]
    """(step, from, to) of each vehicle, steps ascending."""
    t0_s: float
    """Road time at which step 0 may begin."""
    slot_s: float
    """T_F: step n may begin at t0 + n slot."""
    territory: tuple[Cell, ...]
    before: dict[Name, tuple[Cell, ...]] = field(factory=dict)
    """Rolling operation: the cells that each vehicle owns as the plan is made. Empty: formations
    own their blocks."""
    after: dict[Name, tuple[Cell, ...]] = field(factory=dict)
    """Rolling operation: the cells that each vehicle owns when the start gate is open."""


@frozen
class VehicleState:
    """Vehicle to its formation and the coordinators, every tick and at once on every change.

    It is promise, acknowledgement and progress report in one. Missing: whoever waits for it holds
    its cell. Late or duplicated: harmless, since all it says ("completed k moves of ballot b")
    stays true. Of another ballot than the receiver's plan: says nothing about this plan.
    """

    vehicle: Name
    incarnation: int
    formation: int
    """In whose block it entered."""
    joined: tuple[int, ...]
    """Formations whose blocks its plans may use, as its motion controller keeps them; ascending."""
    promised: Ballot | None
    accepted: bool
    """It has the plan of the promised ballot, and its motion controller has noted that."""
    ready: bool
    """Accepted, and not moving or moving in a move of this plan."""
    completed: int
    """k: completed moves of the accepted plan."""
    hold_cell: Cell
    """Where it holds: its cell, or the target while it moves."""
    moving: bool
    go: bool
    """Its start gate is open."""
    done: bool
    """It has completed all moves of the accepted plan."""
    overdue: bool
    """Its next move has been due for longer than the leader should accept."""
    attended: bool
    """An agent drives it; without one its caretaker speaks for it, and it only ever holds."""
    s_m: float
    y_m: float
    speed_mps: float
    t_s: float
    estate: tuple[Cell, ...] = ()
    """Rolling operation: the cells that it owns, as its motion controller keeps them; none while
    that has not noted the promise."""
    deed: Deed | None = None
    """Rolling operation: the newest plan by which cells change hands."""


@frozen
class Motion:
    """Vehicle to those in its stretch of columns and in the two next to it: its motion under way.

    When the motion begins and every ten ticks while it lasts; who holds says nothing, since its
    speed is constant. Its trajectory is not sent: all vehicles share the scenario, from which it
    follows. Missing or late: those around go by what they sense. Duplicated: no effect. Older than
    the newest motion of the vehicle, by incarnation and then by `begin_tick`: ignored.
    """

    vehicle: Name
    incarnation: int
    stretch: int
    """Number of the stretch of columns in which the motion began."""
    origin: Cell
    target: Cell
    begin_tick: int
    ticks: int
    """How long it takes."""
    tick: int
    """When this was sent."""


@frozen
class Neighbour:
    """The nearest vehicle ahead in a lane, or behind in it, as local sensing sees it."""

    lane: int
    gap_m: float
    """Net bumper-to-bumper distance along the road; negative: side by side."""
    speed_mps: float
    accel_mps2: float = 0.0


@frozen
class Sense:
    """Bridge to one vehicle at each tick: what its own sensors and motion controller know.

    Missing: sent again every `runtime.tick_resend_s` until the deadline; after it the vehicle's
    last trajectory is continued. Duplicated: answered again, the same way. Older than the newest
    tick of the same bridge, or from an older bridge than the newest: ignored. From a newer bridge:
    the agent forgets the earlier road and takes a new incarnation.
    """

    vehicle: Name
    tick: int
    t_s: float
    state: tuple[float, float, float, float, float, float]
    """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2) as measured; s is the front bumper, y the body
    centre."""
    hold_cell: Cell
    """The cell in which the motion controller will hold when nothing new comes."""
    motion_end_tick: int
    """The tick at which the move under way ends; not after `tick`: the vehicle holds."""
    motion_origin: Cell
    """Where the move under way began; `hold_cell` when it holds."""
    preferred_lane: int
    ahead: tuple[Neighbour, ...]
    """One for each lane that the body touches or that is next to it, where there is somebody."""
    behind: tuple[Neighbour, ...] = ()
    """Likewise."""
    setpoint: tuple[float, float] = (0.0, 0.0)
    """Accelerations that the actuators were told last, along and across [m/s2]."""
    formation: int = 0
    """In whose block the vehicle entered."""
    attendant: int = 0
    """Incarnation of the process that is in charge of the vehicle; 0: none yet."""
    motion_ticks: int = 0
    """How many ticks the move under way was to take; 0: it settles in its cell, or holds."""
    caretaker: bool = False
    """The one in charge is the vehicle's caretaker, because its agent died or fell silent."""
    joined: tuple[int, ...] = ()
    """Formations whose blocks the vehicle's plans may use, as the controller has noted."""
    accepted: Ballot | None = None
    """Newest plan that the process in charge has accepted, as the controller has noted."""
    left: bool = False
    """The vehicle has left the road: its agent reports and ends."""
    estate: tuple[Cell, ...] = ()
    """Rolling operation: the cells that it owns."""
    promised: Ballot | None = None
    """Highest ballot that the process in charge has promised, as the controller has noted."""
    deed: Deed | None = None
    """Newest deed of the vehicle."""
    bridge: int = 0
    """Incarnation of the bridge: ticks of another one belong to another road; 0: not told."""


@frozen
class Command:
    """Vehicle agent to its motion controller (in the bridge), the answer to each `Sense`.

    It holds the whole remaining trajectory: jerks per tick from `tick` on. Missing: the controller
    plays the trajectory it has and then holds `hold_cell`. Duplicated: no effect. For an older
    tick than the newest command: ignored. From an older incarnation than the one in charge:
    refused; from a newer one: that process is in charge from now on. What it asks to be noted is
    noted whatever its tick, and confirmed with a SENSE.
    """

    vehicle: Name
    incarnation: int
    tick: int
    hold_cell: Cell
    motion_end_tick: int
    motion_origin: Cell
    jerks: bytes
    """Little-endian float32 pairs (j_s, j_y) in m/s3, one for each tick of the horizon."""
    motion_ticks: int = 0
    """How many ticks the move under way was to take; 0: it settles in its cell, or holds."""
    joined: tuple[int, ...] = ()
    """Formations that the controller should note as joined, beside those that it knows."""
    accepted: Ballot | None = None
    """The plan that the sender has accepted: the controller should note it."""
    promised: Ballot | None = None
    """Rolling operation: what the sender has promised: the controller should note it."""
    deed: Deed | None = None
    """Rolling operation: the deed of the newest plan that the sender has taken."""


@frozen
class CensusEntry:
    """One vehicle on the road, as counted at its start."""

    vehicle: Name
    cell: Cell
    """The cell in which it entered; its column tells its formation."""
    preferred_lane: int
    entered_s: float


@frozen
class ClosedFormation:
    """The blocks of columns of a formation; no vehicle enters them any more."""

    first_block: int
    """Number of its foremost block, which is the formation's number, too."""
    last_block: int
    closed_s: float
    """Road time at which it was closed."""

    @property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of its blocks, ascending."""
        return tuple(range(self.first_block, self.last_block + 1))

    def columns(self, lattice: Lattice) -> range:
        """Return its columns in ascending order."""
        return range(
            lattice.block_range(self.last_block).start, lattice.block_range(self.first_block).stop
        )


@frozen
class Announcement:
    """A vehicle that will arrive soon."""

    vehicle: Name
    lane: int
    preferred_lane: int
    arrival_s: float


@frozen
class Census:
    """Roadside to coordinators and the launcher, on every change and every ten ticks.

    It is complete: a vehicle is on the road if and only if it is listed. Missing: the receiver
    works with the older one, which lacks only the newest vehicles. Older than the newest: ignored.
    """

    t_s: float
    on_road: tuple[CensusEntry, ...]
    announced: tuple[Announcement, ...]
    formations: tuple[ClosedFormation, ...] = ()
    """The closed formations with a vehicle on the road, foremost first. What is said of one never
    changes, and no block is in two. Empty in the rolling operation."""
    closed_to: int = -1
    """All blocks up to this number are closed; their vehicles are listed here or have left."""
    bridge: int = 0
    """Incarnation of the bridge, which tells this road from an earlier one; 0: not told."""


@frozen
class RoadClock:
    """Bridge to everyone who needs road time and progress, each tick.

    Missing: the receiver's clock stands still until the next one, or a census, so that nothing new
    begins. Late: ignored.
    """

    tick: int
    t_s: float
    demanded: int
    entered: int
    on_road: int
    left: int
    ended: bool
    bridge: int = 0
    """Incarnation of the bridge, which tells this road from an earlier one; 0: not told."""


@frozen
class Report:
    """Agents, bridge and coordinators to the recorder at the end; coordinators now and then, too.

    Missing: the summary counts less. Duplicated: the newest of a sender counts.
    """

    role: Name
    name: Name
    process: Name = Name("unknown")
    """The process that counts; several vehicles may share one. The node fills it in, and the next
    two counters."""
    published: int = 0
    """Messages that the process has published so far."""
    rejected: int = 0
    """Messages so far that were not well formed."""
    solves: int = 0
    unusable: int = 0
    osqp_solves: int = 0
    """Of the solves, those for which OSQP ran."""
    solve_ms: bytes = b""
    """Little-endian float32 CPU milliseconds, one for each tracking solve."""


@frozen
class LogEvent:
    """Any role to the recorder: something worth a line in `events.jsonl`. Missing: not recorded."""

    role: Name
    name: Name
    t_s: float
    kind: Name
    data: dict[str, Any] = field(factory=dict)
