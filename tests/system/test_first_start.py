"""The first start after an installation: no solver is compiled, and nothing waits for it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import urllib.request
from pathlib import Path

import psutil
import pytest

from support.deployments import ask, deployment, free_tcp, start_router, stop
from support.harness import DEMAND, END_S, RUN_S, Lab, summary
from support.service_lab import request

REQUEST = request()
NEEDED_S = 400.0
"""Limit for a compilation of low priority; it takes half a minute on an idle machine."""
ROOT = Path(__file__).resolve().parents[2]
CASE = ROOT / "docs" / "examples" / "case-study.json"


def available(address: str) -> bool:
    """Return whether a coordinator says that branching can be used."""
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=END_S) as answer:
        text = answer.read().decode()
    assert 'laneweave_solver_available{solver="tappa"} 1.0' in text
    return 'laneweave_solver_available{solver="branching"} 1.0' in text


def compilers(lab: Lab) -> list[psutil.Process]:
    """Return the processes that compile."""
    found = []
    for process in lab.processes():
        with contextlib.suppress(psutil.NoSuchProcess):
            if any("compile_for_parent" in word for word in process.cmdline()):
                found.append(process)
    return found


def compiled(cache: Path) -> bool:
    return next(cache.rglob("*.nbi"), None) is not None


def test_a_plan_compiles_nothing(lab: Lab) -> None:
    cache = lab.folder / "cache"

    ended = lab.run("plan", CASE, NUMBA_CACHE_DIR=str(cache))

    answer = json.loads(ended.out)
    assert (ended.status, ended.complaints) == (0, [])
    assert (answer["status"], answer["solver"]) == ("optimal", "tappa")
    assert not compiled(cache)


@pytest.mark.more
def test_coordinators_answer_while_one_of_them_compiles(lab: Lab) -> None:
    cache = {"NUMBA_CACHE_DIR": str(lab.folder / "cache")}
    config = deployment(lab, free_tcp())
    router = start_router(lab, config)
    addresses = [free_tcp().removeprefix("tcp/") for _ in range(2)]
    coordinators = [
        lab.start(
            *("coordinator", "--config", config, "--name", f"c{number}", "--metrics", address),
            **cache,
        )
        for number, address in enumerate(addresses, start=1)
    ]
    lab.wait_until(lambda: ask(lab, config, REQUEST).status == 0, END_S)

    first = json.loads(ask(lab, config, REQUEST).out)
    other = json.loads(ask(lab, config, REQUEST, "--solver", "branching").out)
    assert (first["solver"], first.get("fallback", False)) == ("tappa", False)
    assert (other["solver"], other["fallback"]) == ("tappa", True)
    assert other["cost"] == first["cost"]
    lab.wait_until(lambda: len(compilers(lab)) == 1, END_S)
    assert not any(map(available, addresses))

    # Another coordinator continues what a killed one has begun.
    (compiler,) = compilers(lab)
    assert compiler.nice() > os.nice(0)
    owner = compiler.ppid()
    (index,) = (i for i, one in enumerate(coordinators) if one.pid == owner)
    coordinators[index].send_signal(signal.SIGKILL)
    lab.finish(coordinators.pop(index), END_S)
    del addresses[index]
    lab.wait_until(lambda: [one.ppid() for one in compilers(lab)] == [coordinators[0].pid], END_S)

    lab.wait_until(lambda: available(addresses[0]), NEEDED_S)
    answer = json.loads(ask(lab, config, REQUEST, "--solver", "branching").out)
    assert (answer["solver"], answer.get("fallback", False)) == ("branching", False)
    assert (answer["status"], answer["cost"]) == ("optimal", first["cost"])
    assert compilers(lab) == []
    stop(lab, *coordinators, router)
    lab.check_nothing_left()


@pytest.mark.more
def test_a_run_of_formations_does_not_wait_for_a_solver(lab: Lab, road: Path) -> None:
    cache = lab.folder / "cache"

    ended = lab.run(
        *("run", road, *DEMAND, "--vehicles-per-process", "20", "--coordinators", "1"),
        *("--out", "out"),
        within_s=RUN_S,
        NUMBA_CACHE_DIR=str(cache),
    )

    assert (ended.status, ended.complaints) == (0, []), ended
    out = lab.folder / "out"
    log = [json.loads(line) for line in (out / "log.jsonl").read_text("utf-8").splitlines()]
    assert "a solver is being compiled; until then TAPPA makes all plans" in [
        entry["event"] for entry in log
    ]
    plans = summary(out)["planning"]
    assert plans["plans"] > 0
    assert plans["by_solver"]["tappa"] == plans["plans"]


@pytest.mark.full
@pytest.mark.parametrize("options", [("--operation", "rolling"), ("--solver", "branching")])
def test_a_run_that_needs_a_solver_waits_for_it(
    lab: Lab, road: Path, options: tuple[str, str]
) -> None:
    cache = lab.folder / "cache"
    process = lab.start(
        *("run", road, *DEMAND, *options, "--out", "out"), NUMBA_CACHE_DIR=str(cache)
    )
    lab.wait_until(lambda: compiled(cache), END_S)

    os.killpg(process.pid, signal.SIGINT)

    ended = lab.finish(process, END_S)
    assert (ended.status, ended.complaints) == (1, ["interrupted"])
    assert f"solver={options[1]}" in ended.err
    lab.check_nothing_left()
    assert not (lab.folder / "out").exists()


@pytest.mark.more
def test_a_run_whose_solver_cannot_be_compiled_says_why(lab: Lab, road: Path) -> None:
    ended = lab.run(
        *("run", road, *DEMAND, "--operation", "rolling", "--out", "out"),
        NUMBA_CACHE_DIR="/proc/none",
        NUMBA_CACHE_LOCATOR_CLASSES="UserProvidedCacheLocator",
    )

    assert ended.status == 1
    (line,) = ended.complaints
    assert line.startswith("rolling: cannot be compiled: ")
    assert "NUMBA_CACHE_DIR" in line
