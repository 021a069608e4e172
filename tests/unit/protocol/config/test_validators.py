"""Addresses in a configuration."""

import pytest

from laneweave.protocol.config.loading import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.validators import host_and_port


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


@pytest.mark.parametrize(
    "text",
    ["9464", ":9464", "host:", "host:0", "host:65536", "host:-1", "host:+1", "::1:80", "[]:80",
     "[host]:80", "a b:80", "host:80 ", "host:\u0661", "host:1e3"],
)  # fmt: skip
def test_no_addresses(text: str) -> None:
    with pytest.raises(BadInputError, match=r"metrics: got .*HOST:PORT"):
        load_scenario(None, observation__metrics=text)


def test_no_metrics() -> None:
    assert load_scenario(None, observation__metrics="").observation.metrics == ""
