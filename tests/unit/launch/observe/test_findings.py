"""Findings: a test for each rule of the table, and that none of them is found in a healthy road."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from attrs import evolve, frozen

from laneweave.launch.observe.findings import RULES, Finding, Findings
from laneweave.launch.observe.observed import UNPLANNED_S, Expected
from laneweave.launch.observe.process_view import OtherVersion
from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario
from laneweave.protocol.runtime.transport import LinkDown
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.wire.codec import VERSION
from laneweave.protocol.wire.common_settings import CommonSettings
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.messages import Ballot, ClosedFormation, Name
from laneweave.protocol.wire.topics import Party
from support.observing import BRIDGE, ELECTION_S, WALL_S, Listener

OWN = settings_of(parse_scenario({}))
OTHER = settings_of(parse_scenario({"formation": {"gap_m": 20.0}}))
EXPECTED = Expected(
    bridge=True, coordinators=("c1", "c2"), fleets={"a": Shard(0, 2), "b": Shard(1, 2)}
)
IN_A, IN_B = "v0001", "v0004"
PROMISED = Ballot(1, Name("c1"), 1, 1)
FORMATIONS = (ClosedFormation(0, 2, 80.0), ClosedFormation(3, 5, 90.0))
"""Closed 40 and 30 s before the newest clock."""


def healthy(listener: Listener | None = None) -> Listener:
    """Return an observer of a deployment in good order."""
    listener = listener or Listener()
    for number, name in enumerate(("c1", "c2")):
        listener.coordinator(name)
        listener.heartbeat(name, 3, 1.9, leading=name == "c1")
        listener.process(Identity(Party.COORDINATOR, name), BRIDGE - 10 - number, OWN)
    listener.bridge()
    listener.process(Identity(Party.BRIDGE), BRIDGE, OWN)
    listener.fleet("a", "0-of-2", OWN)
    listener.fleet("b", "1-of-2", OWN)
    for vehicle in (IN_A, IN_B):
        listener.agent(vehicle)
    for tick in range(1180, 1201):
        listener.clock(tick, at_s=(tick - 1180) / 10)
    listener.census(1200, FORMATIONS, **{IN_A: 70.0, IN_B: 70.0})
    for vehicle, block in ((IN_A, 1), (IN_B, 4)):
        listener.states(vehicle, [1200], block=block, accepted=True, promised=PROMISED)
    listener.road_status(1.5)
    return listener


def found(listener: Listener, now_s: float = 2.0, **options: Any) -> list[Finding]:  # noqa: ANN401
    return listener.look(now_s, options.pop("expected", EXPECTED), **options)


def rules(findings: list[Finding]) -> list[tuple[str, str]]:
    return [(one.rule, one.process) for one in findings]


def test_a_shard_of_each_fleet_is_used() -> None:
    assert EXPECTED.fleets["a"].contains(IN_A)
    assert EXPECTED.fleets["b"].contains(IN_B)


def test_nothing_is_found_in_a_healthy_deployment() -> None:
    assert found(healthy()) == []
    for process in ("bridge", "coordinator c1", "coordinator c2", "fleet a", "fleet b"):
        assert found(healthy(), process=process) == []


def test_nothing_is_expected_of_a_service_alone() -> None:
    listener = Listener()
    listener.coordinator("c1")
    listener.heartbeat("c1", 3, 1.9, leading=True)
    assert listener.look(2.0, Expected()) == []


def test_nothing_is_found_after_the_end_of_a_road() -> None:
    listener = healthy()
    listener.clock(1201, ended=True)
    listener.bridge(up=False)
    listener.fleet("a", "0-of-2", OWN, up=False)
    for name in ("c1", "c2"):
        listener.heartbeat(name, 3, 9.9, leading=name == "c1")
    assert found(listener, 10.0) == []


@frozen
class Case:
    """What happens in a healthy deployment, and what is found then."""

    rule: str
    process: str
    words: str
    """Part of the text."""
    now_s: float = 2.0


def _happens(listener: Listener, rule: str) -> None:  # noqa: C901 (a table)
    match rule:
        case "link-lost":
            listener.view.update(LinkDown(), 1.0)
        case "overlap":
            listener.road_status(1.9, overlaps=2)
        case "other-version":
            listener.view.update(OtherVersion("fleet b", VERSION + 1), 1.0)
        case "no-bridge":
            listener.bridge(up=False)
        case "several-bridges":
            listener.bridge(incarnation=BRIDGE + 5)
            listener.road_status(1.9, bridge=BRIDGE + 5)
        case "clock-off":
            listener.road_status(1.9, clock_s=WALL_S + 72 * 3600.0)
        case "other-settings":
            listener.fleet("b", "1-of-2", OWN, up=False)
            listener.fleet("b", "1-of-2", OTHER)
        case "same-name":
            listener.heartbeat("c2", 3, 1.9, incarnation=2)
        case "no-leader":
            listener.heartbeat("c1", 3, 1.95)
        case "several-leaders":
            listener.heartbeat("c2", 3, 1.9, leading=True)
        case "coordinator-missing":
            listener.coordinator("c2", up=False)
        case "fleet-missing":
            listener.fleet("b", "1-of-2", OWN, up=False)
            listener.view.agent_tokens.pop(Name(IN_B))
        case "road-stands":
            listener.road_status(1.9, standing_s=7.0, awaited=(Name("v0005"),))
        case "unattended":
            listener.road_status(1.9, unattended={Name(IN_B): 12.0})
        case "nothing-planned":
            for vehicle, block in ((IN_A, 1), (IN_B, 4)):
                listener.states(vehicle, [1201], block=block)
        case "not-recorded":
            listener.road_status(1.9, recording=False)
        case _:
            raise AssertionError(rule)


CASES = [
    Case("link-lost", "router", "the connection to the router was lost"),
    Case("overlap", "bridge", "bodies have overlapped: 2 pairs"),
    Case(
        "other-version", "fleet b", f"messages of fleet b have version {VERSION + 1}, not {VERSION}"
    ),
    Case("no-bridge", "bridge", "the bridge disappeared at 120.0 s, before the end of its road"),
    Case("several-bridges", "bridge", "2 bridges are in this realm"),
    Case("clock-off", "bridge", "the clock of the bridge is 72 h ahead of that of this host"),
    Case("other-settings", "fleet b", "fleet b does not act on the road: settings of lattice"),
    Case("same-name", "coordinator c2", "2 coordinators have the name c2, which must be unique"),
    Case("no-leader", "coordinator", "there is no leader: 2 coordinators found"),
    Case("several-leaders", "coordinator c2", "c1 and c2 all lead"),
    Case("coordinator-missing", "coordinator c2", "no coordinator c2 found"),
    Case("fleet-missing", "fleet b", "no process found for the vehicles of shard 1/2"),
    Case("road-stands", "fleet b", "the road has stood at 120.0 s for 7 s, waiting for the agent"),
    Case("unattended", "fleet b", "1 vehicle has no agent, such as v0004 for 12 s"),
    Case("nothing-planned", "coordinator c1", "the newest closed 2 formations have no plan, for"),
    Case("not-recorded", "bridge", "the run is no longer recorded"),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.rule)
def test_each_situation_has_its_finding_alone(case: Case) -> None:
    listener = healthy()
    _happens(listener, case.rule)
    (finding,) = found(listener)
    assert (finding.rule, finding.process) == (case.rule, case.process)
    assert finding.what.startswith(case.words), finding.what
    assert finding.advice
    assert str(finding) == f"{finding.what}: {finding.advice}"


def test_a_bridge_that_hangs_is_silent() -> None:
    listener = healthy()
    for name in ("c1", "c2"):
        listener.heartbeat(name, 3, 4.9, leading=name == "c1")
    (finding,) = found(listener, 5.1)
    assert rules([finding]) == [("bridge-silent", "bridge")]
    assert finding.what == "nothing heard from the bridge for 3.6 s"
    fresh = Listener()
    fresh.bridge()
    assert rules(fresh.look(1.4, process="bridge")) == []
    assert rules(fresh.look(1.6, process="bridge")) == [("bridge-silent", "bridge")]


def test_a_coordinator_that_hangs_is_silent() -> None:
    listener = healthy()
    listener.heartbeat("c1", 3, 3.0, leading=True)
    listener.road_status(3.0)
    assert rules(found(listener, 3.1)) == [("coordinator-silent", "coordinator c2")]


def test_an_agent_of_a_vehicle_can_be_asked_for() -> None:
    expected = Expected(vehicles=("v0009", IN_A))
    listener = healthy()
    assert rules(listener.look(2.0, expected, "agent v0009")) == [("agent-missing", "agent v0009")]
    assert listener.look(2.0, expected, f"agent {IN_A}") == []


def test_every_rule_has_a_test() -> None:
    tested = {case.rule for case in CASES}
    assert tested | {"bridge-silent", "coordinator-silent", "agent-missing"} == {
        rule.name for rule in RULES
    }


def test_settings_that_differ_are_named_once_both_sides_are_known() -> None:
    listener = healthy()
    _happens(listener, "other-settings")
    listener.settings("bridge", "bridge", BRIDGE, OWN)
    listener.settings("fleet", "b", BRIDGE - 1, OTHER)
    (finding,) = found(listener)
    assert "formation.gap_m is 20.0 here, 15.0 at the bridge" in finding.what


def test_a_formation_that_came_too_late_is_no_finding_if_those_behind_it_are_planned() -> None:
    listener = healthy()
    listener.states(IN_A, [1201], block=1)
    assert found(listener) == []
    listener.states(IN_B, [1201], block=4)
    (finding,) = found(listener)
    assert finding.rule == "nothing-planned"
    assert UNPLANNED_S < 30.0


ROLLING = settings_of(parse_scenario({"formation": {"operation": "rolling"}}))
IN_S2 = settings_of(parse_scenario({"formation": {"operation": "rolling", "sort_in_s2": True}}))
EXIT = settings_of(load_scenario(Path("scenarios/off-ramp.toml")))
SORTED_M = 400.0 + 15.0 * UNPLANNED_S
"""Where vehicles of the paper's road have had time to sort."""


@pytest.mark.parametrize(
    ("settings", "changes", "planned"),
    [
        (ROLLING, {}, False),
        (OWN, {}, True),  # formations, which have closed later
        (ROLLING, {"v0003": {"promised": PROMISED}}, True),
        (ROLLING, {"v0003": {"hold_cell": (-9, 0)}}, True),  # in its lane
        (ROLLING, {"v0003": {"attended": False}}, True),
        (ROLLING, {"v0003": {"s_m": SORTED_M - 1.0}}, True),
        (ROLLING, {"v0001": {"promised": PROMISED}}, True),
        (IN_S2, {}, False),
        (IN_S2, {"v0003": {"s_m": 15.0 * (10.0 + 4.0 + UNPLANNED_S) + 1.0}}, False),
        (IN_S2, {"v0003": {"s_m": 15.0 * (10.0 + 4.0 + UNPLANNED_S) - 1.0}}, True),
        (EXIT, {}, True),
        (ROLLING, {"v0001": {"promised": PROMISED}, "v0004": {}}, False),
    ],
)
def test_vehicles_of_the_rolling_operation_in_no_plan(
    settings: CommonSettings, changes: dict[str, dict[str, Any]], *, planned: bool
) -> None:
    listener = healthy()
    names = sorted({"v0001", "v0002", "v0003"} | changes.keys())
    entered_s = {name: 70.0 + number for number, name in enumerate(names)}
    listener.census(1201, (), **entered_s)
    for name in names:
        values = {"hold_cell": (-9, 1), "s_m": SORTED_M + 1.0, "promised": None}
        listener.states(name, [1201], **values | changes.get(name, {}))
    listener.settings("bridge", "bridge", BRIDGE, settings)
    nothing = [("nothing-planned", "coordinator c1")]
    assert rules(found(listener)) == ([] if planned else nothing)
    # Vehicles that have just entered, from a ramp, may still get a plan.
    listener.census(1202, (), **dict.fromkeys(names, 110.0))
    assert rules(found(listener)) == []


def test_a_condition_must_last_unless_it_was_so_all_the_time() -> None:
    listener = healthy()
    findings = Findings(EXPECTED, 0.0, ELECTION_S)

    def look(now_s: float, *, last: bool = False) -> list[Finding]:
        for name in ("c1", "c2"):
            listener.heartbeat(name, 3, now_s - 0.1, leading=name == "c1")
        listener.road_status(now_s)
        return findings.look(listener.view, now_s, WALL_S + now_s, last=last)

    assert look(2.0) == []
    listener.fleet("b", "1-of-2", OWN, up=False)
    listener.view.agent_tokens.pop(Name(IN_B))
    assert look(3.0) == look(3.5) == look(3.6, last=True) == []
    (finding,) = look(4.1)
    assert finding.for_s == pytest.approx(1.1)
    listener.fleet("b", "1-of-2", OWN)
    assert look(4.2) == []
    listener.fleet("b", "1-of-2", OWN, up=False)
    assert look(4.3) == []
    # A single look, which cannot know how long it has been so.
    assert rules(listener.look(4.4, EXPECTED)) == [("fleet-missing", "fleet b")]


def test_shards_that_no_file_names_follow_from_those_that_are_there() -> None:
    listener = healthy()
    listener.fleet("b", "1-of-2", OWN, up=False)
    listener.view.agent_tokens.pop(Name(IN_B))
    expected = evolve(EXPECTED, fleets={})
    assert rules(found(listener, expected=expected)) == [("fleet-missing", "fleet 1-of-2")]


def test_a_bridge_of_the_release_before_says_in_states_who_has_no_agent() -> None:
    listener = healthy()
    listener.view.processes.road_statuses.clear()
    listener.states(IN_B, [1201], block=4, attended=False)
    assert rules(found(listener, 1.0)) == []
    assert rules(found(listener, 2.0)) == [("unattended", "fleet b")]
