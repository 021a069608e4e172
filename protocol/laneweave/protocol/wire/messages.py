"""All messages, with units, sender, rate, and what the receiver does when one is not as expected.

All are frozen attrs classes; `codec` turns them into MessagePack and back and checks field types,
so a core never sees a malformed message. `t_s` is road time [s], the clock that moves the lattice;
it advances in ticks. A cell is (column, lane) in the lattice frame. docs/PROTOCOL.md has a section
for each class, generated from the docstrings of this module.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, NewType

from attrs import field, frozen
from cattrs import override

from laneweave.protocol.lattice import Cell, Lattice, PlannedMove

Name = NewType("Name", str)
"""Name of a vehicle, coordinator or role: letters, digits, `_`, `-`, `.`; at most 64."""


class Ballot(NamedTuple):
    """Identifier of one attempt of one leader process to execute one plan.

    Part of several messages; compared field by field, in this order. Never used for two plans: a
    coordinator that restarts has another incarnation.
    """

    term: int
    """Term of the leader, raised at each election and above every term that it sees."""
    coordinator: Name
    incarnation: int
    """Start time of the coordinator process [ns]."""
    seq: int
    """Number of the ballot in this process."""


@frozen
class Heartbeat:
    """Coordinator to coordinators, bridge and observers, every `network.heartbeat_s` (wall clock).

    Also sent at once when a coordinator begins or stops leading. Missing for `network.election_s`:
    the sender is no longer a candidate. Late or duplicated: harmless. From a process whose token is
    gone, or older than one heard since: only its term is noted. A term above its own: a candidate
    notes it, a leader continues one term above it. Under the receiver's own name: ignored.
    """

    coordinator: Name
    """Sender."""
    incarnation: int
    """Incarnation of the sender [ns]."""
    term: int
    """Highest term that it has seen; its own while it leads."""
    leading: bool
    formations: int
    """Number of plans in force, for observers."""


@frozen
class PendingTransfer:
    """Pending transfer of cells with one plan of the rolling operation, as one vehicle stores it.

    Part of other messages. The vehicle owns `before` until it knows that the start gate is open,
    then `after`.
    """

    ballot: Ballot
    """Ballot of the plan."""
    before: tuple[Cell, ...] = ()
    """Cells that the vehicle owns before the gate is open."""
    after: tuple[Cell, ...] = ()
    """Cells that the vehicle owns once the gate is open."""
    roster: tuple[Name, ...] = ()
    """Vehicles with a pending transfer of this ballot."""
    open: bool = False
    """The start gate is open; the other fields are empty then."""


@frozen
class Prepare:
    """Leader to each vehicle of the roster that has not promised, every `network.resend_s`.

    Missing: sent again. Duplicated, late, or of an older ballot than the promised one: changes
    nothing; the vehicle answers with its state, which shows the promised ballot.
    """

    ballot: Ballot
    formations: tuple[int, ...]
    """Blocks that the plan may use, ascending; of one formation or of joined ones."""
    roster: tuple[Name, ...]
    """All vehicles on the road that entered in these blocks."""


@frozen
class Plan:
    """Leader to each vehicle of the roster that has not accepted, every `network.resend_s`.

    One per ballot. Missing: sent again; no vehicle moves before all have accepted (start gate).
    Duplicated, late, of any ballot but the promised one, not executable, for other blocks than the
    vehicle has joined, leaving these blocks, or with unsound transfers of cells: ignored (V3).
    Dependencies between moves are not sent; they are a pure function of this message.
    """

    ballot: Ballot
    formations: tuple[int, ...]
    """Blocks of the ballot, which contain the territory."""
    roster: tuple[Name, ...]
    incarnations: dict[Name, int]
    """Incarnation of the process in charge of each vehicle when it promised [ns]."""
    start_cells: dict[Name, Cell]
    """Hold cell in each vehicle's promise."""
    moves: dict[Name, tuple[PlannedMove, ...]]
    """(step, from, to) of each vehicle, steps ascending; steps without a move are not listed."""
    t0_s: float
    """Road time at which step 0 may begin [s]."""
    slot_s: float
    """T_F: step n may begin at t0 + n slot [s]. A move takes 0.2 s less, or `formation.move_s`."""
    territory: tuple[Cell, ...]
    """Start cells and footprints of all moves."""
    before: dict[Name, tuple[Cell, ...]] = field(factory=dict)
    """Rolling operation: cells that each vehicle owns when the plan is made."""
    after: dict[Name, tuple[Cell, ...]] = field(factory=dict)
    """Rolling operation: cells that each vehicle owns once the start gate is open."""


@frozen
class VehicleState:
    """Vehicle to its formation and the coordinators, every tick and at once on every change.

    It is promise, acknowledgement and progress report in one. Missing: vehicles that wait for it
    hold. Late or duplicated: harmless to vehicles, since "completed k moves of ballot b" stays
    true; the leader drops states older than its newest. Of another ballot than the receiver's plan:
    says nothing about this plan.
    """

    vehicle: Name
    """Sender; the caretaker sends for a vehicle without an agent."""
    incarnation: int
    """Incarnation of the process in charge of the vehicle [ns]."""
    formation: int
    """Number of the block in which the vehicle entered."""
    joined: tuple[int, ...]
    """Blocks that its plans must have, ascending, as its motion controller has stored them."""
    promised: Ballot | None
    accepted: bool
    """It has the plan of the promised ballot, and its motion controller has stored that."""
    ready: bool
    """Accepted, and not moving, or moving in a move of this plan."""
    completed: int
    """k: completed moves of the accepted plan."""
    hold_cell: Cell
    """Cell in which it holds: its own, or the target while it moves."""
    moving: bool
    go: bool
    """Its start gate is open."""
    done: bool
    """It has completed all moves of the accepted plan."""
    overdue: bool
    """Its next move has been due for more than 1.5 slots, or a slot and 2 s if that is less."""
    attended: bool
    """An agent drives it; without one its caretaker sends this state, and it only holds."""
    s_m: float
    """Position of the front bumper along the road [m], from the start of the road."""
    y_m: float
    """Position of the body centre across the road [m], from the right edge."""
    speed_mps: float
    """Speed along the road [m/s]."""
    t_s: float
    """Road time of the tick [s]."""
    owned: Annotated[tuple[Cell, ...], override(rename="estate")] = ()
    """Rolling operation: cells that it owns; empty until its motion controller has stored the
    promise."""
    transfer: Annotated[PendingTransfer | None, override(rename="deed")] = None
    """Rolling operation: its newest pending transfer of cells."""


@frozen
class Motion:
    """Vehicle to those in its own and both adjacent stretches of columns: its motion under way.

    Sent when the motion begins and every 10 ticks while it lasts; a vehicle that holds sends
    nothing. The trajectory is not sent: it follows from the scenario, which all vehicles share.
    Only the trackers of others use it, and only if they sense a vehicle where the motion says.
    Missing, late, or not repeated for 30 ticks: others use their sensors alone. Duplicated: no
    effect. Older than the vehicle's newest motion, by incarnation and then `begin_tick`, or not a
    move of the scenario: ignored.
    """

    vehicle: Name
    """Sender."""
    incarnation: int
    """Incarnation of the sending process [ns]."""
    stretch: int
    """Number of the stretch of columns in which the motion began."""
    origin: Cell
    target: Cell
    begin_tick: int
    """Tick at which the motion began."""
    ticks: int
    """Duration [ticks]."""
    tick: int
    """Tick at which this was sent."""


@frozen
class Neighbour:
    """Nearest vehicle ahead or behind in a lane, as local sensing sees it; part of `Sense`."""

    lane: int
    gap_m: float
    """Net bumper-to-bumper distance along the road [m]; negative: side by side."""
    speed_mps: float
    """Speed along the road [m/s]."""
    accel_mps2: float = 0.0
    """Acceleration along the road [m/s2]."""


@frozen
class Sense:
    """Bridge to one vehicle at each tick: the state of its sensors and its motion controller.

    Missing: sent again every `runtime.tick_resend_s` until `runtime.tick_deadline_s`; then the
    vehicle continues its last trajectory. Duplicated: the agent gives the same answer again. Older
    than the newest tick of the same bridge, or from an older bridge than the newest: ignored. From
    a newer bridge: the agent forgets the earlier road and takes a new incarnation. `left` is
    repeated for 20 ticks or until the agent's token is gone; at the end of a run it goes once to
    every vehicle on the road.
    """

    vehicle: Name
    """Receiver."""
    tick: int
    t_s: float
    """Road time of the tick [s]."""
    state: tuple[float, float, float, float, float, float]
    """Measured (s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2]); s is the front bumper
    along the road, y the body centre from the right edge."""
    hold_cell: Cell
    """Cell in which the motion controller will hold without a new command."""
    motion_end_tick: int
    """Tick at which the motion under way ends; not after `tick`: the vehicle holds."""
    motion_origin: Cell
    """Cell in which the motion under way began; `hold_cell` when it holds."""
    preferred_lane: int
    ahead: tuple[Neighbour, ...]
    """Neighbours ahead: at most one per lane that the body touches or is next to."""
    behind: tuple[Neighbour, ...] = ()
    """Neighbours behind, likewise."""
    setpoint: tuple[float, float] = (0.0, 0.0)
    """Newest accelerations commanded to the actuators, along and across [m/s2]."""
    formation: int = 0
    """Number of the block in which the vehicle entered."""
    attendant: int = 0
    """Incarnation of the process in charge of the vehicle [ns]; 0: none yet."""
    motion_ticks: int = 0
    """Duration of the move under way [ticks]; 0: the vehicle settles in its cell, or holds."""
    caretaker: bool = False
    """The caretaker is in charge, because the agent died or fell silent."""
    joined: tuple[int, ...] = ()
    """Blocks that the controller has stored as joined."""
    accepted: Ballot | None = None
    """Newest plan accepted by the process in charge, as the controller has stored it."""
    left: bool = False
    """The vehicle has left the road: its agent reports and ends."""
    owned: Annotated[tuple[Cell, ...], override(rename="estate")] = ()
    """Rolling operation: cells that the vehicle owns."""
    promised: Ballot | None = None
    """Rolling operation: highest ballot promised by any process in charge, as the controller has
    stored it."""
    transfer: Annotated[PendingTransfer | None, override(rename="deed")] = None
    """Rolling operation: the newest pending transfer of cells."""
    bridge: int = 0
    """Incarnation of the bridge [ns]: another one means another road; 0: not given."""


@frozen
class Command:
    """Agent to the motion controller of its vehicle (in the bridge), the answer to each `Sense`.

    It contains the whole remaining trajectory. Missing: the controller plays the trajectory that it
    has, then holds. Duplicated: no effect. Only the answer to the current tick is played, while the
    bridge waits for answers; a late one only ends `silent`. From an older incarnation than the one
    in charge: refused; from a newer one: that process takes charge. `joined`, `accepted`,
    `promised` and `deed` are stored whatever the tick, and confirmed in the next SENSE. Jerks that
    are not finite pairs, or cells off the road's lanes: refused and logged.
    """

    vehicle: Name
    """Sender."""
    incarnation: int
    """Incarnation of the sending process [ns]."""
    tick: int
    """Tick that it answers."""
    hold_cell: Cell
    """Cell in which the controller holds after the last jerk."""
    motion_end_tick: int
    """Tick at which the motion under way ends; 0 when the vehicle holds."""
    motion_origin: Cell
    """Cell in which the motion began."""
    jerks: bytes
    """Little-endian float32 pairs (along, across) [m/s3], one per tick of the horizon, from `tick`
    on."""
    motion_ticks: int = 0
    """Duration of the move under way [ticks]; 0: the vehicle settles in its cell, or holds."""
    joined: tuple[int, ...] = ()
    """Blocks that the controller shall store as joined, in addition to those that it has."""
    accepted: Ballot | None = None
    """Accepted plan, which the controller shall store."""
    promised: Ballot | None = None
    """Rolling operation: promised ballot, which the controller shall store."""
    transfer: Annotated[PendingTransfer | None, override(rename="deed")] = None
    """Rolling operation: transfer of the newest plan, which the controller shall store or open."""


@frozen
class CensusEntry:
    """Vehicle on the road, as counted at its entry; part of `Census`."""

    vehicle: Name
    cell: Cell
    """Cell in which it entered; its column determines the block."""
    preferred_lane: int
    entered_s: float
    """Road time of its entry [s]."""


@frozen
class ClosedFormation:
    """Blocks of a formation that no vehicle enters any more; part of `Census`."""

    first_block: int
    """Number of its foremost block, which is also the number of the formation."""
    last_block: int
    """Number of its rearmost block."""
    closed_s: float
    """Road time at which it was closed [s]."""

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
    """Vehicle that will arrive soon; part of `Census`."""

    vehicle: Name
    lane: int
    """Lane on which it arrives."""
    preferred_lane: int
    arrival_s: float
    """Road time at which it would pass s = 0 on a free road [s]."""


@frozen
class Census:
    """Bridge to coordinators, fleets and observers, on every change and every 10 ticks.

    A change: a vehicle has entered, left, or is announced or no longer announced, or a formation is
    closed. The census is complete: a vehicle is on the road at `t_s` if and only if it is listed.
    On each lane, only as many vehicles are announced as free cells pass in `runtime.announce_s`,
    and one more, so that agents start only for vehicles that can enter soon. An agent process with
    a shard starts an agent for each listed vehicle of its shard, and ends those no longer listed.

    Missing: the receiver works with the older census, and plans nothing for formations closed
    since. Duplicated: no effect. Late, that is older than the newest: ignored. A coordinator's road
    time is the newest `t_s` of census and clock.
    """

    t_s: float
    """Road time [s]."""
    on_road: tuple[CensusEntry, ...]
    """All vehicles on the road."""
    announced: tuple[Announcement, ...]
    """Vehicles that wait at the entrance or arrive within `runtime.announce_s`."""
    formations: tuple[ClosedFormation, ...] = ()
    """Closed formations with a vehicle on the road, foremost first; an entry never changes, and no
    block is in two. Empty in the rolling operation."""
    closed_to: int = -1
    """All blocks up to this number are closed; their vehicles are listed, or have left."""
    bridge: int = 0
    """Incarnation of the bridge [ns]: another one means another road; 0: not given."""


@frozen
class RoadClock:
    """Bridge to coordinators and observers, each tick: road time and progress.

    Missing: the coordinator's clock stands still until the next clock or census, so that nothing
    new begins. Late or duplicated: ignored. Agents take road time from `Sense`.
    """

    tick: int
    t_s: float
    """Road time of the tick [s]."""
    demanded: int
    """Vehicles that have arrived so far."""
    entered: int
    """Vehicles that have entered so far."""
    on_road: int
    """Vehicles on the road."""
    left: int
    """Vehicles that have left so far."""
    ended: bool
    """The run is over."""
    bridge: int = 0
    """Incarnation of the bridge [ns]: another one means another road; 0: not given."""


@frozen
class Report:
    """Any role to the recorder: its counters.

    Sent by agents when their vehicle has left or they are asked to end, by the bridge at the end of
    its run, and by coordinators every 2 s and when they are asked to end. Missing: the summary
    counts less; at the end of a run the bridge waits up to 2 s for the reports of all its agents.
    Late: not recorded. Duplicated: the newest of a sender counts. Counters of a process are the
    maximum over its senders, all others are summed.
    """

    role: Name
    name: Name
    process: Name = Name("unknown")
    """Process that counts, set by the node; several vehicles may share one."""
    published: int = 0
    """Messages published by the process since its start, including this one; set by the node."""
    rejected: int = 0
    """Malformed messages received by the process since its start; set by the node."""
    solves: int = 0
    """Ticks that were tracked."""
    unusable: int = 0
    """Solves without a usable solution."""
    osqp_solves: int = 0
    """Solves with OSQP; in the others the unconstrained optimum satisfies all constraints."""
    solve_ms: bytes = b""
    """CPU time of each solve [ms], little-endian float32."""


@frozen
class LogEvent:
    """Any role to the recorder, when something happens: a line in `events.jsonl`.

    So far only coordinators send events; the bridge writes its own directly. Missing, or late,
    after the end of the run: not recorded. Duplicated: recorded twice.
    """

    role: Name
    name: Name
    t_s: float
    """Road time [s]."""
    kind: Name
    """One of the names in `wire.events`."""
    data: dict[str, Any] = field(factory=dict)
    """Details, as JSON values."""
