"""A secured network under test: a real router, and sessions of whoever a test lets connect."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import pytest
import zenoh
from attrs import define, field

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.transport import Delivery, Query, Received, TokenUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.connection import (
    Access,
    Credentials,
    ca_path,
    certificate_path,
    key_path,
)
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import Keys, Quality, Topic
from support.deployments import REALM, deployment
from support.harness import Lab
from support.waiting import wait_until

KEYS = Keys(REALM)
SECURITY = """
[security]
mode = "mtls"
fleets = { agents-1 = "0/2", agents-2 = "1/2" }
clients = ["plan", "other"]
"""
QUIET_S = 0.1
"""How long to wait for what must not come; what comes, comes in milliseconds."""
COME_S = 60.0
"""Longest wait for what must come."""


LINKS = ("tls/127.0.0.1:{}", "quic/127.0.0.1:{}?mixed_rel=1")
"""Encrypted endpoints with a port to fill in."""
ONE_LINK = (LINKS[0], pytest.param(LINKS[1], marks=pytest.mark.more))
"""Parameters of tests, of which `make test` uses one."""


def secured_deployment(lab: Lab, endpoint: str) -> Path:
    """Write a secured deployment's configuration."""
    return deployment(lab, endpoint, SECURITY)


@define
class Member:
    """One session, and what it was handed."""

    transport: ZenohTransport
    got: list[Delivery]

    def publish(self, topic: Topic, payload: bytes = b"", **parameters: object) -> None:
        """Publish something on a key of a topic."""
        self.transport.publish(KEYS.key(topic, **parameters), payload, Quality.ASSURED)

    def heard(self, topic: Topic, *but: bytes) -> set[bytes]:
        """Return the payloads that came under a topic, but for some."""
        return {payload for key, payload in self.received() if _is_of(key, topic)} - set(but)

    def received(self) -> list[tuple[str, bytes]]:
        """Return keys and payloads of all that came."""
        return [(item.key, item.payload) for item in list(self.got) if isinstance(item, Received)]

    def tokens(self) -> set[str]:
        """Return the keys of tokens that came up."""
        return {item.key for item in list(self.got) if isinstance(item, TokenUp)}


def _is_of(key: str, topic: Topic) -> bool:
    known = KEYS.read(key)
    return known is not None and known[0] is topic


@define
class Network:
    """A secured deployment whose router runs."""

    folder: Path
    """Of the certificates."""
    scenario: Scenario
    _sessions: contextlib.ExitStack = field(factory=contextlib.ExitStack)

    def join(self, identity: str) -> Member:
        """Connect as somebody."""
        got: list[Delivery] = []
        transport = ZenohTransport(self.access(identity), got.append)
        self._sessions.callback(transport.close)
        return Member(transport, got)

    def serve(self, identity: str, key: str) -> None:
        """Connect as somebody who answers all questions with its name."""
        member = self.join(identity)

        def answer(delivery: Delivery) -> None:
            if isinstance(delivery, Query):
                member.transport.answer(delivery.token, identity.encode(), ok=True)

        member.transport._deliver = answer
        member.transport.serve(key)

    def access(self, identity: str) -> Access:
        """Return how somebody gets onto the network, whether the deployment knows it or not."""
        network = self.scenario.network
        return Access(
            network.endpoint,
            network.realm,
            network.lease_s,
            Credentials(
                str(ca_path(self.folder)),
                str(certificate_path(self.folder, identity)),
                str(key_path(self.folder, identity)),
            ),
            identity,
        )

    def close(self) -> None:
        """Close all sessions."""
        self._sessions.close()


def answer_to(member: Member, key: str, payload: bytes = b"plan", timeout_s: float = 5.0) -> bytes:
    """Ask a service; empty when nobody answers."""
    try:
        answer = member.transport.query(key, payload, timeout_s).result()
    except TimeoutError:
        return b""
    return answer.payload if answer is not None else b""


def opens(access: Access) -> bool:
    """Tell whether a session comes up."""
    try:
        ZenohTransport(access, lambda _: None).close()
    except BadInputError:
        return False
    return True


def until_heard(sender: Member, reader: Member, topic: Topic, **parameters: object) -> None:
    """Have a reader subscribe, and send `first` until it is heard: that takes a moment."""
    reader.transport.subscribe(KEYS.key(topic, **parameters))

    def heard() -> set[bytes]:
        sender.publish(topic, b"first", **parameters)
        return reader.heard(topic)

    wait_until(heard, COME_S, lambda: topic.name)


def connects(endpoint: str, **tls: object) -> bool:
    """Tell whether a client with these settings gets to the router, whatever they are."""
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [endpoint],
        **{f"transport/link/tls/{name}": str(value) for name, value in tls.items()},
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    if "connect_certificate" in tls:
        config.insert_json5("transport/link/tls/enable_mtls", "true")
    try:
        with zenoh.open(config) as session:
            return bool(session.info.routers_zid())
    except zenoh.ZError:
        return False


def shown_by(folder: Path, name: str) -> dict[str, object]:
    """Return the settings of a client that shows a certificate."""
    return {
        "connect_certificate": folder / f"{name}.pem",
        "connect_private_key": folder / f"{name}.key",
    }
