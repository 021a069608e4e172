"""Numbers that no correct sender has are refused; those that a correct one has are not."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.wire.bounds import (
    CLAIM_AHEAD_NS,
    DAY_NS,
    Bounds,
    check_ballot,
    max_election_term,
    max_term,
)
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Command,
    CurrentMotion,
    Heartbeat,
    Name,
    PendingTransfer,
    RoadClock,
    VehicleRecord,
)
from laneweave.protocol.wire.process_messages import Report
from support.states import A, changed, holding, sense_in
from support.tables import for_each

HUGE = 2**63 - 1
ROAD_S = 100.0
"""Latest possible road time of the receiver."""
OWN = 10**18
"""Incarnation of the receiver."""
BALLOT = Ballot(HUGE, Name("c"), 1, 1)
CLOCK = RoadClock(500, 50.0, 1, 1, 1, 0, ended=False, bridge=OWN)
CENSUS = Census(50.0, (), (), bridge=OWN)
BEAT = Heartbeat(Name("c2"), OWN, 3, leading=True, plans=1)
STATE = holding(A, t_s=50.0, incarnation=OWN)
SENSE = sense_in((0, 0), 500, incarnation=OWN, bridge=OWN)
COMMAND = Command(A, VehicleRecord(OWN), 500, (0, 0), CurrentMotion((0, 0)), b"")
REPORT = Report(
    *(Name("agent"), A, Name("1-2"), 10**6, 0),
    solves=1000,
    unusable=1,
    osqp_solves=1000,
    solve_ms=np.full(1000, 0.5, "<f4").tobytes(),
)
"""A process that has published for hours, and an agent that was there from the start."""
POSSIBLE = (CLOCK, CENSUS, BEAT, STATE, SENSE, COMMAND, REPORT)


def durations_ms(value: float, count: int = 1000) -> bytes:
    return np.full(count, value, "<f4").tobytes()


def bounds() -> Bounds:
    made = Bounds(OWN, tick_s=0.1, max_road_s=1000.0)
    made.max_incarnation(7.0)  # the node's clock at its start
    return made


@pytest.mark.parametrize("message", POSSIBLE, ids=lambda each: type(each).__name__)
def test_possible_numbers_pass(message: object) -> None:
    bounds().check(message, ROAD_S, 7.0)


@for_each(
    ("message", "changes"),
    [
        (CLOCK, {"t_s": 1e12, "tick": 10**13}),
        (CLOCK, {"t_s": 150.0, "tick": 1500}),
        (CLOCK, {"t_s": -1.0}),
        (CLOCK, {"tick": HUGE}),
        (CLOCK, {"bridge": HUGE}),
        (CENSUS, {"t_s": 1e12}),
        (CENSUS, {"bridge": HUGE}),
        (BEAT, {"term": HUGE}),
        (BEAT, {"term": 2**62}),
        (BEAT, {"term": -1}),
        (BEAT, {"incarnation": HUGE}),
        (STATE, {"promised": BALLOT}),
        (STATE, {"transfer": PendingTransfer(BALLOT)}),
        (STATE, {"t_s": 1e12}),
        (STATE, {"incarnation": 2**62}),
        (STATE, {"incarnation": -1}),
        (SENSE, {"tick": HUGE}),
        (SENSE, {"t_s": 1e12}),
        (SENSE, {"incarnation": HUGE}),
        (SENSE, {"bridge": HUGE}),
        (SENSE, {"promised": BALLOT}),
        (SENSE, {"accepted": BALLOT}),
        (COMMAND, {"incarnation": HUGE}),
        (COMMAND, {"promised": BALLOT}),
        (COMMAND, {"accepted": BALLOT}),
        (COMMAND, {"transfer": PendingTransfer(BALLOT)}),
        *(
            (REPORT, {name: number})
            for name in ("published", "rejected", "solves", "unusable", "osqp_solves")
            for number in (HUGE, 10**11, -1)
        ),
        (REPORT, {"solves": 2003}),
        (REPORT, {"unusable": 1001}),
        (REPORT, {"osqp_solves": 1001}),
        (REPORT, {"solves": 999, "osqp_solves": 0}),
        *(
            (REPORT, {"solve_ms": packed})
            for packed in (
                *map(durations_ms, (-1.0, math.nan, math.inf, 1e30)),
                durations_ms(0.5, 1001),
                durations_ms(0.5)[:-1],
                durations_ms(0.5, 999) + durations_ms(-0.1, 1),
            )
        ),
    ],
)
def test_impossible_numbers_are_refused(message: Any, changes: dict[str, Any]) -> None:  # noqa: ANN401
    with pytest.raises(BadInputError):
        bounds().check(changed(message, **changes), ROAD_S, 7.0)


def test_before_a_road_time_is_known_the_end_of_every_run_is_the_limit() -> None:
    late = replace(CLOCK, t_s=999.0, tick=9990)
    bounds().check(late, float("inf"), 7.0)
    with pytest.raises(BadInputError):
        bounds().check(replace(late, t_s=1001.0, tick=10010), float("inf"), 7.0)


def test_incarnations_may_be_two_days_ahead_and_the_limit_moves_with_the_clock() -> None:
    made, limit = bounds(), OWN + 2 * DAY_NS
    made.check_incarnation(limit, 7.0)
    with pytest.raises(BadInputError):
        made.check_incarnation(limit + 10**9, 7.0)
    made.check_incarnation(limit + 10**9, 8.0)


def test_a_claim_may_be_a_day_ahead_or_just_above_the_process_in_charge() -> None:
    made, limit = bounds(), OWN + CLAIM_AHEAD_NS
    made.check_claim(limit, 0, 7.0)
    with pytest.raises(BadInputError):
        made.check_claim(limit + 1, 0, 7.0)
    made.check_claim(limit + 1, limit, 7.0)  # such as the agent after a caretaker
    with pytest.raises(BadInputError):
        made.check_claim(HUGE, HUGE - 1, 7.0)


def test_counters_as_of_simulations_are_far_below_the_limits() -> None:
    made = Bounds(0, tick_s=0.1, max_road_s=1000.0)
    made.check(replace(BEAT, incarnation=10**6), 0.0, 0.0)
    made.check_claim(10**6, 0, 0.0)


def test_the_limit_of_messages_moves_with_the_clock() -> None:
    made, limit = bounds(), 100_000 * 86_400
    for name in ("published", "rejected"):
        made.check(replace(REPORT, **{name: limit}), ROAD_S, 7.0)
        above = replace(REPORT, **{name: limit + 100_000})
        with pytest.raises(BadInputError, match=name):
            made.check(above, ROAD_S, 7.0)
        made.check(above, ROAD_S, 8.0)


def test_the_limit_of_solves_moves_with_the_road() -> None:
    made, report = bounds(), replace(REPORT, solves=2 * 1101)
    with pytest.raises(BadInputError, match="solves"):
        made.check(report, ROAD_S, 7.0)
    made.check(report, ROAD_S + 10.0, 7.0)


def test_a_leader_can_soon_go_above_every_promise() -> None:
    """Whatever a forger made a vehicle promise: the limit is the same for all, and it grows."""
    for road_s in (0.0, 10.0, 99_999.0):
        highest = Ballot(max_term(road_s), Name("zz"), HUGE, HUGE)
        check_ballot(highest, road_s)
        above = highest._replace(term=highest.term + 1)
        with pytest.raises(BadInputError):
            check_ballot(above, road_s)
        check_ballot(above, road_s + 0.1)
    assert max_term(1e6) < 2**53


def test_what_a_coordinator_adopts_is_acceptable_to_all_vehicles() -> None:
    """Vehicles accept the term of an election, also if their road time is 60 s behind."""
    check_ballot(Ballot(max_election_term(100.0) + 1000, Name("c"), 1, 1), 40.0)
