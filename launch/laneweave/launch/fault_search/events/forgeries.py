"""Messages that must do no harm: malformed bytes, absurd numbers, and plans that must be refused.

A message that is well-formed, possible and false would be a forgery that the protocol does not
tolerate, because it trusts its senders (docs/SAFETY.md).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping

from attrs import frozen
from msgspec.structs import replace

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, PlannedMove, territory
from laneweave.protocol.wire.codec import decode
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Command,
    Heartbeat,
    Name,
    Plan,
    Prepare,
    RoadClock,
    Sense,
    VehicleState,
)

ABSURD_NUMBERS = (2**63 - 1, 2**62)
ABSURD_S = 1e12
FAR_COLUMNS = 1000
"""Distance to a cell that no vehicle can own."""


@frozen
class Harm:
    """A plan that was changed on its way: who must refuse it, and what was changed."""

    refusing: frozenset[Name]
    """Vehicles that must not accept it. No vehicle may open its gate."""
    text: str


Forgery = Callable[[Plan, random.Random], tuple[Plan, Harm] | None]
"""Changes a plan such that vehicles must refuse it; None if this plan cannot be changed so."""


def malformed(payload: bytes, rng: random.Random) -> bytes:
    """Return an encoded message with changed bytes, such that it is no longer a message."""
    damaged = bytearray(payload)
    for _ in range(rng.randint(1, 4)):
        damaged[rng.randrange(len(damaged))] = rng.randrange(256)
    try:
        decode(bytes(damaged))
    except BadInputError:
        return bytes(damaged)
    return payload[:-1]


def absurd(message: object, rng: random.Random) -> object | None:
    """Return a message with a number that no correct sender has; None: it has no such number."""
    huge = rng.choice(ABSURD_NUMBERS)
    match message:
        case Heartbeat() if rng.random() < 0.5:
            return replace(message, term=huge)
        case Heartbeat():
            return replace(message, incarnation=huge)
        case RoadClock() | Sense() if rng.random() < 0.5:
            return replace(message, tick=huge, t_s=ABSURD_S)
        case Census() if rng.random() < 0.5:
            return replace(message, t_s=ABSURD_S)
        case RoadClock() | Census():
            return replace(message, bridge=huge)
        case Prepare():
            return replace(message, ballot=_above(message.ballot, huge))
        case VehicleState() if rng.random() < 0.3:
            return replace(message, t_s=ABSURD_S)
        case VehicleState(record=record) | Command(record=record) if (
            record.promised is not None and rng.random() < 0.5
        ):
            forged = replace(record, promised=_above(record.promised, huge))
            return replace(message, record=forged)
        case VehicleState() | Command() | Sense():
            return replace(message, record=replace(message.record, incarnation=huge))
        case _:
            return None


def _above(ballot: Ballot, term: int) -> Ballot:
    return ballot._replace(term=term)


def harmful(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    """Change a plan in one respect such that some or all vehicles must refuse it.

    Returns:
        The changed plan, and who must refuse it; None if the plan cannot be changed.
    """
    forgeries = list(_ROLLING if plan.before else _FORMATIONS)
    rng.shuffle(forgeries)
    for forgery in forgeries:
        changed = forgery(plan, rng)
        if changed is not None:
            return changed
    return None


def _all(plan: Plan, text: str) -> Harm:
    return Harm(frozenset(plan.roster), text)


def _moved(
    plan: Plan,
    moves: Mapping[Name, tuple[PlannedMove, ...]],
    start_cells: Mapping[Name, Cell] | None = None,
) -> Plan:
    """Return a plan with other moves and start cells, and the territory of these."""
    cells, every = dict(start_cells or plan.start_cells), dict(moves)
    occupied = territory(cells.values(), [move for each in every.values() for move in each])
    return replace(plan, start_cells=cells, moves=every, territory=tuple(sorted(occupied)))


def _with_same_start(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    if len(plan.roster) < 2:
        return None
    name, other = rng.sample(plan.roster, 2)
    cells = {**plan.start_cells, name: plan.start_cells[other]}
    changed = _moved(plan, {**plan.moves, name: ()}, cells)
    return changed, _all(plan, f"{name} and {other} start in one cell")


def _with_meeting(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    """Let two vehicles move into one cell in the same step."""
    names = list(plan.roster)
    rng.shuffle(names)
    for name in names:
        column, lane = plan.start_cells[name]
        for other in names:
            cell = plan.start_cells[other]
            if other != name and abs(cell[0] - column) + abs(cell[1] - lane) == 1:
                moves = {**plan.moves, name: ((0, (column, lane), cell),), other: ()}
                return _moved(plan, moves), _all(plan, f"{name} meets {other}")
    return None


def _with_wrong_start(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    name = rng.choice(plan.roster)
    column, lane = plan.start_cells[name]
    taken = set(plan.territory)
    free = [
        cell
        for cell in ((column + 1, lane), (column - 1, lane), (column, lane + 1), (column, lane - 1))
        if cell not in taken and cell[1] >= 0
    ]
    if not free:
        return None
    cells = {**plan.start_cells, name: rng.choice(free)}
    changed = _moved(plan, {**plan.moves, name: ()}, cells)
    return changed, Harm(frozenset({name}), f"{name} starts elsewhere")


def _for_other_process(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    name = rng.choice(plan.roster)
    numbers = plan.incarnations | {name: plan.incarnations[name] - 1}
    text = f"made for another process of {name}"
    return replace(plan, incarnations=numbers), Harm(frozenset({name}), text)


def _beyond_blocks(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    """Let the foremost vehicle drive ahead, out of all blocks."""
    name = max(plan.roster, key=lambda each: plan.start_cells[each])
    cell, moves = plan.start_cells[name], []
    for step in range(rng.randint(9, 12)):
        ahead: Cell = (cell[0] + 1, cell[1])
        moves.append((step, cell, ahead))
        cell = ahead
    others: dict[Name, tuple[PlannedMove, ...]] = dict.fromkeys(plan.roster, ())
    return _moved(plan, {**others, name: tuple(moves)}), _all(plan, f"{name} leaves the blocks")


def _without_block(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    if len(plan.blocks) < 2:
        return None
    left_out = rng.choice(plan.blocks)
    blocks = tuple(block for block in plan.blocks if block != left_out)
    return replace(plan, blocks=blocks), _all(plan, f"block {left_out} left out")


def _with_another_block(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    block = rng.choice((min(plan.blocks) - 1, max(plan.blocks) + 1))
    blocks = tuple(sorted((*plan.blocks, block)))
    return replace(plan, blocks=blocks), _all(plan, f"block {block} claimed")


def _with_foreign_cell(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    """Attribute a cell to a vehicle that does not own it."""
    name = rng.choice(plan.roster)
    column, lane = plan.start_cells[name]
    cell = (column + FAR_COLUMNS, lane)
    changed = replace(
        plan, before=_with(plan.before, name, cell), after=_with(plan.after, name, cell)
    )
    return changed, Harm(frozenset({name}), f"{name} does not own {cell}")


def _with_two_owners(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    if len(plan.roster) < 2:
        return None
    name, other = rng.sample(plan.roster, 2)
    cell = rng.choice(plan.after[other])
    changed = replace(plan, after=_with(plan.after, name, cell))
    return changed, _all(plan, f"{name} and {other} both get {cell}")


def _with_cell_of_nobody(plan: Plan, rng: random.Random) -> tuple[Plan, Harm] | None:
    name = rng.choice(plan.roster)
    cell = (plan.start_cells[name][0] + FAR_COLUMNS, 0)
    changed = replace(plan, after=_with(plan.after, name, cell))
    return changed, _all(plan, f"{name} gets {cell}, which no member owned")


def _with(
    owned: Mapping[Name, tuple[Cell, ...]], name: Name, cell: Cell
) -> dict[Name, tuple[Cell, ...]]:
    return {**owned, name: tuple(sorted((*owned[name], cell)))}


_COMMON: Iterable[Forgery] = (_with_same_start, _with_wrong_start, _for_other_process)
_FORMATIONS = (
    *_COMMON,
    _with_meeting,
    _beyond_blocks,
    _without_block,
    _with_another_block,
)
_ROLLING = (*_COMMON, _with_foreign_cell, _with_two_owners, _with_cell_of_nobody)
