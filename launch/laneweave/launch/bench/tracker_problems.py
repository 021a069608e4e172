"""Problems for `laneweave bench tracker`: ticks recorded in seeded closed loops.

Situations in which another vehicle limits the solution, and undisturbed holds and moves, all with
small errors of measurement. The exact solution of every program is recorded with it.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from attrs import evolve, frozen
from numpy.typing import NDArray
from scipy import sparse

from laneweave.agents.driving.qp import QPSettings, QuadraticProgram
from laneweave.agents.driving.reference import Reference, Window
from laneweave.agents.driving.surroundings import NOBODY, SENSED_S, Gaps
from laneweave.agents.driving.tracker import Tracker
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import State, integrate

Array = NDArray[np.float64]

FAMILIES: Final = ("gap-rows", "yielding", "undisturbed")
"""A gap row presses on the solution; the reference gave way, so that none does; neither, nowhere
near another vehicle. Other ticks are recorded too, as what comes before these."""

_NOISE = (0.05, 0.02, 0.05, 0.05, 0.02, 0.05)
"""Standard deviations of what is measured of (s, v, a, y, v_y, a_y)."""
_PUSH_TICKS = 20
_PRESSING_M = 1e-3
_REFERENCE = QPSettings(
    eps_abs=1e-7,
    max_iter=40_000,
    check_termination=25,
    rho=0.3,
    polishing=True,
    row_tolerance=1e-4,
)


@frozen(eq=False)
class Parts:
    """What the columns and rows of the tracker's programs stand for.

    Columns are 6 N states, 2 N jerks and N slacks; the first 6 N rows are the dynamics.
    """

    cost: Any
    rows: Any
    states: int
    jerks: int
    jerk_rows: NDArray[np.intp]
    """Rows that bound a jerk alone, in the order of the jerks."""

    @classmethod
    def of(cls, cost: Any, rows: Any) -> Parts:  # noqa: ANN401 - scipy.sparse has no types
        """Find them in P and A, sparse."""
        matrix = sparse.csr_matrix(rows)
        states = 6 * (matrix.shape[1] // 9)
        jerks = states // 3
        filled = [
            matrix[:, :states],
            matrix[:, states : states + jerks],
            matrix[:, states + jerks :],
        ]
        of_states, of_jerks, of_slacks = (np.diff(part.indptr) for part in filled)
        alone = (of_states == 0) & (of_jerks == 1) & (of_slacks == 0)
        return cls(cost, matrix, states, jerks, np.flatnonzero(alone))

    def first_jerk(self, problem: Problem, solution: Array) -> Array:
        """Return the first jerk (2,) from what a solution adds to the reference's jerks."""
        rows = self.jerk_rows[:2]
        # The same jerk is allowed in both directions, so the bounds tell the reference's.
        reference = -(problem.lower[rows] + problem.upper[rows]) / 2.0
        return np.asarray(reference + solution[:2])


@frozen(eq=False)
class Problem:
    """One tick: what the tracker was given, the program it made of it, and what it answered."""

    state: State
    window: Window
    gaps: Gaps
    lower: Array
    upper: Array
    jerk: Array
    """(N, 2) [m/s3]."""
    first: Array
    """First jerk (2,) of the exact solution [m/s3]."""
    pressing: bool
    """Whether a gap row changes the solution: a row whose slack is not zero."""


@frozen(eq=False)
class Recording:
    """Episodes of consecutive ticks, and what all their programs share."""

    parts: Parts
    episodes: list[list[Problem]]
    names: list[str]
    """Of the episodes' situations."""

    def in_family(self, family: str) -> list[tuple[int, int]]:
        """Return (episode, tick) of the problems of a family."""
        return [
            (index, tick)
            for index, episode in enumerate(self.episodes)
            for tick, problem in enumerate(episode)
            if self._family(self.names[index], problem) == family
        ]

    def _family(self, name: str, problem: Problem) -> str:
        if name == "undisturbed":
            return name
        if problem.pressing:
            return "gap-rows"
        # Only a reference that gives way does not obey the dynamics.
        return "yielding" if problem.lower[6 : self.parts.states].any() else ""


@frozen(eq=False)
class _Episode:
    """A situation to be driven through."""

    reference: Reference
    ticks: int
    rear_m: Callable[[Array], Array] | None = None
    """Rear bumper of the vehicle ahead at some times [s]."""
    seen_s: float = 0.0
    """When it is first seen."""
    planned: bool = True
    """Whether its plan is known, else it is sensed and extrapolated."""
    pushes: tuple[tuple[float, float], ...] = ()
    """By how much the body gets too far ahead [m] and too fast [m/s], at every `_PUSH_TICKS`."""


def record(scenario: Scenario, *, instances: int, seed: int) -> Recording:
    """Drive through `instances` episodes of each situation and record all ticks.

    Raises:
        RuntimeError: the exact solution of a program was not found.
    """
    tracker = Tracker(scenario)
    cost, rows, lower, upper = tracker.last_program()
    parts = Parts.of(cost, rows)
    exact = QuadraticProgram(cost, rows, lower, upper, settings=_REFERENCE)
    recording = Recording(parts, [], [])
    for name, make in _SITUATIONS.items():
        for index in range(instances):
            rng = random.Random(f"{seed} {name} {index}")  # noqa: S311 (not for secrets)
            recording.episodes.append(
                [
                    _with_reference(problem, exact, parts)
                    for problem in _drive(scenario, make(scenario, rng), rng)
                ]
            )
            recording.names.append(name)
    return recording


def _drive(scenario: Scenario, episode: _Episode, rng: random.Random) -> Iterator[Problem]:
    """Close the loop with the exact plant, from the reference's first state."""
    tick_s = scenario.runtime.tick_s
    ahead_s = np.array([tick_s * k for k in range(scenario.horizon_ticks + 1)])
    tracker = Tracker(evolve(scenario, tracking=evolve(scenario.tracking, always_solve=True)))
    body = _row(episode.reference.window(0).states[0])
    for tick in range(episode.ticks):
        if tick and tick % _PUSH_TICKS == 0 and tick // _PUSH_TICKS <= len(episode.pushes):
            by_m, by_mps = episode.pushes[tick // _PUSH_TICKS - 1]
            body = (body[0] + by_m, body[1] + by_mps, *body[2:])
        state = _row(np.array([x + rng.gauss(0.0, by) for x, by in zip(body, _NOISE, strict=True)]))
        window = episode.reference.window(tick)
        rear = _predicted(episode, tick * tick_s, ahead_s)
        gaps = NOBODY if rear is None else Gaps(latest=rear - scenario.tracking.min_gap_m)
        jerk = tracker.solve(state, window, gaps).jerk
        _, _, lower, upper = tracker.last_program()
        yield Problem(state, window, gaps, lower, upper, jerk, jerk[0], pressing=False)
        along, across = jerk[0].tolist()
        body = integrate(body, (along, across), tick_s)


def _predicted(episode: _Episode, now_s: float, ahead_s: Array) -> Array | None:
    if episode.rear_m is None or now_s < episode.seen_s:
        return None
    if episode.planned:
        return episode.rear_m(now_s + ahead_s)
    now_m, soon_m = episode.rear_m(now_s + np.array([0.0, 0.01]))
    rear = now_m + (soon_m - now_m) / 0.01 * ahead_s
    rear[ahead_s > SENSED_S + 1e-9] = np.inf
    return np.asarray(rear)


def _with_reference(problem: Problem, exact: QuadraticProgram, parts: Parts) -> Problem:
    exact.update(problem.lower, problem.upper)
    result = exact.solve()
    if not result.usable:
        raise RuntimeError(f"no exact solution: OSQP's status is {result.status}")
    first = parts.first_jerk(problem, result.x[parts.states :])
    slack = np.abs(result.x[parts.states + parts.jerks :])
    return evolve(problem, first=first, pressing=bool((slack >= _PRESSING_M).any()))


def _row(numbers: Array) -> State:
    s, v, a, y, v_y, a_y = numbers.tolist()
    return s, v, a, y, v_y, a_y


def _braking(
    scenario: Scenario, gap_m: float, start_s: float, decel: float, speed_mps: float
) -> Callable[[Array], Array]:
    """Return the rear bumper of a vehicle that leaves the road's speed at `start_s`.

    Args:
        scenario: for the road's speed.
        gap_m: from the front bumper of a vehicle in column 0, before.
        start_s: when it begins to brake.
        decel: its deceleration [m/s2].
        speed_mps: its speed in the end.
    """
    before_mps = scenario.lattice.speed_mps
    until_s = (before_mps - speed_mps) / decel
    rear_m = scenario.lattice.cell_s_m(0, 0.0) + gap_m

    def rear(t_s: Array) -> Array:
        late_s = np.maximum(t_s - start_s, 0.0)
        braked_s = np.minimum(late_s, until_s)
        lost_m = decel * braked_s * (late_s - braked_s / 2.0)
        return np.asarray(rear_m + before_mps * t_s - lost_m)

    return rear


def _net_gap_m(scenario: Scenario, cells: int) -> float:
    return cells * scenario.formation.gap_m - scenario.vehicle.length_m


def _slower_ahead(scenario: Scenario, rng: random.Random) -> _Episode:
    start_s, decel, speed_mps = rng.uniform(0.5, 2.0), rng.uniform(2.0, 5.0), rng.uniform(4.0, 12.0)
    rear = _braking(scenario, _net_gap_m(scenario, 1), start_s, decel, speed_mps)
    return _Episode(Reference.hold(scenario, (0, 1)), 80, rear, planned=_is_planned(rng))


def _closing(scenario: Scenario, rng: random.Random) -> _Episode:
    start_s, decel, speed_mps = rng.uniform(0.5, 3.0), rng.uniform(1.5, 2.5), rng.uniform(5.0, 11.0)
    rear = _braking(scenario, _net_gap_m(scenario, 2), start_s, decel, speed_mps)
    reference = Reference.move(scenario, (0, 1), (1, 1), rng.randrange(10))
    return _Episode(reference, 80, rear, planned=_is_planned(rng))


def _falling_back(scenario: Scenario, rng: random.Random) -> _Episode:
    """Return a move to the rear, late, from close behind one that brakes."""
    start_s, decel, speed_mps = rng.uniform(0.5, 2.0), rng.uniform(1.0, 3.0), rng.uniform(8.0, 12.0)
    rear = _braking(scenario, rng.uniform(4.0, 10.0), start_s, decel, speed_mps)
    reference = Reference.move(scenario, (0, 1), (-1, 1), rng.randrange(15))
    return _Episode(reference, 80, rear, planned=_is_planned(rng), pushes=_pushes(rng))


def _close_behind(scenario: Scenario, rng: random.Random) -> _Episode:
    """Return a hold behind a vehicle that leaves little more than the least gap."""
    gap_m = scenario.tracking.min_gap_m + rng.uniform(0.1, 2.0)
    rear = _braking(scenario, gap_m, 0.0, 1.0, scenario.lattice.speed_mps)
    reference = Reference.hold(scenario, (0, 1))
    return _Episode(reference, 80, rear, planned=_is_planned(rng), pushes=_pushes(rng))


def _pushes(rng: random.Random) -> tuple[tuple[float, float], ...]:
    return tuple((rng.uniform(0.3, 2.0), rng.uniform(0.0, 2.0)) for _ in range(3))


def _entering(scenario: Scenario, rng: random.Random) -> _Episode:
    """Return a change into a lane where a slow vehicle is seen when the change begins."""
    start, tick_s = rng.randrange(10), scenario.runtime.tick_s
    seen_s, gap_m, speed_mps = start * tick_s, rng.uniform(4.0, 10.0), rng.uniform(8.0, 12.0)
    # It has its speed when it is first seen.
    rear = _braking(scenario, gap_m, seen_s - tick_s, 15.0 / tick_s, speed_mps)
    reference = Reference.move(scenario, (0, 1), (0, rng.choice((0, 2))), start)
    return _Episode(reference, 80, rear, seen_s, planned=_is_planned(rng))


def _is_planned(rng: random.Random) -> bool:
    # What is only sensed is found out late, so it is where gap rows become active.
    return rng.random() < 0.3


def _undisturbed(scenario: Scenario, rng: random.Random) -> _Episode:
    """Return a hold or a move, every other time with a vehicle in the cell before the next one."""
    dx, dy = rng.choice([(0, 0), (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    reference = Reference.move(scenario, (0, 1), (dx, 1 + dy), 10) if dx or dy else None
    reference = reference or Reference.hold(scenario, (0, 1))
    rear = _braking(scenario, _net_gap_m(scenario, 2), 0.0, 1.0, scenario.lattice.speed_mps)
    return _Episode(reference, 60, rng.choice((None, rear)), planned=_is_planned(rng))


_SITUATIONS: Final[dict[str, Callable[[Scenario, random.Random], _Episode]]] = {
    "slower ahead": _slower_ahead,
    "closing": _closing,
    "falling back": _falling_back,
    "close behind": _close_behind,
    "entering": _entering,
    "undisturbed": _undisturbed,
}
