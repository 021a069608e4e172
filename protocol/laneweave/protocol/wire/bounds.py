"""Bounds of received numbers: terms, incarnations, road times, ticks, and counters of others.

Malformed messages are refused by the codec. A well-formed message may still contain a number that
no correct sender has, such as a term of 2^63 - 1, above which no leader can go. Each role refuses
such a message before it uses any of the fields. Values within the bounds that their sender does not
repeat are forgotten (`newest`). Safety depends on neither: a refused message is a lost one
(decision 32).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

from attrs import define

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Command,
    Heartbeat,
    RoadClock,
    Sense,
    VehicleRecord,
    VehicleState,
)
from laneweave.protocol.wire.newest import AHEAD_S
from laneweave.protocol.wire.obstacle_messages import Obstacles
from laneweave.protocol.wire.process_messages import Report

MAX_TERM_AT_START = 200_000
"""Maximum term of a ballot at road time 0."""
TERMS_PER_S = 1_000
"""Growth of the maximum term per second of road time.

The maximum is a function of time only, so that all vehicles accept the same ballots, whatever each
has received before. It grows, so that a leader can soon go above any promise."""
ELECTION_MARGIN = 100_000
"""Difference between the maximum terms of ballots and of elections. A leader uses a term above that
of its election only if a vehicle has promised a ballot of a higher term."""
DAY_NS = 86_400 * 10**9
CLAIM_AHEAD_NS = DAY_NS
"""Maximum lead of the incarnation in a COMMAND over the bridge's clock."""
MAX_COLUMN = 2**31 - 1
"""Maximum column: columns are recorded as 32-bit integers. Block numbers are no larger."""
AHEAD_NS = 2 * DAY_NS
"""Maximum lead of all other incarnations; more than `CLAIM_AHEAD_NS`, because every process must
accept what the bridge has accepted."""
SUCCESSION_NS = 10**9
"""Maximum lead of a claim over the process in charge, if the latter is itself near the limit."""
MAX_MOTION_TICKS = 6000
"""Maximum duration of a motion; the longest are those of vehicles that settle in their cells."""
MAX_MESSAGES_PER_S = 100_000
"""Maximum mean rate of the messages that a process publishes or receives: a process needs about
10 us to encode or decode one."""
MAX_AGE_S = 86_400.0
"""Time for which a process may have had that rate before the receiver started. At the 50 messages
per second of a coordinator, this is more than five years."""
MAX_SOLVES_PER_TICK = 2
"""An agent solves once in each tick, and again if it has been misled about the time."""
MAX_SOLVE_MS = 60_000.0
"""Maximum CPU time of one solve, whose iterations are limited; usually it is a few milliseconds."""
_DURATION = struct.Struct("<f")


def max_term(road_s: float) -> int:
    """Return the maximum term of a ballot at a road time."""
    return MAX_TERM_AT_START + int(TERMS_PER_S * road_s)


def max_election_term(road_s: float) -> int:
    """Return the maximum term that a coordinator adopts from another one at a road time."""
    return max_term(road_s) - ELECTION_MARGIN


@define
class Bounds:
    """Limits of one receiver; `check` refuses messages outside them.

    Incarnations are bounded by the receiver's own: its start time plus the time since then, so no
    wall clock is needed. Counters, which simulations use, are far below this limit.
    """

    incarnation: int
    """Incarnation of the receiver [ns]."""
    tick_s: float
    max_road_s: float
    """Road time at which every run ends [s]."""
    _since_s: float | None = None
    """Node clock at the first check."""

    def max_incarnation(self, now_s: float, ahead_ns: int = AHEAD_NS) -> int:
        """Return the maximum incarnation at a time on the node's clock."""
        return self.incarnation + ahead_ns + int(self._age_s(now_s) * 1e9)

    def _age_s(self, now_s: float) -> float:
        """Return the time since the first check."""
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s

    def check_incarnation(self, incarnation: int, now_s: float) -> None:
        """Check the incarnation of a process.

        Raises:
            BadInputError: it is out of bounds.
        """
        if self._since_s is not None and 0 <= incarnation <= self.incarnation:
            return  # nearly always; the limit only grows
        limit = self.max_incarnation(now_s)
        if not 0 <= incarnation <= limit:
            raise BadInputError("incarnation", incarnation, f"0 to {limit}")

    def check(self, message: object, road_s: float, now_s: float) -> None:
        """Check a message.

        Args:
            message: received message of any kind.
            road_s: latest possible road time at the receiver [s].
            now_s: the node's clock.

        Raises:
            BadInputError: a number is out of bounds.
        """
        road_s = min(road_s, self.max_road_s)
        match message:
            case VehicleState():
                self._check_time(message.t_s, road_s)
                self._check_record(message.record, road_s, now_s)
            case Sense():
                self._check_tick(message.tick, message.t_s, road_s)
                limit = message.tick + MAX_MOTION_TICKS
                if message.motion.end_tick > limit:
                    raise BadInputError("end_tick", message.motion.end_tick, f"at most {limit}")
                self.check_incarnation(message.bridge, now_s)
                self._check_record(message.record, road_s, now_s)
            case Command():
                self._check_record(message.record, road_s, now_s)
            case RoadClock():
                self._check_tick(message.tick, message.t_s, road_s)
                self.check_incarnation(message.bridge, now_s)
            case Census():
                self._check_time(message.t_s, road_s)
                self.check_incarnation(message.bridge, now_s)
            case Heartbeat():
                self.check_incarnation(message.incarnation, now_s)
                _check_term(message.term, road_s)
            case Report():
                self._check_report(message, road_s, now_s)
            case Obstacles():
                self._check_obstacles(message, road_s, now_s)
            case _:
                pass

    def check_claim(self, incarnation: int, in_charge: int, now_s: float) -> None:
        """Check the incarnation in a COMMAND for a vehicle with a process in charge.

        Raises:
            BadInputError: the incarnation is out of bounds.
        """
        limit = max(
            self.max_incarnation(now_s, CLAIM_AHEAD_NS),
            min(in_charge + SUCCESSION_NS, self.max_incarnation(now_s)),
        )
        if not 0 <= incarnation <= limit:
            raise BadInputError("incarnation", incarnation, f"0 to {limit}")

    def _check_record(self, record: VehicleRecord, road_s: float, now_s: float) -> None:
        self.check_incarnation(record.incarnation, now_s)
        transfer = None if record.transfer is None else record.transfer.ballot
        for ballot in (record.promised, record.accepted, transfer):
            if ballot is not None:
                check_ballot(ballot, road_s)

    def _check_report(self, report: Report, road_s: float, now_s: float) -> None:
        messages = int(MAX_MESSAGES_PER_S * (MAX_AGE_S + self._age_s(now_s)))
        solves = MAX_SOLVES_PER_TICK * (int(road_s / self.tick_s) + 1)
        _check_count("published", report.published, messages)
        _check_count("rejected", report.rejected, messages)
        _check_count("solves", report.solves, solves)
        _check_count("unusable", report.unusable, report.solves)
        _check_count("osqp_solves", report.osqp_solves, report.solves)
        for link in ("sidelink", "cellular"):
            sent = getattr(report, link)
            _check_count(link, sent, messages)
            _check_count(f"{link}_lost", getattr(report, f"{link}_lost"), sent)
        size = len(report.solve_ms)
        if size % _DURATION.size or size > _DURATION.size * report.solves:
            allowed = f"at most {report.solves} durations of {_DURATION.size} bytes"
            raise BadInputError("solve_ms", f"{size} bytes", allowed)
        for (duration_ms,) in _DURATION.iter_unpack(report.solve_ms):
            if not 0.0 <= duration_ms <= MAX_SOLVE_MS:
                raise BadInputError("solve_ms", duration_ms, f"0 to {MAX_SOLVE_MS:g}")

    def _check_obstacles(self, message: Obstacles, road_s: float, now_s: float) -> None:
        self._check_time(message.t_s, road_s)
        self.check_incarnation(message.bridge, now_s)
        # Parts that are not on the road have no effect.
        for part in message.parts:
            if part.late_m < 0.0:
                raise BadInputError("late_m", part.late_m, "at least 0")

    def _check_time(self, t_s: float, road_s: float) -> None:
        limit_s = road_s + self.tick_s
        if not 0.0 <= t_s <= limit_s:
            raise BadInputError("t_s", t_s, f"0 to {limit_s:g}")

    def _check_tick(self, tick: int, t_s: float, road_s: float) -> None:
        self._check_time(t_s, road_s)
        tick_s = tick * self.tick_s
        if not 0 <= tick_s <= road_s + self.tick_s or abs(tick_s - t_s) > AHEAD_S:
            raise BadInputError("tick", tick, f"about {t_s / self.tick_s:.0f}, by t_s")


def check_ballot(ballot: Ballot, road_s: float) -> None:
    """Check the term of a ballot.

    Raises:
        BadInputError: it is out of bounds.
    """
    if not 0 <= ballot.term <= MAX_TERM_AT_START:
        _check_term(ballot.term, road_s)


def _check_term(term: int, road_s: float) -> None:
    if not 0 <= term <= max_term(road_s):
        raise BadInputError("term", term, f"0 to {max_term(road_s)}")


def _check_count(name: str, count: int, limit: int) -> None:
    if not 0 <= count <= limit:
        raise BadInputError(name, count, f"0 to {limit}")


def blocks_in_range(blocks: Iterable[int]) -> bool:
    """Return whether block numbers can be recorded."""
    return max(map(abs, blocks), default=0) <= MAX_COLUMN
