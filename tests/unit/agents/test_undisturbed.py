"""When an agent says that its vehicle needs no SENSE for a while."""

from __future__ import annotations

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.undisturbed import HoldWatch
from laneweave.protocol.runtime.node import Arrived, Send
from laneweave.protocol.vehicle.plan_execution import LISTEN_S
from laneweave.protocol.wire.messages import Command, CurrentMotion, Neighbour, Prepare
from laneweave.protocol.wire.topics import COMMAND, PLAN, PREPARE, SENSE, STATE
from support.agent_rig import HOME, ME, OTHER, SCENARIO, TICK_S, Rig, up_and_running
from support.states import BALLOT, changed, holding, make_plan, sent

PERIOD = SCENARIO.runtime.hold_ticks
SLOT_TICKS = round(SCENARIO.timing.cycles_s[0] / TICK_S)


def quiet(rig: Rig) -> list[bool]:
    """Let a period of ticks pass, all with a SENSE; return which were answered as undisturbed."""
    answers = [sent(rig.answer(), Command)[0] for _ in range(PERIOD)]
    return [one.undisturbed_ticks > 0 for one in answers]


def undisturbed() -> Rig:
    """Return a vehicle that has just said that it holds undisturbed."""
    rig = up_and_running()
    for _ in range(3 * PERIOD):
        rig.run()
        assert rig.played is not None
        if rig.played.undisturbed_ticks:
            return rig
    raise AssertionError("never undisturbed")


def test_a_vehicle_that_holds_says_so_after_its_last_change_has_been_published_often() -> None:
    rig = up_and_running()
    assert quiet(rig)[: PERIOD - 1] == [False] * (PERIOD - 1)
    rig = undisturbed()
    assert rig.played is not None
    first = rig.played.undisturbed_ticks
    assert rig.played.motion == CurrentMotion(HOME, 0, first)
    rig.coast(first - 1)  # the bridge waits as long as it may
    rig.run()
    for _ in range(3):
        assert rig.played.undisturbed_ticks == PERIOD
        rig.coast(PERIOD - 1)
        rig.run()
        assert rig.played.undisturbed_ticks == PERIOD


def test_an_earlier_sense_than_expected_is_a_disturbance() -> None:
    """The bridge has seen something, and it may go on."""
    rig = undisturbed()
    assert quiet(rig) == [False] * PERIOD
    rig.run()
    assert rig.played is not None
    assert rig.played.undisturbed_ticks == PERIOD


def test_a_ballot_ends_the_rest_at_once() -> None:
    """The COMMAND is for the old tick; the bridge then sends SENSE in the next one."""
    rig = undisturbed()
    last = rig.played
    effects = rig.hand(PREPARE, Prepare(BALLOT, (0,), (ME,)))
    (command,) = sent(effects, Command)
    assert last is not None
    assert (command.tick, command.motion) == (last.tick, CurrentMotion(HOME))
    assert next(one.topic for one in effects if isinstance(one, Send)) is COMMAND
    assert rig.shown[-1].record.promised == BALLOT
    assert quiet(rig) == [False] * PERIOD


def test_it_is_disturbed_while_its_gate_is_closed_and_around_its_move() -> None:
    rig = up_and_running()
    target = (HOME[0], HOME[1] + 1)
    due_tick = rig.tick + 20 * PERIOD
    rig.accept((0, HOME, target), t0_tick=due_tick)
    answered: dict[int, bool] = {}
    end_tick = due_tick + SLOT_TICKS + 3 * PERIOD
    while rig.tick < end_tick:
        rig.run()
        assert rig.played is not None
        answered[rig.played.tick] = bool(rig.played.undisturbed_ticks)
        if answered[rig.played.tick]:
            rig.coast(rig.played.undisturbed_ticks - 1)
    # It is not late for its move, and hears of what that waits for.
    before = due_tick - round(LISTEN_S / TICK_S)
    assert any(answered[tick] for tick in answered if tick < before - PERIOD)
    assert not any(answered[t] for t in range(before, due_tick + SLOT_TICKS - 2) if t in answered)
    assert set(range(before, due_tick + SLOT_TICKS - 2)) <= set(answered)
    assert rig.controller.hold_cell == target
    assert answered[max(answered)]


def test_it_is_disturbed_whenever_another_vehicle_may_wait_for_its_move() -> None:
    """The other one begins step 3 when this one has reported that it has left the cell."""
    rig = up_and_running()
    target, behind = (HOME[0], HOME[1] + 1), (HOME[0] - 1, HOME[1])
    rig.hand(PREPARE, Prepare(BALLOT, (0,), (ME, OTHER)))
    begins = rig.tick
    plan = make_plan(
        {ME: HOME, OTHER: behind},
        {ME: ((0, HOME, target),), OTHER: ((3, behind, HOME),)},
        incarnations={ME: rig.shown[-1].record.incarnation, OTHER: 1},
        t0_s=begins * TICK_S,
    )
    rig.confirm(rig.hand(PLAN, plan))
    assert not any(quiet(rig))  # the other one has not accepted
    other = holding(OTHER, BALLOT, behind, accepted=BALLOT, ready=True)
    rig.hand(STATE, other)
    answered = {}
    while rig.tick < begins + 5 * SLOT_TICKS:
        rig.run()
        assert rig.played is not None
        answered[rig.played.tick] = bool(rig.played.undisturbed_ticks)
        if answered[rig.played.tick]:
            rig.coast(rig.played.undisturbed_ticks - 1)
    assert rig.controller.hold_cell == target
    due, listens = begins + 3 * SLOT_TICKS, round(LISTEN_S / TICK_S)
    assert any(answered[tick] for tick in answered if tick < due - listens - 2 * PERIOD)
    around = set(range(due - listens, due + listens))
    assert around <= set(answered)
    assert not any(answered[tick] for tick in around)
    assert answered[max(answered)]


def test_a_vehicle_ahead_that_brakes_is_a_disturbance() -> None:
    rig = undisturbed()
    rig.ahead = (Neighbour(lane=HOME[1], gap_m=8.0, speed_mps=9.0),)
    rig.coast(PERIOD - 1)
    rig.run()
    assert rig.played is not None
    assert rig.played.undisturbed_ticks == 0


def test_a_period_of_one_tick_is_the_full_rate() -> None:
    rig = up_and_running()
    scenario = evolve(SCENARIO, runtime=evolve(SCENARIO.runtime, hold_period_ticks=1))
    rig.agent._hold_watch = HoldWatch(scenario, ME)
    for _ in range(3):
        assert not any(quiet(rig))


@pytest.mark.parametrize(("tick_s", "ticks"), [(0.1, 10), (0.5, 2), (1.0, 1)])
def test_the_period_is_at_most_a_second(tick_s: float, ticks: int) -> None:
    runtime = evolve(SCENARIO.runtime, tick_s=tick_s, hold_period_ticks=50)
    assert runtime.hold_ticks == ticks


def test_a_lost_end_of_the_rest_is_sent_again_with_the_next_message_of_the_leader() -> None:
    rig = undisturbed()
    prepare = Prepare(BALLOT, (0,), (ME,))
    for _ in range(2):
        (command,) = sent(rig.hand(PREPARE, prepare), Command)
        assert command.undisturbed_ticks == 0
    rig.coast(1)
    rig.hand(SENSE, rig.sense())
    assert sent(rig.hand(PREPARE, prepare), Command) == []  # a SENSE shows that it has arrived


def test_an_older_bridge_that_sends_again_does_not_replace_one_that_need_not_send() -> None:
    rig = up_and_running()
    rig.hand(SENSE, replace(rig.sense(), bridge=7))
    rig.coast(1)
    for _ in range(3 * PERIOD):
        command = rig.hand(SENSE, changed(rig.sense(), bridge=7, incarnation=2))
        if sent(command, Command)[0].undisturbed_ticks:
            break
        rig.coast(1)
    old = replace(rig.sense(), bridge=6, tick=3, t_s=3 * TICK_S)
    for now_s in (0.1, 0.9):  # more than `FORGET_S` apart
        assert rig.agent.handle(Arrived(SENSE, {"vehicle": ME}, old), now_s) == []
    assert rig.agent.handle(Arrived(SENSE, {"vehicle": ME}, old), 5.0) != []
