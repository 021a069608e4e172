"""Addresses and endpoints in a configuration."""

from __future__ import annotations

import pytest

from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import (
    check_endpoint,
    host_and_port,
    host_of,
    is_encrypted,
    link_of,
)
from support.refusals import refusal
from support.tables import for_each


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("127.0.0.1:9464", "127.0.0.1", 9464),
        ("[::1]:1", "::1", 1),
        ("host.example:65535", "host.example", 65535),
    ],
)
def test_addresses(text: str, host: str, port: int) -> None:
    assert host_and_port("x", text) == (host, port)
    assert load_scenario(None, observation__metrics=text).observation.metrics == text


@for_each("text", ["9464", ":9464", "host:", "host:0", "host:65536", "host:-1", "host:+1", "::1:80",
     "[]:80", "[host]:80", "a b:80", "host:80 ", "host:\u0661", "host:1e3"])  # fmt: skip
def test_no_addresses(text: str) -> None:
    with pytest.raises(BadInputError, match=r"metrics: got .*HOST:PORT"):
        load_scenario(None, observation__metrics=text)


def test_no_metrics() -> None:
    assert load_scenario(None, observation__metrics="").observation.metrics == ""


@pytest.mark.parametrize(
    ("endpoint", "host", "link", "encrypted"),
    [("tcp/127.0.0.1:7447", "127.0.0.1", "tcp", False), ("tls/router:1", "router", "tls", True),
     ("tls/[::1]:7447", "::1", "tls", True),
     ("unixsock-stream//tmp/x y", "", "unixsock-stream", False),
     ("tls/a-b.example.org:65535", "a-b.example.org", "tls", True),
     ("udp/host:1", "host", "udp", False), ("udp/[::1]:1?rel=0", "::1", "udp?rel=0", False),
     ("udp/host:1?rel=1;mixed_rel=1", "host", "udp?rel=1;mixed_rel=1", False),
     ("quic/host:1", "host", "quic", True), ("quic/host:1?rel=0", "host", "quic?rel=0", True),
     ("quic/host:1?mixed_rel=1", "host", "quic?mixed_rel=1", True)],
)  # fmt: skip
def test_the_host_and_the_link_of_an_endpoint(
    endpoint: str, host: str, link: str, *, encrypted: bool
) -> None:
    assert check_endpoint(endpoint) == endpoint
    assert (host_of(endpoint), link_of(endpoint), is_encrypted(endpoint)) == (host, link, encrypted)


@for_each("endpoint", ["", "tcp/", "tcp/host", "tcp/host:", "tcp/host:70000", "tcp/:7447",
     "ws/host:1", "tls", "host:7447", "tls/::1:7447", "unixsock-stream/", "tls/host:7447?x=1",
     "tls/host:7447#verify_name_on_connect=false", "tls/host:7447;tcp/host:1", "tcp/a b:1",
     "tcp/host:1?rel=0", "tls/host:1?mixed_rel=1", "quic/host:1?prio=1", "udp/host",
     "quic/host:0x1", "quic/host:1?rel=0#verify_name_on_connect=false",
     "quic/host:1?rel=0;mixed_rel=1", "quic/host:1?", "unixsock-stream/x?rel=0"])  # fmt: skip
def test_what_is_no_endpoint_is_refused(endpoint: str) -> None:
    assert refusal(check_endpoint, endpoint, "network.listen").field == "network.listen"
