"""Compare the tracker with other solvers: `python benchmarks/tracker_solvers.py`.

All solvers get the same recorded problems, the ticks of an episode in order, since some of them
start from the solution of the previous tick. Episodes are those of `laneweave bench tracker`:

    tracker     the whole call of the tracker
    shortcut    the same with `tracking.shortcut`: OSQP runs only where a constraint binds
    osqp        the program alone, from the previous solution: bounds, solve, check of the answer
    daqp        the same program without its states, by a dual active-set method
    lq          the same program without its inequalities, a matrix times a vector: the lower bound

Times are CPU times of one thread; each problem is measured several times, and the median counts.
Answers are compared with the exact first jerk of each program.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

import daqp
import numpy as np
from attrs import evolve, frozen
from numpy.typing import NDArray
from scipy import sparse

from laneweave.agents.driving.qp_solver import QPSettings, QuadraticProgram
from laneweave.agents.driving.reference import Window
from laneweave.agents.driving.tracker import Tracker
from laneweave.agents.driving.tracking_problem import SETTINGS, Gaps, program_scale
from laneweave.launch.bench.runtime import machine
from laneweave.launch.bench.tracker import SITUATIONS, drive
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.sim_bridge.recording.statistics import percentiles_of

Array = NDArray[np.float64]

FAMILIES: Final = ("gap-rows", "yielding", "undisturbed")
"""Ticks with an active gap constraint; with none active, because the reference yields; with no
vehicle near. Other ticks are recorded as well, because solvers start from the previous solution."""
GOALS_MS: Final = {"p50": 0.2, "p99": 1.0, "max": 4.0}
"""Goals for the tracker's CPU time in ticks with active gap constraints."""
_REPEATS = 3
_ROW_TOLERANCE = 2e-2
"""Largest constraint violation of a valid solution."""
_BINDING_M = 1e-3
"""Slack from which a gap constraint counts as active."""
_EXACT = QPSettings(
    eps_abs=1e-7, max_iter=40_000, check_termination=25, rho=0.3, polishing=True, tolerance=1e-4
)


@frozen(eq=False)
class Parts:
    """Meaning of the columns and rows of the tracker's programs.

    Columns are 6 N states, 2 N jerks and N slacks; the first 6 N rows are the dynamics.
    """

    cost: Any
    rows: Any
    states: int
    jerks: int
    jerk_rows: NDArray[np.intp]
    """Rows that bound a single jerk and nothing else, in the order of the jerks."""

    @classmethod
    def of(cls, cost: Any, rows: Any) -> Parts:  # noqa: ANN401 - scipy.sparse has no types
        """Find the blocks in P and A, both sparse."""
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
        """Return the first jerk (2,) from a solution relative to the reference's jerks."""
        rows = self.jerk_rows[:2]
        # Jerk limits are symmetric, so the bounds contain the reference's jerk.
        reference = -(problem.lower[rows] + problem.upper[rows]) / 2.0
        return np.asarray(reference + solution[:2])


@frozen(eq=False)
class Problem:
    """One tick: the tracker's inputs and answer, the bounds of its program, the exact solution."""

    state: State
    window: Window
    gaps: Gaps
    lower: Array
    upper: Array
    jerk: Array
    """The tracker's answer (N, 2) [m/s3]."""
    first: Array
    """First jerk (2,) of the exact solution [m/s3]."""
    binding: bool
    """Whether a gap constraint is active, that is, a slack is not zero."""


@frozen(eq=False)
class Recording:
    """Episodes of consecutive ticks, and the structure shared by their programs."""

    parts: Parts
    episodes: list[list[Problem]]
    names: list[str]
    """Name of the situation of each episode."""

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
        if problem.binding:
            return "gap-rows"
        # Only a reference that gives way violates the dynamics.
        return "yielding" if problem.lower[6 : self.parts.states].any() else ""


def record(scenario: Scenario, *, instances: int, seed: int) -> Recording:
    """Drive through `instances` episodes of each situation and record all ticks.

    Raises:
        RuntimeError: the exact solution of a program was not found.
    """
    program = Tracker(scenario, scenario.vehicle).program
    parts = Parts.of(program.cost, program.constraints)
    exact = QuadraticProgram(
        program.cost, program.constraints, program.low.all, program.high.all, settings=_EXACT
    )
    recording = Recording(parts, [], [])
    for name in SITUATIONS:
        for index in range(instances):
            tracker, problems = Tracker(scenario, scenario.vehicle), []
            for tick in drive(tracker, scenario, name, f"{seed} {name} {index}"):
                lower, upper = tracker.program.low.all.copy(), tracker.program.high.all.copy()
                exact.update(lower, upper)
                solution = exact.solve()
                if not solution.usable:
                    raise RuntimeError(f"no exact solution: OSQP's status is {solution.status}")
                slack = np.abs(solution.x[parts.states + parts.jerks :])
                problem = Problem(
                    tick.state,
                    tick.window,
                    tick.gaps,
                    lower,
                    upper,
                    tick.result.jerk,
                    np.zeros(2),
                    bool((slack >= _BINDING_M).any()),
                )
                first = parts.first_jerk(problem, solution.x[parts.states :])
                problems.append(evolve(problem, first=first))
            recording.episodes.append(problems)
            recording.names.append(name)
    return recording


@frozen(eq=False)
class Answer:
    """A solver's answer to a problem."""

    first: Array
    """First jerk (2,) [m/s3]."""
    solved: bool
    iterations: int | None = None


class Solver(Protocol):
    """Interface of a solver for the programs of a recording, in order."""

    def reset(self) -> None:
        """Begin a new episode."""

    def prepare(self, problem: Problem) -> Any:  # noqa: ANN401 - each has its own
        """Return the input of `solve`; this time counts, and is also reported separately."""

    def solve(self, prepared: Any) -> Answer:  # noqa: ANN401
        """Solve a prepared problem."""


class TrackerSolver:
    """The whole call of the tracker."""

    def __init__(self, make_tracker: Callable[[], Tracker]) -> None:
        """Store the factory and create the first tracker."""
        self._make = make_tracker
        self._tracker = make_tracker()

    def reset(self) -> None:
        """Begin with a new tracker."""
        self._tracker = self._make()

    def prepare(self, problem: Problem) -> Problem:
        """Return the problem."""
        return problem

    def solve(self, prepared: Problem) -> Answer:
        """Track."""
        result = self._tracker.solve(prepared.state, prepared.window, prepared.gaps)
        return Answer(result.jerk[0], result.usable, result.iterations)


class OsqpSolver:
    """OSQP with the tracker's program and settings, without the rest of the tracker."""

    def __init__(self, parts: Parts) -> None:
        """Set up the program."""
        free = np.full(parts.rows.shape[0], np.inf)
        self._parts = parts
        scale = program_scale(parts.jerks // 2)
        self._qp = QuadraticProgram(
            parts.cost, parts.rows, -free, free, settings=SETTINGS, scale=scale
        )

    def reset(self) -> None:
        """Discard the solution of the previous tick."""
        self._qp.reset()

    def prepare(self, problem: Problem) -> Problem:
        """Return the problem."""
        return problem

    def solve(self, prepared: Problem) -> Answer:
        """Replace the bounds and solve."""
        self._qp.update(prepared.lower, prepared.upper)
        result = self._qp.solve()
        first = self._parts.first_jerk(prepared, result.x[self._parts.states :])
        return Answer(first, result.usable, result.iterations)


@frozen(eq=False)
class Condensed:
    """The tracker's program without its states, in unknowns z with the identity as Hessian.

    With b the bounds of the dynamics (6 N,) and u the 2 N jerks and N slacks, the states are
    e = drift b + drive u, and the remaining program is

        minimise  1/2 z' z + (linear b)' z   subject to  lower <= rows z + moved b <= upper
        u = back z
    """

    linear: Array
    rows: Array
    moved: Array
    back: Array
    drift: Array
    drive: Array

    @classmethod
    def of(cls, parts: Parts) -> Condensed:
        """Eliminate the states; the dense matrices are computed once."""
        n = parts.states
        matrix, cost = parts.rows.toarray(), parts.cost.toarray()
        drift = np.linalg.inv(matrix[:n, :n])
        drive = -drift @ matrix[:n, n:]
        weighted = drive.T @ cost[:n, :n]
        back = np.linalg.inv(np.linalg.cholesky(weighted @ drive + cost[n:, n:])).T
        return cls(
            linear=back.T @ weighted @ drift,
            rows=np.ascontiguousarray((matrix[n:, :n] @ drive + matrix[n:, n:]) @ back),
            moved=matrix[n:, :n] @ drift,
            back=np.ascontiguousarray(back),
            drift=drift,
            drive=drive,
        )


class DaqpSolver:
    """The condensed program, solved by DAQP, always from an empty active set.

    Updating DAQP's workspace instead gave one wrong answer in a hundred (version 0.8.5), and is
    unnecessary: an identity Hessian needs no factorisation.
    """

    def __init__(self, parts: Parts, condensed: Condensed) -> None:
        """Set up the matrices."""
        self._parts, self._condensed = parts, condensed
        unknowns = len(condensed.back)
        self._hessian = np.eye(unknowns)
        self._kinds = np.zeros(len(condensed.rows), dtype=np.int32)
        # One product for all terms that depend on the dynamics' bounds.
        self._from_bounds = np.concatenate([condensed.linear, -condensed.moved])

    def reset(self) -> None:
        """Do nothing: there is no state between ticks."""

    def prepare(self, problem: Problem) -> tuple[Problem, Array, Array, Array]:
        """Return the problem and its vectors: linear cost, lower and upper bounds."""
        states, unknowns = self._parts.states, len(self._hessian)
        changes = self._from_bounds @ problem.lower[:states]
        lower = problem.lower[states:] + changes[unknowns:]
        upper = problem.upper[states:] + changes[unknowns:]
        return problem, changes[:unknowns], lower, upper

    def solve(self, prepared: tuple[Problem, Array, Array, Array]) -> Answer:
        """Solve."""
        problem, linear, lower, upper = prepared
        solution, _, status, info = daqp.solve(
            self._hessian, linear, self._condensed.rows, upper, lower, self._kinds.copy()
        )
        first = self._parts.first_jerk(problem, self._condensed.back[:2] @ solution)
        return Answer(first, status > 0, int(info["iterations"]))


class LqSolver:
    """The optimum without inequalities: a gain from the dynamics' bounds to all jerks.

    The bounds contain the initial error and, where the reference gives way, its defect.
    """

    def __init__(self, parts: Parts, condensed: Condensed) -> None:
        """Compute the gain (2 N, 6 N)."""
        self._parts, self._condensed = parts, condensed
        self._gain = -condensed.back[: parts.jerks] @ condensed.linear

    def reset(self) -> None:
        """Do nothing: there is no state between ticks."""

    def prepare(self, problem: Problem) -> Problem:
        """Return the problem."""
        return problem

    def solve(self, prepared: Problem) -> Answer:
        """Multiply; see `keeps_rows`."""
        answer = self._gain @ prepared.lower[: self._parts.states]
        return Answer(self._parts.first_jerk(prepared, answer), solved=True)

    def keeps_rows(self, problem: Problem) -> bool:
        """Return whether the answer also solves the whole program."""
        bounds = problem.lower[: self._parts.states]
        unknowns = np.zeros(len(self._condensed.back))
        unknowns[: self._parts.jerks] = self._gain @ bounds
        states = self._condensed.drift @ bounds + self._condensed.drive @ unknowns
        values = self._parts.rows @ np.concatenate([states, unknowns])
        over = np.maximum(values - problem.upper, problem.lower - values)
        return bool(over.max() <= _ROW_TOLERANCE)


def compare(
    scenario: Scenario, *, instances: int, seed: int, repeats: int = _REPEATS
) -> list[dict[str, Any]]:
    """Measure all solvers on recorded problems.

    Args:
        scenario: limits, tick and horizon.
        instances: number of episodes per situation.
        seed: seed of all episodes.
        repeats: number of measurements per problem.

    Returns:
        One row per family and solver.
    """
    recording = record(scenario, instances=instances, seed=seed)
    rows = []
    for name, solver in solvers(scenario, recording.parts).items():
        measured = _measured(solver, recording, repeats)
        for family in FAMILIES:
            summary = _summary(measured, recording, family)
            rows.append({"family": family, "solver": name, **summary})
    rows.sort(key=lambda row: FAMILIES.index(row["family"]))
    return rows


def solvers(scenario: Scenario, parts: Parts) -> dict[str, Solver]:
    """Return all solvers by name."""
    condensed = Condensed.of(parts)
    shortcut = evolve(scenario, tracking=evolve(scenario.tracking, shortcut=True))
    return {
        "tracker": TrackerSolver(lambda: Tracker(scenario, scenario.vehicle)),
        "shortcut": TrackerSolver(lambda: Tracker(shortcut, shortcut.vehicle)),
        "osqp": OsqpSolver(parts),
        "daqp": DaqpSolver(parts, condensed),
        "lq": LqSolver(parts, condensed),
    }


@frozen(eq=False)
class _Measured:
    """Measurements of all problems, by episode and tick."""

    prepare_ms: list[Array]
    solve_ms: list[Array]
    solved: list[Array]
    differences: list[Array]
    iterations: list[list[int | None]]


def _measured(solver: Solver, recording: Recording, repeats: int) -> _Measured:
    measured = _Measured([], [], [], [], [])
    for episode in recording.episodes:
        times = np.zeros((repeats, len(episode), 2))
        answers: list[Answer] = []
        for repeat in range(repeats):
            solver.reset()
            answers = []
            for tick, problem in enumerate(episode):
                began = time.thread_time()
                prepared = solver.prepare(problem)
                ready = time.thread_time()
                answers.append(solver.solve(prepared))
                times[repeat, tick] = ready - began, time.thread_time() - ready
        prepare_ms, solve_ms = np.median(times, axis=0).T * 1e3
        solved = [answer.solved for answer in answers]
        if isinstance(solver, LqSolver):
            solved = [solver.keeps_rows(problem) for problem in episode]
        measured.prepare_ms.append(prepare_ms)
        measured.solve_ms.append(solve_ms)
        measured.solved.append(np.array(solved))
        measured.differences.append(
            np.array(
                [
                    np.abs(answer.first - problem.first).max()
                    for answer, problem in zip(answers, episode, strict=True)
                ]
            )
        )
        measured.iterations.append([answer.iterations for answer in answers])
    return measured


def _summary(measured: _Measured, recording: Recording, family: str) -> dict[str, Any]:
    members = recording.in_family(family)

    def of(values: Sequence[Any]) -> Array:
        return np.array([values[episode][tick] for episode, tick in members])

    prepare_ms, differences = of(measured.prepare_ms), of(measured.differences)
    cpu_ms = prepare_ms + of(measured.solve_ms)
    iterations = of(measured.iterations)
    counted = iterations[iterations != np.array(None)].astype(float)
    return {
        "problems": len(members),
        "prepare_ms": percentiles_of(prepare_ms, 50),
        "cpu_ms": {
            "mean": round(float(cpu_ms.mean()), 3) if len(cpu_ms) else None,
            **percentiles_of(cpu_ms, 50, 99, largest=True),
        },
        "solved_share": round(float(of(measured.solved).mean()), 4) if members else None,
        "first_jerk_difference_mps3": percentiles_of(differences, 50, 99, largest=True),
        "iterations": percentiles_of(counted, 50, 99, largest=True),
    }


def main() -> None:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--instances", type=int, default=20, help="number of episodes per situation"
    )
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    rows = compare(load_scenario(None), instances=chosen.instances, seed=chosen.seed)
    goals = {"family": "gap-rows", "solver": "tracker", "cpu_ms": GOALS_MS}
    result = {"benchmark": "tracker", "machine": machine(), "results": rows, "goals": goals}
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
