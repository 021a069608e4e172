"""Who takes part in a deployment, by which name, and with what it shows that."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.loading import load_scenario, parse_scenario, to_tables
from laneweave.protocol.config.participants import demanded_vehicles, identities_of, members_of
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.deployment import Shard, parse_shard
from laneweave.protocol.security.access import Credentials
from laneweave.protocol.security.rights import access_of
from laneweave.protocol.validators import check_endpoint, host_of, is_tls
from laneweave.protocol.wire.identities import Identity, parse_identity
from laneweave.protocol.wire.topics import Party
from laneweave.sim_bridge.road.demand import arrivals

MTLS: dict[str, Any] = {"network": {"endpoint": "tls/r:7447"}, "security": {"mode": "mtls"}}


def refusal(call: Callable[[], object]) -> BadInputError:
    with pytest.raises(BadInputError) as caught:
        call()
    return caught.value


# --- identities -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["router", "bridge", "coordinator.c1", "vehicle.v0001", "fleet.a.b", "client.-",
             "observer." + "x" * 55]
)  # fmt: skip
def test_an_identity_is_read_back(text: str) -> None:
    assert parse_identity(text).common_name == text


@pytest.mark.parametrize(
    "text", ["", "router.", "router.x", "bridge.b", "coordinator", "coordinator.", "vehicle.a/b",
             "Vehicle.a", "tram.a", "vehicle.a b", "vehicle.*", "observer." + "x" * 56, "vehicle.é",
             "vehicle.a\n", " bridge"]
)  # fmt: skip
def test_what_is_no_identity_is_refused(text: str) -> None:
    assert refusal(lambda: parse_identity(text)).field == "identity"


@given(st.text(max_size=70))
def test_any_text_is_an_identity_or_refused(text: str) -> None:
    try:
        identity = parse_identity(text)
    except BadInputError:
        return
    assert identity.common_name == text
    assert len(text) <= 64


def test_the_identities_of_a_deployment() -> None:
    scenario = parse_scenario(
        {
            "runtime": {"coordinators": 2},
            "security": {"fleets": {"f": "0/2"}, "vehicles": ["a"], "clients": ["x"]},
        }
    )
    names = {identity.common_name for identity in identities_of(scenario)}
    assert names == {"router", "bridge", "coordinator.c1", "coordinator.c2", "fleet.f", "client.x",
                     "vehicle.a", "observer.ping", "observer.status", "observer.watch"}  # fmt: skip


# --- fleets ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("volume", [20.0, 400.0, 1600.0, 3600.0])
@pytest.mark.parametrize("duration_s", [3.0, 40.0, 600.0])
def test_no_demand_has_more_vehicles_than_are_expected(volume: float, duration_s: float) -> None:
    for seed in range(15):
        scenario = parse_scenario(
            {
                "seed": seed,
                "demand": {"volume_veh_per_lane_h": volume, "duration_s": duration_s},
            }
        )
        expected = demanded_vehicles(scenario)
        arriving = [arrival.vehicle for arrival in arrivals(scenario)]
        assert tuple(arriving) == expected[: len(arriving)]
        assert len(expected) <= 3 * volume * duration_s / 3600 * 1.4 + 60


@pytest.mark.parametrize("text", ["", "1", "1/1", "2/2", "-1/2", "0/0", "0/1/2", "a/b", "0/10001",
                                  "1 / 2", "0/" + "9" * 30, "²/3"])  # fmt: skip
def test_what_is_no_shard_is_refused(text: str) -> None:
    assert refusal(lambda: parse_shard(text, "--shard")).field == "--shard"


def test_shards_share_all_vehicles() -> None:
    vehicles = [f"v{number:04d}" for number in range(1, 200)]
    parts = [members_of(f"{index}/3", vehicles) for index in range(3)]
    assert sorted(name for part in parts for name in part) == vehicles
    assert parts[1] == tuple(name for name in vehicles if Shard(1, 3).takes(name))
    assert members_of(("x", "y"), vehicles) == ("x", "y")


# --- endpoints ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("endpoint", "host"),
    [("tcp/127.0.0.1:7447", "127.0.0.1"), ("tls/router:1", "router"), ("tls/[::1]:7447", "::1"),
     ("tls/a-b.example.org:65535", "a-b.example.org"), ("unixsock-stream//tmp/x y", "")],
)  # fmt: skip
def test_the_host_of_an_endpoint(endpoint: str, host: str) -> None:
    assert check_endpoint(endpoint) == endpoint
    assert host_of(endpoint) == host
    assert is_tls(endpoint) == endpoint.startswith("tls")


@pytest.mark.parametrize(
    "endpoint",
    ["", "tcp/", "tcp/host", "tcp/host:", "tcp/host:70000", "tcp/:7447", "udp/host:1", "tls",
     "host:7447", "tls/::1:7447", "unixsock-stream/", "tls/host:7447?x=1",
     "tls/host:7447#verify_name_on_connect=false", "tls/host:7447;tcp/host:1", "tcp/a b:1"],
)  # fmt: skip
def test_what_is_no_endpoint_is_refused(endpoint: str) -> None:
    assert refusal(lambda: check_endpoint(endpoint, "network.listen")).field == "network.listen"


# --- the tables -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "field"),
    [
        (MTLS | {"network": {"endpoint": "tcp/r:7447"}}, "network.endpoint"),
        (MTLS | {"network": {"endpoint": "unixsock-stream/r"}}, "network.endpoint"),
        (MTLS | {"network": {"listen": ["tls/r:1", "tcp/r:2"]}}, "network.listen"),
        ({"network": {"endpoint": "tls/r:7447"}}, "security.mode"),
        ({"network": {"listen": ["tls/r:7447"]}}, "security.mode"),
        (MTLS | {"demand": {"duration_s": 80_000.0}}, "demand.duration_s"),
        (MTLS | {"security": {"mode": "mtls", "clients": ["x" * 58]}}, "security.clients"),
        (MTLS | {"security": {"mode": "mtls", "folder": ""}}, "security.folder"),
        ({"security": {"mode": "tls"}}, "security.mode"),
        ({"security": {"fleets": {"a b": "0/1"}}}, "security.fleets"),
        ({"security": {"fleets": {"a": "1/1"}}}, "security.fleets[a]"),
        ({"security": {"fleets": {"a": ["v/1"]}}}, "security.fleets"),
        ({"security": {"fleets": {"a": ["v", "v"]}}}, "security.fleets"),
        ({"security": {"observers": ["*"]}}, "security.observers"),
    ],
)
def test_what_does_not_fit_is_named(data: dict[str, Any], field: str) -> None:
    assert refusal(lambda: parse_scenario(data)).field == field


def test_a_secured_scenario_survives_the_way_to_a_process() -> None:
    scenario = parse_scenario(MTLS | {"security": {"mode": "mtls", "fleets": {"a": ["v"]}}})
    assert parse_scenario(to_tables(scenario)) == scenario
    hash(scenario)


def test_the_folder_is_found_from_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "d.toml"
    path.write_text("[security]\nfolder = 'keys'\n")
    assert load_scenario(path).security.folder == str(tmp_path / "keys")
    path.write_text("[security]\nfolder = '/etc/keys'\n")
    assert load_scenario(path).security.folder == "/etc/keys"
    path.write_text("[security]\n")
    assert load_scenario(path).security.folder == str(tmp_path / "certs")


# --- access ---------------------------------------------------------------------------------------

SECURED = parse_scenario(MTLS | {"security": {"mode": "mtls", "folder": "/keys"}})


def test_credentials_lie_in_the_folder() -> None:
    access = access_of(SECURED, "coordinator.c1", {})
    assert access.identity == "coordinator.c1"
    assert access.credentials == Credentials(
        "/keys/ca.pem", "/keys/coordinator.c1.pem", "/keys/coordinator.c1.key"
    )
    assert access_of(load_scenario(None), "coordinator.c1", {}).credentials is None


def test_the_environment_goes_before_the_folder() -> None:
    environment = {
        "LANEWEAVE_CA_FILE": "ca",
        "LANEWEAVE_CERTIFICATE_FILE": "own",
        "LANEWEAVE_PRIVATE_KEY": "secret words",
    }
    credentials = access_of(SECURED, "bridge", environment).credentials
    assert credentials == Credentials("ca", "own", "", "secret words")
    assert "secret" not in repr(credentials)
    both = environment | {"LANEWEAVE_PRIVATE_KEY_FILE": "key"}
    error = refusal(lambda: access_of(SECURED, "bridge", both))
    assert error.field == "LANEWEAVE_PRIVATE_KEY_FILE"
    assert "secret" not in str(error)


def test_only_identities_have_credentials() -> None:
    assert refusal(lambda: access_of(SECURED, "somebody", {})).field == "identity"


@pytest.mark.parametrize("identity", ["coordinator.c9", "client.nobody", "fleet.none"])
def test_whom_the_configuration_does_not_know_is_refused(identity: str) -> None:
    # The router would let it in, and let it do nothing.
    error = refusal(lambda: access_of(SECURED, identity, {}))
    assert error.field == "identity"
    assert "security.clients" in str(error)
    assert access_of(load_scenario(None), identity, {}).credentials is None


def test_the_parties_are_the_words_of_the_table_of_topics() -> None:
    assert Identity(Party.VEHICLE, "a").common_name == "vehicle.a"
