"""Identities and incarnations of processes.

    router  bridge  coordinator.NAME  vehicle.NAME  fleet.NAME  client.NAME  operator.NAME
    observer.NAME

The *identity* is the common name of a process's certificate and determines its rights
(`security.access_control`). The *incarnation* identifies one start of a process: a time in ns whose
low bits are the process id, combined with a hash of the machine and the container, in which process
ids may be the same. Incarnations ascend, and two live processes of a machine never have the same
one, even after `above` has raised one beyond the clock.
"""

from __future__ import annotations

import os
import platform
import time
from hashlib import blake2b
from pathlib import Path

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.wire.topics import Party

MAX_COMMON_NAME = 64
"""Maximum number of characters of a common name (X.520)."""
IDENTITY_RULE = (
    "router, bridge, or coordinator, vehicle, fleet, client, operator or observer with a dot and a "
    f"name, at most {MAX_COMMON_NAME} characters"
)
_PROCESS_BITS = 22
"""Number of low bits of an incarnation that identify the process: as many as a Linux process id
has. The bits above them count steps of 4 ms."""
_STEP = 1 << _PROCESS_BITS


@frozen
class Identity:
    """Identity of one process."""

    party: Party
    name: str = ""
    """Empty for the router and the bridge."""

    @property
    def common_name(self) -> str:
        """Common name in the certificate."""
        return f"{self.party}.{self.name}" if self.name else str(self.party)


def parse_identity(text: str, field: str = "identity") -> Identity:
    """Return the identity with this common name.

    Raises:
        BadInputError: the text is not an identity.
    """
    kind, dot, name = text.partition(".")
    if len(text) <= MAX_COMMON_NAME and kind in list(Party):
        party = Party(kind)
        unnamed = party in (Party.ROUTER, Party.BRIDGE)
        if not dot if unnamed else NAME_PATTERN.fullmatch(name):
            return Identity(party, name)
    raise BadInputError(field, text, IDENTITY_RULE)


class Incarnations:
    """Generator of incarnations for this process, in ascending order."""

    def __init__(self) -> None:
        """Start below every incarnation."""
        self._last = 0
        self._process = (os.getpid() ^ _host_hash()) % _STEP

    def __call__(self) -> int:
        """Return an unused incarnation."""
        number = time.time_ns() // _STEP * _STEP + self._process
        self._last = number = above(number, self._last)
        return number


def process_id_of(incarnation: int) -> int:
    """Return the id of the process with an incarnation, if it runs on this host.

    For a process of another host or container, the result is arbitrary.
    """
    return (incarnation ^ _host_hash()) % _STEP


def _host_hash() -> int:
    """Return a hash of the machine, since its last boot, and of the container (PID namespace)."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        container = Path("/proc/self/ns/pid").stat().st_ino
    except OSError:  # not Linux
        boot, container = platform.node(), 0
    return int.from_bytes(blake2b(f"{boot}/{container}".encode(), digest_size=8).digest())


def above(number: int, floor: int) -> int:
    """Return `number`, or the next incarnation of the same process that is greater than `floor`."""
    if number > floor:
        return number
    return number + -(-(floor + 1 - number) // _STEP) * _STEP
