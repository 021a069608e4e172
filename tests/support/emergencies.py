"""Random emergencies: the vehicle ahead brakes to a stop, and at that moment all messages stop.

It brakes as hard as a vehicle can. From then on the other vehicles have no commands: their motion
controllers have the rest of the last trajectory, their hold law, and their sensors. Bodies
must not touch.

The kinds are `holding`, one cell behind in the same lane; `closing`, a move from two cells behind
to one; and `lane-entry`, a move into the lane from the side, to one cell behind, in mode 2 also
diagonally from two cells. Sometimes a third vehicle holds one cell behind the second one.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite
from random import Random
from typing import Any

import numpy as np
from attrs import frozen

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name
from support.driving import LimitUse, Road, limit_figures, limit_use, road_scenario

KINDS = ("holding", "closing", "lane-entry")
STANDING_MPS = 0.1
"""A vehicle this slow stands still."""
MOVE_TICK = 15
"""When the second vehicle begins to move."""

_COLUMN = 10
"""Of the one ahead."""
_EARLY_TICKS, _LATE_TICKS = 8, 12
"""Braking begins this much before a move begins, at the earliest, or after it ended."""
_STOPPED_TICKS = 10
"""When all have stood still for so long, nothing more will happen."""
_AFTER_TICKS = 200
"""So much is driven after braking began, at most."""
_THIRD_SHARE = 1.0 / 3.0


@frozen
class Situation:
    """An emergency before it is played; vehicles in the order from the front."""

    scenario: Scenario
    kind: str
    diagonal: bool
    cells: dict[Name, Cell]
    target: Cell
    """Where the second vehicle moves, or holds."""
    braking_tick: int

    @property
    def ahead(self) -> Name:
        """The vehicle that brakes."""
        return next(iter(self.cells))

    @property
    def follower(self) -> Name:
        """The second vehicle."""
        return list(self.cells)[1]

    def begins(self, tick: int) -> dict[Name, PlannedMove]:
        """Return the moves that begin with a tick."""
        origin = self.cells[self.follower]
        if tick != MOVE_TICK or origin == self.target:
            return {}
        return {self.follower: (0, origin, self.target)}


@frozen
class EmergencyResult:
    """Result of a situation."""

    index: int
    kind: str
    diagonal: bool
    phase_ticks: int
    """Begin of braking relative to `MOVE_TICK`."""
    impact: tuple[str, str] | None
    """Lesser and greater name of the first two bodies that overlapped, if any."""
    impact_mps: float
    """How fast these two were, one relative to the other; 0: no impact."""
    least_gap_m: float
    """Since braking began; infinite: no vehicle was behind another."""
    standing: bool
    """All stood still in the end."""
    braked: int
    """Vehicle ticks of emergency braking by motion controllers."""
    limits: dict[str, LimitUse]
    """Of all but the one ahead."""


def random_situation(seed: int, index: int) -> Situation:
    """Return a situation; numbers run through the kinds.

    Args:
        seed: of the programme, and of the noise of measurement.
        index: number of the situation.
    """
    rng = Random(f"{seed}:{index}")
    kind = KINDS[index % len(KINDS)]
    scenario = road_scenario(seed, mode=rng.choice((1, 2)))
    lane = rng.randrange(scenario.road.lanes)
    side = rng.choice([beside for beside in (lane - 1, lane + 1) if 0 <= beside <= 2])
    diagonal = kind == "lane-entry" and scenario.formation.mode == 2 and rng.random() < 0.5
    target = _COLUMN - 1, lane
    origin = {
        "holding": target,
        "closing": (_COLUMN - 2, lane),
        "lane-entry": (_COLUMN - 2 if diagonal else _COLUMN - 1, side),
    }[kind]
    cells = [(_COLUMN, lane), origin]
    if rng.random() < _THIRD_SHARE:
        # Behind where the second one comes from or, in a lane-entry, where it goes.
        cells.append((origin[0] - 1, rng.choice((origin[1], lane))))
    move_ticks = round(scenario.timing.move_s / scenario.runtime.tick_s)
    return Situation(
        scenario=scenario,
        kind=kind,
        diagonal=diagonal,
        # Noise is drawn from seed and name.
        cells={Name(f"e{index}v{place}"): cell for place, cell in enumerate(cells)},
        target=target,
        braking_tick=MOVE_TICK + rng.randint(-_EARLY_TICKS, move_ticks + _LATE_TICKS),
    )


def play(situation: Situation) -> Road:
    """Play a situation until all stand still, an impact, or nothing more can happen."""
    road = Road(situation.scenario, situation.cells)
    while road.tick < situation.braking_tick:
        road.step(situation.begins(road.tick))
    road.messages = False
    standing = 0
    while (
        not road.record.overlaps
        and standing < _STOPPED_TICKS
        and road.tick < situation.braking_tick + _AFTER_TICKS
    ):
        road.step(braking=[situation.ahead])
        standing = standing + 1 if _standing(road) else 0
    return road


def _standing(road: Road) -> bool:
    return all(state[1] <= STANDING_MPS for state in road.record.states[-1])


def outcome(seed: int, index: int) -> EmergencyResult:
    """Make, play and measure a situation."""
    situation = random_situation(seed, index)
    road = play(situation)
    record, names = road.record, list(situation.cells)
    impact = record.overlaps[0][1:] if record.overlaps else None
    speeds = dict(zip(names, (state[1] for state in record.states[-1]), strict=True))
    return EmergencyResult(
        index=index,
        kind=situation.kind,
        diagonal=situation.diagonal,
        phase_ticks=situation.braking_tick - MOVE_TICK,
        impact=impact,
        impact_mps=abs(speeds[Name(impact[0])] - speeds[Name(impact[1])]) if impact else 0.0,
        least_gap_m=min(record.gaps_m[situation.braking_tick :]),
        standing=_standing(road),
        braked=road.braked,
        limits=limit_use(record, situation.scenario, range(1, len(names))),
    )


def summary(outcomes: Iterable[EmergencyResult]) -> dict[str, Any]:
    """Return the figures of some situations."""
    outcomes = list(outcomes)
    impacts = [one for one in outcomes if one.impact]
    gaps = [one.least_gap_m for one in outcomes if isfinite(one.least_gap_m)]
    closest = min(outcomes, key=lambda one: one.least_gap_m)
    return {
        "situations": len(outcomes),
        "impacts": len(impacts),
        "impacts_diagonal": sum(one.diagonal for one in impacts),
        # With the third vehicle: not with the one ahead, which is number 0.
        "impacts_behind": sum(not _with_the_first(one) for one in impacts),
        "worst_impact_mps": max((one.impact_mps for one in impacts), default=0.0),
        "impact_situations": [one.index for one in impacts[:10]],
        "least_gap_m": closest.least_gap_m if gaps else None,
        "closest_situation": closest.index,
        "gap_p1_m": float(np.percentile(gaps, 1)) if gaps else None,
        "gap_p50_m": float(np.percentile(gaps, 50)) if gaps else None,
        "never_in_line": len(outcomes) - len(gaps),
        "standing": sum(one.standing for one in outcomes),
        "braked_situations": sum(one.braked > 0 for one in outcomes),
        **limit_figures([one.limits for one in outcomes]),
    }


def _with_the_first(one: EmergencyResult) -> bool:
    return one.impact is not None and any(name.endswith("v0") for name in one.impact)


def missed_goals(figures: dict[str, Any]) -> list[str]:
    """Return which goals the figures of `summary` miss, in words."""
    return [f"{figures['impacts']} impacts"] if figures["impacts"] else []
