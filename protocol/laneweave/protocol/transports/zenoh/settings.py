"""Settings of Zenoh sessions, as (path in Zenoh's configuration, value).

docs/PROTOCOL.md gives the reasons.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from typing import Any

from laneweave.protocol.security.connection import Access, Credentials, RouterGuard
from laneweave.protocol.wire.topics import TOPICS, Keys

DROP_AFTER_US = 50
OPEN_MS = 2000
"""Timeout of one attempt to connect. An attempt over a cut link sends again after 1 s. With shorter
timeouts clients abandon attempts that a busy router has not reached yet; it handles one abandoned
attempt in 0.1 s, so that a few clients can keep each other out for good (docs/adr/0036)."""
Setting = tuple[str, Any]


def client_settings(access: Access) -> Iterator[Setting]:
    """Yield the settings of a client."""
    yield from _common_settings("client", access.lease_s)
    yield "connect/endpoints", [access.endpoint]
    # Zenoh accepts these values only together.
    yield (
        "connect/retry",
        {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 1.5},
    )
    # Matters on links that carry reliable and unreliable messages (`?mixed_rel=1`). `Session.put`
    # has no such argument.
    unreliable = [Keys(access.realm).all_of(topic) for topic in TOPICS if not topic.reliable]
    yield (
        "qos/publication",
        [{"key_exprs": unreliable, "config": {"reliability": "best_effort"}}],
    )
    if access.credentials is not None:
        yield from _tls_settings(access.credentials, "connect")


def router_settings(
    endpoints: Sequence[str], lease_s: float, guard: RouterGuard | None
) -> Iterator[Setting]:
    """Yield the settings of a router; without a guard all clients have all rights."""
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
    # The buffers of a hanging client fill up. Blocking senders must wait for less than a lease, or
    # all sessions would expire; other senders drop messages at once.
    yield f"{congestion}/block/wait_before_close", int(lease_s * 1e6 / 3)
    yield f"{congestion}/drop/wait_before_drop", DROP_AFTER_US


def _tls_settings(credentials: Credentials, side: str) -> Iterator[Setting]:
    """Yield the TLS settings of a session; `side` is `connect` or `listen`."""
    tls = "transport/link/tls"
    yield f"{tls}/root_ca_certificate", credentials.ca
    yield f"{tls}/{side}_certificate", credentials.certificate
    if credentials.private_key_pem:
        encoded = base64.b64encode(credentials.private_key_pem.encode()).decode()
        yield f"{tls}/{side}_private_key_base64", encoded
    else:
        yield f"{tls}/{side}_private_key", credentials.private_key
    # Both sides present certificates, and close the link when one expires.
    yield f"{tls}/enable_mtls", True
    yield f"{tls}/verify_name_on_connect", True
    yield f"{tls}/close_link_on_expiration", True
    # Allow only encrypted links, for any endpoint.
    yield "transport/link/protocols", ["tls", "quic"]
