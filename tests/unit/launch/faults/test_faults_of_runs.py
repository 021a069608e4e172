"""Fault injection into role processes and into the simulated network."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from laneweave.launch.faults.fault_file import (
    GROUPS,
    FaultSpec,
    Kill,
    LinkFault,
    Partition,
    Pause,
    load_faults,
)
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.faults.network_namespaces import (
    GroupNetwork,
    Link,
    NamespacesUnavailableError,
)
from laneweave.launch.faults.shared_counters import MessageFaults, SharedBoard
from laneweave.launch.library.recorded_run import load_run
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.local_run import add_faults, fault_injection
from laneweave.launch.run.outcome import Outcome
from laneweave.launch.run.role_processes import RoleProcesses, RoleStart
from laneweave.launch.run.roles import fork_server
from laneweave.launch.run.run_folder import LOG_FILE, repair_run
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import load_scenario, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.message_faults import MessageRule
from laneweave.protocol.scenario.fields import Scenario

LOSS = MessageRule(loss=0.5)
CUT = Partition(between=("coordinators", "others"), from_s=5.0)


def processes() -> RoleProcesses:
    """Return role processes, none of which is started."""
    return RoleProcesses(fork_server(), lambda _: ({}, {}), ("c1", "c2"))


def without_namespaces(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: GroupNetwork) -> None:
        raise NamespacesUnavailableError("not permitted")

    monkeypatch.setattr(GroupNetwork, "open", refuse)


# --- processes ------------------------------------------------------------------------------------


def injection_of(faults: FaultSpec) -> FaultInjection:
    return fault_injection(faults, Scenario(), processes())


@pytest.fixture
def board(tmp_path: Path) -> SharedBoard:
    return SharedBoard(tmp_path / "board")


def prepared(
    injection: FaultInjection, board: SharedBoard, role: str, name: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return tables and options of a role with faults."""
    tables, options = to_tables(Scenario()), {"folder": "f"}
    add_faults(injection, board, RoleStart(role, name, {}), tables, options)
    return tables, options


def test_each_start_of_a_role_gets_the_rules_and_its_own_seed(board: SharedBoard) -> None:
    injection = injection_of(FaultSpec(messages=(LOSS,), seed=9))
    given = [
        prepared(injection, board, role, name)[1]["faults"]
        for role, name in (
            *(("coordinator", "c1"), ("coordinator", "c1"), ("bridge", "bridge")),
            ("agent", "agent-v0001"),
        )
    ]
    assert all(isinstance(one, MessageFaults) and one.rules == (LOSS,) for one in given)
    assert [one.seed for one in given] == ["9/c1/1", "9/c1/2", "9/bridge/1", "9/agent-v0001/1"]
    assert [one.receiver for one in given] == ["coordinator", "coordinator", "bridge", "vehicle"]
    assert len({one.counter for one in given}) == 4


def test_the_router_has_no_message_faults(board: SharedBoard) -> None:
    injection = injection_of(FaultSpec(messages=(LOSS,)))
    expected = (to_tables(Scenario()), {"folder": "f"})
    assert prepared(injection, board, "router", "router") == expected


def test_without_namespaces_a_partition_drops_messages_and_gives_the_reason(
    board: SharedBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_namespaces(monkeypatch)
    injection = injection_of(FaultSpec(partition=(CUT,)))
    _, options = prepared(injection, board, "coordinator", "c1")
    assert options["faults"].rules == tuple(CUT.message_rules())
    assert injection.results(0)["faults"] == {
        "injected": [],
        "partition_methods": {"partition[0]": "messages"},
        "why_no_namespaces": "not permitted",
    }


def test_a_partition_that_requires_namespaces_is_refused_without_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without_namespaces(monkeypatch)
    required = Partition(between=("bridge", "others"), method="namespaces")
    with pytest.raises(BadInputError, match=r"partition\[1\].method: .*not permitted"):
        injection_of(FaultSpec(partition=(CUT, required)))


def test_lost_packets_are_refused_without_namespaces(monkeypatch: pytest.MonkeyPatch) -> None:
    without_namespaces(monkeypatch)
    for fault in (LinkFault(of="bridge", loss=0.1), LinkFault(delay_s=0.1)):
        with pytest.raises(BadInputError, match=r"link\[0\]: .*not permitted"):
            injection_of(FaultSpec(link=(fault,)))


def test_only_links_that_may_be_delayed_have_a_relay(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[GroupNetwork] = []

    def record(network: GroupNetwork) -> None:
        opened.append(network)

    monkeypatch.setattr(GroupNetwork, "open", record)
    monkeypatch.setattr(GroupNetwork, "check_filters", lambda _: None)
    faults = (LinkFault(of="bridge", jitter_s=0.1, from_s=5.0), LinkFault(loss=0.1))
    injection_of(FaultSpec(link=faults))
    (network,) = opened
    assert set(network.groups) == set(GROUPS)
    assert network.delayed == {"bridge"}


class _FakeNetwork(GroupNetwork):
    """Namespaces that are only names."""

    def process_id(self, name: str) -> int:
        return {"hub": 11, "coordinators": 12}[name]

    def set_links(self, links: Mapping[str, Link]) -> None:
        self._links = dict(links)


def test_links_follow_the_faults_in_force(board: SharedBoard) -> None:
    del board
    lossy = LinkFault(loss=0.1, from_s=1.0, until_s=4.0)
    bursts = LinkFault(of="coordinators", loss=0.2, burst=5, delay_s=0.1, jitter_s=0.2, from_s=2.0)
    cut = Partition(between=("coordinators", "others"), from_s=3.0, until_s=5.0)
    specification = FaultSpec(link=(lossy, bursts), partition=(cut,))
    network = _FakeNetwork(processes().context, GROUPS)
    injection = FaultInjection(specification, 1, processes(), 1.0, network)
    found = []
    for road_s in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        injection.step(road_s, road_s, RoadView())
        found.append([network._links.get(group) for group in ("bridge", "coordinators")])
    some, many, down = Link(loss=0.1), Link(True, 0.2, 5, 0.1, 0.2), Link(up=False)
    # The first table counts, and a cut before any loss.
    assert found == [
        [None, None],
        [some, some],
        [some, some],
        [some, down],
        [None, down],
        [None, many],
    ]
    assert [entry.get("link") for entry in injection.injected] == [
        "began", "began", None, "ended", None,
    ]  # fmt: skip


def test_with_namespaces_groups_reach_the_router_over_their_link(board: SharedBoard) -> None:
    roles = processes()
    pair = Partition(between=("vehicles", "bridge"))
    specification = FaultSpec(partition=(CUT, pair))
    network = _FakeNetwork(roles.context, ("coordinators",))
    injection = FaultInjection(specification, 1, roles, 1.0, network)

    _, router = prepared(injection, board, "router", "router")
    tables, coordinator = prepared(injection, board, "coordinator", "c1")
    bridge_tables, bridge = prepared(injection, board, "bridge", "bridge")

    assert (router["namespace"], router["listen"]) == (11, ("tcp/0.0.0.0:7447",))
    assert coordinator["namespace"] == 12
    assert tables["network"]["endpoint"] == "tcp/10.77.255.1:7447"
    assert "namespace" not in bridge
    assert bridge_tables == to_tables(Scenario())
    # A link cannot separate the pair: only its rules are there.
    assert bridge["faults"].rules == tuple(pair.message_rules())
    methods = injection.results(0)["faults"]["partition_methods"]
    assert methods == {"partition[0]": "namespaces", "partition[1]": "messages"}


# --- the simulated network ------------------------------------------------------------------------


@pytest.fixture
def simulate(tmp_path: Path) -> Callable[[str, FaultSpec], Outcome]:
    """Run a few vehicles over the simulated network."""
    scenario = load_scenario(
        None,
        road__s2_m=60.0,
        road__s3_m=240.0,
        demand__volume_veh_per_lane_h=1300.0,
        demand__duration_s=12.0,
    )

    def run(name: str, faults: FaultSpec) -> Outcome:
        return SimulatedRun(scenario, tmp_path / name, faults=faults, show_progress=False).run()

    return run


@pytest.mark.slow
@pytest.mark.more
def test_a_simulated_run_with_all_faults_is_repeatable(
    simulate: Callable[[str, FaultSpec], Outcome], tmp_path: Path
) -> None:
    faults = load_faults("everything", ("c1", "c2", "c3"))

    first, second = simulate("first", faults), simulate("second", faults)

    assert first.summary is not None
    assert second.summary is not None
    assert first.summary.safety.overlaps == 0
    assert first.summary.messages.dropped_by_faults > 0
    assert first.summary.faults is not None
    assert len(first.summary.faults["injected"]) >= 3
    for part in ("faults", "messages", "vehicles", "failover"):
        assert getattr(first.summary, part) == getattr(second.summary, part)
    name = "trajectories.parquet"
    tables = [pq.read_table(tmp_path / folder / name) for folder in ("first", "second")]
    assert tables[0].equals(tables[1])


@pytest.mark.slow
def test_a_simulated_run_supports_almost_all_faults(
    simulate: Callable[[str, FaultSpec], Outcome],
) -> None:
    found = simulate(
        "all",
        FaultSpec(
            kill=(
                Kill(at_s=5.0, restart_after_s=1.0),
                Kill(at_s=8.0, target="router", restart_after_s=1.0),
                Kill(at_s=10.0, target="agent", count=2, restart_after_s=0.5),
                Kill(at_s=12.0, target="v0003"),
            ),
            pause=(Pause(at_s=14.0, target="coordinator", for_s=2.0),),
            partition=(Partition(between=("bridge", "others"), from_s=16.0, until_s=17.0),),
        ),
    )
    assert found.problems == ()
    assert found.summary is not None
    assert found.summary.safety.overlaps == 0
    assert found.summary.faults is not None
    done = [one["fault"] for one in found.summary.faults["injected"]]
    kills = ["kill[0]", "kill[1]", "kill[2]", "kill[2]", "kill[3]"]
    assert done == [*kills, "pause[0]", "partition[0]", "partition[0]"]
    assert found.summary.faults["partition_methods"] == {"partition[0]": "messages"}
    assert len(found.summary.failover.recovery_s) == 1


def events_of(folder: Path, kind: str) -> list[dict[str, Any]]:
    lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    return [event for event in map(json.loads, lines) if event["kind"] == kind]


@pytest.mark.slow
def test_rules_between_single_processes_in_a_simulated_run(
    simulate: Callable[[str, FaultSpec], Outcome], tmp_path: Path
) -> None:
    """Without commands of its agent, only the named vehicle misses answers to ticks."""
    faults = load_faults(
        {
            "messages": [
                {"loss": 1.0, "from": "bridge", "to": "v0003", "until_s": 20.0},
                {"loss": 1.0, "between": ["v0001", "v0002"]},
            ]
        },
        ("c1", "c2", "c3"),
    )
    found = simulate("rules", faults)

    assert found.problems == ()
    assert found.summary is not None
    assert found.summary.safety.overlaps == 0
    assert found.summary.messages.dropped_by_faults > 0
    silent = {one["vehicle"] for one in events_of(tmp_path / "rules", "caretaker-took-over")}
    assert silent == {"v0003"}
    assert [
        (one["fault"], one["action"], one["target"], one["role"])
        for one in events_of(tmp_path / "rules", "fault-injected")
    ] == [
        ("messages[0]", "began", "bridge to v0003", "launcher"),
        ("messages[1]", "began", "v0001 and v0002", "launcher"),
        ("messages[0]", "ended", "bridge to v0003", "launcher"),
    ]


@pytest.mark.slow
def test_a_simulated_run_ends_with_its_killed_bridge(
    simulate: Callable[[str, FaultSpec], Outcome], tmp_path: Path
) -> None:
    faults = FaultSpec(
        kill=(Kill(at_s=8.0, target="bridge"), Kill(at_s=50.0)),
    )
    found = simulate("killed", faults)

    assert found.problems == ("the bridge was killed at 8.0 s by kill[0]",)
    assert found.exit_status == 1
    folder = tmp_path / "killed"
    (event,) = events_of(folder, "fault-injected")
    assert (event["target"], event["action"], event["t_s"]) == ("bridge", "killed", 8.0)
    assert events_of(folder, "run-ended") == []
    recorded = load_run(folder)
    assert recorded.summary.ending == "unfinished"
    assert recorded.summary.simulated_s == pytest.approx(8.0, abs=0.2)
    assert recorded.trajectories().num_rows > 0
    (folder / LOG_FILE).touch()  # `new_folder` makes it
    assert repair_run(folder).ending == "interrupted"


@pytest.mark.parametrize(
    ("faults", "name"),
    [
        (FaultSpec(pause=(Pause(at_s=1.0, target="router", for_s=1.0),)), "pause[0].target"),
        (
            FaultSpec(
                partition=(CUT, Partition(between=("bridge", "others"), method="namespaces"))
            ),
            "partition[1].method",
        ),
    ],
)
def test_unsupported_faults_are_refused(
    simulate: Callable[[str, FaultSpec], Outcome], tmp_path: Path, faults: FaultSpec, name: str
) -> None:
    with pytest.raises(BadInputError) as caught:
        simulate("out", faults)
    assert caught.value.field == name
    assert not (tmp_path / "out").exists()
