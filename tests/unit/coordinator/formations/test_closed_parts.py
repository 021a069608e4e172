"""When the leader plans again for a formation, since parts of lanes are closed or open again."""

from __future__ import annotations

import random
from itertools import count

import pytest

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.formations.operation import HEED_S, FormationsOperation
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.road_layout import ClearedPart, TemporaryClosure, TemporaryParts
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Ballot, Census, CensusEntry, ClosedFormation, Name

SCENARIO = Scenario()
"""S3 begins at 400 of 1000 m."""
LATTICE = SCENARIO.lattice
NOW_S = 1000.0
"""Time on the clock of the node."""
BLOCKS = (0, 1, 2)


def part(from_m: float, to_m: float, lane: int = 1) -> TemporaryParts:
    return TemporaryParts((TemporaryClosure(lane, from_m, to_m),))


def time_at(rear_m: float) -> float:
    """Return the road time at which the rear of the formation is at a position."""
    return LATTICE.passing_time_s(LATTICE.block_range(BLOCKS[-1])[0], rear_m)


def fast(behind_m: float, speed_mps: float = 25.0) -> TemporaryParts:
    """Return what is cleared for a vehicle at a distance from a formation at 100 m."""
    to_m = 100.0 - behind_m
    part = ClearedPart(1, to_m - 140.0, to_m, speed_mps, time_at(100.0))
    return TemporaryParts((), (part,))


class Leading:
    """An operation that leads one formation, whose plan is in force."""

    def __init__(self, rear_m: float, known: TemporaryParts) -> None:
        """Begin with a formation of two vehicles that ends at a position."""
        column = LATTICE.block_range(BLOCKS[-1])[0]
        self.t_s = time_at(rear_m)
        numbers = count(1)
        self.operation = FormationsOperation(
            SCENARIO,
            lambda _: Ballot(1, Name("c1"), 1, next(numbers)),
            lambda: next(numbers),
            lambda _: True,
            random.Random(1),
            plan,
            LEADER_RULES,
        )
        entries = (
            CensusEntry(Name("a"), (column + 2, 0), 0, 0.0),
            CensusEntry(Name("b"), (column, 2), 2, 0.0),
        )
        closed = ClosedFormation(BLOCKS[0], BLOCKS[-1], 0.0)
        self.census = Census(self.t_s, entries, (), (closed,), BLOCKS[-1])
        self.phase_with(known, -HEED_S)
        (self.leader,) = self.operation.leaders.values()
        self.leader.phase = BallotPhase.IN_FORCE

    def phase_with(self, known: TemporaryParts, after_s: float = 0.0) -> BallotPhase:
        """Return the phase of the leader after it has learned which parts are closed."""
        self.operation.on_obstacles(known)
        return self.phase(after_s)

    def phase(self, after_s: float) -> BallotPhase:
        """Return the phase of the leader at a time after the formation was at its position."""
        changed = not self.operation.leaders
        t_s, now_s = self.t_s + after_s, NOW_S + after_s
        list(self.operation.lead(self.census, t_s, now_s, changed=changed))
        (leader,) = self.operation.leaders.values()
        return leader.phase


NOTHING = TemporaryParts()
PLANS_AGAIN, KEEPS_ITS_PLAN = BallotPhase.PREPARING, BallotPhase.IN_FORCE


@pytest.mark.parametrize(
    ("rear_m", "before", "after", "phase"),
    [
        (100.0, NOTHING, part(600.0, 620.0), PLANS_AGAIN),
        (100.0, part(600.0, 620.0), NOTHING, PLANS_AGAIN),
        # About to be closed.
        (100.0, NOTHING, TemporaryParts((), (ClearedPart(1, 600.0, 620.0),)), PLANS_AGAIN),
        # A fast vehicle will overtake it, has overtaken it, or is too slow for this.
        (100.0, NOTHING, fast(50.0), PLANS_AGAIN),
        (100.0, fast(50.0), NOTHING, PLANS_AGAIN),
        (100.0, NOTHING, fast(-300.0), KEEPS_ITS_PLAN),
        (100.0, NOTHING, fast(50.0, 15.5), KEEPS_ITS_PLAN),
        (100.0, NOTHING, fast(50.0, 10.0), KEEPS_ITS_PLAN),
        # It has passed the part, in S3 and before.
        (615.0, NOTHING, part(500.0, 520.0), KEEPS_ITS_PLAN),
        (615.0, part(500.0, 520.0), NOTHING, KEEPS_ITS_PLAN),
        (615.0, part(500.0, 502.0), part(500.0, 544.0), KEEPS_ITS_PLAN),
        (615.0, NOTHING, part(300.0, 320.0), KEEPS_ITS_PLAN),
        # Another part, far ahead of the first one.
        (
            105.0,
            part(300.0, 320.0),
            TemporaryParts((*part(300.0, 320.0).closed, *part(850.0, 860.0, 0).closed)),
            KEEPS_ITS_PLAN,
        ),
        # The queue at the next part begins earlier.
        (100.0, part(600.0, 620.0), part(550.0, 620.0), PLANS_AGAIN),
        # Too late for another plan.
        (945.0, NOTHING, part(970.0, 980.0), KEEPS_ITS_PLAN),
    ],
)
def test_a_formation_plans_again_only_if_it_needs_another_plan(
    rear_m: float, before: TemporaryParts, after: TemporaryParts, phase: BallotPhase
) -> None:
    assert Leading(rear_m, before).phase_with(after) is phase


def test_parts_that_change_again_soon_are_heeded_later() -> None:
    leading = Leading(100.0, part(600.0, 620.0))
    assert leading.phase_with(part(550.0, 620.0)) is PLANS_AGAIN
    leading.leader.phase = BallotPhase.IN_FORCE
    assert leading.phase_with(part(500.0, 620.0), 0.5 * HEED_S) is KEEPS_ITS_PLAN
    assert leading.phase_with(NOTHING, 0.9 * HEED_S) is KEEPS_ITS_PLAN
    assert leading.phase(HEED_S) is PLANS_AGAIN


def test_a_formation_without_a_plan_in_force_learns_that_it_is_too_late() -> None:
    leading = Leading(945.0, NOTHING)
    leading.leader.phase = BallotPhase.PREPARING
    before = leading.leader.formation.stage
    leading.phase_with(part(970.0, 980.0))
    assert leading.leader.formation.stage != before
