"""The bridge's tick, step by step, and the beginning and end of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Event,
    Listen,
    PeerDown,
    Refuse,
    Send,
    Stopping,
    Wakeup,
    Watch,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.messages import Census, CurrentMotion, Name, RoadClock, Sense
from laneweave.protocol.wire.process_messages import Report
from laneweave.sim_bridge.bodies.overlaps_and_gaps import pose_of
from laneweave.sim_bridge.core import CATCH_UP_S, CENSUS_S, SHUT_DOWN_S, TickPhase
from laneweave.sim_bridge.road.caretakers import LEFT_REPEATS
from support.bridge_bench import (
    TWO,
    A,
    B,
    Desk,
    arrival,
    asked,
    deadlines_until_silent,
    ended,
    make_scenario,
    read_events,
    read_summary,
)
from support.states import jerks, sent

SCENARIO = make_scenario()
TICK_S, RESEND_S = SCENARIO.runtime.tick_s, SCENARIO.runtime.tick_resend_s
DEADLINE_S, SILENT_S = SCENARIO.runtime.tick_deadline_s, SCENARIO.runtime.agent_silent_s
PATIENCE_S, LITTLE_PATIENCE_S = SCENARIO.runtime.agent_start_s, SCENARIO.network.resend_s
MISSES = deadlines_until_silent(SCENARIO)


# --- the beginning ----------------------------------------------------------------------------


def test_start(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, TWO)
    effects = desk.start()
    assert effects[:6] == [
        Listen(topics.EVENT),
        Listen(topics.REPORT),
        Listen(topics.HEARTBEAT),
        Listen(topics.COMMAND),
        Watch(topics.VEHICLE_ALIVE),
        Announce(topics.BRIDGE_ALIVE, {"incarnation": 0}),
    ]
    clock, census = (send.message for send in effects[6:] if isinstance(send, Send))
    assert (clock.tick, clock.t_s, clock.on_road, clock.ended) == (0, 0.0, 0, False)
    assert [one.vehicle for one in census.announced] == [A, B]
    assert (desk.core.phase, desk.core.tick) == (TickPhase.PACE, 1)  # no answer had to be awaited


def test_the_census_is_sent_on_changes_and_now_and_then(tmp_path: Path) -> None:
    scenario = make_scenario(runtime={"announce_s": 1.5})
    desk = Desk(scenario, tmp_path, [arrival(A, 4.05)])
    desk.start(A)
    desk.drive_to_entry(A)
    sent_at = [round(census.t_s / TICK_S) for census in sent(desk.effects, Census)]
    assert sent_at == [0, 10, 20, 26, 36, 41]  # announced at 2.6 s, entered at 4.1 s
    assert [e.vehicle for e in sent(desk.effects, Census)[-1].on_road] == [A]


# --- lockstep ---------------------------------------------------------------------------------


def test_a_tick_ends_when_all_have_answered(desk: Desk) -> None:
    tick = desk.core.tick
    assert desk.answer(B) == []
    assert desk.core.tick == tick
    assert desk.answer(A) == []  # the next tick is not due yet
    assert (desk.core.phase, desk.core.tick) == (TickPhase.PACE, tick + 1)
    assert desk.world.positions() == {
        name: pose_of(vehicle.state) for name, vehicle in desk.core.vehicles.items()
    }
    effects = desk.wake()
    assert [type(effect.message) for effect in effects if isinstance(effect, Send)] == [
        RoadClock,
        Sense,
        Sense,
    ]
    assert asked(effects) == [A, B]
    for sense in sent(effects, Sense):
        assert sense.tick == tick + 1
        assert sense.measured == desk.world.states[sense.vehicle]


def test_the_answers_are_played_from_this_tick_on(desk: Desk) -> None:
    plants = {name: desk.core.vehicles[name].controller.plant for name in (A, B)}
    before = {name: plant.setpoint for name, plant in plants.items()}
    desk.answer(A, jerks=jerks((-2.0, 0.0), (-3.0, 1.0)))
    desk.answer(B)
    assert plants[A].setpoint[0] == pytest.approx(before[A][0] - 2.0 * TICK_S)
    assert plants[B].setpoint[0] == before[B][0]


def test_ticks_keep_the_pace_on_average_and_never_exceed_the_maximum(desk: Desk) -> None:
    opened_s = desk.now_s
    desk.drive_to(desk.core.tick + 1)
    assert desk.now_s == pytest.approx(opened_s + TICK_S)
    desk.now_s += 2.3 * TICK_S
    desk.answer(A)
    desk.answer(B)
    assert desk.core.wakeup_s == desk.now_s  # late: at once
    desk.wake()
    desk.drive_to(desk.core.tick + 1)  # at the maximum pace, the scenario's
    assert desk.now_s == pytest.approx(
        opened_s + 3.3 * TICK_S + TICK_S / desk.scenario.runtime.max_pace
    )
    desk.drive_to(desk.core.tick + 1)  # nothing is left to make up for
    assert desk.now_s == pytest.approx(opened_s + 4 * TICK_S)


def test_ticks_do_not_make_up_for_a_long_delay(desk: Desk) -> None:
    desk.now_s += 5 * CATCH_UP_S
    desk.answer(A)
    desk.answer(B)
    late_s = desk.now_s
    desk.wake()
    desk.drive_to(desk.core.tick + 30)
    assert desk.now_s == pytest.approx(late_s + 30 * TICK_S - CATCH_UP_S)


def test_measurement_errors_are_the_same_in_repeated_senses(tmp_path: Path) -> None:
    """B has entered behind A."""
    desk = Desk(make_scenario(sensing={}), tmp_path, [arrival(A, 0.1), arrival(B, 2.1)])
    desk.start(A, B)
    desk.drive_to_entry(B)
    desk.answer(A)
    desk.answer(B)
    senses = {sense.vehicle: sense for sense in sent(desk.wake(), Sense)}
    for name, sense in senses.items():
        true = desk.core.vehicles[name].state
        assert sense.measured != true
        assert sense.measured == pytest.approx(true, abs=0.4)
        controller = desk.core.vehicles[name].controller
        assert (sense.measured, sense.ahead) == (controller.measured, controller.neighbours.ahead)
        assert sense.behind == controller.neighbours.behind
    assert senses[A].ahead == senses[B].behind == ()
    for (other,) in (senses[B].ahead, senses[A].behind):
        assert other.gap_m != 25.0
        assert other.gap_m == pytest.approx(25.0, abs=0.4)
    assert {sense.vehicle: sense for sense in sent(desk.wake(), Sense)} == senses


# --- missing answers --------------------------------------------------------------------------


def test_only_agents_that_have_not_answered_are_asked_again(desk: Desk) -> None:
    began_s, tick = desk.now_s, desk.core.tick
    desk.answer(A)
    desk.now_s += 0.99 * RESEND_S
    assert desk.give(Wakeup()) == []  # too early
    for times in (1, 2, 3):
        assert desk.core.wakeup_s == pytest.approx(began_s + times * RESEND_S)
        effects = desk.wake()
        assert asked(effects) == [B]
        assert len(effects) == 1
        assert sent(effects, Sense)[0].tick == tick
    desk.answer(B)
    assert desk.core.tick == tick + 1


def test_an_agent_without_answers_is_awaited_to_each_deadline_until_it_is_silent(
    desk: Desk,
) -> None:
    for _ in range(MISSES):
        assert read_events(desk.folder, "agent-silent") == []
        assert B not in desk.core.road.caretakers
        assert desk.core.road.answers.awaited == {A, B}
        began_s, tick = desk.now_s, desk.core.tick
        desk.answer(A)
        while desk.core.tick == tick:
            desk.wake()
        assert desk.now_s == pytest.approx(began_s + DEADLINE_S)
        desk.drive_to(desk.core.tick)
    assert desk.core.road.answers.silent == {B}
    (event,) = read_events(desk.folder, "agent-silent")
    assert (event["vehicle"], event["t_s"]) == (B, pytest.approx(desk.core.t_s))
    # All agents are still asked, but the tick does not wait for the silent one.
    began_s, tick = desk.now_s, desk.core.tick
    desk.effects.clear()
    desk.drive_to(tick + 6, B)
    assert desk.now_s < began_s + 6 * TICK_S
    assert asked(desk.effects).count(B) == asked(desk.effects).count(A) == 6
    assert len(read_events(desk.folder, "agent-silent")) == 1
    desk.give(Stopping())
    assert read_summary(desk.folder)["tracking"]["missed_ticks"] == MISSES


def test_a_late_answer_ends_the_silence_and_does_nothing_else(desk: Desk) -> None:
    late = desk.command(B, jerks=jerks((5.0, 5.0), ticks=40))
    desk.drive_to_silence(B)
    desk.drive_to(desk.core.tick + 3)
    known = desk.known(B)
    assert desk.give(Arrived(topics.COMMAND, {"vehicle": B}, late)) == []
    assert desk.known(B) == known
    assert B in desk.core.road.caretakers  # until it claims its vehicle
    desk.answer(A)  # this tick had not asked it to be waited for
    desk.wake()
    assert desk.core.road.answers.awaited == {A, B}


@pytest.mark.parametrize(
    ("apart", "changes"),
    [
        *[(apart, {}) for apart in (-5, -1, 1, 5, 2**62)],
        (0, {"jerks": b"123"}),
        (0, {"jerks": jerks((float("nan"), 0.0))}),
        (0, {"hold_cell": (0, 7)}),
    ],
)
def test_an_answer_to_another_tick_or_that_makes_no_sense_changes_nothing(
    desk: Desk, apart: int, changes: dict[str, object]
) -> None:
    known, tick = desk.known(A), desk.core.tick
    moving = {"hold_cell": (-1, 0), "motion": CurrentMotion((-1, 0), tick + 9)}
    answer = {"tick": tick + apart, "jerks": jerks((9.0, 9.0), ticks=9), **moving}
    desk.answer(A, **(answer | changes))
    assert desk.known(A) == known
    assert desk.core.road.answers.awaited == {A, B}


def test_an_answer_between_two_ticks_changes_nothing(desk: Desk) -> None:
    desk.answer(A)
    desk.answer(B)
    assert desk.core.phase is TickPhase.PACE
    known = desk.known(A)
    early = desk.command(A, hold_cell=(-1, 0), jerks=jerks((9.0, 9.0), ticks=9))
    assert early.tick == desk.core.tick  # no agent has been asked about it yet
    desk.give(Arrived(topics.COMMAND, {"vehicle": A}, early))
    assert desk.known(A) == known
    desk.wake()
    assert desk.core.road.answers.awaited == {A, B}


def test_the_first_answer_of_a_known_vehicle_counts(desk: Desk) -> None:
    desk.answer(A)
    known = desk.known(A)
    desk.answer(A, jerks=jerks((9.0, 0.0)))
    assert desk.known(A) == known
    ghost = replace(desk.command(A), vehicle=Name("ghost"))
    assert desk.give(Arrived(topics.COMMAND, {"vehicle": "ghost"}, ghost)) == []


def test_a_dead_agent_is_not_waited_for(desk: Desk) -> None:
    tick = desk.core.tick
    desk.answer(A)
    desk.down(B)
    assert desk.core.tick == tick + 1
    desk.wake()
    assert desk.core.road.answers.awaited == {A}
    desk.up(B)  # another one: from the next tick on
    desk.answer(A)
    desk.wake()
    assert desk.core.road.answers.awaited == {A, B}
    assert read_events(desk.folder, "agent-silent") == []


def test_a_network_without_any_answers_does_not_stop_the_road(tmp_path: Path) -> None:
    """All tokens are there and no message comes through: the first vehicles pay, once."""
    names = [f"v{number:02d}" for number in range(12)]
    desk = Desk(SCENARIO, tmp_path, [arrival(n, 2.0 * k + 0.1) for k, n in enumerate(names)], 100.0)
    desk.start(*names)
    desk.drive_to_entry(names[0])
    began_s, tick = desk.now_s, desk.core.tick
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN, *names)
    road_s = (desk.core.tick - tick) * TICK_S
    # Real time, and not faster, though the pace would allow it.
    paid_s = SILENT_S - MISSES * TICK_S
    assert desk.now_s - began_s == pytest.approx(road_s + paid_s, abs=2 * TICK_S)
    desk.give(Stopping())
    summary = read_summary(tmp_path)
    assert summary["vehicles"]["left"] == summary["vehicles"]["left_unattended"] == len(names)
    assert summary["safety"]["overlaps"] == 0
    silent = [event["vehicle"] for event in read_events(tmp_path, "agent-silent")]
    assert sorted(silent) == names
    assert {e["reason"] for e in read_events(tmp_path, "caretaker-took-over")} == {"silent"}


# --- the entrance -----------------------------------------------------------------------------


def test_the_entrance_waits_for_agents(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, TWO)
    desk.start(A)
    desk.drive(lambda: desk.core.phase is TickPhase.AGENTS)
    tick, opened_s = desk.core.tick, desk.now_s
    # Meanwhile it publishes the census, so that a process which has just started learns of them.
    assert desk.core.wakeup_s == opened_s + CENSUS_S
    desk.now_s += 0.9 * PATIENCE_S
    (sent,) = desk.give(Wakeup())
    assert isinstance(sent, Send)
    assert isinstance(sent.message, Census)
    assert B in [each.vehicle for each in sent.message.announced]
    assert asked(desk.up(B)) == [A, B]
    assert desk.core.tick == tick
    assert read_events(tmp_path, "agent-missing") == []


def test_after_one_timeout_the_entrance_waits_only_briefly_until_an_agent_comes(
    tmp_path: Path,
) -> None:
    """A deployment without agents must not take fifteen seconds for each vehicle."""
    names = [f"v{number}" for number in range(5)]
    desk = Desk(SCENARIO, tmp_path, [arrival(n, 2.0 * k + 0.1) for k, n in enumerate(names)])
    desk.start()
    waited = []
    for name in names:
        desk.drive(lambda: desk.core.phase is TickPhase.AGENTS)
        opened_s = desk.now_s
        if name == "v2":
            desk.now_s += 0.5 * LITTLE_PATIENCE_S
            desk.up("v2")
        while Name(name) not in desk.core.vehicles:
            desk.wake()
        waited.append(desk.now_s - opened_s)
        desk.drive(lambda: desk.core.phase is TickPhase.PACE)
    little_s = LITTLE_PATIENCE_S
    assert waited == pytest.approx([PATIENCE_S, little_s, 0.5 * little_s, PATIENCE_S, little_s])
    missing = [event["vehicle"] for event in read_events(tmp_path, "agent-missing")]
    assert missing == ["v0", "v1", "v3", "v4"]


# --- leaving ----------------------------------------------------------------------------------


def test_departures_are_notified_until_the_agent_is_gone(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, [arrival(A, 0.5), arrival(B, 8.5)])
    desk.start(A, B)
    desk.drive(lambda: A in desk.core.vehicles)
    desk.drive(lambda: A not in desk.core.vehicles)
    assert B in desk.core.vehicles
    desk.effects.clear()
    desk.drive_to(desk.core.tick + 2)
    assert [sense.vehicle for sense in sent(desk.effects, Sense) if sense.left] == [A] * 3
    desk.down(A)
    desk.effects.clear()
    desk.drive_to(desk.core.tick + 2)
    assert not any(sense.left for sense in sent(desk.effects, Sense))
    assert len(desk.core.road.caretakers.departed) == 0


def test_departures_are_notified_a_limited_number_of_times(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, [arrival(A, 0.5), arrival(B, 8.5)])
    desk.start(A, B)
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN)
    notified = [sense.vehicle for sense in sent(desk.effects, Sense) if sense.left]
    assert notified.count(A) == LEFT_REPEATS
    assert notified.count(B) == 1  # it was the last one
    assert A not in desk.core.road.caretakers.departed


# --- the end ----------------------------------------------------------------------------------


def wound_up(tmp_path: Path, scenario: Scenario = SCENARIO) -> Desk:
    desk = Desk(scenario, tmp_path, TWO)
    desk.start(A, B)
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN)
    return desk


def test_the_end_is_published_to_all_vehicles(tmp_path: Path) -> None:
    desk = wound_up(tmp_path)
    clocks = sent(desk.effects, RoadClock)
    assert [clock.ended for clock in clocks] == [False] * (len(clocks) - 1) + [True]
    assert (clocks[-1].demanded, clocks[-1].entered, clocks[-1].left) == (2, 2, 2)
    assert sent(desk.effects, Census)[-1].on_road == ()
    assert isinstance(sent(desk.effects[-1:], Report)[0], Report)  # last: it counts all before


def test_winds_up_until_all_have_reported(tmp_path: Path) -> None:
    desk = wound_up(tmp_path)
    ends_s = desk.now_s + SHUT_DOWN_S
    assert desk.core.wakeup_s == ends_s
    assert desk.report("agent", A) == []
    assert desk.report_own() == []
    assert desk.report("coordinator", B) == []  # another role of that name
    assert desk.core.wakeup_s == ends_s
    assert ended(desk.report("agent", B))
    assert desk.core.phase is TickPhase.ENDED
    assert desk.now_s < ends_s
    assert desk.core.wakeup_s is None
    assert read_summary(tmp_path)["ending"] == "complete"


def test_reports_about_vehicles_of_an_earlier_run_do_not_count(tmp_path: Path) -> None:
    """A host that finds a new bridge lets its old vehicles go, whose names are used again."""
    desk = Desk(SCENARIO, tmp_path, TWO)
    desk.start(A, B)
    for name in (A, B, "v0099"):
        desk.report("agent", name, solves=1000)
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN)
    desk.report_own()
    desk.report("agent", A, solves=1)
    assert desk.core.phase is TickPhase.SHUTTING_DOWN
    assert ended(desk.report("agent", B, solves=2))
    assert read_summary(tmp_path)["tracking"]["solves"] == 3


@pytest.mark.parametrize(
    "forged",
    [
        {"rejected": 2**63 - 1},
        {"published": 2**63 - 1},
        {"published": -1},
        {"solves": 2**63 - 1},
        {"unusable": -5},
        {"solves": 1, "osqp_solves": 2},
        {"solves": 1, "solve_ms": b"\x00\x00\xc0\x7f"},  # NaN
    ],
    ids=str,
)
def test_reports_with_impossible_numbers_are_refused_and_add_nothing(
    tmp_path: Path, forged: dict[str, Any]
) -> None:
    desk = wound_up(tmp_path)
    desk.report("coordinator", "c1", process=Name("c"), published=70, rejected=7)
    for role, name in (("coordinator", "c1"), ("coordinator", "c2"), ("agent", A)):
        effects = desk.report(role, name, **forged)
        assert [type(effect) for effect in effects] == [Refuse]
    desk.report_own()
    desk.report("agent", B, solves=2)
    # The vehicle's own report is still awaited.
    assert ended(desk.report("agent", A, solves=1))
    found = read_summary(tmp_path)
    assert found["messages"]["published"] == 70
    assert found["messages"]["rejected"] == 7
    assert found["tracking"]["solves"] == 3


@pytest.mark.parametrize("stopped", [False, True])
def test_winding_up_has_a_deadline_and_may_be_stopped(tmp_path: Path, *, stopped: bool) -> None:
    desk = wound_up(tmp_path)
    desk.report("agent", A)
    began_s = desk.now_s
    desk.give(Stopping()) if stopped else desk.wake()
    assert desk.core.phase is TickPhase.ENDED
    assert desk.now_s == (began_s if stopped else began_s + SHUT_DOWN_S)
    assert read_summary(tmp_path)["ending"] == "complete"


def test_reports_are_awaited_of_agents_that_came_late_and_of_no_others(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, TWO)
    desk.start()
    desk.drive(lambda: desk.core.tick >= 40)
    desk.up(B)
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN)
    desk.report_own()
    assert desk.core.phase is TickPhase.SHUTTING_DOWN
    assert ended(desk.report("agent", B))


def test_a_run_that_is_stopped_was_interrupted(desk: Desk) -> None:
    desk.give(Stopping())
    assert desk.core.phase is TickPhase.ENDED
    assert desk.core.wakeup_s is None
    found = read_summary(desk.folder)
    assert found["ending"] == "interrupted"
    assert (found["vehicles"]["entered"], found["vehicles"]["left"]) == (2, 0)
    (event,) = read_events(desk.folder, "run-ended")
    assert event["ending"] == "interrupted"
    assert desk.give(Wakeup()) == []


def test_a_run_ends_at_the_limit(tmp_path: Path) -> None:
    scenario = make_scenario(runtime={"max_road_s": 5.0})
    desk = wound_up(tmp_path, scenario)
    assert desk.core.t_s == 5.0
    # Vehicles on the road are not driven any further.
    assert {sense.vehicle for sense in sent(desk.effects, Sense) if sense.left} == {A, B}
    desk.wake()
    assert read_summary(tmp_path)["ending"] == "limit"


def test_a_run_that_is_over_at_the_limit_is_complete(tmp_path: Path) -> None:
    over_s = wound_up(tmp_path / "first").core.t_s
    scenario = make_scenario(runtime={"max_road_s": over_s})
    wound_up(tmp_path / "second", scenario).wake()
    assert read_summary(tmp_path / "second")["ending"] == "complete"


def test_nothing_is_left_over_at_the_end(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, [*TWO, arrival("C", 3.0)])
    desk.start(A, B, "C")
    desk.drive(lambda: desk.core.tick > 60, B)
    assert desk.core.road.answers.silent == {B}
    desk.drive(lambda: desk.core.phase is TickPhase.SHUTTING_DOWN, B)
    for name in (A, B, "C"):
        desk.report("agent", name)
        desk.down(name)
    desk.report_own()
    core = desk.core
    assert core.phase is TickPhase.ENDED
    for left_over in (
        *(core.vehicles, core.road.caretakers.departed, core.road.caretakers._caretakers),
        *(core.road.answers._without_message, core.road.answers._silence_s),
        *(core.road.answers.silent, core.road.answers.awaited, core.road.answers.up),
        *(core.road.at_entrance, core._unreported, desk.world.states),
    ):
        assert not left_over


def test_a_run_without_vehicles_ends(tmp_path: Path) -> None:
    desk = Desk(SCENARIO, tmp_path, [])
    desk.start()
    assert desk.core.phase is TickPhase.SHUTTING_DOWN
    assert ended(desk.report_own())
    assert read_summary(tmp_path)["vehicles"]["demanded"] == 0


# --- the link ---------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["link", "tokens"])
def test_the_clock_does_not_race_while_the_network_is_away(tmp_path: Path, first: str) -> None:
    desk = Desk(SCENARIO, tmp_path, TWO, pace=1000.0)
    desk.start(A, B)
    desk.drive_to_entry(A, B)
    news: list[Event] = [LinkDown()]
    news += [PeerDown(topics.VEHICLE_ALIVE, {"process": name, "vehicle": name}) for name in (A, B)]
    for event in news if first == "link" else reversed(news):
        desk.give(event)
    began_s, tick = desk.now_s, desk.core.tick
    desk.drive(lambda: desk.now_s >= began_s + 3.0, A, B)
    passed = desk.core.tick - tick
    assert 5 <= passed <= 3.0 / TICK_S + 1
    desk.give(LinkUp())
    for name in (A, B):
        desk.up(name)
    tick = desk.core.tick
    desk.drive_to(tick + 3)
    assert desk.core.road.answers.awaited == {A, B}
    began_s = desk.now_s
    desk.drive_to(tick + 10)
    assert desk.now_s < began_s + 0.1  # as fast as it may


def test_tokens_that_vanish_with_the_link_are_not_believed(desk: Desk) -> None:
    desk.give(LinkDown())
    desk.down(A)
    assert desk.core.road.answers.awaited == {A, B}
    desk.give(LinkUp())
    desk.give(
        PeerDown(topics.COORDINATOR_ALIVE, {"coordinator": B, "incarnation": "1"})
    )  # no agent's
    desk.down(A)
    assert desk.core.road.answers.awaited == {B}
