"""Faults are done, undone and counted; what is injected as malformed is malformed."""

from __future__ import annotations

import random

import pytest

from laneweave.launch.fault_search.fault_run import FaultRun
from laneweave.launch.fault_search.faults import HEALTHY, FaultMix
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import Node
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.wire.codec import decode
from laneweave.protocol.wire.topics import Keys


@pytest.fixture
def world() -> FaultRun:
    """A calm world that has run for two seconds."""
    world = FaultRun(3, PROFILES["calm"])
    world.network.run(2.0)
    return world


def harm(world: FaultRun, kind: str) -> None:
    world.faults._apply(kind)


def test_malformed_bytes_are_malformed(world: FaultRun) -> None:
    keys = Keys(world.setup.scenario.network.realm)
    for _ in range(2000):
        key, payload = world.faults._malformed()
        known = keys.read(key)
        kind = known[0].kind if known is not None else None
        if kind is not None:
            with pytest.raises(BadInputError):
                decode(payload, kind)


def test_malformed_bytes_arrive_and_are_dropped(world: FaultRun) -> None:
    before = _rejected(world.network)
    for _ in range(10):
        harm(world, "garbage")
    world.network.run(2.5)
    assert _rejected(world.network) > before
    assert world.checker.violations == []


def test_old_messages_are_delivered_once_more(world: FaultRun) -> None:
    delivered = world.network.delivered
    world.network.run(2.0001)
    harm(world, "replay")
    assert world.faults.counts["replay"] == 1
    world.network.run(2.05)
    assert world.network.delivered > delivered


@pytest.mark.parametrize("kind", ["leader-kill", "coordinator-kill", "agent-kill"])
def test_killed_processes_are_started_again(world: FaultRun, kind: str) -> None:
    all_nodes = set(world.network.names)
    harm(world, kind)
    assert len(all_nodes - set(world.network.names)) == 1
    world.faults.heal()
    assert set(world.network.names) == all_nodes


def test_the_leader_is_the_coordinator_that_leads(world: FaultRun) -> None:
    assert world.leaders == ("c1",)
    harm(world, "leader-kill")
    assert "c1" not in world.network


@pytest.mark.parametrize("kind", ["blackout", "partition", "router-loss", "cut"])
def test_a_network_that_was_broken_becomes_whole(world: FaultRun, kind: str) -> None:
    network = world.network
    dropped = network.dropped
    harm(world, kind)
    network.run(network.now_s + 0.3)
    assert network.dropped > dropped
    world.faults.heal()
    network.run(network.now_s + 1.0)
    assert network.conditions == HEALTHY
    dropped = network.dropped
    network.run(network.now_s + 1.0)
    assert network.dropped == dropped


@pytest.mark.slow
def test_faults_end_by_themselves(world: FaultRun) -> None:
    conditions = world.network.conditions
    harm(world, "blackout")
    harm(world, "partition")
    harm(world, "blackout")
    assert world.network.conditions.loss == 1.0
    world.network.run(8.0)
    assert world.network.conditions == conditions
    dropped = world.network.dropped
    world.network.run(9.0)
    assert world.network.dropped == dropped


def test_an_unknown_fault_is_an_error(world: FaultRun) -> None:
    with pytest.raises(ValueError, match="unknown fault: rain"):
        harm(world, "rain")


def test_lasting_faults_are_counted() -> None:
    mix = FaultMix.drawn(PROFILES["clocks"], random.Random(1))
    kinds = mix.kinds()
    assert kinds["wrong-clocks"] == 1
    assert ("loss" in kinds) == (mix.conditions.loss > 0)
    assert FaultMix.drawn(PROFILES["calm"], random.Random(1)).kinds() == {}


@pytest.mark.slow
def test_every_kind_in_a_profile_can_be_applied() -> None:
    for kind in sorted({kind for profile in PROFILES.values() for kind in profile.event_kinds}):
        world = FaultRun(3, PROFILES["calm"])
        world.network.run(2.0)
        harm(world, kind)
        assert world.faults.counts[kind] == 1, kind


def _rejected(network: SimulatedNetwork) -> int:
    nodes: list[Node] = [network.node(name) for name in network.names]
    return sum(node.rejected for node in nodes)
