"""However a run ends, it ends soon, says why, keeps what it wrote, and leaves no process."""

from __future__ import annotations

import fcntl
import os
import random
import shutil
import signal
import subprocess
import termios
import time
from functools import partial
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


def check_files(folder: Path, *, entered: int = 1) -> None:
    """Check that a run's files are complete though the run is not."""
    assert summary(folder)["vehicles"]["entered"] >= entered
    trips = pq.read_table(folder / "trips.parquet")
    assert trips.num_rows - trips["entered_s"].null_count == summary(folder)["vehicles"]["entered"]
    assert pq.read_table(folder / "trajectories.parquet").num_rows >= entered
    last = events(folder)[-1]
    assert (last["kind"], last["ending"]) == ("run-ended", "interrupted")
    assert summary(folder)["ending"] == "interrupted"


SIMULATED = ("--transport", "simulated")
OVER_ZENOH = (*FEW_PROCESSES, "--pace", "10")


@pytest.mark.parametrize(
    ("options", "to_group"),
    [
        (OVER_ZENOH, True),
        *(
            pytest.param(options, to_group, marks=pytest.mark.more)
            for options, to_group in (
                (OVER_ZENOH, False),
                (SIMULATED, False),
                (SIMULATED, True),
                (("--method", "rule"), False),
                (("--method", "rule"), True),
            )
        ),
    ],
)
def test_a_signal_ends_a_run(
    lab: Lab, road: Path, options: tuple[str, ...], *, to_group: bool
) -> None:
    process = start_and_wait(lab, road, *options)

    if to_group:
        interrupt(process, signal.SIGINT)
    else:
        process.send_signal(signal.SIGTERM)

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    assert "FAILED" not in ended.out
    (said,) = ended.complaints
    assert said.startswith("interrupted at ")
    assert said.endswith("s of road time; the data so far: out")
    assert "vehicles left" in ended.out
    lab.check_nothing_left()
    check_files(lab.folder / "out")
    assert summary(lab.folder / "out")["runtime"]["processes"] is not None


@pytest.mark.timeout(2400)
@pytest.mark.parametrize("tries", [3, pytest.param(20, marks=pytest.mark.full)])
@pytest.mark.parametrize("options", [OVER_ZENOH, SIMULATED], ids=["zenoh", "simulated"])
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
@pytest.mark.more
def test_a_signal_to_the_group_ends_a_run_in_good_order_at_any_moment(
    lab: Lab, road: Path, number: signal.Signals, options: tuple[str, ...], tries: int
) -> None:
    moments = random.Random(f"{number.name} {options} {tries}")
    recorded = 0
    for attempt in range(tries):
        out = lab.folder / f"out-{attempt}"
        process = lab.start("run", road, *DEMAND, "--duration", "600", *options, "--out", out.name)
        # While the command starts, once the folder exists, when files are opened, under way.
        stage = (
            lambda: True,
            out.exists,
            (out / "trips.parquet").exists,
            partial(has_entered, out, 5),
        )[attempt % 4]
        lab.wait_until(stage)
        time.sleep(moments.uniform(0.0, 1.5))

        interrupt(process, number)

        ended = lab.finish(process, END_S)
        lab.check_nothing_left()
        if ended.status == -number:  # before Python could handle signals
            assert not out.exists()
            continue
        assert (ended.status, len(ended.complaints)) == (1, 1), ended
        assert ended.complaints[0].startswith("interrupted")
        assert "FAILED" not in ended.out
        if out.exists():
            recorded += 1
            check_files(out, entered=0)
    assert recorded >= tries // 3


def has_entered(folder: Path, vehicles: int) -> bool:
    return len(events(folder, "entered")) > vehicles


@pytest.mark.more
def test_a_run_goes_on_if_its_terminal_is_closed_under_nohup(lab: Lab, road: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        process = start_and_wait(lab, road, *SIMULATED)
    finally:
        signal.signal(signal.SIGHUP, before)

    interrupt(process, signal.SIGHUP)
    here = len(events(lab.folder / "out", "entered"))
    lab.wait_until(partial(has_entered, lab.folder / "out", here + 3))

    interrupt(process, signal.SIGTERM)
    assert lab.finish(process, END_S).complaints[0].startswith("interrupted at ")


@pytest.mark.more
def test_a_run_ends_in_good_order_when_its_terminal_is_closed(lab: Lab, road: Path) -> None:
    terminal, process = start_in_terminal(
        lab, "run", road, *DEMAND, "--duration", "600", *OVER_ZENOH, "--out", "out", "--report"
    )
    lab.wait_until(partial(has_entered, lab.folder / "out", 5))

    os.close(terminal)  # the kernel sends SIGHUP, and output fails from now on

    assert process.wait(END_S) == 1
    lab.check_nothing_left()
    check_files(lab.folder / "out")
    assert (lab.folder / "out" / "report.html").exists()


def start_in_terminal(lab: Lab, *arguments: object) -> tuple[int, subprocess.Popen[str]]:
    """Start a command in a terminal of its own; return the terminal's other end."""
    ours, theirs = os.openpty()

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    streams = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    process = lab.start_with(streams | {"preexec_fn": take_terminal}, *arguments)
    os.close(theirs)
    return ours, process


@pytest.mark.more
def test_what_killed_runs_left_is_removed_at_the_next_start(lab: Lab, road: Path) -> None:
    own = lab.sockets / "laneweave-results"
    own.mkdir()
    (own / "notes.txt").touch()
    live = start_and_wait(lab, road, *SIMULATED)
    (of_live_run,) = set(lab.sockets.iterdir()) - {own}
    processes = [
        lab.start("run", road, *DEMAND, "--duration", "600", *options, "--out", f"killed-{number}")
        for number, options in enumerate((OVER_ZENOH, SIMULATED))
    ]
    for number, process in enumerate(processes):
        folder = lab.folder / f"killed-{number}"
        lab.wait_until(partial(has_entered, folder, 0))
        process.kill()
        process.wait()
    lab.wait_until(lambda: len(lab.processes()) == 1, END_S)
    left = set(lab.sockets.iterdir()) - {own, of_live_run}
    assert len(left) >= len(processes)

    short = ("--duration", "1", *SIMULATED)
    assert lab.finish(lab.start("run", road, *DEMAND, *short, "--out", "next")).status == 0

    assert set(lab.sockets.iterdir()) == {own, of_live_run}
    interrupt(live, signal.SIGTERM)
    lab.finish(live, END_S)
    assert list(lab.sockets.iterdir()) == [own]
    shutil.rmtree(own)


@pytest.mark.more
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
@pytest.mark.more
def test_ctrl_c_ends_a_run_that_is_starting(lab: Lab, road: Path, role: str) -> None:
    process = lab.start("run", road, *DEMAND, "--coordinators", "1", "--out", "out")
    lab.wait_until(lambda: role in lab.roles())

    interrupt(process, signal.SIGINT)
    interrupt(process, signal.SIGINT)

    ended = lab.finish(process, END_S)
    assert ended.status == 1
    assert len(ended.complaints) == 1
    assert ended.complaints[0].startswith("interrupted")
    lab.check_nothing_left()


def test_roles_end_when_the_supervisor_is_killed(lab: Lab, road: Path) -> None:
    process = start_and_wait(lab, road, *FEW_PROCESSES, "--pace", "10")

    process.kill()

    lab.wait_until(lambda: not lab.processes(), END_S)
    check_files(lab.folder / "out")


@pytest.mark.more
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
        ("bridge", signal.SIGUSR1),
        ("router", signal.SIGKILL),
        pytest.param("router", signal.SIGUSR1, marks=pytest.mark.full),
    ],
)
@pytest.mark.more
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


@pytest.mark.more
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


@pytest.mark.more
def test_the_reason_of_a_failure_is_printed(lab: Lab, road: Path) -> None:
    broken = lab.folder / "broken" / "libsumo"
    broken.mkdir(parents=True)
    (broken / "__init__.py").write_text("raise ImportError('libX11.so.6: cannot open')\n")

    ended = lab.run("run", road, *DEMAND, "--out", "out", PYTHONPATH=str(broken.parent))

    assert ended.status == 1
    assert "FAILED: the bridge ended with status 1: " in ended.out
    assert "libX11.so.6" in ended.out
