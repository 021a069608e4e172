"""Zenoh endpoints: which kinds there are, and how they are written."""

from __future__ import annotations

import re

from laneweave.protocol.errors import BadInputError

ENDPOINT_RULE = "unixsock-stream/PATH, tcp/HOST:PORT or tls/HOST:PORT"
_NETWORK = re.compile(r"(?:tcp|tls)/(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s/:?#\[\]]+):(?P<port>\d{1,5})")
# Zenoh reads settings of its own behind `?` and `#`, those of TLS among them.
_SOCKET = re.compile(r"unixsock-stream/[^?#]+")


def check_endpoint(endpoint: str, name: str = "network.endpoint") -> str:
    """Return the endpoint.

    Args:
        endpoint: what somebody wrote.
        name: of the field, for the error.

    Raises:
        BadInputError: it is malformed, or of a kind that the Zenoh wheel does not carry.
    """
    found = _NETWORK.fullmatch(endpoint)
    if not _SOCKET.fullmatch(endpoint) and (found is None or int(found["port"]) > 65535):
        raise BadInputError(name, endpoint, ENDPOINT_RULE)
    return endpoint


def is_tls(endpoint: str) -> bool:
    """Tell whether what goes through an endpoint is encrypted."""
    return endpoint.startswith("tls/")


def host_of(endpoint: str) -> str:
    """Return the host of a well-formed endpoint, without brackets; empty for sockets in files."""
    found = _NETWORK.fullmatch(endpoint)
    return found["host"].strip("[]") if found else ""
