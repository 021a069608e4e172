"""Plans as partial orders of moves: dependencies between moves, and validity of plans.

Moves are ordered by *dependencies*, which every vehicle derives from the same PLAN message. Each
dependency is released by a fact that stays true: "A has completed k moves of this ballot".
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

from laneweave.protocol.lattice import Cell, footprint, territory
from laneweave.protocol.wire.messages import Name, Plan

Needs = dict[Name, int]
"""Number of moves that each other vehicle must have completed before a move may start."""


def dependencies(plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    """Return, for each move of a vehicle, how many moves others must complete first.

    For a move in step s and another vehicle A, this number is 1 + the index of A's last move before
    step s whose footprint intersects that of the move. Vehicles without such a move are left out.
    """

    def needs(step: int, cells: frozenset[Cell]) -> Needs:
        return {
            other: index + 1
            for other, moves in plan.moves.items()
            for index, (other_step, origin, target) in enumerate(moves)
            if other != vehicle and other_step < step and cells & footprint(origin, target)
        }

    return tuple(
        needs(step, footprint(origin, target)) for step, origin, target in plan.moves[vehicle]
    )


def followers(plan: Plan, vehicle: Name) -> tuple[int, ...]:
    """Return the steps in which moves of others begin that depend on moves of a vehicle."""
    own = [(step, footprint(origin, target)) for step, origin, target in plan.moves[vehicle]]
    steps = {
        step
        for other, moves in plan.moves.items()
        for step, origin, target in moves
        if other != vehicle
        and any(before < step and cells & footprint(origin, target) for before, cells in own)
    }
    return tuple(sorted(steps))


def plan_problems(plan: Plan) -> list[str]:
    """Return the reasons why a plan cannot be executed safely; empty if it can.

    The maps must cover the roster, and slots must have a positive length. The moves of each vehicle
    must form a chain of neighbouring cells from its start cell, with ascending steps. The cells
    that vehicles occupy during a step (footprint of a move, or hold cell) must be disjoint. The
    territory must contain all occupied cells.
    """
    problems = list(_roster_problems(plan))
    if plan.slot_s <= 0:
        problems.append(f"a slot lasts {plan.slot_s:g} s")
    if problems:
        return problems
    for vehicle in plan.roster:
        problems += _chain_problems(plan, vehicle)
    if problems:
        return problems
    problems += _step_problems(plan)
    every_move = [move for moves in plan.moves.values() for move in moves]
    missing = territory(plan.start_cells.values(), every_move) - set(plan.territory)
    if missing:
        problems.append(f"territory lacks cells {sorted(missing)}")
    return problems


def ownership_problems(plan: Plan) -> list[str]:
    """Return the reasons why the cell transfers of a plan are invalid; empty if they are valid.

    The maps must cover the roster. No cell may have two owners, before or after the plan. No
    vehicle may receive a cell that no member owned. Afterwards every vehicle must own the cells
    that it occupies.
    """
    problems = [
        f"{name} does not cover the roster"
        for name, mapping in (("before", plan.before), ("after", plan.after))
        if set(mapping) != set(plan.roster)
    ]
    if problems:
        return problems
    for name, mapping in (("before", plan.before), ("after", plan.after)):
        all_cells = [cell for cells in mapping.values() for cell in cells]
        if len(all_cells) != len(set(all_cells)):
            problems.append(f"a cell has two owners {name}")
    owned = {cell for each in plan.before.values() for cell in each}
    for vehicle, cells in plan.after.items():
        occupied = territory([plan.start_cells[vehicle]], plan.moves[vehicle])
        if not occupied <= set(cells):
            problems.append(f"{vehicle} does not own {sorted(occupied - set(cells))}")
        if not set(cells) <= owned:
            problems.append(f"no member owned {sorted(set(cells) - owned)}")
    return problems


def _roster_problems(plan: Plan) -> Iterator[str]:
    if len(set(plan.roster)) != len(plan.roster):
        yield "roster names a vehicle twice"
    for name, mapping in (
        ("incarnations", plan.incarnations),
        ("start_cells", plan.start_cells),
        ("moves", plan.moves),
    ):
        if set(mapping) != set(plan.roster):
            yield f"{name} does not cover the roster"


def _chain_problems(plan: Plan, vehicle: Name) -> Iterator[str]:
    cell = plan.start_cells[vehicle]
    last_step = -1
    for step, origin, target in plan.moves[vehicle]:
        if step <= last_step:
            yield f"{vehicle}: steps do not ascend at step {step}"
        if origin != cell:
            yield f"{vehicle}: move from {origin} in step {step}, but it is in {cell}"
        apart = max(abs(origin[0] - target[0]), abs(origin[1] - target[1]))
        if apart != 1:
            yield f"{vehicle}: {origin} and {target} are not neighbours"
        cell, last_step = target, step


def _step_problems(plan: Plan) -> Iterator[str]:
    cells = dict(plan.start_cells)
    by_step: dict[int, dict[Name, Cell]] = {}
    for vehicle, moves in plan.moves.items():
        for step, _, target in moves:
            by_step.setdefault(step, {})[vehicle] = target
    for vehicle, other in _overlapping({name: frozenset({cell}) for name, cell in cells.items()}):
        yield f"{vehicle} and {other} start in the same cell"
    for step, moving in sorted(by_step.items()):
        occupied = {
            vehicle: footprint(cell, moving.get(vehicle, cell)) for vehicle, cell in cells.items()
        }
        for vehicle, other in _overlapping(occupied):
            yield f"{vehicle} and {other} meet in step {step}"
        cells |= moving


def _overlapping(occupied: dict[Name, frozenset[Cell]]) -> Iterator[tuple[Name, Name]]:
    for (vehicle, mine), (other, theirs) in combinations(occupied.items(), 2):
        if mine & theirs:
            yield vehicle, other
