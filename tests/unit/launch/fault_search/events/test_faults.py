"""Faults are done, undone and counted; what is injected as malformed is malformed."""

from __future__ import annotations

import random

import pytest

from laneweave.launch.fault_search.events.faults import FaultEvent
from laneweave.launch.fault_search.events.lasting_faults import HEALTHY, LastingFaults
from laneweave.launch.fault_search.fault_run import FaultRun
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.story import Story
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import Node
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.wire.codec import decode
from laneweave.protocol.wire.topics import Keys


@pytest.fixture
def world() -> FaultRun:
    """A calm world that has run for two seconds."""
    world = FaultRun(Story.drawn(3, PROFILES["calm"]))
    world.network.run(2.0)
    return world


def harm(world: FaultRun, kind: str) -> None:
    world.faults.apply(FaultEvent(world.network.now_s, kind, 1))


def test_malformed_bytes_are_malformed(world: FaultRun) -> None:
    keys = Keys(world.setup.scenario.network.realm)
    for _ in range(2000):
        key, payload = world.faults.messages._malformed()
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
    network.run(network.now_s + 0.6)  # a vehicle that holds is silent for half a second
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


def test_an_unknown_fault_is_an_error() -> None:
    with pytest.raises(BadInputError, match="got 'rain'; allowed: leader-kill"):
        FaultEvent(1.0, "rain", 1)


def test_lasting_faults_are_counted() -> None:
    lasting = LastingFaults.drawn(PROFILES["clocks"], random.Random(1))
    kinds = lasting.kinds()
    assert kinds["wrong-clocks"] == 1
    assert ("loss" in kinds) == (lasting.conditions.loss > 0)
    assert LastingFaults.drawn(PROFILES["calm"], random.Random(1)).kinds() == {}


@pytest.mark.more
@pytest.mark.slow
def test_every_kind_in_a_profile_can_be_applied() -> None:
    for kind in sorted({kind for profile in PROFILES.values() for kind in profile.event_kinds}):
        world = FaultRun(Story.drawn(3, PROFILES["calm"]))
        world.network.run(2.0)
        harm(world, "agent-kill")  # there are states of earlier processes
        world.network.run(6.0)
        harm(world, kind)
        assert world.faults.counts[kind] >= (kind != "harmful-plan"), kind
        world.network.run(8.0)
        assert world.checker.violations == [], kind


def test_a_changed_plan_is_counted_when_it_is_sent_and_refused_by_all() -> None:
    world = FaultRun(Story.drawn(3, PROFILES["calm"]))
    harm(world, "harmful-plan")
    assert world.faults.counts["harmful-plan"] == 0
    world.network.run(6.0)
    assert world.faults.counts["harmful-plan"] == 1
    assert len(world.checker.claims.harmful) == 1
    assert world.checker.violations == []


def test_another_road_begins_after_a_restart_of_the_bridge(world: FaultRun) -> None:
    before = world.road
    harm(world, "road-restart")
    assert "road" not in world.network
    world.faults.heal()
    world.network.run(4.0)
    assert world.road is not before
    assert world.road.began_s > before.began_s
    assert world.road.vehicles.keys() == before.vehicles.keys()


def _rejected(network: SimulatedNetwork) -> int:
    nodes: list[Node] = [network.node(name) for name in network.names]
    return sum(node.rejected for node in nodes)
