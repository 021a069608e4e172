"""However a run ends, it ends soon, says why, keeps what it wrote, and leaves no process."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import pytest

from support.harness import (
    DEMAND,
    END_S,
    SHORT_ROAD,
    Lab,
    check_safe_and_complete,
    events,
    interrupt,
    summary,
)

FEW_PROCESSES = ("--vehicles-per-process", "4", "--coordinators", "2")


def start_and_wait(lab: Lab, road: Path, *options: str, entered: int = 2) -> subprocess.Popen[str]:
    """Start a run into `out` that does not end by itself soon, and wait until it is under way."""
    process = lab.start("run", road, *DEMAND, "--duration", "600", *options, "--out", "out")
    folder = lab.folder / "out"

    def is_under_way() -> bool:
        assert process.poll() is None, process.communicate()
        return len(events(folder, "entered")) >= entered

    lab.wait_until(is_under_way)
    return process


def check_files(folder: Path) -> None:
    """Check that a run's files are complete though the run is not."""
    assert summary(folder)["vehicles"]["entered"] > 0
    assert pq.read_table(folder / "trajectories.parquet").num_rows > 0
    assert pq.read_table(folder / "trips.parquet").num_rows > 0
    last = events(folder)[-1]
    assert (last["kind"], last["ending"]) == ("run-ended", "interrupted")
    assert summary(folder)["ending"] == "interrupted"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("simulated", [False, True])
def test_a_signal_ends_a_run(
    lab: Lab, road: Path, number: signal.Signals, *, simulated: bool
) -> None:
    options = ("--transport", "simulated") if simulated else (*FEW_PROCESSES, "--pace", "10")
    process = start_and_wait(lab, road, *options)

    if simulated or number is signal.SIGINT:
        interrupt(process, number)
    else:
        process.send_signal(number)

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    assert ("FAILED: interrupted" in ended.out) is not simulated
    assert ended.complaints == (["interrupted"] if simulated else [])
    lab.check_nothing_left()
    check_files(lab.folder / "out")


def test_ctrl_c_ends_a_run_whose_fork_server_is_not_ready(lab: Lab, road: Path) -> None:
    # With an empty cache a rolling run waits for half a minute.
    cache = lab.folder / "cache"
    process = lab.start(
        *("run", road, *DEMAND, "--operation", "rolling", "--out", "out"),
        NUMBA_CACHE_DIR=str(cache),
    )
    lab.wait_until(lambda: len(lab.processes()) > 1)

    interrupt(process, signal.SIGINT)

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    assert ended.complaints == ["interrupted"]
    lab.check_nothing_left()
    assert not (lab.folder / "out").exists()
    # The compilation ended with its launcher; the rolling planner has about 20 kernels.
    assert len(list(cache.rglob("*.nbi"))) < 15


@pytest.mark.parametrize("role", ["router", "bridge"])
def test_ctrl_c_ends_a_run_that_is_starting(lab: Lab, road: Path, role: str) -> None:
    process = lab.start("run", road, *DEMAND, "--coordinators", "1", "--out", "out")
    lab.wait_until(lambda: role in lab.roles())

    interrupt(process, signal.SIGINT)
    interrupt(process, signal.SIGINT)

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    assert ended.complaints in ([], ["interrupted"])
    lab.check_nothing_left()


def test_roles_end_when_the_supervisor_is_killed(lab: Lab, road: Path) -> None:
    process = start_and_wait(lab, road, *FEW_PROCESSES, "--pace", "10")

    process.kill()

    lab.wait_until(lambda: not lab.processes(), END_S)
    check_files(lab.folder / "out")


def test_a_run_ends_when_the_fork_server_is_killed(lab: Lab, road: Path) -> None:
    process = start_and_wait(lab, road, *FEW_PROCESSES, "--pace", "10")
    server = psutil.Process(lab.roles()["bridge"]).parent()
    assert server is not None

    server.kill()

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    # What is noticed first: a process that ended, or an agent that cannot be started.
    assert "FAILED: " in ended.out
    lab.wait_until(lambda: not lab.processes(), END_S)


@pytest.mark.parametrize(
    ("role", "number"),
    [
        ("bridge", signal.SIGKILL),
        ("bridge", signal.SIGTERM),
        ("router", signal.SIGKILL),
        pytest.param("router", signal.SIGTERM, marks=pytest.mark.full),
    ],
)
def test_a_run_ends_with_its_bridge_and_its_router(
    lab: Lab, road: Path, role: str, number: signal.Signals
) -> None:
    process = start_and_wait(lab, road, *FEW_PROCESSES, "--pace", "10")

    os.kill(lab.roles()[role], number)

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    assert "FAILED: " in ended.out
    if number is signal.SIGKILL:
        assert f"FAILED: the {role} ended with status -9" in ended.out
    lab.check_nothing_left()
    if (role, number) != ("bridge", signal.SIGKILL):
        check_files(lab.folder / "out")


def test_vehicles_arrive_though_an_agent_is_killed(lab: Lab) -> None:
    road = lab.path("short.toml", SHORT_ROAD)
    process = start_and_wait(lab, road, "--duration", "14", "--coordinators", "1")
    agent = next(name for name in sorted(lab.roles()) if name.startswith("agent-"))

    os.kill(lab.roles()[agent], signal.SIGKILL)

    ended = lab.finish(process)
    lab.check_nothing_left()
    check_safe_and_complete(lab.folder / "out")
    # A lost process is a failure, though nobody came to harm.
    assert ended.status == 1
    assert f"FAILED: {agent} ended with status -9" in ended.out


def test_the_reason_of_a_failure_is_printed(lab: Lab, road: Path) -> None:
    broken = lab.folder / "broken" / "libsumo"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise ImportError('libX11.so.6: cannot open')\n")

    ended = lab.run("run", road, *DEMAND, "--out", "out", PYTHONPATH=str(broken.parent))

    assert ended.status == 1
    assert "FAILED: the bridge ended with status 1: " in ended.out
    assert "libX11.so.6" in ended.out
