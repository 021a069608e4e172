"""Who may do what on a secured network, tried out against a real router.

Each test tries something that is not allowed, and the same thing by whoever may do it.
"""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from laneweave.launch.deploy.certificate_authority import issue, load_authority, make_authority
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.field_validators import link_of
from laneweave.protocol.runtime.transport import Query
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import REQUEST_MARGIN
from laneweave.protocol.wire.codec import MAX_BYTES
from laneweave.protocol.wire.identities import parse_identity
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLIENT_ALIVE,
    CLOCK,
    COMMAND,
    COORDINATOR_ALIVE,
    EVENT,
    HEARTBEAT,
    MOTION,
    PLAN,
    PREPARE,
    REPORT,
    ROAD_REQUEST,
    SENSE,
    SERVICE,
    STATE,
    VEHICLE_ALIVE,
    Topic,
)
from support.deployments import ask, free_port, start_router, stop
from support.harness import END_S, RUN_S, Lab, check_safe_and_complete, laboratory, trips
from support.secured import (
    COME_S,
    KEYS,
    LINKS,
    ONE_LINK,
    QUIET_S,
    Member,
    Network,
    answer_to,
    connects,
    opens,
    secured_deployment,
    shown_by,
    until_heard,
)
from support.waiting import wait_until

A, B = "v0001", "v0002"
FLEETS = {one: f"fleet.agents-{1 if Shard(0, 2).contains(one) else 2}" for one in (A, B)}
STRANGERS = ("client.stranger", "vehicle.stranger")
"""They have certificates of the right authority, but the deployment does not know them."""
MEMBERS = ("bridge", "coordinator.c1", "coordinator.c3", f"vehicle.{A}", f"vehicle.{B}",
           "fleet.agents-1", "fleet.agents-2", "client.plan", "operator.operator", "observer.watch",
           *STRANGERS)  # fmt: skip


@pytest.fixture(scope="module", params=ONE_LINK)
def secured(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, Scenario]]:
    """Run one router per kind of link; give its folder of certificates, and the scenario."""
    folder = tmp_path_factory.mktemp("secured")
    with laboratory(folder) as lab:
        config = secured_deployment(lab, request.param.format(free_port()))
        init = ("certs", "init", "certs", "--config", config)
        assert lab.run(*init).status == 0
        authority = load_authority(folder / "certs")
        for name in (f"vehicle.{A}", f"vehicle.{B}", *STRANGERS):
            issue(authority, folder / "certs", parse_identity(name), days=30.0)
        network = Network(folder / "certs", load_scenario(config))
        router = lab.start("router", "--config", config)
        lab.wait_until(
            lambda: router.poll() is not None or opens(network.access("observer.ping")), END_S
        )
        yield network.folder, network.scenario
        router.send_signal(signal.SIGTERM)
        assert lab.finish(router, END_S).status == 0


@pytest.fixture
def network(secured: tuple[Path, Scenario]) -> Iterator[Network]:
    """The router of this module, and sessions that are closed at the test's end."""
    with contextlib.closing(Network(*secured)) as network:
        yield network


# --- what is published ----------------------------------------------------------------------------

PUBLISHED: tuple[tuple[str, Topic, dict[str, object], str, tuple[str, ...]], ...] = (
    ("bridge", CLOCK, {}, "coordinator.c2", ()),
    ("bridge", CENSUS, {}, "coordinator.c2", ()),
    ("bridge", SENSE, {"process": B, "vehicle": B}, f"vehicle.{B}", ()),
    ("coordinator.c1", PREPARE, {"process": B, "vehicle": B}, f"vehicle.{B}", ("coordinator.c3",)),
    ("coordinator.c1", PLAN, {"process": B, "vehicle": B}, f"vehicle.{B}", ("coordinator.c3",)),
    ("coordinator.c1", HEARTBEAT, {"coordinator": "c1"}, "coordinator.c2", ()),
    ("coordinator.c1", EVENT, {"role": "coordinator", "name": "c1"}, "bridge", ()),
    (f"vehicle.{B}", COMMAND, {"vehicle": B}, "bridge", (FLEETS[B],)),
    # A vehicle's caretaker is a part of the bridge.
    (f"vehicle.{B}", STATE, {"block": 3, "vehicle": B}, f"vehicle.{A}", (FLEETS[B], "bridge")),
    (f"vehicle.{B}", MOTION, {"stretch": -3, "vehicle": B}, f"vehicle.{A}", (FLEETS[B],)),
    (f"vehicle.{B}", REPORT, {"role": "agent", "name": B}, "observer.watch", (FLEETS[B],)),
)
"""Who publishes what, who reads it, and who may publish it, too."""


def test_nobody_publishes_what_is_somebody_elses(network: Network) -> None:
    rightful = {owner: network.join(owner) for owner in {row[0] for row in PUBLISHED}}
    readers = {reader: network.join(reader) for reader in {row[3] for row in PUBLISHED}}
    for owner, topic, parameters, reader, _ in PUBLISHED:
        until_heard(rightful[owner], readers[reader], topic, **parameters)

    for who in MEMBERS:
        forger = network.join(who)
        for _, topic, parameters, _, _ in PUBLISHED:
            forger.publish(topic, who.encode(), **parameters)
    time.sleep(QUIET_S)

    for owner, topic, parameters, reader, others in PUBLISHED:
        rightful[owner].publish(topic, b"last", **parameters)
        allowed = {who.encode() for who in (owner, *others)} | {b"last"}
        wait_until(lambda r=reader, t=topic: b"last" in readers[r].heard(t), COME_S)  # type: ignore[misc]
        assert readers[reader].heard(topic, b"first") == allowed, topic.name


def test_other_ways_of_naming_a_key_are_no_ways_around(network: Network) -> None:
    rightful, reader = network.join(f"vehicle.{A}"), network.join("coordinator.c2")
    until_heard(rightful, reader, STATE, block=1, vehicle=A)
    key = KEYS.key(STATE, block=1, vehicle=A)
    for who in (f"vehicle.{B}", FLEETS[A], "coordinator.c1", "observer.watch"):
        session = network.join(who).transport._session
        for wild in ("laneweave/test/state/1/*", "laneweave/test/**", "laneweave/*/state/1/*"):
            session.put(wild, b"wild")
        if who != FLEETS[A]:
            session.put(session.declare_keyexpr(key), b"declared")
            session.declare_publisher(key).put(b"by a publisher")
            session.delete(key)
    time.sleep(QUIET_S)
    rightful.publish(STATE, b"last", block=1, vehicle=A)
    wait_until(lambda: b"last" in reader.heard(STATE), COME_S)
    assert {payload for _, payload in reader.received()} == {b"first", b"last"}


# --- what is read ---------------------------------------------------------------------------------

EVERYTHING = ("**", "laneweave/**", "laneweave/test/**", "laneweave/*/*/*", "laneweave/test/*/*",
              "laneweave/test/plan/*/*", "laneweave/test/plan/*/v$*")  # fmt: skip
MAY_READ: dict[str, tuple[str, ...]] = {
    f"vehicle.{A}": ("state",),
    "fleet.agents-1": ("state", "census"),
    "coordinator.c3": ("state", "census"),
    "client.plan": (),
    "observer.watch": ("state", "census", f"plan/{B}"),
    "client.stranger": (),
    "vehicle.stranger": (),
}
"""What each may read of what is sent here, by the beginning of its key."""


def test_nobody_reads_what_is_for_somebody_else(network: Network) -> None:
    bridge, leader = network.join("bridge"), network.join("coordinator.c1")
    vehicle = network.join(f"vehicle.{B}")
    sent: tuple[tuple[Member, Member, Topic, dict[str, object]], ...] = (
        (leader, vehicle, PLAN, {"process": B, "vehicle": B}),
        (leader, vehicle, PREPARE, {"process": B, "vehicle": B}),
        (bridge, vehicle, SENSE, {"process": B, "vehicle": B}),
        (vehicle, bridge, COMMAND, {"vehicle": B}),
        (vehicle, leader, STATE, {"block": 1, "vehicle": B}),
        (bridge, leader, CENSUS, {}),
    )
    snoopers = {who: network.join(who) for who in MAY_READ if who != FLEETS[B]}
    for snooper in snoopers.values():
        for expression in EVERYTHING:
            snooper.transport.subscribe(expression)
        for _, _, topic, parameters in sent:
            snooper.transport.subscribe(KEYS.key(topic, **parameters))
    for sender, reader, topic, parameters in sent:
        until_heard(sender, reader, topic, **parameters)
    time.sleep(QUIET_S)

    for sender, reader, topic, parameters in sent:
        sender.publish(topic, b"last", **parameters)
        wait_until(lambda r=reader, t=topic: b"last" in r.heard(t), COME_S)  # type: ignore[misc]
    time.sleep(QUIET_S)
    for who, snooper in snoopers.items():
        read = {key.removeprefix("laneweave/test/") for key, _ in snooper.received()}
        allowed = MAY_READ[who]
        assert {key for key in read if not key.startswith(allowed or "-")} == set(), who
        assert len(read) == len(allowed), f"{who} should read {allowed}"


def test_a_vehicle_reads_its_own_plan_and_nobody_elses(network: Network) -> None:
    leader = network.join("coordinator.c1")
    first, second = network.join(f"vehicle.{A}"), network.join(f"vehicle.{B}")
    first.transport.subscribe(KEYS.key(PLAN, process=B, vehicle=B))
    until_heard(leader, second, PLAN, process=B, vehicle=B)
    until_heard(leader, first, PLAN, process=A, vehicle=A)
    assert {key for key, _ in first.received()} == {KEYS.key(PLAN, process=A, vehicle=A)}


# --- tokens ---------------------------------------------------------------------------------------


def test_nobody_shows_somebody_elses_token(network: Network) -> None:
    bridge, leader = network.join("bridge"), network.join("coordinator.c2")
    shown = {
        KEYS.key(VEHICLE_ALIVE, process=B, vehicle=B): f"vehicle.{B}",
        KEYS.key(COORDINATOR_ALIVE, coordinator="c1", incarnation=7): "coordinator.c1",
        KEYS.key(BRIDGE_ALIVE, incarnation=8): "bridge",
        KEYS.key(CLIENT_ALIVE, session="secret", client="other"): "client.other",
    }
    bridge.transport.watch(KEYS.all_of(VEHICLE_ALIVE))
    leader.transport.watch(KEYS.all_of(COORDINATOR_ALIVE))
    leader.transport.watch(KEYS.all_of(BRIDGE_ALIVE))
    leader.transport.watch(KEYS.all_of(CLIENT_ALIVE))
    snooper = network.join("client.plan")
    for expression in ("**", *EVERYTHING, KEYS.all_of(VEHICLE_ALIVE), *shown):
        snooper.transport.watch(expression)

    for who in MEMBERS:
        forger = network.join(who)
        for key, owner in shown.items():
            if who not in (owner, FLEETS[B]):
                forger.transport.announce(key)
    time.sleep(QUIET_S)
    assert bridge.tokens() | leader.tokens() == set()

    for key, owner in shown.items():
        network.join(owner).transport.announce(key)
    wait_until(lambda: bridge.tokens() | leader.tokens() == set(shown), COME_S)
    assert snooper.tokens() == set()


# --- the planning service -------------------------------------------------------------------------


def test_only_coordinators_serve_and_only_clients_ask(network: Network) -> None:
    key = KEYS.key(SERVICE)
    client = network.join("client.other")
    for who in MEMBERS:
        if not who.startswith("coordinator."):
            for expression in (key, "laneweave/test/**", "**"):
                network.serve(who, expression)
    time.sleep(QUIET_S)
    assert answer_to(client, key) == b""

    network.serve("coordinator.c1", key)
    wait_until(lambda: answer_to(client, key) == b"coordinator.c1", COME_S)
    for who in ("bridge", f"vehicle.{A}", "fleet.agents-1", "observer.watch", *STRANGERS):
        assert answer_to(network.join(who), key, timeout_s=0.1) == b""
    assert answer_to(client, key) == b"coordinator.c1"


def test_only_operators_change_the_road(network: Network) -> None:
    key = KEYS.key(ROAD_REQUEST)
    network.serve("bridge", key)
    operator = network.join("operator.operator")
    wait_until(lambda: answer_to(operator, key) == b"bridge", COME_S)
    for who in ("coordinator.c1", f"vehicle.{A}", "client.plan", "observer.watch", *STRANGERS):
        assert answer_to(network.join(who), key, timeout_s=0.1) == b""
    for who in ("coordinator.c1", f"vehicle.{A}", "operator.operator"):
        network.serve(who, key)
    time.sleep(QUIET_S)
    assert answer_to(operator, key) == b"bridge"


def test_a_query_has_the_name_of_its_clients_certificate(network: Network) -> None:
    coordinator, client = network.join("coordinator.c1"), network.join("client.other")
    coordinator.transport.watch(KEYS.all_of(CLIENT_ALIVE))
    key = KEYS.key(SERVICE)
    coordinator.transport.serve(key)
    own = KEYS.key(CLIENT_ALIVE, session="s", client="other")
    forged = KEYS.key(CLIENT_ALIVE, session="s", client="plan")
    for token in (own, forged):
        client.transport.announce(token)
    wait_until(lambda: coordinator.tokens() == {own}, COME_S)
    declined = [client.transport.query(key, b"forged", 5.0, sender=s) for s in (forged, "x" * 2000)]
    for number, sender in enumerate((own, "")):
        client.transport.query(key, b"%d" % number, 5.0, sender=sender)

    def queries() -> list[tuple[bytes, str]]:
        return [(q.payload, q.sender) for q in list(coordinator.got) if isinstance(q, Query)]

    wait_until(lambda: len(queries()) == 2, COME_S)
    assert queries() == [(b"0", own), (b"1", "")]
    assert [query.result(END_S) for query in declined] == [None, None]


def test_what_is_too_long_does_not_come_in(network: Network) -> None:
    key, most_bytes = KEYS.key(SERVICE), network.scenario.service.max_request_bytes
    client = network.join("client.plan")
    network.serve("coordinator.c1", key)
    wait_until(lambda: answer_to(client, key, bytes(most_bytes)), COME_S)
    assert answer_to(client, key, bytes(REQUEST_MARGIN * most_bytes + 1), 0.2) == b""
    assert answer_to(client, key, bytes(most_bytes))

    bridge, reader = network.join("bridge"), network.join("coordinator.c2")
    until_heard(bridge, reader, CENSUS)
    for size in (MAX_BYTES + 1, MAX_BYTES):
        bridge.publish(CENSUS, bytes(size))
    wait_until(lambda: reader.heard(CENSUS, b"first"), COME_S)
    assert reader.heard(CENSUS) == {b"first", bytes(MAX_BYTES)}


# --- who gets in at all ---------------------------------------------------------------------------


@pytest.mark.more
def test_outsiders_do_not_get_in(network: Network, tmp_path: Path) -> None:
    endpoint, ours = network.scenario.network.endpoint, network.folder
    ca = {"root_ca_certificate": ours / "ca.pem"}
    theirs, expired, name = tmp_path / "theirs", tmp_path / "expired", "coordinator.c1"
    issue(make_authority(theirs), theirs, parse_identity(name), days=30.0)
    expired.mkdir()
    issue(load_authority(ours), expired, parse_identity(name), days=-1.0)

    assert connects(endpoint, **ca, **shown_by(ours, name))
    assert not connects(endpoint, **ca), "no certificate"
    host = endpoint.partition("/")[2].partition("?")[0]
    for plain in (f"tcp/{host}", f"udp/{host}", f"udp/{host}?rel=1;mixed_rel=1"):
        assert not connects(plain), plain
    assert not connects(endpoint, **ca, **shown_by(theirs, name)), "wrong authority"
    assert not connects(endpoint, **ca, **shown_by(expired, name)), "expired"
    assert not connects(endpoint, **ca, **shown_by(ours, "router")), "not for clients"
    # And the other way round: this router is none that others would believe.
    assert not connects(endpoint, root_ca_certificate=theirs / "ca.pem", **shown_by(ours, name))
    assert not connects(endpoint.replace("127.0.0.1", "127.0.0.2"), **ca, **shown_by(ours, name))
    assert connects(endpoint, **ca, **shown_by(ours, name))


@pytest.mark.parametrize("name", ["router", "vehicle.v0001", "bridge", "coordinator.c1"])
def test_nobody_else_passes_for_the_router(network: Network, name: str) -> None:
    current = network.scenario.network.endpoint
    endpoint = next(one for one in LINKS if link_of(one) == link_of(current)).format(free_port())
    config = zenoh.Config()
    folder = network.folder
    settings: dict[str, Any] = {
        "mode": "router",
        "scouting/multicast/enabled": False,
        "scouting/delay": 0,
        "listen/endpoints": [endpoint],
        "transport/link/tls/root_ca_certificate": str(folder / "ca.pem"),
        "transport/link/tls/listen_certificate": str(folder / f"{name}.pem"),
        "transport/link/tls/listen_private_key": str(folder / f"{name}.key"),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        client = {"root_ca_certificate": folder / "ca.pem", **shown_by(folder, "coordinator.c2")}
        assert connects(endpoint, **client) == (name == "router")


@pytest.mark.more
def test_a_role_says_in_one_line_what_is_wrong_with_its_certificate(
    network: Network, lab: Lab
) -> None:
    config = secured_deployment(lab, network.scenario.network.endpoint)
    ours, theirs = network.folder, lab.folder / "theirs"
    name = "observer.ping"
    issue(make_authority(theirs), theirs, parse_identity(name), days=30.0)

    def shown(authority: Path, certificate: Path) -> dict[str, str]:
        return {
            "LANEWEAVE_CA_FILE": str(authority / "ca.pem"),
            "LANEWEAVE_CERTIFICATE_FILE": str(certificate / f"{name}.pem"),
            "LANEWEAVE_PRIVATE_KEY_FILE": str(certificate / f"{name}.key"),
        }

    cases: tuple[tuple[dict[str, str], str], ...] = (
        ({}, "certificate authority"),
        ({"LANEWEAVE_CA_FILE": str(ours / "ca.pem")}, "certificate"),
        (shown(ours, theirs), "certificate"),
        # These fit together, but the router's certificate is of another authority.
        (shown(theirs, theirs), "network.endpoint"),
    )
    for environment, field in cases:
        ended = lab.run("ping", "--config", config, within_s=END_S, **environment)
        assert (ended.status, ended.out) == (2, ""), ended
        (line,) = ended.complaints
        assert line.startswith(f"{field}: ")
    # The key may come as text.
    good = shown(ours, ours)
    key = Path(good.pop("LANEWEAVE_PRIVATE_KEY_FILE"))
    good["LANEWEAVE_PRIVATE_KEY"] = key.read_text(encoding="ascii")
    ended = lab.run("ping", "--config", config, within_s=END_S, **good)
    assert (ended.status, ended.out, ended.complaints) == (0, "", []), ended


# --- a whole deployment ---------------------------------------------------------------------------


@pytest.mark.more
@pytest.mark.parametrize("link", ONE_LINK)
def test_a_secured_deployment_runs_to_its_end(lab: Lab, link: str) -> None:
    config = secured_deployment(lab, link.format(free_port()))
    text = config.read_text(encoding="utf-8")
    text = text.replace("duration_s = 14.0", "duration_s = 5.0")
    config.write_text(f"{text}\n[runtime]\ncoordinators = 2\n", encoding="utf-8")
    assert lab.run("certs", "init", "certs", "--config", config).status == 0
    network = Network(lab.folder / "certs", load_scenario(config))
    router = start_router(lab, config)
    roles = [
        lab.start("coordinator", "--config", config, "--name", "c1"),
        lab.start("coordinator", "--config", config, "--name", "c2"),
        lab.start("agent", "--config", config, "--fleet", "agents-1"),
        lab.start("agent", "--config", config, "--shard", "1/2"),
    ]
    with contextlib.closing(network):
        observer = network.join("observer.status")
        observer.transport.subscribe(KEYS.all_of(HEARTBEAT))
        lab.wait_until(lambda: len({key for key, _ in observer.received()}) == 2, END_S)
        example = Path(__file__).parents[2] / "docs/examples/case-study.json"
        request = json.loads(example.read_text(encoding="utf-8"))
        # Planning is prepared first, which may take longer than the request's deadline.
        lab.wait_until(lambda: ask(lab, config, request).status == 0)
        assert json.loads(ask(lab, config, request | {"deadline_s": 60.0}).out)["cost"] == 7
        look = ("status", "--config", config, "--no-bridge", "--json")
        looked = lab.finish(lab.start(*look), END_S)
        assert (looked.status, looked.complaints) == (0, []), looked
        assert json.loads(looked.out)["leader"] == "c1"
        bridge = lab.start("bridge", "--config", config, "--pace", "20", "--out", "out")
        ended = lab.finish(bridge, RUN_S)
    assert (ended.status, ended.complaints) == (0, []), ended
    stop(lab, *roles)
    stop(lab, router)
    check_safe_and_complete(lab.folder / "out")
    for vehicle, trip in trips(lab.folder / "out").items():
        assert trip["final_lane"] == trip["preferred_lane"], vehicle
    lab.check_nothing_left()
