"""The process in charge of a vehicle: its agent, or a caretaker in its place."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from laneweave.protocol.runtime.node import (
    Arrived,
    Effect,
    Listen,
    Refuse,
    Send,
    Stopping,
    Unlisten,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.wire.identities import above
from laneweave.protocol.wire.messages import (
    Ballot,
    Name,
    PendingTransfer,
    Plan,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.topics import COMMAND, PLAN, PREPARE, STATE
from laneweave.sim_bridge.core import TickPhase
from laneweave.sim_bridge.road.tick_answers import LATE_SHARE
from support.bridge_bench import (
    TWO,
    A,
    B,
    Desk,
    arrival,
    deadlines_until_silent,
    make_scenario,
    read_events,
    read_summary,
)
from support.states import BALLOT, jerks, make_plan, sent, set_record

SCENARIO = make_scenario()
TICK_S, SILENT_S = SCENARIO.runtime.tick_s, SCENARIO.runtime.agent_silent_s
MISSES = deadlines_until_silent(SCENARIO)
OF_B = {"vehicle": B}
CARE_OF_B: list[Effect] = [Listen(PREPARE, OF_B), Listen(PLAN, OF_B)]
CARE_OF_B_ENDS: list[Effect] = [Unlisten(PREPARE, OF_B), Unlisten(PLAN, OF_B)]
AGENT = 17
"""Incarnation of B's agent."""


@pytest.fixture
def attended(desk: Desk) -> Desk:
    """B's agent is in charge, and the next tick has begun."""
    desk.answer(B, incarnation=AGENT)
    next_tick(desk, A)
    return desk


@pytest.fixture
def cared_for(attended: Desk) -> Desk:
    """B's agent has died, its caretaker is in charge."""
    attended.down(B)
    next_tick(attended, A)
    return attended


def next_tick(desk: Desk, *answering: Name) -> list[Effect]:
    """Let some answer and the others not; return what is said from then to the next answers."""
    tick = desk.core.tick
    desk.effects.clear()
    for name in answering:
        desk.answer(name)
    deaf = {A, B} - set(answering)
    desk.drive(lambda: desk.core.tick > tick and desk.core.phase is TickPhase.ANSWERS, *deaf)
    return desk.effects


def sense_of(effects: Iterable[Effect], vehicle: Name, tick: int) -> Sense:
    (sense,) = (s for s in sent(effects, Sense) if (s.vehicle, s.tick) == (vehicle, tick))
    assert isinstance(sense, Sense)
    return sense


def sensed(desk: Desk, vehicle: Name) -> Sense:
    """Return the SENSE of a vehicle in this tick."""
    return sense_of(desk.effects, vehicle, desk.core.tick)


def listening(effects: Iterable[Effect]) -> list[Effect]:
    return [effect for effect in effects if isinstance(effect, (Listen, Unlisten))]


# --- agents -----------------------------------------------------------------------------------


def test_the_first_agent_is_in_charge_with_its_first_command(desk: Desk) -> None:
    assert desk.core.vehicles[B].controller.record.incarnation == 0
    desk.answer(B, incarnation=AGENT)
    next_tick(desk, A)
    sense = sensed(desk, B)
    block = SCENARIO.lattice.block_of(sense.hold_cell[0])
    assert (sense.record.incarnation, sense.caretaker) == (AGENT, False)
    assert (sense.block, sense.record.joined) == (block, (block,))
    assert read_events(desk.folder, "agent-took-over") == []


def test_an_agent_that_restarts_takes_charge_and_its_zombie_does_not(attended: Desk) -> None:
    attended.answer(B, incarnation=AGENT + 1)
    before = attended.known(B)
    attended.answer(B, incarnation=AGENT, jerks=jerks((9.0, 0.0)))
    assert attended.known(B) == before
    next_tick(attended, A)
    attended.answer(B, incarnation=AGENT, jerks=jerks((9.0, 0.0)))
    assert attended.known(B) == before
    assert attended.core.road.answers.awaited == {A, B}  # it is not the zombie's answer that counts
    (event,) = read_events(attended.folder, "agent-took-over")
    assert (event["vehicle"], event["previous"]) == (B, "agent")


def test_the_answers_of_a_zombie_are_no_sign_of_life(attended: Desk) -> None:
    attended.answer(B, incarnation=AGENT + 1)
    next_tick(attended, A)
    for _ in range(MISSES):
        attended.answer(B, incarnation=AGENT)
        next_tick(attended, A)
    assert attended.core.road.answers.silent == {B}
    assert sensed(attended, B).caretaker


# --- what is noted within a tick --------------------------------------------------------------


def test_what_is_new_to_the_controller_is_confirmed_at_once(attended: Desk) -> None:
    block, tick = attended.core.vehicles[B].block, attended.core.tick
    effects = attended.answer(B, incarnation=AGENT, joined=(block + 1,), accepted=BALLOT)
    sense = sense_of(effects, B, tick)
    assert (sense.record.joined, sense.record.accepted) == ((block, block + 1), BALLOT)
    assert (sense.record.incarnation, sense.caretaker) == (AGENT, False)
    again = attended.answer(B, incarnation=AGENT, joined=(block + 1,), accepted=BALLOT)
    assert sent(again, Sense) == []  # the next tick confirms it
    next_tick(attended, A)
    sense = sensed(attended, B)
    assert (sense.record.joined, sense.record.accepted) == ((block, block + 1), BALLOT)


def test_it_is_confirmed_at_once_whatever_the_tick_and_then_not_played(attended: Desk) -> None:
    attended.answer(B, incarnation=AGENT)
    attended.answer(A)
    assert attended.core.phase is TickPhase.PACE  # the next tick is not due yet
    before = attended.known(B)
    for tick, ballot in ((-1, BALLOT), (0, BALLOT._replace(seq=2))):
        late = {"incarnation": AGENT, "tick": attended.core.tick + tick, "accepted": ballot}
        effects = attended.answer(B, **late, hold_cell=(-1, 1), jerks=jerks((9.0, 0.0)))
        assert sense_of(effects, B, attended.core.tick).record.accepted == ballot
        set_record(attended.core.vehicles[B].controller.store, accepted=None)
        assert attended.known(B) == before


def test_a_caretaker_inherits_no_acceptance(attended: Desk) -> None:
    attended.answer(B, incarnation=AGENT, accepted=BALLOT)
    attended.down(B)
    (state,) = sent(next_tick(attended, A), VehicleState)
    assert (sensed(attended, B).record.accepted, state.accepted) == (None, False)
    assert attended.answer(B, incarnation=AGENT, accepted=BALLOT) == []


# --- caretakers take charge -------------------------------------------------------------------


def check_cared_for(desk: Desk, reason: str) -> None:
    """Check that B's caretaker has taken charge in this tick."""
    assert sensed(desk, B).caretaker
    assert listening(desk.effects)[-2:] == CARE_OF_B
    (event,) = read_events(desk.folder, "caretaker-took-over")
    assert (event["vehicle"], event["reason"]) == (B, reason)


def test_the_caretaker_takes_charge_when_the_agent_is_gone(attended: Desk) -> None:
    attended.down(B)
    next_tick(attended, A)
    check_cared_for(attended, "absent")
    in_charge = sensed(attended, B).record.incarnation
    assert in_charge > AGENT
    for _ in range(5):  # once
        assert listening(next_tick(attended, A)) == []
        assert sensed(attended, B).record.incarnation == in_charge


def test_the_caretaker_takes_charge_when_the_agent_is_silent(attended: Desk) -> None:
    for _ in range(MISSES - 1):
        next_tick(attended, A)
        assert not sensed(attended, B).caretaker
    next_tick(attended, A)
    check_cared_for(attended, "silent")


def late_answer(desk: Desk) -> None:
    """Let B's agent answer the tick before."""
    late = desk.command(B, incarnation=AGENT, tick=desk.core.tick - 1)
    desk.give(Arrived(COMMAND, OF_B, late))


def test_the_caretaker_takes_charge_when_no_answer_comes_in_time(attended: Desk) -> None:
    """It is alive, but it does not drive the vehicle: the caretaker must publish that it holds."""
    # Ticks last longer while answers are late, so it takes no more of them than deadlines.
    for tick in range(round(LATE_SHARE * MISSES)):  # noqa: B007 (counts)
        late_answer(attended)
        next_tick(attended, A)
        if sensed(attended, B).caretaker:
            break
    assert tick > 2
    check_cared_for(attended, "late")
    assert attended.core.road.answers.silent == set()
    for _ in range(3):  # as long as it is late it stays so
        late_answer(attended)
        next_tick(attended, A)
        assert sensed(attended, B).caretaker
    check_takes_back(attended)


def test_an_agent_that_claims_its_vehicle_is_present_without_a_token(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, TWO)
    desk.core.road.caretakers._new_incarnation = lambda: 10**9
    desk.start(A)
    desk.drive_to_entry(A, B)
    check_cared_for(desk, "absent")  # its agent never came
    care = sensed(desk, B).record.incarnation
    assert care == 10**9  # as for any process
    assert desk.answer(B, incarnation=care + 1) == CARE_OF_B_ENDS
    assert B in desk.core.road.answers.up
    for _ in range(3):
        next_tick(desk, A, B)
        assert not sensed(desk, B).caretaker
        assert desk.core.road.answers.awaited == {A, B}


def test_a_refused_claim_is_no_presence(desk: Desk) -> None:
    desk.down(B)
    desk.answer(B, incarnation=AGENT, hold_cell=(-1, 1))  # a move is no claim
    assert B not in desk.core.road.answers.up


def test_an_agent_that_is_back_at_once_needs_no_caretaker(attended: Desk) -> None:
    attended.down(B)
    attended.up(B)
    next_tick(attended, A)
    assert not sensed(attended, B).caretaker


def test_caretakers_have_greater_incarnations_than_all_before(desk: Desk) -> None:
    desk.core.road.caretakers._new_incarnation = lambda: 5
    desk.answer(B, incarnation=10**13)
    desk.down(B)
    next_tick(desk, A)
    # Not just the next number: another process that steps above the agent may take that.
    assert sensed(desk, B).record.incarnation == above(5, 10**13) > 10**13


def test_there_are_no_caretakers_while_the_bridge_is_off_the_network(attended: Desk) -> None:
    attended.down(B)  # a moment before the bridge hears that its own link is down
    attended.give(LinkDown())
    away_s = attended.now_s
    attended.drive(lambda: attended.now_s >= away_s + 2 * SILENT_S, A, B)
    assert attended.core.tick > SILENT_S / TICK_S
    assert read_events(attended.folder, "caretaker-took-over") == []
    attended.give(LinkUp())
    came_s, lease_s = attended.now_s, SCENARIO.network.lease_s
    attended.drive(lambda: B in attended.core.road.caretakers, B)
    # The others reconnect about now, too: only later is B's silence evidence.
    assert came_s + lease_s <= attended.now_s <= came_s + lease_s + 2 * TICK_S
    assert A not in attended.core.road.caretakers


# --- messages of caretakers -------------------------------------------------------------------


def ballot_for(desk: Desk) -> tuple[Prepare, Plan]:
    """Return a ballot for B alone, which only holds."""
    sense = desk.core.vehicles[B].sense(0, caretaker=True)
    prepare = Prepare(BALLOT, (sense.block,), (B,))
    incarnations = {B: sense.record.incarnation}
    plan = make_plan({B: sense.hold_cell}, blocks=prepare.blocks, incarnations=incarnations)
    return prepare, plan


def test_a_caretaker_shows_its_vehicle_at_each_tick(cared_for: Desk) -> None:
    for _ in range(3):
        effects = next_tick(cared_for, A)
        (send,) = (e for e in effects if isinstance(e, Send) and e.topic is STATE)
        state, vehicle = send.message, cared_for.core.vehicles[B]
        assert send.parameters == {"block": vehicle.block, "vehicle": B}
        assert (state.vehicle, state.attended, state.t_s) == (B, False, cared_for.core.t_s)
        assert (state.record.incarnation, state.s_m) == (
            vehicle.controller.record.incarnation,
            vehicle.state[0],
        )


def test_a_caretaker_promises_and_accepts_at_once(cared_for: Desk) -> None:
    prepare, plan = ballot_for(cared_for)
    (state,) = sent(cared_for.give(Arrived(PREPARE, OF_B, prepare)), VehicleState)
    assert (state.record.promised, state.accepted) == (prepare.ballot, False)
    (state,) = sent(cared_for.give(Arrived(PLAN, OF_B, plan)), VehicleState)
    assert (state.record.promised, state.accepted) == (prepare.ballot, True)


def test_the_bridge_publishes_no_state_of_a_vehicle_with_an_agent(attended: Desk) -> None:
    prepare, plan = ballot_for(attended)
    assert attended.give(Arrived(PREPARE, OF_B, prepare)) == []
    assert attended.give(Arrived(PLAN, OF_B, plan)) == []
    assert sent(next_tick(attended, A, B), VehicleState) == []


# --- agents take their vehicles back ----------------------------------------------------------


def test_an_agent_that_was_gone_takes_its_vehicle_back(cared_for: Desk) -> None:
    cared_for.up(B)
    next_tick(cared_for, A)
    assert cared_for.core.road.answers.awaited == {A, B}
    check_takes_back(cared_for)


def test_an_agent_that_was_silent_takes_its_vehicle_back(attended: Desk) -> None:
    attended.drive_to_silence(B)
    late = attended.command(B, tick=attended.core.tick - 1, incarnation=AGENT)
    attended.give(Arrived(COMMAND, OF_B, late))
    next_tick(attended, A)
    assert attended.core.road.answers.awaited == {A, B}
    check_takes_back(attended)


def check_takes_back(desk: Desk) -> None:
    care = sensed(desk, B).record.incarnation
    before = desk.known(B)
    assert desk.answer(B, incarnation=AGENT) == []  # it does not know yet
    assert desk.known(B) == before
    assert desk.answer(B, incarnation=care + 1) == CARE_OF_B_ENDS
    next_tick(desk, A)
    sense = sensed(desk, B)
    assert (sense.record.incarnation, sense.caretaker) == (care + 1, False)
    (event,) = read_events(desk.folder, "agent-took-over")
    assert (event["vehicle"], event["previous"]) == (B, "caretaker")
    desk.give(Stopping())
    tracking = read_summary(desk.folder)["tracking"]
    assert (tracking["caretaker_takeovers"], tracking["agent_takeovers"]) == (1, 1)


def test_an_agent_cannot_move_its_vehicle_with_the_claim(cared_for: Desk) -> None:
    cared_for.up(B)
    next_tick(cared_for, A)
    before = cared_for.known(B)
    assert cared_for.answer(B, hold_cell=(-1, 1)) == []
    assert cared_for.known(B) == before
    assert cared_for.core.road.answers.awaited == {A, B}


def test_a_caretaker_that_has_ended_publishes_nothing(cared_for: Desk) -> None:
    prepare, _ = ballot_for(cared_for)
    cared_for.up(B)
    next_tick(cared_for, A)
    cared_for.answer(B)
    assert cared_for.give(Arrived(PREPARE, OF_B, prepare)) == []
    assert sent(next_tick(cared_for, A), VehicleState) == []


def test_the_next_caretaker_remembers_the_joined_formations_only(cared_for: Desk) -> None:
    prepare, _ = ballot_for(cared_for)
    both = (prepare.blocks[0], prepare.blocks[0] + 1)
    cared_for.give(Arrived(PREPARE, OF_B, replace(prepare, blocks=both)))
    first = cared_for.core.vehicles[B].controller.record.incarnation
    cared_for.up(B)
    next_tick(cared_for, A)
    cared_for.answer(B)
    cared_for.down(B)
    (state,) = sent(next_tick(cared_for, A), VehicleState)
    assert (state.record.promised, state.record.joined) == (None, both)
    assert state.record.incarnation > first


# --- leaving ----------------------------------------------------------------------------------


def test_caretakers_end_with_their_vehicles(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, [*TWO, arrival("C", 9.0)])
    desk.start(A, "C")
    desk.drive_to_entry(A, B)
    desk.drive(lambda: B not in desk.core.vehicles)
    assert listening(desk.effects)[-4:] == CARE_OF_B + CARE_OF_B_ENDS
    assert B not in desk.core.road.caretakers


def test_vehicles_that_leave_off_their_lane_are_reported(tmp_path: Path) -> None:
    arrivals = [
        arrival(A, 0.5, lane=1, preferred_lane=0),
        arrival(B, 0.6, lane=0, preferred_lane=1),
        arrival("C", 5.0, lane=1, preferred_lane=1),
    ]
    desk = Desk(SCENARIO, tmp_path, arrivals)
    desk.start(A, "C")
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN)
    found = {
        event["vehicle"]: (event["lane"], event["preferred_lane"], event["attended"])
        for event in read_events(tmp_path, "left-off-lane")
    }
    assert found == {A: (1, 0, True), B: (0, 1, False)}
    desk.give(Stopping())
    vehicles = read_summary(tmp_path)["vehicles"]
    assert (vehicles["left"], vehicles["on_preferred_lane"]) == (3, 1)
    assert (vehicles["left_off_lane"], vehicles["left_unattended"]) == (2, 1)


# --- numbers that no correct sender has -------------------------------------------------------

HUGE = 2**63 - 1
DAY_NS = 86_400 * 10**9
HIGH = Ballot(HUGE, Name("zz"), HUGE, HUGE)


@pytest.mark.parametrize(
    "changes",
    [
        {"incarnation": HUGE},
        {"incarnation": 2 * DAY_NS},
        {"incarnation": -1},
        {"promised": HIGH},
        {"accepted": HIGH},
        {"transfer": PendingTransfer(HIGH)},
    ],
)
def test_a_command_with_an_impossible_number_is_refused(
    attended: Desk, changes: dict[str, Any]
) -> None:
    before = attended.known(B)
    effects = attended.answer(B, **({"incarnation": AGENT} | changes))
    assert [type(effect) for effect in effects] == [Refuse]
    assert attended.known(B) == before
    assert B in attended.core.road.answers.awaited
    attended.answer(B, incarnation=AGENT)
    assert B not in attended.core.road.answers.awaited


def test_a_claim_near_the_limit_leaves_room_for_successors(attended: Desk) -> None:
    """A forged claim that is possible takes charge; the caretaker and the agent follow it."""
    limit = DAY_NS
    attended.answer(B, incarnation=limit)
    assert attended.core.vehicles[B].controller.record.incarnation == limit
    attended.drive(lambda: B in attended.core.road.caretakers, B)
    caretaker = attended.core.vehicles[B].controller.record.incarnation
    assert caretaker > limit
    attended.drive_to(attended.core.tick + 1, B)
    attended.answer(B, incarnation=above(5, caretaker))
    assert B not in attended.core.road.caretakers


def test_a_caretaker_promises_no_ballot_of_an_impossible_term(cared_for: Desk) -> None:
    for ballot, promised in ((HIGH, False), (BALLOT, True)):
        prepare = Prepare(ballot, (0,), (B,))
        effects = cared_for.give(Arrived(PREPARE, {"vehicle": B}, prepare))
        assert [state.record.promised for state in sent(effects, VehicleState)] == [
            ballot
        ] * promised
