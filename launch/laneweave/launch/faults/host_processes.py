"""Processes of a deployment on this host: from a liveliness token to a process that gets signals.

The token of a process contains its incarnation, which contains its process id. On other hosts and
in other containers the same number means another process, or none. So a process gets signals only
if its command line, its configuration, its user and its start time are those of the token's sender.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path

from attrs import frozen

from laneweave.launch.deploy.assigned_vehicles import AssignedVehicles, assigned_vehicles
from laneweave.launch.observe.process_view import ProcessToken
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.identities import parse_identity, process_id_of
from laneweave.protocol.wire.topics import ROLES, Party

COMMAND = "laneweave"
DEFAULT_COORDINATOR = "c1"
"""Name of `laneweave coordinator` without `--name`."""
FLAGS = ("--takeover",)
"""Options of the roles' commands without a value."""
CLOCK_TOLERANCE_S = 2.0
"""Tolerance of start times, which the system reports in seconds."""
PROC = Path("/proc")
ELSEWHERE = "is not a process of this host"


class NotOnThisHostError(Exception):
    """No process of this host is certainly the sender of a token; the message says why."""


@frozen
class HostProcess:
    """A role of a deployment by hand that runs on this host."""

    pid: int
    vehicles: AssignedVehicles | None
    """Vehicles that it drives; None: it is not an agent process."""
    _descriptor: int
    """Descriptor of the process: unlike its id, it never means another process."""

    @property
    def is_alive(self) -> bool:
        """Whether the process has not exited."""
        return self.send(0)

    def send(self, number: int) -> bool:
        """Send a signal; return False if the process has exited."""
        try:
            signal.pidfd_send_signal(self._descriptor, number)
        except ProcessLookupError:
            return False
        # A process that has exited and not been awaited by its parent accepts signals.
        return _state(self.pid) != "Z"

    def drives(self, vehicle: str) -> bool:
        """Return whether the process drives a vehicle of this name."""
        assigned = self.vehicles
        if assigned is None:
            return False
        of_shard = assigned.shard is not None and assigned.shard.contains(vehicle)
        return of_shard or vehicle in assigned.vehicles

    def close(self) -> None:
        """Release the descriptor."""
        os.close(self._descriptor)


def find_process(token: ProcessToken, realm: str) -> HostProcess:
    """Return the process that has declared a token, if it certainly runs on this host.

    Raises:
        NotOnThisHostError: it does not, or it is not certain.
    """
    pid = process_id_of(token.incarnation)
    try:
        descriptor = os.pidfd_open(pid)
    except OSError as error:
        raise NotOnThisHostError(ELSEWHERE) from error
    try:
        # What is read from now on is of the process of the descriptor, if that is still alive.
        process = HostProcess(pid, _checked(token, realm, pid), descriptor)
        if process.is_alive:
            return process
    except OSError as error:
        os.close(descriptor)
        raise NotOnThisHostError(f"may be process {pid}: {error.strerror}") from error
    except NotOnThisHostError:
        os.close(descriptor)
        raise
    os.close(descriptor)
    raise NotOnThisHostError(ELSEWHERE)


def _checked(token: ProcessToken, realm: str, pid: int) -> AssignedVehicles | None:
    """Check that a process is the sender of a token, and return the vehicles that it drives.

    Raises:
        NotOnThisHostError: it is not.
        OSError: the process has exited, or its files cannot be read.
    """
    if _started_s(pid) > token.incarnation / 1e9 + CLOCK_TOLERANCE_S:
        raise NotOnThisHostError(ELSEWHERE)
    owner, user = (PROC / str(pid)).stat().st_uid, os.geteuid()
    arguments = _arguments(pid)
    if not arguments or arguments[0] != _command_of(token.role):
        raise NotOnThisHostError(ELSEWHERE)
    if user not in (0, owner):
        raise NotOnThisHostError(f"is process {pid} of another user")
    options, names = _parsed(arguments[1:])
    vehicles = None
    try:
        settings = _settings(pid, options)
        if token.role == ROLES[Party.COORDINATOR]:
            role, name = token.role, options.get("--name", DEFAULT_COORDINATOR)
        elif token.role == ROLES[Party.BRIDGE]:
            role = name = token.role
        else:
            shard, fleet = options.get("--shard"), options.get("--fleet")
            vehicles = assigned_vehicles(settings.security, names, shard, fleet)
            identity = parse_identity(vehicles.identity)
            role, name = ROLES[identity.party], identity.name
    except BadInputError as error:
        raise NotOnThisHostError(f"may be process {pid}: {error}") from error
    if (role, name) != (token.role, token.name):
        raise NotOnThisHostError(ELSEWHERE)
    if settings.network.realm != realm:
        found = settings.network.realm
        raise NotOnThisHostError(f"is process {pid}, whose file has realm {found} now")
    return vehicles


def _settings(pid: int, options: dict[str, str]) -> Scenario:
    config = options.get("--config")
    # A relative path begins in the folder of the process.
    path = None if config is None else (PROC / str(pid) / "cwd").readlink() / config
    return load_scenario(path)


def _command_of(role: str) -> str:
    return ROLES[Party.VEHICLE] if role == ROLES[Party.FLEET] else role


def _arguments(pid: int) -> list[str]:
    """Return the arguments of a process after `laneweave`; empty: it runs another program.

    Raises:
        OSError: the process has exited.
    """
    raw = (PROC / str(pid) / "cmdline").read_bytes()
    words = [word.decode(errors="replace") for word in raw.split(b"\0")[:-1]]
    # The interpreter, which may have an option, comes first.
    for index, word in enumerate(words[:3]):
        if Path(word).name == COMMAND:
            return words[index + 1 :]
    return []


def _parsed(arguments: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return the options of a role's command with their values, and the other arguments."""
    options: dict[str, str] = {}
    others: list[str] = []
    words = iter(arguments)
    for word in words:
        name, equals, value = word.partition("=")
        if not name.startswith("--"):
            others.append(word)
        elif equals or name in FLAGS:
            options[name] = value
        else:
            options[name] = next(words, "")
    return options, others


def _started_s(pid: int) -> float:
    """Return when a process was started [s since 1970].

    Raises:
        OSError: the process has exited.
    """
    began_s = next(
        float(line.split()[1])
        for line in (PROC / "stat").read_text(encoding="ascii").splitlines()
        if line.startswith("btime ")
    )
    return began_s + int(_fields(pid)[19]) / os.sysconf("SC_CLK_TCK")


def _state(pid: int) -> str:
    try:
        return _fields(pid)[0]
    except OSError:
        return "Z"


def _fields(pid: int) -> list[str]:
    """Return what the system says about a process, from its state on.

    Raises:
        OSError: the process has exited.
    """
    text = (PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace")
    # The name of the program comes before, in brackets, and may contain anything.
    return text.rpartition(")")[2].split()
