"""Planners of users: their plans are used if valid, otherwise those of built-in solvers."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import attrs
import pytest

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.plug_ins import process
from laneweave.coordinator.planning.plug_ins.registry import PLANNERS
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import PLUG_IN_SHARE, plan, prepare
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.formation_table import SOLVERS
from support.plug_ins import Install, installing
from support.variants import variants

REQUEST = PlanRequest(
    Grid(4, 2),
    1,
    ("node", "edge"),
    (VehicleRequest("a", (0, 0), lane=1), VehicleRequest("b", (2, 0), lane=0)),
    ((1, 1), (2, 0), (3, 0)),
    deadline_s=3600.0,
)
OPTIMAL = "[[(0, 0), (1, 0), (1, 1)], [(2, 0)]]"
"""Costs 2: the lower bound, since nothing is in the way."""
DETOUR = "[[(0, 0), (0, 1), (0, 1), (1, 1)], [(2, 0), (3, 0)]]"
"""Costs 4."""


@pytest.fixture
def install(tmp_path: Path) -> Iterator[Install]:
    with installing(tmp_path / "installed", PLANNERS.group) as install:
        yield install
    process._end_all()
    process._processes.clear()


def planner(install: Install, body: str) -> None:
    """Install the planner `own`, a function with this body."""
    lines = "\n    ".join(body.splitlines())
    source = f"import os, sys, time\n\ndef own(request, limits):\n    {lines}\n"
    install("mine", {"own": "own"}, source)


def replaced(response: PlanResponse) -> bool:
    """Return whether built-in solvers made the plan, which is optimal for this request."""
    return (response.solver, response.fallback, response.status) == ("branching", True, "optimal")


def test_built_in_solvers_are_in_the_registry() -> None:
    assert tuple(PLANNERS.built_in) == SOLVERS


@pytest.mark.parametrize(
    ("paths", "cost", "status", "steps"), [(OPTIMAL, 2, "optimal", 2), (DETOUR, 4, "feasible", 3)]
)
def test_a_valid_plan_is_used_as_it_is(
    install: Install, paths: str, cost: int, status: str, steps: int
) -> None:
    planner(install, f"return {paths}")
    response = plan(attrs.evolve(REQUEST, solver="own"))
    assert (response.solver, response.fallback) == ("own", False)
    assert (response.status, response.cost, response.lower_bound) == (status, cost, 2)
    assert (response.steps, response.assignment) == (steps, (0, cost // 2))
    assert response.paths[1] == ((2, 0),) + ((cost // 2 + 1, 0),) * steps
    assert plan(REQUEST, solver="own").paths == response.paths


@pytest.mark.parametrize(
    ("body", "reason"),
    variants(
        [
            ("return None", "it returned no paths"),
            ("raise KeyError('lane')", "KeyError: 'lane'"),
            ("return [[(0, 0), (1, 1)], [(2, 0)]]", "a jumps"),
            ("os._exit(3)", "its process died"),
            ("return 7", "TypeError"),
            ("return [[(0, 0), (0.5, 1)], [(2, 0)]]", "TypeError"),
            ("return []", "2 vehicles, but"),
            ("return [[], []]", "paths have 1 to"),
            ("return [[(0, 0)] * 20_000, [(2, 0)]]", "paths have 1 to"),
            ("return [[(0, 0), (0, 1)], [(2, 0)]]", "a ends at (0, 1), no target"),
            ("return [[(0, 0), (1, 0), (2, 0)], [(2, 0)]]", "a prefers lane 1"),
            ("return [[(0, 0), (1, 0), (1, 1)], [(2, 0), (1, 0), (2, 0)]]", "conflict"),
        ],
        4,
    ),
)
def test_built_in_solvers_replace_a_plan_that_is_not_valid(
    install: Install, body: str, reason: str, capfd: pytest.CaptureFixture[str]
) -> None:
    planner(install, body)
    assert replaced(plan(REQUEST, solver="own"))
    written = capfd.readouterr()
    assert reason in written.out + written.err


def test_what_a_planner_prints_is_not_in_the_output(
    install: Install, capfd: pytest.CaptureFixture[str]
) -> None:
    planner(install, f"print('hello'); sys.stdout.flush()\nreturn {OPTIMAL}")
    assert plan(REQUEST, solver="own").solver == "own"
    assert capfd.readouterr() == ("", "hello\n")


def test_a_planner_that_hangs_is_killed_and_paused(
    install: Install, capfd: pytest.CaptureFixture[str]
) -> None:
    planner(install, "while True: pass")
    prepare("own")
    hung = process._process_of("own")._process
    assert hung is not None
    request = attrs.evolve(REQUEST, deadline_s=3.0)
    began = time.monotonic()
    assert replaced(plan(request, solver="own"))
    assert time.monotonic() - began >= PLUG_IN_SHARE * request.deadline_s
    assert hung.poll() is not None
    # The next request is not delayed: the planner is not asked.
    assert replaced(plan(request, solver="own"))
    assert "paused" in "".join(capfd.readouterr())


def test_a_planner_that_was_killed_is_asked_again(
    install: Install, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(process, "PAUSE_S", 0.0)
    mark = tmp_path / "mark"
    body = f"if os.path.exists({str(mark)!r}): return {OPTIMAL}\nopen({str(mark)!r}, 'x')\n"
    planner(install, body + "os._exit(1)")
    assert replaced(plan(REQUEST, solver="own"))
    assert plan(REQUEST, solver="own").solver == "own"


def test_a_planner_keeps_its_process_and_gets_its_limits(install: Install) -> None:
    body = "assert limits.max_nodes == 500, limits\nassert 1700 < limits.deadline_s <= 1800\n"
    planner(install, f"{body}return {OPTIMAL}")
    children = []
    for _ in range(2):
        assert plan(REQUEST, solver="own", max_nodes=500).solver == "own"
        children.append(process._process_of("own")._process)
    first, second = children
    assert first is second
    assert first is not None
    assert first.poll() is None


def test_a_class_is_instantiated_once(install: Install) -> None:
    source = f"""
class Own:
    calls = 0
    def __call__(self, request, limits):
        self.calls += 1
        return {OPTIMAL} if self.calls == 2 else None
"""
    install("mine", {"own": "Own"}, source)
    assert [plan(REQUEST, solver="own").solver for _ in range(2)] == ["branching", "own"]


@pytest.mark.parametrize(
    ("source", "reason"), variants([("import gone", "gone"), ("own = 1", "int is not callable")])
)
def test_a_planner_that_cannot_be_loaded_is_refused(
    install: Install, source: str, reason: str
) -> None:
    install("mine", {"own": "own"}, source)
    with pytest.raises(BadInputError, match=rf"^formation\.solver: got 'own'.*{reason}"):
        prepare("own", "formation.solver")
    with pytest.raises(BadInputError, match=rf"^solver: got 'own'.*{reason}"):
        plan(REQUEST, solver="own")


def test_a_forked_process_has_planners_of_its_own(install: Install) -> None:
    planner(install, f"return {OPTIMAL}")
    assert plan(REQUEST, solver="own").solver == "own"
    child = os.fork()
    if child == 0:
        made = plan(REQUEST, solver="own").solver
        process._end_all()
        os._exit(0 if made == "own" else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert plan(REQUEST, solver="own").solver == "own"


def test_structures_and_shared_cells_are_planned(install: Install) -> None:
    planner(install, f"assert request.targets\nreturn {OPTIMAL}")
    structure = attrs.evolve(REQUEST, targets=(), structure="parallel", lanes=(0, 1))
    response = plan(structure, solver="own")
    assert response.targets is not None
    shared = attrs.evolve(REQUEST, conflicts=("edge",))
    assert plan(shared, solver="own").solver == "own"
