"""Loading and compilation of kernels, with two small kernels that compile in a second.

Each process of a test has an empty or a shared cache of its own, and gets its kernels from a
folder: `fake_calls` calls the kernel in `fake_outer`, which calls the kernel in `fake_inner`.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import attrs
import pytest

from laneweave.coordinator.planning import solve
from laneweave.coordinator.planning.exact.joint_kernel import (
    add_goals,
    fill_slots,
    search,
)
from laneweave.coordinator.planning.kernels import BRANCHING, KERNELS, _without_compiling
from laneweave.coordinator.planning.paper import tappa
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import block_request, formation_request
from support.commands import run

INNER = """
from numba import njit
@njit(cache=True)
def inner(x): return x + {added}
"""
OUTER = """
from numba import njit
from laneweave.coordinator.planning.fake_inner import inner
@njit(cache=True)
def outer(x): return 10 * inner(x)
"""
CALLS = """
def call_kernels():
    from laneweave.coordinator.planning.fake_outer import outer
    outer(1)
"""
PROGRAM = """
import json, sys
from laneweave.coordinator import planning
planning.__path__.append(sys.argv[1])
from laneweave.coordinator.planning import kernels
fake = kernels.Kernels("fake", "fake_calls", ("fake_outer", "fake_inner"))
def outer(): return sys.modules["laneweave.coordinator.planning.fake_outer"].outer
calls, original = [], kernels.Kernels.compile
def counted(one): calls.append(one.name); original(one)
kernels.Kernels.compile = counted
"""
EASY = block_request(1, vehicles=3, deadline_s=3600.0)
HARD = formation_request(1, vehicles=14, deadline_s=3600.0)
"""TAPPA needs thousands of nodes for it."""


def printed(text: str) -> Any:  # noqa: ANN401 (JSON)
    """Return the last line of a program's output, which follows its log."""
    return json.loads(text.splitlines()[-1])


@attrs.frozen
class Workshop:
    """A folder with kernels, and a cache."""

    folder: Path

    def write(self, added: int) -> None:
        """Write the kernels; `outer` returns ten times the sum of its argument and `added`."""
        for name, text in (("inner", INNER.format(added=added)), ("outer", OUTER)):
            (self.folder / f"fake_{name}.py").write_text(text, encoding="utf-8")
        (self.folder / "fake_calls.py").write_text(CALLS, encoding="utf-8")

    @property
    def environment(self) -> dict[str, str]:
        """Environment of the processes, which find the project as this one does."""
        path = os.pathsep.join(entry for entry in sys.path if entry)
        cache = str(self.folder / "cache")
        return dict(os.environ) | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": path}

    def start(self, program: str) -> subprocess.Popen[str]:
        """Start a process that runs a program with the kernels `fake`."""
        command = [sys.executable, "-c", PROGRAM + program, str(self.folder)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=self.environment)

    def result(self, program: str) -> Any:  # noqa: ANN401 (JSON)
        """Run a program to its end, and return what it has printed."""
        command = (sys.executable, "-c", PROGRAM + program, str(self.folder))
        done = run(*command, env=self.environment)
        assert done.returncode == 0, done.stderr
        return printed(done.stdout)

    def compiled_files(self) -> set[str]:
        """Return the names of the files with compiled code."""
        return {path.name for path in self.folder.rglob("*.nbi")}


@pytest.fixture
def workshop(tmp_path: Path) -> Workshop:
    found = Workshop(tmp_path)
    found.write(added=1)
    return found


LOAD = "fake.load(); print(json.dumps([len(calls), outer()(1)]))"
LOAD_IF_COMPILED = "print(json.dumps([fake.load_if_compiled(), fake.known_missing]))"


@pytest.mark.slow
@pytest.mark.more
def test_kernels_are_compiled_once(workshop: Workshop) -> None:
    assert workshop.result(LOAD_IF_COMPILED) == [False, True]
    assert not workshop.compiled_files()

    assert workshop.result(LOAD) == [1, 20]

    assert workshop.result(LOAD_IF_COMPILED) == [True, False]
    assert workshop.result(LOAD) == [0, 20]


@pytest.mark.slow
@pytest.mark.more
def test_a_changed_callee_is_compiled_again(workshop: Workshop) -> None:
    """Numba alone would call the code of the old one, since the caller's file is the same."""
    assert workshop.result(LOAD) == [1, 20]
    workshop.write(added=5)

    assert workshop.result(LOAD_IF_COMPILED) == [False, True]

    assert workshop.result(LOAD) == [1, 60]
    assert len(list(workshop.folder.rglob("*.stamp"))) == 1


@pytest.mark.slow
@pytest.mark.more
def test_an_incomplete_cache_is_not_used(workshop: Workshop) -> None:
    workshop.result(LOAD)
    for path in workshop.folder.rglob("fake_outer.*.nb?"):
        path.unlink()

    assert workshop.result(LOAD_IF_COMPILED) == [False, True]
    assert workshop.result(LOAD) == [1, 20]


@pytest.mark.slow
@pytest.mark.more
def test_a_process_that_found_kernels_missing_loads_them_when_they_are_compiled(
    workshop: Workshop,
) -> None:
    program = """
first = fake.load_if_compiled()
input_ = sys.stdin.readline()
print(json.dumps([first, fake.known_missing, fake.load_if_compiled(), len(calls), outer()(1)]))
"""
    command = [sys.executable, "-c", PROGRAM + program, str(workshop.folder)]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=workshop.environment,
    ) as waiting:
        deadline_s = time.monotonic() + 60.0
        while not list(workshop.folder.glob("cache/*")) and time.monotonic() < deadline_s:
            time.sleep(0.05)
        workshop.result(LOAD)
        out, _ = waiting.communicate("\n", timeout=60.0)
    assert printed(out) == [False, False, True, 0, 20]


@pytest.mark.slow
@pytest.mark.more
def test_one_of_several_processes_compiles(workshop: Workshop) -> None:
    processes = [workshop.start(LOAD) for _ in range(3)]

    found = [printed(process.communicate(timeout=120.0)[0]) for process in processes]

    assert sorted(found) == [[0, 20], [0, 20], [1, 20]]


@pytest.mark.slow
@pytest.mark.more
def test_a_killed_compilation_leaves_no_lock(workshop: Workshop) -> None:
    program = """
with fake.compilation_lock():
    print("locked", flush=True)
    sys.stdin.read()
"""
    command = [sys.executable, "-c", PROGRAM + program, str(workshop.folder)]
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=workshop.environment,
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        waiting = workshop.start(LOAD)
        with pytest.raises(subprocess.TimeoutExpired):
            waiting.wait(3.0)

        holder.send_signal(signal.SIGKILL)

        assert printed(waiting.communicate(timeout=60.0)[0]) == [1, 20]


@pytest.mark.slow
def test_without_a_folder_for_compiled_code_only_tappa_plans(workshop: Workshop) -> None:
    program = """
from laneweave.coordinator.planning.solve import plan
from laneweave.coordinator.planning.request import PlanRequest
request = PlanRequest.from_dict(json.loads(sys.argv[2]))
one, other = plan(request, compiled_only=True), plan(request, compiled_only=True)
try:
    plan(request)
except kernels.CacheError as error:
    print(json.dumps([one.solver, one.fallback, other.solver, str(error)]))
"""
    asked = json.dumps(attrs.evolve(EASY, solver="branching").to_dict())
    nowhere = workshop.environment | {
        "NUMBA_CACHE_DIR": "/proc/none",
        "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator",
    }
    done = run(sys.executable, "-c", PROGRAM + program, str(workshop.folder), asked, env=nowhere)
    assert done.returncode == 0, done.stderr
    *answers, error = printed(done.stdout)
    assert answers == ["tappa", True, "tappa"]
    assert "NUMBA_CACHE_DIR" in error


# --- the real kernels -------------------------------------------------------------------------


def test_all_kernels_that_plans_use_are_loaded() -> None:
    """No later request compiles, whatever it asks for."""
    for kernels in KERNELS.values():
        kernels.load()
    with _without_compiling():
        for vehicles, solver in ((6, "branching"), (18, "branching"), (6, "tappa")):
            assert plan(formation_request(1, vehicles=vehicles, deadline_s=2.0), solver=solver)
        assert plan(HARD, max_nodes=60, solver="tappa").fallback
    assert all(kernels.loaded and not kernels.known_missing for kernels in KERNELS.values())


def test_loading_calls_the_kernels_of_the_joint_search() -> None:
    """Otherwise the first plan that needs one of them would compile it."""
    BRANCHING.load()
    called = (add_goals, fill_slots, search)
    assert all(kernel.signatures for kernel in called)


class _Missing:
    """Stand-in for kernels that are not compiled."""

    name = "branching"

    def __init__(self, *, known: bool) -> None:
        self.known_missing = known
        self.asked = 0

    def available(self, *, compiled_only: bool) -> bool:
        assert compiled_only
        self.asked += 1
        return False


@pytest.mark.parametrize("known", [True, False])
def test_tappa_answers_while_branching_is_not_compiled(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = _Missing(known=known)
    monkeypatch.setattr(solve, "BRANCHING", missing)
    monkeypatch.setattr(tappa, "BRANCHING", missing)

    easy = plan(EASY, compiled_only=True)
    asked = plan(EASY, solver="branching", compiled_only=True)
    hard = plan(HARD, max_nodes=60, solver="tappa", compiled_only=True)

    assert (easy.status, easy.solver, easy.fallback) == ("optimal", "tappa", False)
    assert (asked.status, asked.solver, asked.fallback) == ("optimal", "tappa", True)
    assert asked.cost == easy.cost
    assert (hard.status, hard.solver, hard.fallback) == ("timeout", "tappa", False)
    # A process that knows that branching is missing leaves TAPPA all nodes.
    assert (hard.nodes_expanded > solve.TAPPA_SHARE * 60 + 1) == known
    # TAPPA asks once for its joint search.
    assert missing.asked == (1 if known else 4)
