"""A router's rules: what follows from the table of topics, and nothing else."""

from __future__ import annotations

import json
from functools import cache

import pytest

from laneweave.protocol.config.participants import identities_of
from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario, to_tables
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import (
    DECLARED,
    Flow,
    Rule,
    access_control,
    access_of,
    guard_of,
    rules_of,
    size_limits,
)
from laneweave.protocol.security.connection import Credentials
from laneweave.protocol.wire.identities import parse_identity
from laneweave.protocol.wire.topics import TOPICS, Exchange, Keys, Party, matches
from support.refusals import refusal
from support.tables import for_each

SCENARIO = parse_scenario(
    {
        "demand": {"duration_s": 20.0},
        "network": {"realm": "r", "endpoint": "tls/router:7447"},
        "security": {
            "mode": "mtls",
            "folder": "/keys",
            "fleets": {"even": "0/2", "odd": "1/2", "two": ["a", "b"]},
            "vehicles": ["a", "b", "c"],
        },
    }
)
PREFIX = "laneweave/r/"


@cache
def rules(who: str) -> tuple[Rule, ...]:
    return rules_of(parse_identity(who), SCENARIO)


def may(who: str, flow: str, message: str, key: str) -> bool:
    """Return whether an identity may send or get a kind of Zenoh's messages on a key."""
    return any(
        rule.flow == flow and rule.message == message and matches(expression, PREFIX + key)
        for rule in rules(who)
        for expression in rule.keys
    )


def may_send(who: str, key: str) -> bool:
    return may(who, "ingress", "put", key)


def may_read(who: str, key: str) -> bool:
    # An identity is given what it may subscribe to.
    subscribes = may(who, "ingress", "declare_subscriber", key)
    assert subscribes == may(who, "egress", "put", key)
    return subscribes


@for_each(
    ("key", "senders", "readers"),
    [
        ("clock", "bridge", "bridge c1 c2 watch"),
        ("census", "bridge", "c1 c2 two watch"),
        ("sense/a/a", "bridge", "a"),
        ("sense/two/a", "bridge", "two"),
        ("command/a", "a two", "bridge"),
        ("state/7/a", "a bridge two", "a b c c1 c2 two watch"),
        ("motion/-7/a", "a two", "a b c two watch"),
        ("prepare/a/a", "c1 c2", "a bridge"),
        ("prepare/two/a", "c1 c2", "bridge two"),
        ("plan/a/a", "c1 c2", "a bridge watch"),
        ("plan/two/a", "c1 c2", "bridge two watch"),
        ("heartbeat/c1", "c1", "bridge c1 c2 watch"),
        ("report/agent/a", "a two", "bridge watch"),
        ("report/coordinator/c1", "c1", "bridge watch"),
        ("report/bridge/bridge", "bridge", "bridge watch"),
        ("event/coordinator/c1", "c1", "bridge watch"),
        ("event/agent/c1", "", "bridge watch"),
        ("unknown", "", ""),
    ],
)
def test_who_sends_and_who_reads(key: str, senders: str, readers: str) -> None:
    everybody = (
        "router bridge coordinator.c1 coordinator.c2 vehicle.a vehicle.b vehicle.c fleet.two "
        "client.plan observer.watch"
    )
    for allowed, expected in ((may_send, senders), (may_read, readers)):
        found = sorted(who.rpartition(".")[2] for who in everybody.split() if allowed(who, key))
        assert found == expected.split()


def test_tokens_and_the_service() -> None:
    shows, watches, asks = "liveliness_token", "declare_liveliness_subscriber", "query"
    assert may("vehicle.a", "ingress", shows, "alive/vehicle/a/a")
    assert may("fleet.two", "ingress", shows, "alive/vehicle/two/a")
    for who, key in (("vehicle.a", "a/b"), ("vehicle.a", "b/a"), ("fleet.two", "a/a")):
        assert not may(who, "ingress", shows, f"alive/vehicle/{key}")
    assert may("coordinator.c1", "ingress", shows, "alive/coordinator/c1/77")
    assert not may("coordinator.c1", "ingress", shows, "alive/coordinator/c2/77")
    assert may("bridge", "ingress", watches, "alive/vehicle/a/a")
    assert may("vehicle.a", "egress", shows, "alive/bridge/5")
    assert not may("client.plan", "ingress", watches, "alive/vehicle/a/a")
    assert may("client.plan", "ingress", asks, "service/plan")
    assert may("client.plan", "egress", "reply", "service/plan")
    assert may("coordinator.c1", "ingress", "declare_queryable", "service/plan")
    for who in ("vehicle.a", "bridge", "observer.watch", "client.plan"):
        assert not may(who, "ingress", "declare_queryable", "service/plan")


def test_only_operators_change_the_road_and_only_the_bridge_serves_them() -> None:
    key = "road/request"
    everybody = "bridge coordinator.c1 vehicle.a fleet.two client.plan operator.operator"
    for who in (*everybody.split(), "observer.watch"):
        assert may(who, "ingress", "query", key) is (who == "operator.operator")
        assert may(who, "ingress", "declare_queryable", key) is (who == "bridge")


@for_each("flow", list(Flow))
@for_each("message", ["delete", "put", "query", "declare_subscriber", "reply"])
@for_each("key", ["**", "*", "clock/**", "../other", "@/router", "state/*/*/x"])
def test_no_identity_has_rights_on_a_malformed_key(flow: Flow, message: str, key: str) -> None:
    for identity in identities_of(SCENARIO):
        assert not may(identity.common_name, flow, message, key)


def test_all_keys_are_of_topics_of_the_realm() -> None:
    keys = Keys("r")
    concrete = [keys.key(topic, **dict.fromkeys(topic.parameters, "x")) for topic in TOPICS]
    for rule in (rule for who in identities_of(SCENARIO) for rule in rules(who.common_name)):
        assert rule.message != "delete"
        for expression in rule.keys:
            assert "**" not in expression
            assert len(expression.split("/")) in {len(key.split("/")) for key in concrete}
            assert expression.startswith(PREFIX)


def test_every_topic_has_senders_and_readers() -> None:
    parties = set(Party)
    for topic in TOPICS:
        assert topic.sender in {*parties, "any"}, topic.name
        assert {*topic.readers, topic.deputy} <= {*parties, None}
        assert topic.readers or topic.addressed, topic.name
        # Whom a key names is among its parameters.
        assert not topic.addressed or topic.parameters == ("process", "vehicle")


def test_the_rights_of_a_fleet_are_those_of_its_vehicles_and_the_census() -> None:
    def rights(who: str) -> set[tuple[Flow, str, str]]:
        return {(rule.flow, rule.message, key) for rule in rules(who) for key in rule.keys}

    def addressed(who: str, *vehicles: str) -> set[str]:
        keys = [f"{topic}/{who}/*" for topic in ("sense", "prepare", "plan")]
        return {*keys, *(f"alive/vehicle/{who}/{vehicle}" for vehicle in vehicles)}

    single, fleet = rights("vehicle.a") | rights("vehicle.b"), rights("fleet.two")
    own_keys = ("alive/process/fleet/two/*/*/*", "settings/fleet/two", "report/fleet/two")
    expected = {"census", *own_keys, "event/fleet/two"} | addressed("two", "a", "b")
    assert {key for _, _, key in fleet - single} == {PREFIX + key for key in expected}
    not_its_own = addressed("a", "a") | addressed("b", "b")
    assert {key for _, _, key in single - fleet} == {PREFIX + key for key in not_its_own}
    even, odd = rights("fleet.even"), rights("fleet.odd")
    own = {key for _, _, key in even & odd if "v0" in key}
    assert not own
    assert any("v0001" in key for _, _, key in even | odd)


def test_the_form_that_zenoh_takes() -> None:
    control = access_control(SCENARIO)
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    ids = [rule["id"] for rule in control["rules"]]
    assert len(set(ids)) == len(ids)
    subjects = {subject["id"]: subject["cert_common_names"] for subject in control["subjects"]}
    assert all(names == [subject] for subject, names in subjects.items())
    used = {rule for policy in control["policies"] for rule in policy["rules"]}
    assert used == set(ids)
    assert {name for policy in control["policies"] for name in policy["subjects"]} == set(subjects)
    for rule in control["rules"]:
        (message,) = rule["messages"]
        begin = "*/r/" if message in DECLARED else PREFIX
        assert all(key.startswith(begin) for key in rule["key_exprs"])
    # The router carries everything and takes part in nothing.
    assert set(subjects) == {one.common_name for one in identities_of(SCENARIO)} - {"router"}
    json.dumps(control, allow_nan=False)


def test_size_limits_of_requests_and_messages() -> None:
    requests, messages = size_limits(SCENARIO)
    assert requests["size_limit"] > SCENARIO.service.max_request_bytes
    asked = [topic for topic in TOPICS if topic.exchange is Exchange.QUERIES]
    assert len(requests["key_exprs"]) == len(asked)
    assert all(key.startswith(PREFIX) for key in requests["key_exprs"] + messages["key_exprs"])


def test_an_open_network_has_no_guard() -> None:
    assert guard_of(Scenario(), {}) is None
    guard = guard_of(SCENARIO, {})
    assert guard is not None
    assert guard.host == "router"
    everywhere = parse_scenario(
        {"network": {"endpoint": "tls/0.0.0.0:7447"}, "security": {"mode": "mtls"}}
    )
    guard = guard_of(everywhere, {})
    assert guard is not None
    assert guard.host == ""


# --- access ---------------------------------------------------------------------------------------


def test_credentials_lie_in_the_folder() -> None:
    access = access_of(SCENARIO, "coordinator.c1", {})
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
    credentials = access_of(SCENARIO, "bridge", environment).credentials
    assert credentials == Credentials("ca", "own", "", "secret words")
    assert "secret" not in repr(credentials)
    both = environment | {"LANEWEAVE_PRIVATE_KEY_FILE": "key"}
    error = refusal(access_of, SCENARIO, "bridge", both)
    assert error.field == "LANEWEAVE_PRIVATE_KEY_FILE"
    assert "secret" not in str(error)


def test_only_identities_have_credentials() -> None:
    assert refusal(access_of, SCENARIO, "somebody", {}).field == "identity"


@pytest.mark.parametrize("identity", ["coordinator.c9", "client.nobody", "fleet.none"])
def test_an_identity_that_the_configuration_does_not_know_is_refused(identity: str) -> None:
    # The router would let it in, and let it do nothing.
    error = refusal(access_of, SCENARIO, identity, {})
    assert error.field == "identity"
    assert "security.clients" in str(error)
    assert access_of(load_scenario(None), identity, {}).credentials is None


def test_a_secured_scenario_survives_the_way_to_a_process() -> None:
    assert parse_scenario(to_tables(SCENARIO)) == SCENARIO
    hash(SCENARIO)
