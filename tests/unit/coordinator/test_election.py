"""Rule L1: when a candidate leads, given heartbeats, tokens and its own link."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import count

import pytest

from laneweave.coordinator.election import (
    MAX_SILENCE_FACTOR,
    NEWCOMER_FACTOR,
    SILENCE_MARGIN,
    Election,
)
from laneweave.protocol.wire.messages import Heartbeat, Name

ELECTION_S = 0.4


def candidate(name: str = "b", started_s: float = 0.0) -> Election:
    return Election(Name(name), 1, ELECTION_S, started_s)


def beat(name: str, incarnation: int = 1, term: int = 0, *, leading: bool = False) -> Heartbeat:
    return Heartbeat(Name(name), incarnation, term, leading=leading, plans=0)


@pytest.mark.parametrize("heard_s", [0.1, 0.3, 1.1, 7.7, 1e6 + 0.3])
def test_it_can_decide_exactly_at_its_wakeup(heard_s: float) -> None:
    """Rounding must not make a candidate sleep on until the next heartbeat."""
    election = candidate()
    election.on_heartbeat(beat("a"), heard_s)
    assert election.update(election.next_change_s(heard_s))


def test_alone_it_leads_when_it_is_old_enough() -> None:
    election = candidate(started_s=10.0)
    assert not election.update(10.0 + ELECTION_S - 0.01)
    assert election.update(10.0 + ELECTION_S)
    assert (election.leading, election.term) == (True, 1)
    assert not election.update(10.0 + 2 * ELECTION_S)  # no change


def test_a_better_ranked_candidate_keeps_it_from_leading() -> None:
    election = candidate()
    election.on_heartbeat(beat("a"), 0.3)
    assert not election.update(0.3 + ELECTION_S - 0.01)
    assert election.next_change_s(0.3) == 0.3 + ELECTION_S
    assert election.update(0.3 + ELECTION_S)


def heard_until(election: Election, contacts_s: Iterable[float]) -> float:
    """Let heartbeats of `a` arrive; return how long it counts as present after the last one."""
    for now_s in contacts_s:
        election.on_heartbeat(beat("a"), now_s)
    return next(ms / 1e3 for ms in count() if "a" not in election.living(now_s + ms / 1e3))


def test_late_heartbeats_extend_the_timeout_for_a_while() -> None:
    election = candidate()
    late = (0.0, 0.1, 0.1 + 0.9 * ELECTION_S)
    assert heard_until(election, late) == pytest.approx(SILENCE_MARGIN * 0.9 * ELECTION_S, abs=2e-3)
    began_s = late[-1]
    punctual = [began_s + 0.1 * number for number in range(1, 200)]
    assert heard_until(election, punctual[:5]) > 1.2 * ELECTION_S
    assert heard_until(election, punctual[5:]) == pytest.approx(ELECTION_S, abs=2e-3)


def test_a_long_silence_extends_the_timeout_to_a_limit() -> None:
    election = candidate()
    silent = heard_until(election, (0.0, 100.0))
    assert silent == pytest.approx(MAX_SILENCE_FACTOR * ELECTION_S, abs=2e-3)
    # A new process has not been silent.
    election.on_heartbeat(beat("a", incarnation=2), 100.1)
    assert "a" not in election.living(100.1 + 1.01 * ELECTION_S)


def test_terms_above_the_maximum_end_with_it() -> None:
    election = candidate()
    election.see_term(election.max_term)
    assert election.term == election.max_term
    election.limit_term(7)
    election.see_term(8)
    assert election.term == 7


def test_worse_ranked_candidates_and_its_own_earlier_process_are_no_rivals() -> None:
    election = candidate()
    election.on_heartbeat(beat("c"), 0.3)
    assert election.next_change_s(0.3) == math.inf
    election.on_heartbeat(beat("b", incarnation=2, term=9), 0.3)
    election.on_token_up("b", 2, 0.3)
    election.on_token_down("b", 2)
    assert election.update(ELECTION_S)
    assert election.term == 1  # it does not race with itself


def test_steps_down_for_a_better_ranked_one_and_leads_again_with_a_higher_term() -> None:
    election = candidate()
    election.update(ELECTION_S)
    election.on_heartbeat(beat("a", term=7, leading=True), 1.0)
    assert election.update(1.0)
    assert not election.leading
    assert election.term == 8  # it led when it saw the other term, and may yet again
    election.on_heartbeat(beat("a", term=20), 1.1)  # terms are noted while not leading
    assert election.term == 20
    assert election.update(1.1 + ELECTION_S)
    assert (election.leading, election.term) == (True, 21)


def test_a_heartbeat_in_flight_does_not_revive_a_dead_process() -> None:
    election = candidate()
    election.on_heartbeat(beat("a"), 0.5)
    election.on_token_down("a", 1)
    election.on_heartbeat(beat("a"), 0.6)
    assert election.update(0.6)
    assert election.leading


def test_the_next_process_of_that_name_counts() -> None:
    election = candidate()
    election.on_token_down("a", 1)
    election.on_heartbeat(beat("a", incarnation=2), 0.6)
    assert not election.update(0.6)
    election.on_token_down("a", 1)  # late news of the old one
    assert not election.update(0.6)
    election.on_heartbeat(beat("a", incarnation=1), 0.9)  # late itself, and not to be counted
    election.on_token_up("a", 1, 0.9)
    assert election.update(0.6 + ELECTION_S)


def test_a_heartbeat_of_an_earlier_process_does_not_count() -> None:
    election = candidate()
    election.on_heartbeat(beat("a", incarnation=2), 0.1)
    election.on_heartbeat(beat("a", incarnation=1), 0.1 + ELECTION_S / 2)  # delayed
    assert election.update(0.1 + ELECTION_S)


def test_a_stopped_process_that_resumes_counts_again() -> None:
    election = candidate()
    election.on_heartbeat(beat("a"), 0.1)
    election.on_token_down("a", 1)  # stopped for longer than its lease
    assert election.update(0.6)
    assert election.leading
    election.on_token_up("a", 1, 2.0)
    assert not election.update(2.0)  # it may be too young to lead
    election.on_heartbeat(beat("a", leading=True), 2.1)
    assert election.update(2.1)
    assert not election.leading
    election.on_heartbeat(beat("a"), 2.3)
    assert not election.update(2.3 + ELECTION_S - 0.01)


def test_losing_the_own_link_changes_nothing_known_of_others() -> None:
    election = candidate()
    election.on_heartbeat(beat("a"), 0.5)
    election.on_link(up=False, now_s=0.6)
    election.on_token_down("a", 1)
    election.on_heartbeat(beat("a"), 0.61)  # not dead
    assert not election.update(5.0)  # and without a link it never leads
    election.on_link(up=True, now_s=6.0)
    assert not election.update(6.0 + ELECTION_S - 0.01)  # its age counts from here
    election.on_heartbeat(beat("a"), 6.2)
    assert not election.update(6.0 + ELECTION_S)


def test_terms_only_rise() -> None:
    election = candidate()
    election.see_term(5)
    assert election.term == 5
    election.see_term(3)
    assert election.term == 5
    election.update(ELECTION_S)
    assert election.term == 6
    for lower in (0, 5, 6):  # equal terms happen: ballots tell the coordinators apart
        election.see_term(lower)
        assert election.term == 6
    election.see_term(50)  # what it does from now on is newer than that
    assert (election.leading, election.term) == (True, 51)


def test_a_leader_that_was_paused_takes_a_term_above_those_used_meanwhile() -> None:
    election = candidate("a")
    election.update(ELECTION_S)
    election.on_heartbeat(beat("b", term=2), 9.0)  # it led while this one was paused
    assert not election.update(9.0)
    assert (election.leading, election.term) == (True, 3)
    election.on_heartbeat(beat("b", term=3), 9.1)  # it has seen the new term by now
    assert election.term == 3


def test_two_leaders_that_hear_each_other_stop_outbidding() -> None:
    first, second = candidate("a"), candidate("b")
    for election in (first, second):
        election.update(ELECTION_S)
    second.see_term(6)
    now_s = 1.0
    for _ in range(20):
        for one, other in ((first, second), (second, first)):
            one.on_heartbeat(beat(other.name, term=other.term, leading=other.leading), now_s)
            one.update(now_s)
        now_s += 0.1
    assert (first.leading, second.leading) == (True, False)
    assert (first.term, second.term) == (10, 10)


def test_a_leader_waits_for_a_newcomer_for_a_limited_time() -> None:
    """There is always a leader while a higher-ranked candidate is too young to lead."""
    election = candidate()
    election.update(ELECTION_S)
    patience_s = 1.0 + NEWCOMER_FACTOR * ELECTION_S
    for index in range(5):
        election.on_heartbeat(beat("a"), 1.0 + 0.1 * index)
        assert not election.update(1.0 + 0.1 * index)
    assert election.next_change_s(1.4) == pytest.approx(patience_s)
    election.on_heartbeat(beat("a"), patience_s - 0.01)
    assert not election.update(patience_s - 0.01)
    assert election.update(patience_s)
    assert not election.leading


def test_a_newcomer_that_falls_silent_is_new_again() -> None:
    election = candidate()
    election.on_heartbeat(beat("a"), 0.0)
    assert election.update(ELECTION_S)
    later_s = 5.0
    election.on_heartbeat(beat("a"), later_s)
    assert not election.update(later_s)
