"""Tables of a scenario file about execution and deployment: runtime, network, security, service."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import attrs
from attrs import field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import (
    host_port,
    key_part,
    key_parts,
    one_of,
    within,
    within_or_none,
)
from laneweave.protocol.wire.bounds import Bounds

FleetMembers = str | tuple[str, ...]
"""A shard `I/N` of the announced vehicles, or vehicles by name."""
MAX_SHARDS = 10_000
LOWEST_PACE, HIGHEST_PACE = 0.01, 1000.0
"""Bounds of `runtime.max_pace`."""
MAX_HOLD_S = 1.0
"""Maximum time between two messages of a vehicle that holds undisturbed [s]."""


@frozen
class Shard:
    """Part `index` of the announced vehicles, split into `count` parts by a hash of their names."""

    index: int
    count: int

    @property
    def name(self) -> str:
        """Name of the shard in keys: `I-of-N`."""
        return f"{self.index}-of-{self.count}"

    @classmethod
    def named(cls, name: str) -> Shard | None:
        """Return the shard with this `name`; None: it is not the name of a shard."""
        try:
            return parse_shard(name.replace("-of-", "/"), "drives")
        except BadInputError:
            return None

    def contains(self, vehicle: str) -> bool:
        """Return whether a vehicle belongs to this shard; all processes agree."""
        return zlib.crc32(vehicle.encode()) % self.count == self.index


def parse_shard(text: str, name: str) -> Shard:
    """Return the shard `I/N`; errors name the field or option `name`.

    Raises:
        BadInputError: the text is not a shard.
    """
    index, _, count = text.partition("/")
    digits = index.isdecimal() and count.isdecimal() and len(text) < 20
    if not digits or not int(index) < int(count) <= MAX_SHARDS:
        raise BadInputError(name, text, f"I/N with 0 <= I < N <= {MAX_SHARDS}")
    return Shard(int(index), int(count))


def check_pace(pace: float | None, name: str) -> None:
    """Check a pace that replaces `runtime.max_pace`; None: it replaces nothing.

    Raises:
        BadInputError: the pace is out of range; names the option or argument `name`.
    """
    if pace is not None and not LOWEST_PACE <= pace <= HIGHEST_PACE:
        raise BadInputError(name, pace, f"[{LOWEST_PACE:g}, {HIGHEST_PACE:g}]")


@frozen
class Network:
    """Connections between roles; durations are wall-clock time."""

    realm: str = field(default="default", validator=key_part)
    """First variable part of every key; processes of different realms do not communicate."""
    endpoint: str = ""
    """Zenoh endpoint of the router; empty: a socket in a temporary folder (`laneweave run`)."""
    listen: tuple[str, ...] = ()
    """Endpoints at which the router listens; empty: `endpoint`."""
    lease_s: float = field(default=1.0, validator=within(0.1, 60.0))
    """Time after which a silent session is closed (Zenoh's transport lease)."""
    connect_timeout_s: float = field(default=0.0, validator=within(0.0, 86_400.0))
    """Time for which a role keeps trying to connect if the router starts later; 0: one attempt."""
    heartbeat_s: float = field(default=0.1, validator=within(0.01, 10.0))
    election_s: float = field(default=0.7, validator=within(0.05, 60.0))
    """Election timeout: a candidate leads after ranking highest for this time. The timeout
    detects hanging processes; liveliness tokens report dead ones at once."""
    resend_s: float = field(default=0.2, validator=within(0.01, 10.0))
    """Time without an answer after which PREPARE and PLAN are sent again."""

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
    """Access control of the network; off by default."""

    mode: str = field(default="off", validator=one_of("off", "mtls"))
    """`mtls`: every process has a certificate, whose name determines its rights."""
    folder: str = "certs"
    """Folder of the certificates, relative to the scenario file."""
    fleets: Mapping[str, FleetMembers] = field(factory=dict, validator=_fleets, hash=False)
    """Agent processes that drive several vehicles, by name: a shard `I/N`, or names of vehicles."""
    vehicles: tuple[str, ...] = field(default=(), validator=key_parts)
    """Vehicles that may have their own process; empty: all that may arrive."""
    clients: tuple[str, ...] = field(default=("plan",), validator=key_parts)
    """Processes that may query the planning service."""
    operators: tuple[str, ...] = field(default=("operator",), validator=key_parts)
    """Processes that may close parts of lanes, and open them again."""
    observers: tuple[str, ...] = field(default=("ping", "status", "watch"), validator=key_parts)
    """Processes that may only subscribe."""


@frozen
class Service:
    """The planning service of every coordinator."""

    workers: int = field(default=0, validator=within(0, 256))
    """Number of worker processes; 0: one less than the number of cores, but at least one."""
    worker_memory_mb: float = field(default=300.0, validator=within(50.0, 1_000_000.0))
    """Memory limit for the arrays of branch and bound in each worker. When a plan reaches it, the
    other solver completes the plan; without an optimality proof its status is `feasible`."""
    queue_limit: int = field(default=256, validator=within(1, 100_000))
    """Maximum number of waiting and running requests; further ones are rejected."""
    client_queue_limit: int = field(default=64, validator=within(1, 100_000))
    """Maximum number of waiting and running requests of one client; further ones are rejected."""
    max_request_bytes: int = field(default=262_144, validator=within(1024, 1 << 20))
    """Maximum size of a request; longer ones are rejected."""
    max_deadline_s: float = field(default=600.0, validator=within(0.001, 3600.0))
    """Maximum deadline of a request; longer ones are rejected."""


@frozen
class Runtime:
    """Execution of a run."""

    tick_s: float = field(default=0.1, validator=within(0.01, 1.0))
    tick_resend_s: float = field(default=0.05, validator=within(0.005, 10.0))
    """Interval for resending SENSE to agents that have not answered (wall-clock seconds)."""
    tick_deadline_s: float = field(default=0.3, validator=within(0.02, 60.0))
    """Time after which a tick ends; vehicles that did not answer keep their trajectories
    (wall-clock seconds)."""
    agent_silent_s: float = field(default=3.0, validator=within(0.1, 600.0))
    """Time without an answer after which ticks no longer wait for an agent, and its vehicle's
    caretaker takes charge (wall-clock seconds)."""
    agent_start_s: float = field(default=15.0, validator=within(0.1, 120.0))
    """Maximum wait at the entrance for a vehicle's agent (wall-clock seconds)."""
    announce_s: float = field(default=6.0, validator=within(0.0, 600.0))
    """Time by which announcements precede arrivals, so that agents can start (road seconds)."""
    hold_period_ticks: int = field(default=5, validator=within(1, 100))
    """Ticks between two messages of a vehicle that holds its cell undisturbed, but at most 1 s; 1:
    it sends and receives in every tick, as all others."""
    max_pace: float = field(default=10.0, validator=within(LOWEST_PACE, HIGHEST_PACE))
    """Maximum road seconds per wall-clock second. Network and planning take wall-clock time, which
    must be short compared with the time between a plan and its start."""
    coordinators: int = field(default=3, validator=within(1, 9))
    vehicles_per_process: int = field(default=1, validator=within(1, 1000))
    max_road_s: float = field(default=100_000.0, validator=within(1.0, 1e6))
    """Road time after which an incomplete run is stopped and counts as failed."""

    @property
    def hold_ticks(self) -> int:
        """Ticks between two messages of a vehicle that holds undisturbed: at most 1 s."""
        return max(1, min(self.hold_period_ticks, round(MAX_HOLD_S / self.tick_s)))

    def bounds(self, incarnation: int) -> Bounds:
        """Return the bounds of numbers that a process with this incarnation receives."""
        return Bounds(incarnation, self.tick_s, self.max_road_s)


@frozen
class Observation:
    """Observation of a deployment."""

    metrics: str = field(default="", validator=host_port)
    """HOST:PORT where a role serves its metrics in the Prometheus text format; empty: nowhere."""


@frozen
class SumoSettings:
    """A SUMO simulation of the user, of which laneweave drives a corridor."""

    config: str = ""
    """SUMO's configuration file; empty: the road of the scenario itself."""
    corridor: str = ""
    """Its first and its last edge: FIRST_EDGE:LAST_EDGE."""
    begin_s: float | None = field(default=None, validator=within_or_none(0.0, 1e9))
    """SUMO's time at which the run begins; default: `begin` of the configuration."""
    scale: float | None = field(default=None, validator=within_or_none(0.0, 1e3, open_low=True))
    """Factor for SUMO's demand; default: `scale` of the configuration."""
    gui: bool = False
    """Whether sumo-gui shows the run; with `config` or without."""
