"""Claims: an agent claims its vehicle, publishes once it is in charge, and gives way."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

from laneweave.agents.core import AgentCore
from laneweave.launch.fault_search.road.stand_ins import LightDriver
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Effect, Send, Wakeup
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.wire.messages import Ballot, Command, Name, Prepare, Sense, VehicleState
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import PLAN, PREPARE, SENSE, STATE
from support.agent_rig import HOME, ME, OTHER, Rig
from support.states import BALLOT, changed, holding, make_plan, sense_in, sent

OTHER_IS_READY = holding(OTHER, BALLOT, accepted=True, ready=True, done=True, speed_mps=15.0)
"""The state of the other member, which has accepted the plan."""


class Passenger(LightDriver):
    """A driver that records when it takes over, and is at rest when the test says so."""

    def __init__(self, scenario: Scenario, limits: Vehicle) -> None:
        """Begin without calls."""
        super().__init__(scenario, limits)
        self.taken_over: list[int] = []
        self.resting = True

    def take_over(self, sense: Sense) -> None:
        super().take_over(sense)
        self.taken_over.append(sense.tick)

    def at_rest(self, sense: Sense) -> bool:
        del sense
        return self.resting


class Seat:
    """An agent whose SENSEs the test writes; its incarnations are 1, 2, ..."""

    def __init__(self) -> None:
        """Start the agent."""
        self.drivers: list[Passenger] = []
        self.rig = Rig(self._make_driver)
        self.tick = 0

    def _make_driver(self, scenario: Scenario, limits: Vehicle) -> Passenger:
        self.drivers.append(Passenger(scenario, limits))
        return self.drivers[-1]

    @property
    def agent(self) -> AgentCore:
        return self.rig.agent

    @property
    def driver(self) -> Passenger:
        return self.drivers[-1]

    @property
    def shown(self) -> VehicleState:
        return self.rig.shown[-1]

    def feel(self, in_charge: int, *, cell: Cell = HOME, **more: Any) -> list[Effect]:  # noqa: ANN401
        """Send it the next tick, with a process in charge."""
        self.tick += 1
        self.last = sense_in(cell, self.tick, incarnation=in_charge, **more)
        return self.rig.hand(SENSE, self.last)

    def repeat(self) -> list[Effect]:
        """Show it the last tick once more."""
        return self.rig.hand(SENSE, self.last)

    def note(
        self,
        accepted: Ballot | None = BALLOT,
        *,
        joined: tuple[int, ...] = (0,),
        in_charge: int | None = None,
    ) -> list[Effect]:
        """Show it within the tick what the controller has noted, for the one in charge."""
        if in_charge is None:
            in_charge = self.last.record.incarnation
        noted = changed(self.last, accepted=accepted, joined=joined, incarnation=in_charge)
        return self.rig.hand(SENSE, noted)

    def take_charge(self, joined: tuple[int, ...] = (0,)) -> None:
        for _ in range(2):
            self.feel(1, joined=joined)
        assert self.shown.record.incarnation == 1

    def prepare(self, *formations: int, ballot: Ballot = BALLOT) -> list[Effect]:
        return self.rig.hand(PREPARE, Prepare(ballot, formations or (0,), (ME, OTHER)))

    def plan(self, *formations: int, incarnation: int = 1) -> list[Effect]:
        cells: dict[Name, Cell] = {ME: HOME, OTHER: (0, 0)}
        incarnations = {ME: incarnation, OTHER: 1}
        plan = make_plan(cells, incarnations=incarnations, blocks=formations or (0,))
        return self.rig.hand(PLAN, plan)


def kinds(effects: Iterable[Effect]) -> list[type]:
    return [type(effect.message) for effect in effects if isinstance(effect, Send)]


def wanted(seat: Seat) -> tuple[int, ...]:
    return seat.agent.wanted_states


def command_of(effects: Iterable[Effect]) -> Command:
    (command,) = sent(effects, Command)
    return command


# --- claiming ---------------------------------------------------------------------------------


def test_the_first_answer_is_a_claim_and_states_follow_once_a_sense_grants_it() -> None:
    seat = Seat()
    effects = seat.feel(0)
    assert kinds(effects) == [Command]
    command = command_of(effects)
    assert (command.record.incarnation, command.tick, command.hold_cell) == (1, 1, HOME)
    assert seat.repeat() == effects
    assert not seat.agent.in_charge
    effects = seat.feel(1)
    assert seat.agent.in_charge
    assert kinds(effects) == [Command, VehicleState]
    assert (seat.shown.record.incarnation, seat.shown.attended) == (1, True)
    assert kinds(seat.prepare()) == [VehicleState]
    assert seat.shown.record.promised == BALLOT
    assert kinds(seat.repeat()) == [Command]  # the state is not published again


def test_it_promises_and_accepts_nothing_before_it_is_in_charge() -> None:
    seat = Seat()

    def effects() -> list[Effect]:
        received = seat.rig.hand(STATE, OTHER_IS_READY)
        return [*seat.prepare(), *seat.plan(), *received, *seat.rig.handle(Wakeup())]

    assert effects() == []  # before it has met its vehicle at all
    seat.feel(0)
    assert effects() == []
    assert wanted(seat) == ()
    seat.feel(1)
    assert (seat.shown.record.promised, seat.shown.accepted) == (None, False)


def test_v1_is_repeated_while_a_claim_is_under_way() -> None:
    """Until the claim is granted, another process may have moved the vehicle."""
    seat = Seat()
    cells: tuple[Cell, ...] = ((-1, 1), (-2, 1), (-2, 2), (-3, 2), (-3, 1))
    for in_charge, cell in zip((0, 0, 0, 1, 1), cells, strict=True):
        command = command_of(seat.feel(in_charge, cell=cell))
        # From the moment it is in charge the hold cell is its own business.
        assert command.hold_cell == (cell if seat.tick < 5 else cells[3])
    assert seat.driver.taken_over == [1, 2, 3, 4]
    assert seat.shown.hold_cell == cells[3]


def test_a_motion_and_joined_formations_are_taken_over_with_the_charge() -> None:
    seat = Seat()
    seat.driver.resting = False
    for in_charge in (0, 1):
        assert command_of(seat.feel(in_charge, joined=(0, 3))).record.joined == (0, 3)
    assert (seat.shown.moving, seat.shown.record.joined) == (True, (0, 3))
    seat.driver.resting = True
    seat.feel(1, joined=(0, 3))
    assert (seat.shown.moving, seat.shown.completed) == (False, 0)


# --- giving way -------------------------------------------------------------------------------


def test_superseded_by_another_agent_it_is_silent() -> None:
    seat = Seat()
    seat.take_charge()
    seat.prepare()
    seat.plan()
    assert wanted(seat) == (0,)
    for _ in range(3):
        assert seat.feel(2) == []
        assert seat.repeat() == []
    assert not seat.agent.in_charge
    assert wanted(seat) == ()
    higher = BALLOT._replace(seq=2)
    assert seat.prepare(ballot=higher) == []
    assert seat.plan() == []
    assert seat.rig.hand(STATE, OTHER_IS_READY) == []


def test_superseded_by_the_caretaker_it_claims_with_a_new_incarnation_and_no_memory() -> None:
    seat = Seat()
    seat.take_charge()
    seat.prepare()
    seat.plan()
    caretaker = seat.rig.new_incarnation()
    effects = seat.feel(caretaker, caretaker=True)
    assert kinds(effects) == [Command]
    assert command_of(effects).record.incarnation == 3 > caretaker
    assert seat.prepare(ballot=BALLOT._replace(seq=2)) == []
    assert seat.plan(incarnation=3) == []
    assert kinds(seat.feel(3)) == [Command, VehicleState]
    assert (seat.shown.record.incarnation, seat.shown.record.promised, seat.shown.accepted) == (
        3,
        None,
        False,
    )
    seat.prepare()
    assert seat.plan() == []  # for the incarnation that promised long ago
    assert command_of(seat.plan(incarnation=3)).record.accepted == BALLOT
    seat.note()
    assert seat.shown.accepted


def test_a_caretaker_with_the_same_incarnation_is_superseded() -> None:
    """Clocks of different machines may give both the same number."""
    seat = Seat()
    seat.take_charge()
    seat.prepare()
    effects = seat.feel(seat.shown.record.incarnation, caretaker=True)
    assert kinds(effects) == [Command]
    claim = command_of(effects)
    assert claim.record.incarnation > seat.shown.record.incarnation
    assert kinds(seat.feel(claim.record.incarnation)) == [Command, VehicleState]
    assert (seat.shown.record.incarnation, seat.shown.record.promised) == (
        claim.record.incarnation,
        None,
    )


def test_a_lost_claim_is_repeated_with_the_same_incarnation_and_without_old_promises() -> None:
    seat = Seat()
    seat.take_charge()
    seat.prepare(0, 1)
    caretaker = seat.rig.new_incarnation()
    claims = [command_of(seat.feel(caretaker, caretaker=True)) for _ in range(3)]
    assert [(claim.record.incarnation, claim.tick) for claim in claims] == [(3, 3), (3, 4), (3, 5)]
    assert {claim.record.joined for claim in claims} == {(0,)}


def test_it_ends_with_its_vehicle_whatever_process_is_in_charge() -> None:
    seat = Seat()
    seat.take_charge()
    seat.feel(9)
    effects = seat.feel(9, left=True)
    assert kinds(effects) == [Report]
    assert seat.agent.ended


# --- acceptance -------------------------------------------------------------------------------


def taken() -> Seat:
    """Return a seat whose agent is in charge, and has a plan that is not noted yet."""
    seat = Seat()
    seat.take_charge()
    seat.prepare()
    (command,) = sent(seat.repeat(), Command)
    assert sent(seat.plan(), Command) == [changed(command, accepted=BALLOT)]  # the same motion
    return seat


def test_an_acceptance_is_requested_at_once_and_published_when_noted() -> None:
    seat = taken()
    assert kinds(seat.repeat()) == [Command]  # a SENSE from before it was noted
    assert kinds(seat.feel(1)) == [Command, VehicleState]
    assert (seat.shown.record.promised, seat.shown.accepted) == (BALLOT, False)
    assert kinds(seat.note()) == [VehicleState, Command]
    assert (seat.shown.accepted, seat.shown.ready) == (True, True)
    assert kinds(seat.note()) == [Command]  # once
    assert kinds(seat.repeat()) == [Command]  # an older one that comes late takes nothing back
    assert seat.plan() == []
    seat.feel(1)
    assert seat.shown.accepted


@pytest.mark.parametrize(
    ("noted", "in_charge"),
    [(None, 1), (BALLOT._replace(seq=0), 1), (BALLOT._replace(seq=2), 1), (BALLOT, 0), (BALLOT, 2)],
)
def test_a_note_for_another_plan_or_process_is_no_acceptance(
    noted: Ballot | None, in_charge: int
) -> None:
    seat = taken()
    assert kinds(seat.note(noted, in_charge=in_charge)) == [Command]
    shown = len(seat.rig.shown)
    seat.feel(in_charge, accepted=noted)
    assert len(seat.rig.shown) - shown == seat.agent.in_charge == (in_charge == 1)
    assert not seat.shown.accepted


def test_a_higher_promise_cancels_a_requested_note() -> None:
    seat = taken()
    effects = seat.prepare(ballot=BALLOT._replace(seq=2))
    assert kinds(effects) == [Command, VehicleState]
    assert command_of(effects).record.accepted is None
    seat.note()
    seat.feel(1, accepted=BALLOT)
    assert not seat.shown.accepted


# --- joined formations ------------------------------------------------------------------------


def test_a_joint_plan_is_accepted_once_the_controller_has_confirmed_its_formations() -> None:
    seat = Seat()
    seat.take_charge()
    asked = seat.prepare(0, 1)
    assert kinds(asked) == [Command, VehicleState]
    assert command_of(asked).record.joined == (0, 1)
    assert (seat.shown.record.promised, seat.shown.record.joined) == (BALLOT, (0,))
    assert kinds(seat.prepare(0, 1)) == [VehicleState]  # it has asked already
    assert seat.plan(0, 1) == []
    assert command_of(seat.feel(1)).record.joined == (0, 1)
    assert seat.plan(0, 1) == []
    assert kinds(seat.note(None, joined=(0, 1))) == [VehicleState, Command]
    assert (seat.shown.record.joined, seat.shown.accepted) == ((0, 1), False)
    assert kinds(seat.repeat()) == [Command]  # an older one that comes late takes nothing back
    seat.plan(0, 1)
    seat.note(joined=(0, 1))
    assert (seat.shown.record.joined, seat.shown.accepted) == ((0, 1), True)
    assert wanted(seat) == (0, 1)


def test_states_matter_only_while_a_plan_waits_for_them() -> None:
    seat = Seat()
    seat.take_charge()
    seat.prepare()
    assert wanted(seat) == ()
    seat.plan()
    assert wanted(seat) == (0,)  # also while it is not noted yet: none is missed
    seat.rig.hand(STATE, OTHER_IS_READY)
    seat.note()
    assert wanted(seat) == (0,)
    seat.feel(1)
    assert seat.shown.go
    assert wanted(seat) == ()
