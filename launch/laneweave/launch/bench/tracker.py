"""`laneweave bench tracker`: what a tick of tracking costs, beside other ways to solve it.

All solvers get the same recorded problems (`tracker_problems`), the ticks of an episode in their
order, since most of them start from the solution of the tick before:

    tracker     the whole call of the tracker
    no-shortcut the same with `tracking.always_solve`: OSQP runs at every tick
    osqp        its program alone: bounds replaced, solved, answer checked
    daqp        the same program without its states, by a dual active-set method
    lq          the same program without its inequalities, a matrix times a vector: the floor

CPU time of one thread; each problem is measured several times and its median counts. Answers are
compared with the exact first jerk of each program.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, Final, Protocol

import numpy as np
from attrs import evolve, frozen
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from laneweave.agents.driving.qp import QuadraticProgram
from laneweave.agents.driving.tracker import SETTINGS, Tracker, program_scale
from laneweave.launch.bench.tracker_problems import FAMILIES, Parts, Problem, Recording, record
from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.recording.run_record import spread

Array = NDArray[np.float64]

GOALS_MS: Final = {"p50": 0.2, "p99": 1.0, "max": 4.0}
"""For the tracker where gap rows are active."""
NO_DAQP: Final = "not installed: laneweave[bench]"

_REPEATS = 3
_ROW_TOLERANCE = 2e-2
"""A solution that violates a row by more is not counted as one."""


@frozen(eq=False)
class Answer:
    """What a solver made of a problem."""

    first: Array
    """First jerk (2,) [m/s3]."""
    solved: bool
    iterations: int | None = None


class Solver(Protocol):
    """A way to solve the programs of a recording, one after the other."""

    def reset(self) -> None:
        """Begin a new episode."""

    def prepare(self, problem: Problem) -> Any:  # noqa: ANN401 - each has its own
        """Return what `solve` needs; its time counts, and is told on its own as well."""

    def solve(self, prepared: Any) -> Answer:  # noqa: ANN401
        """Solve a prepared problem."""


class TrackerSolver:
    """The whole call of the tracker."""

    def __init__(self, make_tracker: Callable[[], Tracker]) -> None:
        """Take what makes a tracker."""
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
    """The tracker's program and settings, without the rest of the tracker."""

    def __init__(self, parts: Parts) -> None:
        """Set up the program."""
        free = np.full(parts.rows.shape[0], np.inf)
        self._parts = parts
        scale = program_scale(parts.jerks // 2)
        self._qp = QuadraticProgram(
            parts.cost, parts.rows, -free, free, settings=SETTINGS, scale=scale
        )

    def reset(self) -> None:
        """Forget the solution of the tick before."""
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
    """The tracker's program without its states, in unknowns z that make its Hessian one.

    With b the bounds of the dynamics (6 N,) and u the 2 N jerks and N slacks, the states are
    e = drift b + drive u, and what is left is

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
        """Eliminate the states: dense matrices, made once."""
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
    """The condensed program, solved by DAQP, always from no active row.

    It has a workspace to be updated, but with that one answer in a hundred was wrong (0.8.5). Nor
    is it needed: with a Hessian of one nothing has to be factorised.
    """

    def __init__(self, parts: Parts, condensed: Condensed) -> None:
        """Make the matrices.

        Raises:
            ModuleNotFoundError: DAQP is not installed.
        """
        self._solve = import_module("daqp").solve
        self._parts, self._condensed = parts, condensed
        unknowns = len(condensed.back)
        self._hessian = np.eye(unknowns)
        self._kinds = np.zeros(len(condensed.rows), dtype=np.int32)
        # One product for everything that depends on the dynamics' bounds.
        self._from_bounds = np.concatenate([condensed.linear, -condensed.moved])

    def reset(self) -> None:
        """Nothing is kept between ticks."""

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
        solution, _, status, info = self._solve(
            self._hessian, linear, self._condensed.rows, upper, lower, self._kinds.copy()
        )
        first = self._parts.first_jerk(problem, self._condensed.back[:2] @ solution)
        return Answer(first, status > 0, int(info["iterations"]))


class LqSolver:
    """The optimum without inequalities: a gain from the dynamics' bounds to all jerks.

    The bounds hold the initial error and, where the reference yields, what it lacks in dynamics.
    """

    def __init__(self, parts: Parts, condensed: Condensed) -> None:
        """Compute the gain (2 N, 6 N)."""
        self._parts, self._condensed = parts, condensed
        self._gain = -condensed.back[: parts.jerks] @ condensed.linear

    def reset(self) -> None:
        """Nothing is kept between ticks."""

    def prepare(self, problem: Problem) -> Problem:
        """Return the problem."""
        return problem

    def solve(self, prepared: Problem) -> Answer:
        """Multiply; whether rows are kept is told by `keeps_rows`."""
        answer = self._gain @ prepared.lower[: self._parts.states]
        return Answer(self._parts.first_jerk(prepared, answer), solved=True)

    def keeps_rows(self, problem: Problem) -> bool:
        """Tell whether the answer is one to the whole program, too."""
        bounds = problem.lower[: self._parts.states]
        unknowns = np.zeros(len(self._condensed.back))
        unknowns[: self._parts.jerks] = self._gain @ bounds
        states = self._condensed.drift @ bounds + self._condensed.drive @ unknowns
        values = self._parts.rows @ np.concatenate([states, unknowns])
        over = np.maximum(values - problem.upper, problem.lower - values)
        return bool(over.max() <= _ROW_TOLERANCE)


def bench_tracker(
    scenario: Scenario, *, instances: int, seed: int, repeats: int = _REPEATS
) -> list[dict[str, Any]]:
    """Measure all solvers on recorded problems.

    Args:
        scenario: limits, tick and horizon.
        instances: episodes per situation.
        seed: of all episodes.
        repeats: how often each problem is measured.

    Returns:
        One row per family and solver; one that is not installed has its reason in `missing`.
    """
    recording = record(scenario, instances=instances, seed=seed)
    rows = []
    for name, solver in solvers(scenario, recording.parts).items():
        measured = None if solver is None else _measured(solver, recording, repeats)
        for family in FAMILIES:
            row = {"family": family, "solver": name}
            if measured is None:
                rows.append({**row, "missing": NO_DAQP})
                continue
            rows.append({**row, **_summary(measured, recording, family)})
    rows.sort(key=lambda row: FAMILIES.index(row["family"]))
    return rows


def solvers(scenario: Scenario, parts: Parts) -> dict[str, Solver | None]:
    """Return all solvers by name; None for one that is not installed."""
    condensed = Condensed.of(parts)
    daqp: Solver | None
    try:
        daqp = DaqpSolver(parts, condensed)
    except ModuleNotFoundError:
        daqp = None
    always = evolve(scenario, tracking=evolve(scenario.tracking, always_solve=True))
    return {
        "tracker": TrackerSolver(lambda: Tracker(scenario)),
        "no-shortcut": TrackerSolver(lambda: Tracker(always)),
        "osqp": OsqpSolver(parts),
        "daqp": daqp,
        "lq": LqSolver(parts, condensed),
    }


@frozen(eq=False)
class _Measured:
    """Of all problems, by episode and tick."""

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
        "prepare_ms": spread(prepare_ms, 50),
        "cpu_ms": {
            "mean": round(float(cpu_ms.mean()), 3) if len(cpu_ms) else None,
            **spread(cpu_ms, 50, 99, largest=True),
        },
        "solved_share": round(float(of(measured.solved).mean()), 4) if members else None,
        "first_jerk_difference_mps3": spread(differences, 50, 99, largest=True),
        "iterations": spread(counted, 50, 99, largest=True),
    }


def tracker_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the results of `bench_tracker` as a table."""
    goals = " / ".join(f"{GOALS_MS[name]:g}" for name in ("p50", "p99", "max"))
    table = Table(
        caption="CPU ms of one thread; off: first jerk from the exact one in m/s3;\n"
        f"goals for the tracker in gap-rows: p50 / p99 / max {goals}",
        box=box.SIMPLE_HEAD,
        # Narrow enough for a terminal of 80 columns.
        collapse_padding=True,
        pad_edge=False,
    )
    for name in ("family", "solver", "ticks", "ms\nmean", "\np50", "\np99", "\nmax"):
        table.add_column(name, no_wrap=True)
    for name in ("done\n%", "off\nmax", "steps\n50/99"):
        table.add_column(name, no_wrap=True)
    family, missing = "", {}
    for row in rows:
        if family not in ("", row["family"]):
            table.add_section()
        named, family = "" if row["family"] == family else row["family"], row["family"]
        if "missing" in row:
            table.add_row(named, row["solver"], "-")
            missing[row["solver"]] = row["missing"]
            continue
        iterations, share = row["iterations"], row["solved_share"]
        table.add_row(
            named,
            row["solver"],
            str(row["problems"]),
            *(_text(row["cpu_ms"][name], 3) for name in ("mean", "p50", "p99", "max")),
            _text(None if share is None else 100.0 * share, 1),
            _text(row["first_jerk_difference_mps3"]["max"], 2),
            f"{_text(iterations['p50'], 0)}/{_text(iterations['p99'], 0)}",
        )
    for name, reason in missing.items():
        table.caption = f"{table.caption}\n{name}: {reason}"
    return table


def _text(number: float | None, digits: int) -> str:
    return "-" if number is None else f"{number:.{digits}f}"
