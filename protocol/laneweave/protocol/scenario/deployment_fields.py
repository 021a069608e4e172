"""Configuration tables about the deployment of roles: network, security, service.

They are part of the one TOML file that every role reads (`tables.py`); a file that holds only
these is what docs/DEPLOYMENT.md calls a DEPLOYMENT.toml.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import attrs
from attrs import field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import host_port, key_part, key_parts, one_of, within

FleetMembers = str | tuple[str, ...]
"""A shard `I/N` of the vehicles that are announced, or vehicles by name."""
MAX_SHARDS = 10_000


@frozen
class Shard:
    """Share of the announced vehicles that a process takes, by a hash of their names."""

    index: int
    count: int

    def takes(self, vehicle: str) -> bool:
        """Return whether a vehicle belongs to this shard; equal in all processes."""
        return zlib.crc32(vehicle.encode()) % self.count == self.index


def parse_shard(text: str, name: str) -> Shard:
    """Return the shard `I/N`; `name` is the field or option, for the error.

    Raises:
        BadInputError: the text is not a shard.
    """
    index, _, count = text.partition("/")
    digits = index.isdecimal() and count.isdecimal() and len(text) < 20
    if not digits or not int(index) < int(count) <= MAX_SHARDS:
        raise BadInputError(name, text, f"I/N with 0 <= I < N <= {MAX_SHARDS}")
    return Shard(int(index), int(count))


@frozen
class Network:
    """How roles connect, and when they consider each other lost; wall-clock seconds."""

    realm: str = field(default="default", validator=key_part)
    """First part of every key: deployments with different realms do not see each other."""
    endpoint: str = ""
    """Zenoh endpoint of the router; empty: a socket in a temporary folder (`laneweave run`)."""
    listen: tuple[str, ...] = ()
    """Where the router listens; empty: at `endpoint`."""
    lease_s: float = field(default=1.0, validator=within(0.1, 60.0))
    """A silent session is closed after this time (Zenoh's transport lease)."""
    connect_timeout_s: float = field(default=0.0, validator=within(0.0, 86_400.0))
    """How long a role tries to connect, so that the router may start later; 0: one attempt."""
    heartbeat_s: float = field(default=0.1, validator=within(0.01, 10.0))
    election_s: float = field(default=0.7, validator=within(0.05, 60.0))
    """A candidate leads when it has been the best-ranked one for this long. A process that dies is
    noticed at once by its liveliness token; this is for one that hangs."""
    resend_s: float = field(default=0.2, validator=within(0.01, 10.0))
    """PREPARE and PLAN are sent again after this time without an answer."""

    @property
    def listens_at(self) -> tuple[str, ...]:
        """Endpoints at which the router listens."""
        return self.listen or (self.endpoint,)


def _fleets(_: object, attribute: attrs.Attribute[Any], value: Mapping[str, FleetMembers]) -> None:
    for name, members in value.items():
        field_name = f"{attribute.name}[{name}]"
        if isinstance(members, str):
            parse_shard(members, field_name)
        elif not members:
            raise BadInputError(field_name, [], "a shard I/N, or a list of vehicles")
        key_parts(None, attribute, (name, *(() if isinstance(members, str) else members)))


@frozen
class Security:
    """Access control of the network; off by default, for runs on one host."""

    mode: str = field(default="off", validator=one_of("off", "mtls"))
    """`mtls`: every process has a certificate, and the router grants rights by its name."""
    folder: str = "certs"
    """Folder of the certificates that `laneweave certs init` makes; relative to the file."""
    fleets: Mapping[str, FleetMembers] = field(factory=dict, validator=_fleets, hash=False)
    """Agent processes that drive several vehicles: a shard `I/N`, or the vehicles' names."""
    vehicles: tuple[str, ...] = field(default=(), validator=key_parts)
    """Vehicles that may have a process of their own; empty: all that may arrive in the demand."""
    clients: tuple[str, ...] = field(default=("plan",), validator=key_parts)
    """Processes that may query the planning service."""
    observers: tuple[str, ...] = field(default=("ping", "status", "watch"), validator=key_parts)
    """Processes that may only read."""


@frozen
class Service:
    """The planning service of every coordinator."""

    workers: int = field(default=0, validator=within(0, 256))
    """Processes that plan; 0: one less than there are cores, at least one."""
    worker_memory_mb: float = field(default=1500.0, validator=within(50.0, 1_000_000.0))
    """Limit on the arrays of branch and bound in each of them. A plan that reaches it is completed
    by the other solver; without a proof its status is `feasible`."""
    queue_limit: int = field(default=256, validator=within(1, 100_000))
    """Maximum number of requests that wait or are being planned; more are refused."""
    max_request_bytes: int = field(default=262_144, validator=within(1024, 1 << 20))
    """A longer request is refused."""
    max_deadline_s: float = field(default=600.0, validator=within(0.001, 3600.0))
    """A request with a longer deadline is refused."""
    cache_entries: int = field(default=1024, validator=within(0, 1_000_000))
    """Number of answers kept for requests that are repeated with the same id."""
    cache_s: float = field(default=60.0, validator=within(0.0, 86_400.0))
    """Time for which answers are kept."""


@frozen
class Observation:
    """Observation of a deployment."""

    metrics: str = field(default="", validator=host_port)
    """HOST:PORT at which a role serves its metrics in the Prometheus text format; empty: none."""
