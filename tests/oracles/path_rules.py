"""The rules of collision-free relative paths, stated once more and independently of the planner.

Nothing here is fast. A move is a pair (from, to) of cells made in one step; each kind of conflict
is a predicate over two moves made by two different vehicles in the same step.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, pairwise
from typing import Any

from oracles.moving_bodies import Bodies, too_close

Cell = tuple[int, int]
Move = tuple[Cell, Cell]
Path = list[Cell]

DEFAULT_CONFLICTS = {1: ("node", "edge", "special-1"), 2: ("geometric",)}


# ---------------------------------------------------------------------------------- one move


def moves_away(move: Move) -> bool:
    return move[0] != move[1]


def is_oblique(move: Move) -> bool:
    (c0, l0), (c1, l1) = move
    return c0 != c1 and l0 != l1


def is_longitudinal(move: Move) -> bool:
    (c0, l0), (c1, l1) = move
    return c0 != c1 and l0 == l1


def is_lateral(move: Move) -> bool:
    (c0, l0), (c1, l1) = move
    return c0 == c1 and l0 != l1


def is_allowed(move: Move, mode: int) -> bool:
    (c0, l0), (c1, l1) = move
    columns, lanes = abs(c1 - c0), abs(l1 - l0)
    return columns + lanes <= 1 if mode == 1 else max(columns, lanes) <= 1


def corners(move: Move) -> frozenset[Cell]:
    """The two cells beside an oblique move; none for any other move."""
    (c0, l0), (c1, l1) = move
    return frozenset({(c0, l1), (c1, l0)}) if is_oblique(move) else frozenset()


def footprint(move: Move) -> frozenset[Cell]:
    return frozenset(move) | corners(move)


# ---------------------------------------------------------------------------------- two moves


def _node(a: Move, b: Move) -> bool:
    return a[1] == b[1]


def _edge(a: Move, b: Move) -> bool:
    """Both move and their paths cross or overlap, which unit moves do iff the midpoints agree."""
    return (
        moves_away(a)
        and moves_away(b)
        and a[0][0] + a[1][0] == b[0][0] + b[1][0]
        and a[0][1] + a[1][1] == b[0][1] + b[1][1]
    )


def _special_1(a: Move, b: Move) -> bool:
    return moves_away(a) and moves_away(b) and a[1] == b[0]


def _triangle(a: Move, b: Move) -> bool:
    """Oblique `a` and one cell of `b` have their right angle at that cell, one step long each way.

    The two sides of the angle lie along the road and across it.
    """
    return is_oblique(a) and any(
        _is_one_step(cell, a[0]) and _is_one_step(cell, a[1]) for cell in b
    )


def _is_one_step(cell: Cell, other: Cell) -> bool:
    return abs(cell[0] - other[0]) + abs(cell[1] - other[1]) == 1


def _special_2(a: Move, b: Move) -> bool:
    return _triangle(a, b) and is_longitudinal(b)


def _special_3(a: Move, b: Move) -> bool:
    return _triangle(a, b) and is_lateral(b)


def _special_4(a: Move, b: Move) -> bool:
    return not moves_away(b) and b[0] in corners(a)


def _geometric(a: Move, b: Move) -> bool:
    return bool(footprint(a) & footprint(b))


def _closing(a: Move, b: Move) -> bool:
    """`a` comes from behind, `b` from ahead: the two columns between them become none.

    It matters only if one of them is, before or after the step, on a lane of the other.
    """
    (behind, lane_a), (behind_then, lane_a_then) = a
    (ahead, lane_b), (ahead_then, lane_b_then) = b
    free, free_then = ahead - behind - 1, ahead_then - behind_then - 1
    same_lane = any(
        mine == other for mine in (lane_a, lane_a_then) for other in (lane_b, lane_b_then)
    )
    both_move = behind != behind_then and ahead != ahead_then
    return both_move and (free, free_then) == (2, 0) and same_lane


_ORDERED: dict[str, Callable[[Move, Move], bool]] = {
    "node": _node,
    "edge": _edge,
    "special-1": _special_1,
    "special-2": _special_2,
    "special-3": _special_3,
    "special-4": _special_4,
    "geometric": _geometric,
    "closing": _closing,
}
KINDS = tuple(_ORDERED)


def conflict_kinds(
    a: Move, b: Move, kinds: Iterable[str] = KINDS, bodies: Bodies | None = None
) -> list[str]:
    """Which of `kinds` two vehicles commit that make the moves `a` and `b` in the same step.

    With `bodies`, `geometric` is what these do when they move, instead of a matter of footprints.
    """
    return [
        kind
        for kind in kinds
        if (
            _bodies_meet(bodies, a, b)
            if kind == "geometric" and bodies is not None
            else _ORDERED[kind](a, b) or _ORDERED[kind](b, a)
        )
    ]


def _bodies_meet(bodies: Bodies, a: Move, b: Move) -> bool:
    def difference(to: Cell, cell: Cell) -> Cell:
        return to[0] - cell[0], to[1] - cell[1]

    return too_close(bodies, difference(b[0], a[0]), difference(a[1], a[0]), difference(b[1], b[0]))


# ---------------------------------------------------------------------------------- a request


@dataclass(frozen=True)
class Problem:
    columns: int
    lanes: int
    blocked: frozenset[Cell]
    mode: int
    conflicts: tuple[str, ...]
    starts: tuple[Cell, ...]
    targets: tuple[Cell, ...]
    eligible: tuple[frozenset[int], ...]
    """For each vehicle the indices of the targets it may take."""
    bodies: Bodies | None = None
    drivable: tuple[frozenset[Cell] | None, ...] = ()
    """For each vehicle the displacements that it can drive; None: all of the mode."""
    max_steps: int | None = None
    """Maximum number of steps; None: any number."""

    @classmethod
    def of(cls, request: dict[str, Any]) -> "Problem":
        grid = request["grid"]
        mode = int(request.get("mode", 1))
        targets = tuple(_cell(target) for target in request["targets"])
        eligible = []
        for vehicle in request["vehicles"]:
            if "lane" in vehicle:
                chosen = [j for j, target in enumerate(targets) if target[1] == vehicle["lane"]]
            else:
                chosen = vehicle.get("eligible", range(len(targets)))
            eligible.append(frozenset(chosen))
        return cls(
            columns=grid["columns"],
            lanes=grid["lanes"],
            blocked=frozenset(_cell(cell) for cell in grid.get("blocked", [])),
            mode=mode,
            conflicts=tuple(request.get("conflicts", DEFAULT_CONFLICTS[mode])),
            starts=tuple(_cell(vehicle["cell"]) for vehicle in request["vehicles"]),
            targets=targets,
            eligible=tuple(eligible),
            bodies=Bodies(**request["geometry"]) if "geometry" in request else None,
            drivable=tuple(
                frozenset(map(_cell, vehicle["moves"])) if "moves" in vehicle else None
                for vehicle in request["vehicles"]
            ),
            max_steps=request.get("max_steps"),
        )

    def is_free(self, cell: Cell) -> bool:
        inside = 0 <= cell[0] < self.columns and 0 <= cell[1] < self.lanes
        return inside and cell not in self.blocked

    def free_cells(self) -> list[Cell]:
        grid = [(c, lane) for c in range(self.columns) for lane in range(self.lanes)]
        return [cell for cell in grid if self.is_free(cell)]

    def moves_from(self, cell: Cell) -> list[Move]:
        around = [(cell[0] + dc, cell[1] + dl) for dc in (-1, 0, 1) for dl in (-1, 0, 1)]
        candidates = [(cell, other) for other in around if self.is_free(other)]
        return [move for move in candidates if is_allowed(move, self.mode)]

    def can_drive(self, vehicle: int, move: Move) -> bool:
        drivable = self.drivable[vehicle]
        (c0, l0), (c1, l1) = move
        return drivable is None or not moves_away(move) or (c1 - c0, l1 - l0) in drivable

    def distances_from(self, cell: Cell) -> dict[Cell, int]:
        """Steps to every cell that a vehicle alone on the grid can reach."""
        distance = {cell: 0}
        queue = [cell]
        for here in queue:
            for _, there in self.moves_from(here):
                if there not in distance:
                    distance[there] = distance[here] + 1
                    queue.append(there)
        return distance

    def conflict(self, a: Move, b: Move) -> bool:
        return _exclude(a, b, self.conflicts, self.bodies)


@lru_cache(maxsize=200_000)
def _exclude(a: Move, b: Move, kinds: tuple[str, ...], bodies: Bodies | None) -> bool:
    return bool(conflict_kinds(a, b, kinds, bodies))


def _cell(pair: Iterable[int]) -> Cell:
    column, lane = pair
    return (int(column), int(lane))


# ---------------------------------------------------------------------------------- a response


def final_arrival(path: Path) -> int:
    """The first step from which on the vehicle stays where its path ends."""
    arrival = len(path) - 1
    while arrival > 0 and path[arrival - 1] == path[-1]:
        arrival -= 1
    return arrival


def check_paths(request: dict[str, Any], response: dict[str, Any]) -> list[str]:
    """Everything that is wrong with the paths, assignment and cost of `response`."""
    problem = Problem.of(request)
    paths = [[_cell(cell) for cell in path] for path in response["paths"]]
    assignment = list(response["assignment"])
    count = len(problem.starts)
    if len(paths) != count or len(assignment) != count:
        return [f"{count} vehicles, {len(paths)} paths, {len(assignment)} assigned targets"]
    if any(len(path) != response["steps"] + 1 for path in paths):
        return [f"steps {response['steps']}, lengths of paths {[len(path) for path in paths]}"]
    if problem.max_steps is not None and response["steps"] > problem.max_steps:
        return [f"{response['steps']} steps, permitted are {problem.max_steps}"]
    return [
        *_wrong_assignment(problem, assignment, paths),
        *_wrong_moves(problem, paths),
        *_conflicts(problem, paths),
        *_wrong_cost(response, paths),
    ]


def _wrong_assignment(problem: Problem, assignment: list[int], paths: list[Path]) -> list[str]:
    found = []
    if len(set(assignment)) != len(assignment):
        found.append(f"targets assigned twice: {assignment}")
    if len({path[-1] for path in paths}) != len(paths):
        found.append(f"paths end in one cell: {[path[-1] for path in paths]}")
    for i, (target, path) in enumerate(zip(assignment, paths, strict=True)):
        if target not in problem.eligible[i]:
            found.append(f"vehicle {i}: target {target} is not eligible")
        elif path[-1] != problem.targets[target]:
            found.append(f"vehicle {i}: ends at {path[-1]}, not at target {target}")
    return found


def _wrong_moves(problem: Problem, paths: list[Path]) -> list[str]:
    found = []
    for i, path in enumerate(paths):
        if path[0] != problem.starts[i]:
            found.append(f"vehicle {i}: starts at {path[0]}, not at {problem.starts[i]}")
        found += [f"vehicle {i}: {cell} is not free" for cell in path if not problem.is_free(cell)]
        for step, move in enumerate(pairwise(path)):
            if not is_allowed(move, problem.mode):
                found.append(f"vehicle {i}: step {step}: {move} is not a move")
            elif not problem.can_drive(i, move):
                found.append(f"vehicle {i}: step {step}: it cannot drive {move}")
    return found


def _conflicts(problem: Problem, paths: list[Path]) -> list[str]:
    found = []
    for (i, p), (j, q) in combinations(enumerate(paths), 2):
        for step in range(len(p) - 1):
            a, b = (p[step], p[step + 1]), (q[step], q[step + 1])
            kinds = conflict_kinds(a, b, problem.conflicts, problem.bodies)
            if kinds:
                found.append(f"vehicles {i}, {j}: step {step}: {a} and {b}: {', '.join(kinds)}")
    return found


def _wrong_cost(response: dict[str, Any], paths: list[Path]) -> list[str]:
    cost = sum(final_arrival(path) for path in paths)
    found = []
    if response["cost"] != cost:
        found.append(f"claims cost {response['cost']}, the paths cost {cost}")
    if response.get("lower_bound", cost) > cost:
        found.append(f"claims lower bound {response['lower_bound']}, the paths cost {cost}")
    return found
