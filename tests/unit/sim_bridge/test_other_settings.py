"""Processes whose settings differ from those of the bridge, on a simulated network."""

from __future__ import annotations

from pathlib import Path

import msgpack
import pytest

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.transports.simulated import network
from laneweave.protocol.wire.codec import encode
from laneweave.sim_bridge.core import TickPhase
from support.bridge_bench import Street, arrival, make_scenario, read_events

ROAD = {"lanes": 2, "s1_m": 20.0, "s2_m": 20.0, "s3_m": 240.0}
RIGHT = make_scenario(road=ROAD)
VEHICLES = [
    arrival(f"v{number}", 1.0 + 2.0 * number, lane=number % 2, preferred_lane=(number + 1) % 2)
    for number in range(6)
]
WRONG: dict[str, Scenario] = {
    "formation.gap_m": make_scenario(road=ROAD, formation={"gap_m": 20.0}),
    "formation.speed_mps": make_scenario(road=ROAD, formation={"speed_mps": 13.0}),
    "road.lane_width_m": make_scenario(road=ROAD | {"lane_width_m": 5.0}),
    "vehicle.max_jerk_mps3": make_scenario(road=ROAD, vehicle={"max_jerk_mps3": 10.0}),
}
ONLY_FOR_COORDINATORS = make_scenario(road=ROAD, formation={"settle_s": 9.0})


@pytest.fixture
def street(tmp_path: Path) -> Street:
    return Street(RIGHT, tmp_path, VEHICLES, pace=2.0)


def tokens(street: Street, of: str) -> set[str]:
    """Return what a member of the network has declared."""
    return set(street.network._members[of].declared.tokens)


@pytest.mark.parametrize("setting", WRONG)
def test_a_fleet_that_does_not_fit_never_takes_charge(street: Street, setting: str) -> None:
    street.start_coordinators()
    host = street.start_shard(scenario=WRONG[setting])
    street.run()
    assert not street.agents
    assert not host.metrics[0].vehicles  # type: ignore[attr-defined]
    assert len(tokens(street, "shard-0")) == 1  # its own
    assert len(read_events(street.folder, "left")) == len(VEHICLES)
    assert not read_events(street.folder, "agent-took-over")
    (refused,) = read_events(street.folder, "settings-refused")
    assert refused["process"] == "fleet 0-of-1"
    own, other = refused["settings"][setting]
    assert own != other


def test_a_fleet_drives_that_differs_only_in_what_it_does_not_use(street: Street) -> None:
    street.start_coordinators()
    street.start_shard(scenario=ONLY_FOR_COORDINATORS)
    street.run()
    assert not read_events(street.folder, "settings-refused")
    assert not read_events(street.folder, "agent-missing")
    assert not read_events(street.folder, "caretaker-took-over")


def test_a_coordinator_that_does_not_fit_leaves_the_lead_to_one_that_does(street: Street) -> None:
    misfit = street.start_coordinator("a-first", 1, ONLY_FOR_COORDINATORS)
    fits = street.start_coordinator("b-second", 2)
    street.start_shard()
    street.run_to(20)
    assert not misfit.election.leading
    assert fits.election.leading
    street.run()
    assert read_events(street.folder, "plan-made")
    assert {event["name"] for event in read_events(street.folder, "plan-made")} == {"b-second"}
    (refused,) = read_events(street.folder, "settings-refused")
    assert refused["process"] == "coordinator a-first"


def test_a_process_acts_again_on_the_next_road_that_fits(street: Street, tmp_path: Path) -> None:
    """The road of the first bridge ends, and one with the settings of the fleet begins."""
    wrong = WRONG["vehicle.max_jerk_mps3"]
    leader = street.start_coordinator("c0", 1, wrong)
    street.start_shard(scenario=wrong)
    street.run_to(30)
    street.network.kill("bridge")
    street.scenario = wrong
    street.start_bridge("bridge", tmp_path / "second")
    street.run()
    second = tmp_path / "second"
    assert leader.election.leading
    assert not read_events(second, "settings-refused")
    assert not read_events(second, "agent-missing")
    assert len(read_events(second, "left")) == len(VEHICLES)
    assert read_events(second, "plan-made")


def test_a_bridge_with_other_settings_takes_no_agent_from_a_road(
    street: Street, tmp_path: Path
) -> None:
    street.start_coordinators()
    street.start_shard()
    street.run_to(40)
    first = street.bridge
    street.scenario = WRONG["vehicle.max_jerk_mps3"]
    street.start_bridge("intruder", tmp_path / "second")
    street.network.run(street.network.now_s + 1e6, lambda: first.phase is TickPhase.ENDED)
    assert len(read_events(street.folder, "left")) == len(VEHICLES)
    assert not read_events(street.folder, "caretaker-took-over")
    assert not read_events(tmp_path / "second", "agent-took-over")


def test_processes_of_a_later_release_drive_as_those_of_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All messages have more fields at the end: everything is read, counted, and decided alike."""
    ends = []
    for name in ("this", "later"):
        if name == "later":
            monkeypatch.setattr(network, "encode", _encode_with_more_fields)
        street = Street(RIGHT, tmp_path / name, VEHICLES, pace=2.0)
        street.start_coordinators()
        street.start_shard()
        street.run()
        ends.append((street.world.shown, [node.received for node in street.nodes]))
        assert {node.rejected for node in street.nodes} == {0}
    assert ends[0] == ends[1]


def _encode_with_more_fields(message: object) -> bytes:
    version, kind, body = msgpack.unpackb(encode(message), strict_map_key=False)
    return bytes(msgpack.packb([version, kind, [*body, "new", {"more": [1]}]]))
