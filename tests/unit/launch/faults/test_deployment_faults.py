"""Processes of a deployment by hand: which ones get signals, and which never do."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from attrs import evolve

from laneweave.launch.faults.deployment_faults import DeploymentRoles
from laneweave.launch.faults.fault_file import FaultSpec, Kill, Pause
from laneweave.launch.faults.host_processes import NotOnThisHostError, find_process
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.observe.process_view import ProcessToken
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.wire import identities
from laneweave.protocol.wire.messages import Census, CensusEntry, Name
from support.waiting import wait_until

REALM = "r1"
SLEEP = "import time\nprint(flush=True)\ntime.sleep(600)\n"
Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a process with the command line of a role, which does nothing."""
    (tmp_path / "laneweave").write_text(SLEEP)
    (tmp_path / "other").write_text(SLEEP)
    for name, realm in (("d.toml", REALM), ("o.toml", "r2")):
        text = f'schema = "laneweave.scenario/1"\n[network]\nrealm = "{realm}"\n'
        (tmp_path / name).write_text(text)
    started: list[subprocess.Popen[str]] = []

    def start_process(*arguments: str, program: str = "laneweave") -> subprocess.Popen[str]:
        command = [sys.executable, program, *arguments]
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        process.stdout.readline()
        return process

    yield start_process
    for process in started:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def token_of(process: subprocess.Popen[str], role: str, name: str) -> ProcessToken:
    """Return the token that a process would declare now."""
    step = identities._STEP
    low_bits = (process.pid ^ identities._host_hash()) % step
    incarnation = time.time_ns() // step * step + low_bits
    return ProcessToken(role, name, incarnation, "none", "digests")


def reason(token: ProcessToken) -> str:
    with pytest.raises(NotOnThisHostError) as caught:
        find_process(token, REALM)
    return str(caught.value)


def test_a_process_is_found_by_its_token(start: Start) -> None:
    process = start("coordinator", "--config", "d.toml", "--name=c2")
    found = find_process(token_of(process, "coordinator", "c2"), REALM)
    assert found.pid == process.pid
    assert found.is_alive
    found.send(signal.SIGKILL)
    process.wait()
    assert not found.is_alive
    found.close()


@pytest.mark.parametrize(
    ("arguments", "role", "name", "vehicles"),
    [
        (("coordinator",), "coordinator", "c1", ()),
        (("bridge", "--takeover", "--out", "x"), "bridge", "bridge", ()),
        (("agent", "v1", "v2", "--metrics", "v3"), "agent", "v1", ("v1", "v2")),
        (("agent",), "fleet", "0-of-1", ("v1", "v2", "v3", "v4")),
    ],
)
def test_roles_and_the_vehicles_that_they_drive(
    start: Start, arguments: tuple[str, ...], role: str, name: str, vehicles: tuple[str, ...]
) -> None:
    process = start(*arguments, "--config", "d.toml")
    found = find_process(token_of(process, role, name), REALM)
    assert tuple(v for v in ("v1", "v2", "v3", "v4") if found.drives(v)) == vehicles
    found.close()


@pytest.mark.parametrize(
    ("program", "arguments", "why"),
    [
        ("laneweave", ("coordinator", "--config", "o.toml"), "realm r2"),
        ("laneweave", ("coordinator",), "realm default"),
        ("laneweave", ("coordinator", "--config", "d.toml", "--name", "c2"), "not a process of"),
        ("laneweave", ("bridge", "--config", "d.toml"), "not a process of"),
        ("laneweave", ("coordinator", "--config", "gone.toml"), "may be process"),
        ("laneweave", (), "not a process of"),
        ("other", ("coordinator", "--config", "d.toml"), "not a process of"),
    ],
)
def test_a_process_that_is_not_certainly_the_sender_gets_no_signal(
    start: Start, program: str, arguments: tuple[str, ...], why: str
) -> None:
    process = start(*arguments, program=program)
    assert why in reason(token_of(process, "coordinator", "c1"))


def test_a_process_of_another_host_or_time_or_user_gets_no_signal(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = start("coordinator", "--config", "d.toml")
    token = token_of(process, "coordinator", "c1")
    # The id may have belonged to an earlier process.
    hour = 3_600_000_000_000 // identities._STEP * identities._STEP
    assert reason(evolve(token, incarnation=token.incarnation - hour)).startswith("is not")
    # On another host the same number means another process: here this one, which runs pytest.
    low = (psutil.Process().pid ^ process.pid) % identities._STEP
    assert reason(evolve(token, incarnation=token.incarnation ^ low)).startswith("is not")
    owner = psutil.Process(process.pid).uids().real
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    assert "of another user" in reason(token)
    monkeypatch.undo()
    process.kill()
    process.wait()
    assert reason(token).startswith("is not")


def await_stopped(process: subprocess.Popen[str], *, stopped: bool) -> None:
    """Wait until a process is suspended, or no longer; a signal takes effect soon."""
    one = psutil.Process(process.pid)
    wait_until(lambda: (one.status() == psutil.STATUS_STOPPED) is stopped, 10.0)


def test_faults_affect_processes_by_name_and_vehicle(start: Start) -> None:
    one = start("coordinator", "--config", "d.toml")
    stranger = start("coordinator", "--config", "o.toml", "--name", "c2")
    agents = start("agent", "--config", "d.toml")
    view = RoadView()
    view.processes.tokens |= {
        token_of(one, "coordinator", "c1"),
        token_of(stranger, "coordinator", "c2"),
        token_of(agents, "fleet", "0-of-1"),
    }
    roles = DeploymentRoles(REALM, view)
    faults = FaultInjection(
        FaultSpec(
            pause=(Pause(target="c1", at_s=5.0, for_s=60.0),),
            # Any name is in the shard of the agents, but only v1 is a vehicle of the road.
            kill=(Kill(target="c2", at_s=5.0), Kill(target="v1", at_s=6.0)),
        ),
        1,
        roles,
        1.0,
    )
    view.census = Census(0.0, (CensusEntry(Name("v1"), (0, 0), 0, 0.0),), ())
    faults.step(5.0, 0.0, view)
    await_stopped(one, stopped=True)
    assert set(roles.running) == {"c1", "fleet-0-of-1"}
    assert [event.fault_name for event in faults.waiting] == ["kill[0]"]
    assert roles.elsewhere == {
        "coordinator c2": f"is process {stranger.pid}, whose file has realm r2 now"
    }
    assert agents.poll() is None

    faults.step(6.0, 1.0, view)
    assert agents.wait(10) == -signal.SIGKILL
    view.processes.tokens.clear()  # also that of the paused process: its lease has expired
    assert set(roles.running) == {"c1"}
    assert not faults.finished
    faults.resume_paused()
    await_stopped(one, stopped=False)
    assert stranger.poll() is None


def test_what_was_due_before_the_command_began_is_left_out() -> None:
    view = RoadView()
    kills = (Kill(target="c1", at_s=5.0), Kill(target="c1", at_s=90.0, every_s=10.0, times=3))
    faults = FaultInjection(FaultSpec(kill=kills), 1, DeploymentRoles(REALM, view), 1.0)
    faults.skip(100.0)
    faults.step(100.0, 0.0, view)
    assert [event.due_s for event in faults.waiting] == [100.0]
    late, unused = faults.unused_faults()
    assert late == "kill[0]: c1 was not killed at 5 s: the road was at 100.0 s already"
    assert unused.startswith("kill[1]: c1 was not killed at 90 s")
