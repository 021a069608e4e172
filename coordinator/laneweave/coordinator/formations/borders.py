"""Borders of blocks: moves of neighbouring formations leave each other room to brake, too.

Plans stay in the blocks of their formations, so their moves never meet. But one may close up
head-on with another one across the border (conflict kind `closing`), and then the emergency brake
acts. Formations are planned one after the other: the later plan pauses for a slot where it would.
"""

from __future__ import annotations

from collections.abc import Iterable

from attrs import evolve

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Move
from laneweave.protocol.vehicle.execution_rules import TIME_TOLERANCE_S
from laneweave.protocol.wire.messages import Plan

_MODEL = ConflictModel(("closing",))


def steps_of(plan: Plan) -> int:
    """Return how many slots a plan takes."""
    return max((1 + step for moves in plan.moves.values() for step, _, _ in moves), default=0)


def kept_apart(plan: Plan, others: Iterable[Plan], slack_s: float, most_steps: int) -> Plan:
    """Return a plan with pauses, so that none of its moves closes up with one of other plans.

    Everybody pauses, so the order of moves stays as it was planned.

    Args:
        plan: the new one.
        others: of neighbouring formations; they stay as they are.
        slack_s: how much shorter a move is than the slot of its plan [s].
        most_steps: how many slots there are. What still closes up when they are used up is left to
            the brake: better late than on a wrong lane.
    """
    theirs = [
        (other.t0_s + step * other.slot_s, other.slot_s - slack_s, (origin, target))
        for other in others
        for moves in other.moves.values()
        for step, origin, target in moves
    ]

    def closes_up(step: int, move: Move) -> bool:
        begin_s = plan.t0_s + step * plan.slot_s
        return any(
            begin_s < other_s + other_lasts_s - TIME_TOLERANCE_S
            and other_s < begin_s + plan.slot_s - slack_s - TIME_TOLERANCE_S
            and _MODEL.kind(move, other) is not None
            for other_s, other_lasts_s, other in theirs
        )

    while steps_of(plan) < most_steps:
        closing = [
            step
            for moves in plan.moves.values()
            for step, origin, target in moves
            if closes_up(step, (origin, target))
        ]
        if not closing:
            break
        plan = _paused(plan, min(closing))
    return plan


def _paused(plan: Plan, pause: int) -> Plan:
    """Return a plan whose moves of a step, and all after them, begin a slot later."""
    return evolve(
        plan,
        moves={
            vehicle: tuple(
                (step + (step >= pause), origin, target) for step, origin, target in moves
            )
            for vehicle, moves in plan.moves.items()
        },
    )
