"""Messages about vehicles and the road: senders, receivers, rates, units, effect of loss and delay.

Messages are frozen msgspec structs, which travel as arrays of their fields in the order given here.
`codec` encodes them as MessagePack and checks field types and ranges when decoding, so a core never
receives a malformed message. New fields come last and have a default. `process_messages` has the
messages about processes.
`t_s` is road time [s], the clock that moves the lattice; it advances in ticks. A cell is (column,
lane) in the lattice frame. The sections of docs/MESSAGES.md are generated from the
docstrings of both modules.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from msgspec import field

from laneweave.protocol.lattice import Lattice
from laneweave.protocol.names import Name as Name  # noqa: PLC0414 (exported)
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.wire.field_types import Cell, Int64, Message, PlannedMove, Real

CAR: Final = "car"
"""Name of the type that the scenario's table `vehicle` describes."""


class Ballot(NamedTuple):
    """Identifier of one attempt by one leader process to have one plan executed.

    Part of several messages. Ballots are compared field by field, in this order. No two plans share
    a ballot: a restarted coordinator has a new incarnation.
    """

    term: Int64
    """Term of the leader; each election raises it above every term that other candidates have
    shown. At most `bounds.max_term`."""
    coordinator: Name
    incarnation: Int64
    """Incarnation of the coordinator process [ns]."""
    seq: Int64
    """Sequence number of the ballot in its process."""


class Heartbeat(Message, frozen=True):
    """Coordinator to coordinators, bridge and observers, every `network.heartbeat_s` (wall clock).

    Also sent at once when a coordinator begins or stops leading. Missing for `network.election_s`,
    or for 1.5 times the longest recent silence, at most twice as long: the sender no longer counts
    as a candidate. Late or duplicated: harmless. From a process whose
    token has vanished, or that a newer process of the same name has replaced: only the term is
    used. A higher term than the receiver's, up to `bounds.max_election_term`: a candidate adopts
    it, a leader continues one term above it. With the receiver's own name: ignored.
    """

    coordinator: Name
    """Sender."""
    incarnation: Int64
    """Incarnation of the sender [ns]."""
    term: Int64
    """Highest term that the sender has seen; its own term while it leads."""
    leading: bool
    """Whether the sender leads."""
    plans: Int64
    """Number of plans in force, for observers."""


class PendingTransfer(Message, frozen=True):
    """Transfer of cells by one plan of the rolling operation, as stored by one vehicle.

    Part of other messages. The vehicle owns the cells `before` until it knows that the start gate
    is open, and the cells `after` from then on.
    """

    ballot: Ballot
    """Ballot of the plan."""
    before: tuple[Cell, ...] = ()
    """Cells that the vehicle owns before the gate is open."""
    after: tuple[Cell, ...] = ()
    """Cells that the vehicle owns once the gate is open."""
    roster: tuple[Name, ...] = ()
    """All vehicles that store a transfer of this ballot."""
    open: bool = False
    """Whether the start gate is open; the cells and the roster are then empty."""

    @property
    def withdrawn(self) -> bool:
        """Whether the vehicle has left the lattice, and is gone for this and all lower ballots."""
        return not self.open and not self.roster

    @property
    def undecided(self) -> bool:
        """Whether the start gate still decides which of the cells the vehicle owns."""
        return not self.open and not self.withdrawn


class VehicleRecord(Message, frozen=True):
    """Durable storage of an acceptor of ballots: what outlives the process in charge of a vehicle.

    Part of other messages. SENSE has the record as stored by the motion controller; COMMAND as its
    sender wants it; STATE as stored, with the sender's promise where formations own blocks.
    """

    incarnation: Int64 = 0
    """Incarnation of the process in charge of the vehicle [ns]; 0: none yet."""
    joined: tuple[Int64, ...] = ()
    """Blocks that the vehicle's plans must cover, ascending; none is removed on the lattice."""
    promised: Ballot | None = None
    """Highest promised ballot; stored in the rolling operation, where it binds later processes."""
    accepted: Ballot | None = None
    """Ballot of the newest plan that the process in charge has accepted."""
    owned: tuple[Cell, ...] = ()
    """Rolling operation: cells that the vehicle owns, ascending."""
    transfer: PendingTransfer | None = None
    """Rolling operation: newest transfer of its cells."""


class CurrentMotion(Message, frozen=True):
    """Motion of a vehicle, from which another process in charge of it can continue.

    Part of other messages; like the record, it is stored by the motion controller.
    """

    origin: Cell
    """Cell in which the motion began; the hold cell if the vehicle holds."""
    end_tick: Int64 = 0
    """Tick at which the motion ends."""
    ticks: Int64 = 0
    """Duration of a move [ticks]; 0: the vehicle settles in its cell, or holds. From its cell to
    the same one, without an end: it holds undisturbed, and needs the next SENSE only after so many
    ticks, if nothing changes."""


class Prepare(Message, frozen=True):
    """Leader to each vehicle of the roster that has not promised, every `network.resend_s`.

    Missing: sent again. Duplicated, late, or with a lower ballot than the promised one: no effect,
    but the vehicle answers with its state, which contains the promised ballot. With a term above
    `bounds.max_term`: refused.
    """

    ballot: Ballot
    blocks: tuple[Int64, ...]
    """Blocks that the plan may use, ascending: the blocks of one formation or several joined."""
    roster: tuple[Name, ...]
    """All vehicles on the road that entered in these blocks; in the rolling operation, the vehicles
    that move and the owners of the cells that they need."""


class Plan(Message, frozen=True):
    """Leader to each vehicle of the roster that has not accepted, every `network.resend_s`.

    Each ballot has one plan. Missing: sent again; no vehicle moves until all have accepted (start
    gate). Duplicated or late: ignored. A plan is also ignored (V3) if its ballot is not the
    promised one, if it cannot be executed safely, if its blocks differ from the joined ones or do
    not cover its territory, or if its cell transfers are invalid. Vehicles derive the dependencies
    between moves from this message.
    """

    ballot: Ballot
    blocks: tuple[Int64, ...]
    """Blocks of the ballot, which contain the territory; in the rolling operation those in which
    the members entered, whose states they read."""
    roster: tuple[Name, ...]
    """Vehicles of the ballot."""
    incarnations: dict[Name, Int64]
    """Incarnation of the process in charge of each vehicle when it promised [ns]."""
    start_cells: dict[Name, Cell]
    """Hold cell of each vehicle, from its promise."""
    moves: dict[Name, tuple[PlannedMove, ...]]
    """Moves (step, from, to) of each vehicle, in ascending order of steps."""
    t0_s: Real
    """Road time at which step 0 may begin [s]."""
    slot_s: Real
    """T_F [s]: step n may begin at t0 + n T_F. A move takes 0.2 s less, or `formation.move_s`."""
    territory: tuple[Cell, ...]
    """All start cells and the footprints of all moves."""
    before: dict[Name, tuple[Cell, ...]] = field(default_factory=dict)
    """Rolling operation: cells that each vehicle owns when the plan is made."""
    after: dict[Name, tuple[Cell, ...]] = field(default_factory=dict)
    """Rolling operation: cells that each vehicle owns once the start gate is open."""


class VehicleState(Message, frozen=True):
    """Vehicle to its formation and the coordinators, after each SENSE and at once on every change.

    The state serves as promise, acceptance and progress report. Missing: vehicles that wait for it
    hold. Late or duplicated: harmless to vehicles, since "completed k moves of ballot b" stays
    true; leaders drop states older than that vehicle's newest, unless only older ones arrive for
    0.5 s. With a ballot other than that of the receiver's plan: not used for this plan.
    """

    vehicle: Name
    """Vehicle that the state describes; a caretaker sends the state while there is no agent."""
    block: Int64
    """Number of the block in which the vehicle entered."""
    record: VehicleRecord
    """As stored; the promise as made by the process in charge, the acceptance only if it is one of
    the promised ballot, and the owned cells only once the promise is stored."""
    ready: bool
    """Whether the plan is accepted and the vehicle holds or makes a move of this plan."""
    completed: Int64
    """k: number of completed moves of the accepted plan."""
    hold_cell: Cell
    """Cell in which the vehicle holds, or the target of its motion."""
    moving: bool
    """Whether a motion is in progress."""
    go: bool
    """Whether the start gate of the accepted plan is open."""
    done: bool
    """Whether all moves of the accepted plan are completed."""
    overdue: bool
    """Whether the next move has been due for 1.5 slots, or for a slot plus 2 s if that is less."""
    attended: bool
    """Whether an agent drives the vehicle; otherwise a caretaker does, and the vehicle holds."""
    s_m: Real
    """Position of the front bumper along the road [m], from the start of the road."""
    y_m: Real
    """Position of the body centre across the road [m], from the right edge."""
    speed_mps: Real
    """Speed along the road [m/s]."""
    t_s: Real

    @property
    def accepted(self) -> bool:
        """Whether the plan of the promised ballot is accepted, and this is stored."""
        return self.record.accepted is not None


class Motion(Message, frozen=True):
    """Vehicle to others in its own and both adjacent stretches of columns: its current motion.

    Sent when the motion begins and every 10 ticks while it lasts; a vehicle that holds sends
    nothing. The trajectory follows from the scenario, which all vehicles share. Only the trackers
    of other vehicles use the message, and only if they sense a vehicle at the position that follows
    from it. Missing, late, or not repeated for 30 ticks: trackers rely on their sensors alone.
    Duplicated: no effect. Older than the newest motion of that vehicle (by incarnation, then by
    `begin_tick`), or not a possible move in the scenario: ignored.
    """

    vehicle: Name
    """Sender."""
    incarnation: Int64
    """Incarnation of the sending process [ns]."""
    stretch: Int64
    """Index of the stretch of columns in which the motion began."""
    origin: Cell
    target: Cell
    begin_tick: Int64
    """Tick at which the motion began."""
    ticks: Int64
    """Duration [ticks]."""
    tick: Int64
    """Tick at which the message was sent."""


class Neighbour(Message, frozen=True):
    """Nearest vehicle ahead or behind in a lane, as measured by sensors; part of `Sense`."""

    lane: Int64
    gap_m: Real
    """Net bumper-to-bumper distance along the road [m]; negative: side by side."""
    speed_mps: Real
    """Speed along the road [m/s]."""
    accel_mps2: Real = 0.0
    """Acceleration along the road [m/s2]."""


class Sense(Message, frozen=True):
    """Bridge to one vehicle at each tick: measurements and the state of its motion controller.

    To a vehicle that holds undisturbed only every `runtime.hold_period_ticks`, or when anything
    changes.

    Missing: sent again every `runtime.tick_resend_s` until `runtime.tick_deadline_s`, or at shorter
    intervals while messages are lost; then the vehicle continues its last trajectory. Duplicated:
    the agent repeats its answer. Older than the newest tick of the same bridge, or from an earlier
    bridge: ignored. From a newer bridge, or if only older ones arrive for 0.5 s (2.5 s while it
    holds undisturbed): the agent discards its state and takes a new incarnation. A message with
    `left` is repeated for 20 ticks or until the agent's token vanishes; when a run ends, each
    vehicle on the road receives one.
    """

    vehicle: Name
    """Receiver."""
    tick: Int64
    t_s: Real
    measured: tuple[Real, Real, Real, Real, Real, Real]
    """State (s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2]); s is the front bumper along
    the road, y the body centre from the right edge."""
    hold_cell: Cell
    """Cell in which the motion controller will hold unless it receives a new command."""
    motion: CurrentMotion
    """As stored by the motion controller; its end is at most `tick` if the vehicle holds."""
    preferred_lane: Int64
    record: VehicleRecord
    """As stored by the motion controller."""
    ahead: tuple[Neighbour, ...]
    """Neighbours ahead: at most one per lane that the body touches or is next to."""
    behind: tuple[Neighbour, ...] = ()
    """Neighbours behind: at most one per lane that the body touches or is next to."""
    setpoint: tuple[Real, Real] = (0.0, 0.0)
    """Accelerations last commanded to the actuators, along and across the road [m/s2]."""
    block: Int64 = 0
    """Number of the block in which the vehicle entered."""
    caretaker: bool = False
    """Whether the caretaker is in charge because the agent is absent or does not answer in time."""
    left: bool = False
    """Whether the vehicle has left the road; its agent then sends its report and stops."""
    bridge: Int64 = 0
    """Incarnation of the bridge [ns]; a new value means a new road; 0: not given."""
    off_lattice: bool = False
    """Whether the vehicle has no cell: it has stopped before the end of its lane, or drives back
    into the lattice. Its motion controller drives alone."""
    vehicle_type: Name = Name(CAR)
    """Type of the vehicle, which determines its limits."""
    senders_per_km: Real = 0.0
    """Vehicles of the road per km of it around the vehicle, as the load of a radio channel shows;
    only with a radio (`radio.technology`)."""


class Command(Message, frozen=True):
    """Agent to the motion controller of its vehicle (in the bridge), in answer to each `Sense`.

    Also sent between ticks, for the last one, when there is something to store or the vehicle no
    longer holds undisturbed.

    A command contains the complete remaining trajectory. Missing: the controller executes its
    stored trajectory, then holds. Duplicated: no effect. Only an answer to the current tick that
    arrives in time is executed; a late answer only ends the agent's silence. From an older
    incarnation than the one in charge: refused. From a newer one: that process takes charge, unless
    its incarnation is more than a day ahead of the bridge's clock.
    The record is stored for any tick, and confirmed in the next SENSE. With jerks that are not
    pairs of finite numbers, or cells outside the road's lanes: refused and logged.
    """

    vehicle: Name
    """Sender."""
    record: VehicleRecord
    """To be stored: the incarnation is that of the sending process, the blocks are added to the
    joined ones, and the transfer is begun or opened; owned cells follow from it."""
    tick: Int64
    """Tick of the SENSE that it answers."""
    hold_cell: Cell
    """Cell in which the controller holds after the last jerk."""
    motion: CurrentMotion
    """To be stored; its end is 0 if the vehicle holds."""
    jerks: bytes
    """Little-endian float32 pairs (along, across) [m/s3], one per tick, from `tick` on."""

    @property
    def undisturbed_ticks(self) -> int:
        """Number of ticks after which the vehicle needs the next SENSE; 0: in the next tick.

        It holds undisturbed: its motion leads from its cell to the same cell, and has no end.
        """
        motion = self.motion
        holds = motion.end_tick == 0 and motion.origin == self.hold_cell
        return motion.ticks if holds else 0


class OffLattice(Message, frozen=True):
    """Body of a vehicle that has no cell; part of `CensusEntry`."""

    lane: Int64
    """Lane in which it is; usually one that ends, which it has not left in time."""
    rear_m: Real
    """Position of its rear bumper, or where that will stand; the end of the road: it is about to
    get cells in this lane [m]."""


class CensusEntry(Message, frozen=True):
    """Vehicle on the road, as recorded at its entry; part of `Census`."""

    vehicle: Name
    cell: Cell
    """Cell in which it entered the lattice last; its column determines the block."""
    preferred_lane: Int64
    """Lane in which it wants to leave the road; -1: any lane that reaches its destination."""
    entered_s: Real
    """Road time of its entry [s]."""
    off_lattice: OffLattice | None = None
    """None: the vehicle has cells, and takes part in plans."""
    destination: Name = Name(END_OF_ROAD)
    """Name of the exit by which it wants to leave the road; `end`: the end of the road."""
    vehicle_type: Name = Name(CAR)
    """Type of the vehicle, which determines the moves that it can drive."""
    ready_s: Real = 0.0
    """Road time from which it is in this cell, or almost: it is ready for no plan before [s]."""
    processes: tuple[Name, ...] = ()
    """Processes with an agent for it, as keys name them; empty: see `addresses_of`."""


def addresses_of(vehicle: Name, processes: tuple[Name, ...]) -> tuple[Name, ...]:
    """Return the processes to which messages to a vehicle are addressed.

    `processes` are those with an agent for it; without any, one with the name of the vehicle.
    """
    return processes or (vehicle,)


class ClosedFormation(Message, frozen=True):
    """Formation that accepts no more vehicles, and its blocks; part of `Census`."""

    first_block: Int64
    """Number of its foremost block, which is also the number of the formation."""
    last_block: Int64
    """Number of its rearmost block."""
    closed_s: Real
    """Road time at which it was closed [s]."""

    @property
    def blocks(self) -> tuple[Int64, ...]:
        """Block numbers, ascending."""
        return tuple(range(self.first_block, self.last_block + 1))

    def columns(self, lattice: Lattice) -> range:
        """Return the columns of the formation in ascending order."""
        return range(
            lattice.block_range(self.last_block).start, lattice.block_range(self.first_block).stop
        )


class Announcement(Message, frozen=True):
    """Vehicle that will arrive soon; part of `Census`."""

    vehicle: Name
    lane: Int64
    """Lane in which it arrives."""
    preferred_lane: Int64
    arrival_s: Real
    """Road time at which it would pass its entrance without other vehicles [s]."""


class Census(Message, frozen=True):
    """Bridge to coordinators, fleets and observers, on every change and every 10 ticks.

    The census changes when a vehicle enters or leaves, a formation closes, or an announcement is
    made or withdrawn. The census is complete: a vehicle is on the road at `t_s` if and only if it
    is listed. In each lane, the number of announced vehicles exceeds the number of free cells that
    pass within `runtime.announce_s` by at most one, so that agents start only for vehicles that can
    enter soon. An agent process with a shard starts an agent for each listed vehicle of its shard,
    and stops the agents of vehicles that are no longer listed.

    Missing: the receiver uses the older census, and plans nothing for formations closed since then.
    Duplicated or older than the newest: ignored. A coordinator's road time is the newest `t_s` from
    the census and the clock; more than 10 s ahead of it: refused.
    """

    t_s: Real
    on_road: tuple[CensusEntry, ...]
    """All vehicles on the road."""
    announced: tuple[Announcement, ...]
    """Vehicles that wait at an entrance or arrive within `runtime.announce_s`."""
    formations: tuple[ClosedFormation, ...] = ()
    """Closed formations with a vehicle on the road, foremost first. Listed formations never change,
    and no block belongs to two of them. Empty in the rolling operation."""
    closed_to: Int64 = -1
    """All blocks up to this number are closed: their vehicles are listed or have left."""
    bridge: Int64 = 0
    """Incarnation of the bridge [ns]; a new value means a new road; 0: not given."""
    ends: tuple[OffLattice, ...] = ()
    """Lanes that end earlier now for plans, since vehicles without agents are ahead."""

    @property
    def on_lattice(self) -> tuple[CensusEntry, ...]:
        """The vehicles that have cells."""
        return tuple(entry for entry in self.on_road if entry.off_lattice is None)

    @property
    def off_lattice(self) -> tuple[OffLattice, ...]:
        """The bodies of the vehicles that have no cells."""
        bodies = (entry.off_lattice for entry in self.on_road)
        return tuple(body for body in bodies if body is not None)


class RoadClock(Message, frozen=True):
    """Bridge to coordinators and observers, each tick: road time and progress.

    Missing: the coordinator's road time stops until the next clock or census, so the coordinator
    begins nothing new. Late or duplicated: ignored, unless only earlier ones arrive for 0.5 s: then
    the newest one was wrong. More than 10 s ahead of the receiver's road time: refused. Agents take
    road time from `Sense`.
    """

    tick: Int64
    t_s: Real
    demanded: Int64
    """Number of vehicles that have arrived so far."""
    entered: Int64
    """Number of vehicles that have entered so far."""
    on_road: Int64
    left: Int64
    """Number of vehicles that have left so far."""
    ended: bool
    """Whether the run is over."""
    bridge: Int64 = 0
    """Incarnation of the bridge [ns]; a new value means a new road; 0: not given."""
