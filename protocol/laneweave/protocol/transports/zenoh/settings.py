"""Settings of Zenoh's sessions, as paths in its configuration and values. Pure.

`zenoh_transport` writes them into configurations; docs/PROTOCOL.md says why they are so.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from typing import Any

from laneweave.protocol.security.access import Access, Credentials, RouterGuard

DROP_AFTER_US = 50
OPEN_MS = 2000
"""How long one attempt to connect may take. Over a link that is cut, packets vanish: an attempt
that goes on for long is still waiting when the link is back."""
Setting = tuple[str, Any]


def client_settings(access: Access) -> Iterator[Setting]:
    """Yield the settings of whoever connects to a router."""
    yield from _common_settings("client", access.lease_s)
    yield "connect/endpoints", [access.endpoint]
    # As one: the parts cannot be set one by one.
    yield (
        "connect/retry",
        {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
    )
    if access.credentials is not None:
        yield from _tls_settings(access.credentials, "connect")


def router_settings(
    endpoints: Sequence[str], lease_s: float, guard: RouterGuard | None
) -> Iterator[Setting]:
    """Yield the settings of a router; without a guard anybody may do anything."""
    yield from _common_settings("router", lease_s)
    yield "listen/endpoints", list(endpoints)
    if guard is not None:
        yield from _tls_settings(guard.credentials, "listen")
        yield "access_control", guard.access_control
        yield "low_pass_filter", guard.size_limits


def _common_settings(mode: str, lease_s: float) -> Iterator[Setting]:
    congestion = "transport/link/tx/queue/congestion_control"
    yield "mode", mode
    yield "scouting/multicast/enabled", False
    yield "scouting/gossip/enabled", False
    yield "transport/link/tx/lease", int(lease_s * 1000)
    yield "transport/unicast/open_timeout", OPEN_MS
    yield "transport/shared_memory/enabled", False
    # A client that hangs fills its buffers. Whoever waits for room in them waits for less than
    # a lease, or everybody would give everybody up; who may drop, drops at once.
    yield f"{congestion}/block/wait_before_close", int(lease_s * 1e6 / 3)
    yield f"{congestion}/drop/wait_before_drop", DROP_AFTER_US


def _tls_settings(credentials: Credentials, side: str) -> Iterator[Setting]:
    """Yield the settings of a session that shows credentials; `side` begins its own settings."""
    tls = "transport/link/tls"
    yield f"{tls}/root_ca_certificate", credentials.ca
    yield f"{tls}/{side}_certificate", credentials.certificate
    if credentials.private_key_pem:
        encoded = base64.b64encode(credentials.private_key_pem.encode()).decode()
        yield f"{tls}/{side}_private_key_base64", encoded
    else:
        yield f"{tls}/{side}_private_key", credentials.private_key
    # Both sides show certificates, and believe none beyond its end.
    yield f"{tls}/enable_mtls", True
    yield f"{tls}/verify_name_on_connect", True
    yield f"{tls}/close_link_on_expiration", True
    # Nothing else is spoken, whatever an endpoint says.
    yield "transport/link/protocols", ["tls"]
