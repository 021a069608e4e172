"""Roles are killed and stopped: `laneweave status` says which, and when it is over."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from attrs import define, field

from laneweave.launch.cli.status_command import listen
from laneweave.launch.observe.observed import Expected
from laneweave.launch.observe.status import Status
from laneweave.protocol.config.scenario_files import load_scenario
from support.deployments import free_tcp, start_router, stop
from support.harness import END_S, ROAD, Lab

LOOK_S = 2.0
"""As long as the command listens by default."""
DEPLOYMENT = """
[demand]
volume_veh_per_lane_h = 1300.0
duration_s = 900.0

[network]
realm = "findings"
endpoint = "{endpoint}"

[runtime]
coordinators = 2

[security]
fleets = {{ a = "0/2", b = "1/2" }}
"""
ROLES = {
    "c1": ("coordinator", "--name", "c1"),
    "c2": ("coordinator", "--name", "c2"),
    "a": ("agent", "--fleet", "a"),
    "b": ("agent", "--fleet", "b"),
    "bridge": ("bridge", "--pace", "1"),
}


@define
class Deployment:
    """The roles of a deployment by name."""

    lab: Lab
    config: Path
    running: dict[str, subprocess.Popen[str]] = field(factory=dict)

    def start(self, name: str) -> None:
        command, *options = ROLES[name]
        self.running[name] = self.lab.start(command, "--config", self.config, *options)

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        self.lab.finish(process, END_S)

    def signal(self, name: str, number: signal.Signals) -> None:
        self.running[name].send_signal(number)

    def status(self) -> Status:
        scenario = load_scenario(self.config)
        return listen(scenario, LOOK_S, Expected.of(scenario, bridge=True))

    def findings(self) -> set[tuple[str, str]]:
        return {(one.rule, one.process) for one in self.status().findings}

    def wait_for(self, condition: Callable[[set[tuple[str, str]]], bool]) -> None:
        """Look until a condition holds for what was found; the last look is shown if it fails."""
        self.lab.wait_until(lambda: condition(self.findings()), END_S)

    def wait_for_health(self) -> None:
        self.wait_for(lambda found: not found)


def blames(process: str, found: set[tuple[str, str]]) -> bool:
    return process in {one for _, one in found}


@pytest.fixture
def deployment(lab: Lab) -> Iterator[Deployment]:
    text = ROAD + DEPLOYMENT.format(endpoint=free_tcp())
    found = Deployment(lab, lab.path("deployment.toml", text))
    router = start_router(lab, found.config)
    yield found
    for process in found.running.values():
        process.send_signal(signal.SIGTERM)
    for process in found.running.values():
        assert lab.finish(process, END_S).status == 0
    stop(lab, router)


@pytest.mark.more
def test_what_is_missing_is_found_and_forgotten_when_it_is_back(deployment: Deployment) -> None:
    assert ("no-bridge", "bridge") in deployment.findings()
    assert ("no-leader", "coordinator") in deployment.findings()
    for name in ROLES:
        deployment.start(name)
    deployment.wait_for_health()
    for name, rules in {
        "bridge": {("no-bridge", "bridge")},
        "a": {("fleet-missing", "fleet a"), ("unattended", "fleet a")},
        "c2": {("coordinator-missing", "coordinator c2")},
        "c1": {("coordinator-missing", "coordinator c1")},
    }.items():
        deployment.kill(name)
        deployment.wait_for(rules.__le__)
        # Nothing else is blamed.
        assert {process for _, process in deployment.findings()} == {
            process for _, process in rules
        }, name
        deployment.start(name)
        deployment.wait_for_health()


@pytest.mark.more
def test_a_second_bridge_does_not_start_while_the_first_one_drives(deployment: Deployment) -> None:
    lab, config = deployment.lab, deployment.config
    for name in ROLES:
        deployment.start(name)
    deployment.wait_for_health()
    second = lab.finish(lab.start("bridge", "--config", config, "--out", "second"), END_S)
    assert second.status == 1
    (line,) = second.complaints
    assert line.startswith("another bridge drives a road in realm findings, since ")
    assert line.endswith(": stop it, or start this one with --takeover")
    assert not (lab.folder / "second").exists()
    assert not deployment.findings()

    # With the option it does, and the finding says so.
    taken = lab.start("bridge", "--config", config, "--takeover", "--out", "taken")
    deployment.running["second"] = taken
    deployment.wait_for(partial(blames, "bridge"))
    assert ("several-bridges", "bridge") in deployment.findings()


@pytest.mark.more
def test_a_file_is_compared_with_a_bridge_before_a_role_starts(deployment: Deployment) -> None:
    lab, config = deployment.lab, deployment.config
    check = ("config", "check", config, "--against", "findings")
    absent = lab.run_forked(*check, alone=False)
    assert absent.status == 1
    assert absent.complaints[0].startswith("no bridge found in realm findings at ")
    deployment.start("bridge")
    deployment.wait_for(lambda found: ("no-bridge", "bridge") not in found)
    fits = lab.run_forked(*check, alone=False)
    assert (fits.status, fits.complaints) == (0, [])
    assert "settings are those of the bridge in realm findings" in " ".join(fits.out.split())
    text = config.read_text("utf-8") + "\n[formation]\ngap_m = 20.0\n"
    other = lab.path("other.toml", text)
    ended = lab.run_forked("config", "check", other, "--against", "findings", alone=False)
    assert ended.status == 2
    allowed = "15.0, as the bridge in realm findings"
    assert f"formation.gap_m: got 20.0; allowed: {allowed}" in ended.complaints


@pytest.mark.more
def test_what_hangs_is_found_and_forgotten_when_it_goes_on(deployment: Deployment) -> None:
    for name in ROLES:
        deployment.start(name)
    deployment.wait_for_health()
    for name, process in {"bridge": "bridge", "b": "fleet b", "c1": "coordinator c1"}.items():
        deployment.signal(name, signal.SIGSTOP)
        deployment.wait_for(partial(blames, process))
        deployment.signal(name, signal.SIGCONT)
        deployment.wait_for_health()
