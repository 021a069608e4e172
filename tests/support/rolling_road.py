"""A little road in the rolling operation: real rules, motion controllers and handovers.

Nothing but messages connects its cars and leaders, and each message may be lost, late, doubled and
overtaken. Bodies, time and planning are left out: a car that has begun a move is under way until
somebody says that it has arrived, and leaders think of moves by drawing them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from random import Random

from attrs import define, field, frozen

from laneweave.coordinator.ballots.ballot_round import is_older
from laneweave.coordinator.rolling.ownership import owned_cells
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.protocol.lattice import Cell, footprint
from laneweave.protocol.scenario.fields import FormationSettings, Scenario
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.plan_execution import VEHICLE_RULES, PlanExecution
from laneweave.protocol.wire import messages
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from support.road_vehicles import controller_in

ROLLING = Scenario(formation=FormationSettings(operation="rolling"))
LATTICE, TICK_S = ROLLING.lattice, ROLLING.runtime.tick_s
UNDER_WAY = 2**40
"""A tick that never comes: the motion ends when the test says so."""
LONG_AGO_S, LATER_S = 0.0, 1e3
SLOT_S = 4.0

OWNED: dict[str, tuple[Cell, ...]] = {
    "A": ((0, 0), (1, 0), (2, 0), (-1, 0)),
    "B": ((-2, 0), (-3, 0), (-4, 0)),
    "C": ((1, 1), (2, 1), (0, 1), (-1, 1)),
    "D": ((-2, 1), (-3, 1), (-4, 1)),
}
"""Each car is in the first of its cells."""


def controller_of(cells: Iterable[Cell]) -> MotionController:
    """Return the controller of a vehicle that owns cells and holds in the first one."""
    first, *others = cells
    controller = controller_in(first, ROLLING)
    for cell in (first, *others):
        controller.assign_cell(cell)
    return controller


@define
class Car:
    """A motion controller, and the process in charge of it."""

    name: messages.Name
    controller: MotionController
    rules: RuleBook = VEHICLE_RULES
    tick: int = 0
    attended: bool = True
    execution: PlanExecution = field(init=False)
    sense: messages.Sense = field(init=False)
    """The newest one."""

    def __attrs_post_init__(self) -> None:
        """Start a process."""
        self.start()

    @property
    def under_way(self) -> bool:
        return self.controller.motion_end_tick == UNDER_WAY

    def start(self, *, attended: bool = True) -> None:
        """Put a new process in charge: an agent, or one that never moves the vehicle."""
        self.attended = attended
        self.controller.put_in_charge(self.controller.attendant + 1)
        self.sense = self.sense_now()
        self.execution = PlanExecution(
            vehicle=self.name,
            incarnation=self.controller.attendant,
            hold_cell=self.controller.hold_cell,
            lattice=LATTICE,
            joined=(),
            moving=self.under_way,
            rules=self.rules,
            owned=frozenset(self.controller.owned),
        )
        self.execution.on_owned(self.sense)

    def sense_now(self) -> messages.Sense:
        controller = self.controller
        return messages.Sense(
            self.name, self.tick, LATER_S + self.tick, controller.plant.state, controller.hold_cell,
            controller.motion_end_tick, controller.motion_origin, 0, (), (),
            attendant=controller.attendant, accepted=controller.accepted,
            owned=controller.owned, promised=controller.promised, transfer=controller.transfer,
        )  # fmt: skip

    def command(self) -> messages.Command:
        execution = self.execution
        return messages.Command(
            self.name, execution.incarnation, self.tick, execution.hold_cell, 0,
            self.controller.hold_cell, b"", accepted=execution.wanted_accepted,
            promised=execution.wanted_promised, transfer=execution.transfer,
        )  # fmt: skip

    def state(self) -> messages.VehicleState:
        return self.execution.state(self.sense, 0, attended=self.attended)

    def state_now(self) -> messages.VehicleState:
        """Return what it would show if its process had just heard of its controller."""
        return self.execution.state(self.sense_now(), 0, attended=self.attended)

    def take(self, sense: messages.Sense) -> None:
        """Hear of the controller, as a process in charge does."""
        if sense.attendant != self.execution.incarnation or sense.tick < self.sense.tick:
            return
        self.sense = sense
        self.execution.on_stored(sense.accepted)
        self.execution.on_owned(sense)

    def act(self) -> None:
        """Open the gate and begin a move, if they may."""
        if self.attended:
            execution = self.execution
            arrived = not self.under_way and execution.hold_cell == self.controller.hold_cell
            if execution.moving and arrived:
                execution.end_motion()
            execution.tick(LATER_S)

    def obey(self, command: messages.Command) -> None:
        """Take a COMMAND in the controller."""
        controller = self.controller
        controller.store_requests(command)
        if command.incarnation != controller.attendant or command.tick <= controller.command_tick:
            return
        controller.command_tick = command.tick
        if command.hold_cell != controller.hold_cell:
            controller.motion_origin = controller.hold_cell
            controller.hold_cell = command.hold_cell
            controller.motion_end_tick = UNDER_WAY

    def told(self, message: messages.Prepare | messages.Plan | messages.VehicleState) -> None:
        """Take a message of others in the process in charge."""
        if isinstance(message, messages.Prepare):
            self.execution.on_prepare(message)
        elif isinstance(message, messages.VehicleState):
            if self.attended:
                self.execution.on_state(message)
        elif self.attended or not message.moves.get(self.name):
            self.execution.on_plan(message)


@define
class Leader:
    """Somebody who thinks to lead."""

    name: messages.Name
    seq: int = 0
    states: dict[messages.Name, messages.VehicleState] = field(factory=dict)
    handovers: list[CellTransfer] = field(factory=list)

    def hear(self, state: messages.VehicleState) -> None:
        known = self.states.get(state.vehicle)
        if known is not None and is_older(state, known):
            return
        self.states[state.vehicle] = state
        for handover in self.handovers:
            if state.vehicle in handover.roster and handover.wakeup_s is not None:
                handover.on_state(state, self.states, 0.0)

    def owners(self) -> dict[Cell, messages.Name]:
        return {
            cell: name
            for name, state in self.states.items()
            for cell in (owned_cells(state, self.states) or ())
        }

    def think(self, rng: Random, term: int) -> None:
        """Begin a handover for a move that seems possible."""
        busy = any(handover.wakeup_s is not None for handover in self.handovers)
        if busy and rng.random() < 0.8:
            return
        owners = self.owners()
        held = {state.hold_cell for state in self.states.values()}
        name = rng.choice(sorted(self.states) or [messages.Name("A")])
        if name not in self.states:
            return
        column, lane = self.states[name].hold_cell
        target = (column + rng.choice((-1, 0, 1)), rng.choice((0, 1)))
        cells = footprint((column, lane), target)
        if len(cells) < 2 or not set(owners) >= cells or cells & held != {(column, lane)}:
            return
        roster = tuple(sorted({name} | {owners[cell] for cell in cells}))
        if roster == (name,) and rng.random() < 0.7:
            return
        self.seq += 1
        ballot = messages.Ballot(term, self.name, 1, self.seq)
        move = ((column, lane), target)
        self.handovers = [
            *self.handovers[-2:],
            CellTransfer(
                ballot=ballot,
                roster=roster,
                moves={name: move},
                t0_s=LONG_AGO_S,
                slot_s=SLOT_S,
                resend_s=0.0,
            ),
        ]


@frozen
class Mail:
    """A message on its way."""

    to: messages.Name
    message: object


class WrongError(AssertionError):
    """Something that must never be."""


@define
class Road:
    """Cars, leaders, and what is under way between them."""

    rng: Random
    rules: RuleBook = VEHICLE_RULES
    cars: dict[messages.Name, Car] = field(init=False)
    leaders: tuple[Leader, ...] = field(init=False)
    mail: list[Mail] = field(factory=list)
    opened: set[messages.Ballot] = field(factory=set)
    """Ballots whose gates some controller knows to be open."""
    moves: int = 0
    """Moves that have begun."""
    granted: int = 0

    def __attrs_post_init__(self) -> None:
        """Let everybody hold in its cell."""
        self.cars = {
            messages.Name(name): Car(messages.Name(name), controller_of(cells), self.rules)
            for name, cells in OWNED.items()
        }
        self.leaders = (Leader(messages.Name("c1")), Leader(messages.Name("c2")))

    def run(self, steps: int) -> None:
        """Let anything happen."""
        actions: list[tuple[int, Callable[[], None]]] = [
            (16, self.tick), (6, self.resend), (8, self.think), (4, self.arrive),
            (1, self.restart), (1, self.grant),
        ]  # fmt: skip
        choices = [action for weight, action in actions for _ in range(weight)]
        for _ in range(steps):
            self.rng.choice(choices)()
            for _ in range(self.rng.randrange(9)):
                self.deliver()
            self.check()

    # --- what happens -------------------------------------------------------------------------

    def car(self) -> Car:
        return self.cars[self.rng.choice(sorted(self.cars))]

    def post(self, to: messages.Name, message: object) -> None:
        if self.rng.random() < 0.9:
            self.mail.append(Mail(to, message))

    def deliver(self) -> None:
        if not self.mail:
            return
        # Mostly in order, and now and then not at all, or twice.
        index = 0 if self.rng.random() < 0.6 else self.rng.randrange(len(self.mail))
        mail = self.mail[index] if self.rng.random() < 0.1 else self.mail.pop(index)
        message, car = mail.message, self.cars.get(mail.to)
        if car is None:
            for leader in self.leaders:
                if leader.name == mail.to and isinstance(message, messages.VehicleState):
                    leader.hear(message)
        elif isinstance(message, messages.Command):
            self.obey(car, message)
            self.post(car.name, car.sense_now())
        elif isinstance(message, messages.Sense):
            shown = car.execution.promise_stored, car.execution.accepted
            car.take(message)
            if (car.execution.promise_stored, car.execution.accepted) != shown:
                self.show(car)
        elif isinstance(message, messages.Prepare | messages.Plan | messages.VehicleState):
            car.told(message)
            if not isinstance(message, messages.VehicleState):
                self.post(car.name, car.command())
        if len(self.mail) > 60:
            del self.mail[self.rng.randrange(60)]

    def obey(self, car: Car, command: messages.Command) -> None:
        before = car.controller.hold_cell
        car.obey(command)
        self.moves += car.controller.hold_cell != before
        if car.controller.transfer is not None and car.controller.transfer.open:
            self.opened.add(car.controller.transfer.ballot)

    def tick(self) -> None:
        car = self.car()
        car.tick += 1
        if self.rng.random() < 0.9:
            car.take(car.sense_now())
            car.act()
        self.post(car.name, car.command())
        self.show(car)

    def show(self, car: Car) -> None:
        state = car.state()
        for name in (*self.cars, *(leader.name for leader in self.leaders)):
            if name != car.name:
                self.post(name, state)

    def resend(self) -> None:
        for leader in self.leaders:
            for handover in leader.handovers:
                for name, message in handover.outgoing(1.0):
                    self.post(name, message)

    def think(self) -> None:
        promised = [car.controller.promised for car in self.cars.values()]
        highest = max((ballot.term for ballot in promised if ballot is not None), default=1)
        leader = self.leaders[self.rng.random() < 0.2]
        leader.think(self.rng, max(1, highest + self.rng.choice((-1, 0, 0, 1, 1, 1))))

    def arrive(self) -> None:
        car = self.car()
        if car.under_way:
            car.controller.motion_end_tick = 0

    def restart(self) -> None:
        if self.rng.random() < 0.6:
            self.car().start(attended=self.rng.random() < 0.7)

    def grant(self) -> None:
        if self.granted < 4 and self.rng.random() < 0.1:
            self.granted += 1
            self.car().controller.assign_cell((5 + self.granted, 0))

    # --- what must be -------------------------------------------------------------------------

    def owned(self, car: Car) -> frozenset[Cell]:
        """Return what a car owns, as somebody knows who has seen all."""
        transfer = car.controller.transfer
        if transfer is None or transfer.open:
            return frozenset(car.controller.owned)
        return frozenset(transfer.after if transfer.ballot in self.opened else transfer.before)

    def check(self) -> None:
        """Check that no cell has two owners, and that everybody is where it may be."""
        owner: dict[Cell, messages.Name] = {}
        for name, car in self.cars.items():
            cells = self.owned(car)
            for cell in cells:
                if cell in owner:
                    raise WrongError(f"{cell} is of {owner[cell]} and of {name}")
                owner[cell] = name
            controller = car.controller
            occupied = frozenset({controller.hold_cell})
            if car.under_way:
                occupied = footprint(controller.motion_origin, controller.hold_cell)
            if not occupied <= cells:
                raise WrongError(f"{name} is in {sorted(occupied)} and owns {sorted(cells)}")
