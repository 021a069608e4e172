"""Which agents a tick waits for, and which count as silent."""

from __future__ import annotations

import pytest
from attrs import evolve

from laneweave.protocol.scenario.deployment_fields import Runtime
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.tick_answers import (
    COPIES,
    LATE_SHARE,
    LOSSY_ROUNDS,
    LOSSY_TICK,
    MAX_SLOWDOWN,
    Answers,
)

RUNTIME = Runtime()
DEADLINE_S, SILENT_S = RUNTIME.tick_deadline_s, RUNTIME.agent_silent_s
A, B, C = Name("A"), Name("B"), Name("C")
TICKS = round(SILENT_S / DEADLINE_S)
"""Deadlines after which an agent is silent."""


@pytest.fixture
def answers() -> Answers:
    """The agents of A and B are up; C is on the road, too."""
    answers = Answers(RUNTIME)
    for name in (A, B):
        answers.agent_up(name)
    return answers


def tick(answers: Answers, now_s: float, *heard: Name, lasts_s: float = DEADLINE_S) -> list[Name]:
    """Ask all agents, let some answer; return those that are silent when the next tick begins."""
    answers.start_tick((A, B, C), now_s, link_up=True)
    for name in heard:
        answers.on_message(name)
        answers.awaited.discard(name)
    answers.close()
    return answers.update_durations(now_s + lasts_s)


def test_waits_for_agents_that_are_up_until_the_deadline(answers: Answers) -> None:
    answers.start_tick((A, B, C), 5.0, link_up=True)
    assert answers.awaited == {A, B}
    answers.awaited.discard(A)
    assert not answers.complete(5.0 + 0.99 * DEADLINE_S)
    assert answers.complete(5.0 + DEADLINE_S)
    assert answers.close() == 1  # B's answer is missing
    assert answers.awaited == set()
    assert answers.complete(5.0)


def test_awaited_agents_are_asked_again_at_intervals(answers: Answers) -> None:
    answers.start_tick((A, B, C), 5.0, link_up=True)
    resend_s = RUNTIME.tick_resend_s
    assert answers.due_resends(5.0 + 0.99 * resend_s) == []
    assert answers.due_resends(5.0 + resend_s) == [A, B]
    answers.awaited.discard(B)
    assert answers.due_resends(5.0 + 1.5 * resend_s) == []
    assert answers.due_resends(5.0 + 2.0 * resend_s) == [A]


def test_an_agent_without_answers_for_long_is_silent(answers: Answers) -> None:
    for number in range(-100, 1):  # some misses are no silence
        heard = (A,) if number % (TICKS - 1) else (A, B)
        assert tick(answers, number * DEADLINE_S, *heard) == []
        assert answers.silent == set()
    answers.start_tick((A, B), 1.0, link_up=True)
    assert answers.awaited == {A, B}
    answers.on_message(B)
    fallen = [tick(answers, number * DEADLINE_S, A) for number in range(TICKS + 3)]
    assert fallen == [[]] * (TICKS - 1) + [[B], [], [], []]
    answers.start_tick((A, B), 100.0, link_up=True)
    assert answers.awaited == {A}


@pytest.mark.parametrize("sign", ["answer", "token"])
def test_a_sign_of_life_ends_the_silence(answers: Answers, sign: str) -> None:
    for number in range(TICKS):
        tick(answers, number * DEADLINE_S, A)
    if sign == "answer":
        answers.on_message(B)
    else:
        answers.agent_down(B)
        answers.agent_up(B)
    for number in range(TICKS - 1):  # all the time again
        assert tick(answers, 50.0 + number * DEADLINE_S, A) == []
    assert tick(answers, 99.0, A) == [B]


@pytest.mark.parametrize(
    ("lasts_s", "ticks"),
    [(20.0, TICKS), (0.1 * DEADLINE_S, 10 * TICKS)],
    ids=["the entrance waits or the pace is slow", "ticks of others are short"],
)
def test_silence_is_the_time_spent_waiting_for_an_answer(
    answers: Answers, lasts_s: float, ticks: int
) -> None:
    fallen = [tick(answers, number * lasts_s, A, lasts_s=lasts_s) for number in range(ticks)]
    assert fallen == [[]] * (ticks - 1) + [[B]]


def test_agents_without_a_token_and_departed_ones_are_not_silent(answers: Answers) -> None:
    for number in range(2 * TICKS):
        answers.start_tick((A, C), number * DEADLINE_S, link_up=True)
        answers.on_message(A)
        assert answers.update_durations((number + 1) * DEADLINE_S) == []
    for number in range(TICKS - 1):
        tick(answers, 50.0 + number * DEADLINE_S, A)
    answers.remove(B)
    assert tick(answers, 99.0, A) == []


def test_without_a_connection_no_agent_is_awaited_or_becomes_silent(answers: Answers) -> None:
    for number in range(2 * TICKS):
        answers.start_tick((A, B), number * DEADLINE_S, link_up=False)
        assert answers.awaited == set()
        assert answers.update_durations((number + 1) * DEADLINE_S) == []
    assert not answers.all_silent
    for number in range(2 * TICKS):  # lost while the tick is under way
        answers.start_tick((A, B), 50.0 + number * DEADLINE_S, link_up=True)
        answers.link_down()
        assert answers.update_durations(50.0 + (number + 1) * DEADLINE_S) == []


# --- answers that come too late ---------------------------------------------------------------

LATE_TICKS = round(LATE_SHARE * TICKS)
"""Deadlines that an agent may miss with all its answers."""


def late_tick(answers: Answers, number: int, *effective: Name) -> None:
    """Let A and B be heard, but only some in time."""
    answers.start_tick((A, B, C), number * DEADLINE_S, link_up=True)
    for name in (A, B):
        answers.on_message(name)
    for name in effective:
        answers.in_time(name)
        answers.awaited.discard(name)
    answers.close()
    assert answers.update_durations((number + 1) * DEADLINE_S) == []


def test_an_agent_that_always_answers_late_is_ineffective_but_not_silent(answers: Answers) -> None:
    for number in range(LATE_TICKS - 1):
        late_tick(answers, number, A)
        assert not answers.always_late(B)
    late_tick(answers, LATE_TICKS, A)
    assert [answers.always_late(name) for name in (A, B, C)] == [False, True, False]
    assert answers.silent == set()
    answers.start_tick((A, B), 100.0, link_up=True)
    assert answers.awaited == {A, B}  # it may catch up


def test_one_answer_in_time_in_a_while_is_enough_to_be_effective(answers: Answers) -> None:
    for number in range(10 * LATE_TICKS):
        late_tick(answers, number, *((A, B) if number % LATE_TICKS == 0 else (A,)))
        assert not answers.always_late(B)


@pytest.mark.parametrize("sign", ["in time", "token", "no token", "left"])
def test_what_ends_being_ineffective(answers: Answers, sign: str) -> None:
    for number in range(LATE_TICKS):
        late_tick(answers, number, A)
    assert answers.always_late(B)
    match sign:
        case "in time":
            answers.in_time(B)
        case "token":
            answers.agent_up(B)
        case "no token":
            answers.agent_down(B)
        case _:
            answers.remove(B)
    assert not answers.always_late(B)


def test_time_off_the_network_makes_no_agent_ineffective(answers: Answers) -> None:
    for number in range(2 * LATE_TICKS):
        answers.start_tick((A, B), number * DEADLINE_S, link_up=number % 2 == 0)
        answers.link_down()
        answers.update_durations((number + 1) * DEADLINE_S)
    assert not answers.always_late(A)


# --- no agent answers -------------------------------------------------------------------------


def silence_all(answers: Answers) -> None:
    for number in range(TICKS):
        assert not answers.all_silent
        tick(answers, number * DEADLINE_S)
    assert answers.all_silent


def test_a_silent_network_awaits_no_agent(answers: Answers) -> None:
    silence_all(answers)
    answers.agent_up(C)  # tokens come through when messages do not
    answers.start_tick((A, B, C), 100.0, link_up=True)
    assert answers.awaited == set()
    assert answers.complete(100.0)


def test_an_agent_that_joins_a_silent_network_becomes_silent(answers: Answers) -> None:
    silence_all(answers)
    answers.agent_up(C)
    short_s = 0.25 * DEADLINE_S
    fallen = [tick(answers, 90.0 + n * short_s, lasts_s=short_s) for n in range(4 * TICKS)]
    assert fallen == [[]] * (4 * TICKS - 1) + [[C]]


def test_any_answer_ends_the_silence(answers: Answers) -> None:
    silence_all(answers)
    answers.on_message(A)
    assert not answers.all_silent
    answers.start_tick((A, B), 100.0, link_up=True)
    assert answers.awaited == {A}  # B is silent for itself


def test_one_answer_in_a_while_is_enough(answers: Answers) -> None:
    for number in range(10 * TICKS):
        tick(answers, number * DEADLINE_S, *((A,) if number % (TICKS - 1) == 0 else ()))
        assert not answers.all_silent


def test_an_empty_road_is_not_silent(answers: Answers) -> None:
    for number in range(3 * TICKS):
        answers.start_tick((), number * DEADLINE_S, link_up=True)
        assert answers.update_durations((number + 1) * DEADLINE_S) == []
    assert not answers.all_silent


def test_deadlines_may_be_as_long_as_silence() -> None:
    answers = Answers(evolve(RUNTIME, tick_deadline_s=SILENT_S))
    answers.agent_up(A)
    answers.agent_up(B)
    assert tick(answers, 0.0, B, lasts_s=SILENT_S) == [A]


def slow_ticks(answers: Answers, names: list[Name], count: int, *, late: bool) -> float:
    """Let ticks pass; return how long the next one may last."""
    now_s = 100.0
    for _ in range(count):
        answers.start_tick(names, now_s, link_up=True)
        for name in names:
            answers.on_message(name)
            if not late:
                answers.in_time(name)
        answers.close()
        for name in names:
            answers.late(name)  # without effect if another answer has arrived in time
        now_s += 1.0
    answers.start_tick(names, now_s, link_up=True)
    return answers.deadline_s - now_s


def test_ticks_get_more_time_while_many_answers_are_late_and_less_again() -> None:
    answers = Answers(RUNTIME)
    names = [Name(f"v{number}") for number in range(40)]
    for name in names:
        answers.agent_up(name)
    answers.start_tick(names, 0.0, link_up=True)
    answers.late(names[0])  # one of many changes nothing
    answers.start_tick(names, 1.0, link_up=True)
    assert answers.deadline_s == pytest.approx(1.0 + DEADLINE_S)
    assert slow_ticks(answers, names, 3, late=False) == pytest.approx(DEADLINE_S)
    assert slow_ticks(answers, names, 1, late=True) == pytest.approx(1.5 * DEADLINE_S)
    assert slow_ticks(answers, names, 30, late=True) == pytest.approx(MAX_SLOWDOWN * DEADLINE_S)
    assert answers.resend_s - (answers.deadline_s - MAX_SLOWDOWN * DEADLINE_S) == pytest.approx(
        MAX_SLOWDOWN * RUNTIME.tick_resend_s
    )
    relaxed_s = slow_ticks(answers, names, 30, late=False)
    assert DEADLINE_S < relaxed_s < MAX_SLOWDOWN * DEADLINE_S
    assert slow_ticks(answers, names, 200, late=False) == pytest.approx(DEADLINE_S)


# --- messages are lost ------------------------------------------------------------------------

FLEET = [Name(f"v{number:02d}") for number in range(20)]
RESEND_S, TICK_S = RUNTIME.tick_resend_s, RUNTIME.tick_s


def fleet() -> Answers:
    answers = Answers(RUNTIME)
    for name in FLEET:
        answers.agent_up(name)
    return answers


def ask(answers: Answers, now_s: float, **answered: int) -> None:
    """Begin a tick; agents answer a number of times, after 2 ms."""
    answers.start_tick(FLEET, now_s, link_up=True)
    answers.due_resends(now_s)
    for name, times in answered.items():
        for _ in range(times):
            answers.received(Name(name), now_s + 0.002, current=True)
        answers.on_message(Name(name))
        answers.in_time(Name(name))


def lose_half(answers: Answers, ticks: int, now_s: float = 0.0, answer_s: float = 0.002) -> float:
    """Let ticks pass in which half of the agents answer the first SENSE, others the second one."""
    for number in range(ticks):
        answers.start_tick(FLEET, now_s, link_up=True)
        answers.due_resends(now_s)
        for name in FLEET[number % 2 :: 2]:
            answers.received(name, now_s + answer_s, current=True)
            answers.in_time(name)
        now_s = max(now_s + answer_s, answers.resend_s)
        assert len(answers.due_resends(now_s)) in {10, 10 * COPIES}
        answers.due_resends(now_s)
        for name in FLEET[(number + 1) % 2 :: 2]:
            answers.received(name, now_s + answer_s, current=True)
            answers.in_time(name)
        answers.close()
        now_s += answer_s
    return now_s


def test_unanswered_messages_are_lost() -> None:
    answers = fleet()
    assert not answers.lossy
    now_s = lose_half(answers, 5)
    answers.start_tick(FLEET, now_s, link_up=True)
    assert answers.lossy
    assert answers.deadline_s == pytest.approx(now_s + LOSSY_TICK * TICK_S)
    for number in range(60):  # and until they are answered again
        ask(answers, now_s + number, **dict.fromkeys(FLEET, 1))
    assert not answers.lossy
    answers.start_tick(FLEET, 99.0, link_up=True)
    assert answers.deadline_s == pytest.approx(99.0 + DEADLINE_S)
    assert answers.resend_s == pytest.approx(99.0 + RESEND_S)


def test_answers_that_arrive_in_the_next_tick_are_not_lost() -> None:
    answers = fleet()
    now_s = 0.0
    for number in range(50):
        answers.start_tick(FLEET, now_s, link_up=True)
        assert not answers.lossy
        for name in FLEET if number else ():
            for _ in range(2):  # to what was repeated
                answers.received(name, now_s + 0.01, current=False)
        for _ in range(2):
            assert answers.due_resends(answers.resend_s) == FLEET
        for name in FLEET:
            answers.received(name, answers.resend_s, current=True)
            answers.in_time(name)
        now_s = answers.resend_s


def test_an_agent_that_answers_nothing_hangs_and_is_waited_for() -> None:
    answers = fleet()
    for number in range(20):
        now_s = float(number)
        ask(answers, now_s, **dict.fromkeys(FLEET[1:], 1))
        while not answers.complete(now_s):
            now_s = min(answers.resend_s, answers.deadline_s)
            answers.due_resends(now_s)
        assert now_s == pytest.approx(number + DEADLINE_S)
        assert answers.close() == 1
    assert not answers.lossy


def test_while_messages_are_lost_sense_is_repeated_when_no_more_answers_arrive() -> None:
    answers = fleet()
    now_s = lose_half(answers, 20)
    answers.start_tick(FLEET, now_s, link_up=True)
    assert answers.resend_s == now_s
    sent_s = now_s + 0.004  # as long as it takes to send 20 messages
    assert answers.due_resends(sent_s) == []
    first_wait_s = answers.resend_s - sent_s
    assert 0.002 < first_wait_s < RESEND_S / 5
    for name in FLEET[:18]:
        now_s = answers.resend_s - 0.001
        answers.received(name, now_s, current=True)
        answers.in_time(name)
        assert now_s < answers.resend_s <= now_s + first_wait_s
    wanted = [name for name in FLEET[18:] for _ in range(COPIES)]
    assert answers.due_resends(answers.resend_s) == wanted


@pytest.mark.parametrize(("answered", "copies"), [(0, 2), (3, 2), (4, 3), (19, 3)])
def test_a_round_of_few_agents_has_several_copies(answered: int, copies: int) -> None:
    answers = fleet()
    now_s = lose_half(answers, 20)
    answers.start_tick(FLEET, now_s, link_up=True)
    answers.due_resends(now_s)
    for name in FLEET[:answered]:
        answers.in_time(name)
    wanted = [name for name in FLEET[answered:] for _ in range(copies)]
    assert answers.due_resends(answers.resend_s) == wanted


def test_a_round_of_many_agents_has_no_more_messages_than_the_first_one() -> None:
    answers = fleet()
    now_s = lose_half(answers, 20)
    many = [Name(f"v{number:02d}") for number in range(90)]
    for name in many:
        answers.agent_up(name)
    answers.start_tick(many, now_s, link_up=True)
    answers.due_resends(now_s)
    for left, sent in ((90, 90), (46, 46), (45, 90), (31, 62), (30, 90), (9, 27)):
        for name in many[left:]:
            answers.in_time(name)
        assert len(answers.due_resends(answers.resend_s)) == sent
        answers.due_resends(answers.resend_s)
        answers.deadline_s = now_s + 99.0


def test_a_tick_without_time_for_another_round_ends_early() -> None:
    answers = fleet()
    began_s = now_s = lose_half(answers, 20)
    answers.start_tick(FLEET, now_s, link_up=True)
    rounds = 1
    while not answers.complete(now_s):
        now_s = max(now_s, answers.resend_s)
        rounds += bool(answers.due_resends(now_s))
    lasted_s = now_s - began_s
    assert 0.8 * LOSSY_TICK * TICK_S < lasted_s <= LOSSY_TICK * TICK_S
    assert rounds > LOSSY_ROUNDS
    assert answers.close() == len(FLEET)


def test_on_a_slow_network_there_is_time_for_some_rounds() -> None:
    answers = fleet()
    answer_s = 0.02
    now_s = lose_half(answers, 20, answer_s=answer_s)
    answers.start_tick(FLEET, now_s, link_up=True)
    assert LOSSY_ROUNDS * answer_s < answers.deadline_s - now_s < DEADLINE_S
    answers.due_resends(now_s)
    assert answer_s < answers.resend_s - now_s <= RESEND_S


def test_a_second_answer_to_a_tick_is_not_late() -> None:
    answers = fleet()
    for number in range(20):
        ask(answers, float(number), **dict.fromkeys(FLEET, 2))
        answers.close()
        for name in FLEET:
            answers.late(name)
    answers.start_tick(FLEET, 99.0, link_up=True)
    assert answers.deadline_s == pytest.approx(99.0 + DEADLINE_S)


@pytest.mark.parametrize(("late", "more_time"), [(6, False), (7, True)])
def test_while_messages_are_lost_ticks_get_more_time_if_a_third_is_late(
    late: int,
    more_time: bool,
) -> None:
    answers = fleet()
    now_s = lose_half(answers, 20)
    answers.start_tick(FLEET, now_s, link_up=True)
    answers.close()
    for name in FLEET[:late]:
        answers.late(name)
    answers.start_tick(FLEET, now_s, link_up=True)
    assert answers.lossy
    usual_s = LOSSY_TICK * TICK_S
    assert (answers.deadline_s - now_s > 1.4 * usual_s) is more_time
    assert answers.deadline_s - now_s >= 0.99 * usual_s


def test_a_tick_that_asks_only_a_hanging_agent_is_no_silence_of_all(answers: Answers) -> None:
    """The others hold undisturbed."""
    for number in range(2 * TICKS):
        answers.start_tick((A,), number * DEADLINE_S, link_up=True, all_sensed=False)
        answers.close()
        answers.update_durations((number + 1) * DEADLINE_S)
    assert answers.silent == {A}
    assert not answers.all_silent


def test_late_answers_are_compared_with_those_that_a_tick_awaits(answers: Answers) -> None:
    many = [Name(f"v{number}") for number in range(100)]
    for name in many:
        answers.agent_up(name)
    for number in range(4):
        answers.start_tick(many[:10], number * DEADLINE_S, link_up=True, all_sensed=False)
        answers.close()
        for name in many[:3]:
            answers.late(name)
    assert answers._slowdown > 1.0
