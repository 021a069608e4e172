"""Groups of processes in network namespaces of their own, so that partitions are real ones.

The namespaces form a star. The router lives in the hub, which has one address for all; each group
is joined to it by one pair of virtual Ethernet devices (veth), and taking the hub's end down cuts
the group off: its packets vanish, its connections run into their leases, and it sees everybody
else's tokens go. The supervisor of a run talks to the router through a Unix socket, which no
namespace concerns.

Each namespace is held by a process of the run and has no name. The kernel removes it, with its
devices and addresses, when the last process in it has ended, however the run ends: nothing outside
is touched and nothing is left behind. It takes the right to make namespaces (CAP_SYS_ADMIN) and the
program `ip`.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
from collections.abc import Collection
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path

from attrs import define, field

PORT = 7447
HUB_ADDRESS = "10.77.255.1"
"""Of the hub, whichever link leads there: all groups can read the same configuration."""
ANSWER_S = 10.0
"""How long a namespace may take to be made, or a command in it to be done."""
HUB = "hub"
_CLONE_NEWNET = 0x40000000
_PATH = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
_UPLINK = "uplink"
"""A group's end of its pair of devices; the hub's end is called as the group."""


class NamespacesUnavailableError(RuntimeError):
    """Network namespaces cannot be made or used here; the message says why."""


def join_namespace(process_id: int) -> None:
    """Move this process, which must have one thread only, into another one's network namespace.

    Raises:
        OSError: that is not allowed, or there is no such process.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with Path(f"/proc/{process_id}/ns/net").open("rb") as namespace:
        _check(libc.setns(namespace.fileno(), _CLONE_NEWNET))


def hold_namespace(connection: Connection) -> None:
    """Make a network namespace and carry out commands in it, until the other end is closed.

    Answers an empty text when all is well, the reason when it is not: first for the namespace, then
    for each list of words that it receives.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _check(ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET))
    except OSError as error:
        connection.send(f"cannot make a network namespace: {error.strerror}")
        return
    connection.send("")
    while True:
        try:
            words = connection.recv()
        except EOFError:
            return
        connection.send(_run(words))


def _check(status: int) -> None:
    if status != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _run(words: list[str]) -> str:
    try:
        done = subprocess.run(  # noqa: S603 (words are made in this module)
            words, capture_output=True, text=True, timeout=ANSWER_S / 2, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return "" if done.returncode == 0 else f"{' '.join(words)}: {done.stderr.strip()}"


@define
class _Namespace:
    """The supervisor's side of a namespace and of the process that holds it."""

    process: ForkServerProcess
    connection: Connection

    @classmethod
    def make(cls, context: ForkServerContext, name: str) -> _Namespace:
        ours, theirs = context.Pipe()
        process = context.Process(target=hold_namespace, args=(theirs,), name=f"namespace-{name}")
        process.start()
        theirs.close()
        return cls(process, ours)

    @property
    def process_id(self) -> int:
        return self.process.pid or 0

    def ip(self, *words: str) -> None:
        """Run `ip` in this namespace."""
        program = shutil.which("ip", path=_PATH)
        if program is None:
            raise NamespacesUnavailableError("there is no program `ip`")
        try:
            self.connection.send([program, *words])
        except OSError as error:
            raise NamespacesUnavailableError("a namespace is gone") from error
        self.check_answer()

    def check_answer(self) -> None:
        try:
            answer = self.connection.recv() if self.connection.poll(ANSWER_S) else "no answer"
        except (EOFError, OSError) as error:
            raise NamespacesUnavailableError("a namespace is gone") from error
        if answer:
            raise NamespacesUnavailableError(answer)

    def close(self) -> None:
        self.connection.close()
        self.process.join(ANSWER_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(ANSWER_S)


@define
class GroupNetwork:
    """The namespaces of a run: a hub with the router, and one for each group."""

    context: ForkServerContext
    groups: tuple[str, ...]
    _namespaces: dict[str, _Namespace] = field(factory=dict)
    _cut: set[str] = field(factory=set)

    def open(self) -> None:
        """Make the namespaces and their links.

        Raises:
            NamespacesUnavailableError: that is not possible here; nothing is left of it.
        """
        try:
            for name in (HUB, *self.groups):
                namespace = self._namespaces[name] = _Namespace.make(self.context, name)
                namespace.check_answer()
                namespace.ip("link", "set", "lo", "up")
            self._namespaces[HUB].ip("addr", "add", f"{HUB_ADDRESS}/32", "dev", "lo")
            for group in self.groups:
                self._link(group)
        except NamespacesUnavailableError:
            self.close()
            raise

    def _link(self, group: str) -> None:
        hub, leaf = self._namespaces[HUB], self._namespaces[group]
        ends = ("link", "add", "name", group, "type", "veth", "peer", "name", _UPLINK)
        hub.ip(*ends, "netns", str(leaf.process_id))
        for namespace, device, last in ((hub, group, 1), (leaf, _UPLINK, 2)):
            namespace.ip("addr", "add", f"{self._network(group)}.{last}/30", "dev", device)
            namespace.ip("link", "set", "dev", device, "up")
        leaf.ip("route", "add", "default", "via", f"{self._network(group)}.1")

    def _network(self, group: str) -> str:
        """Return the first three parts of the addresses of a group's link."""
        return f"10.77.{self.groups.index(group)}"

    def process_id(self, name: str) -> int:
        """Return a process in a group's namespace, or in the hub's, for `join_namespace`."""
        return self._namespaces[name].process_id

    @property
    def listen(self) -> str:
        """Zenoh endpoint at which the router listens to the groups."""
        return f"tcp/0.0.0.0:{PORT}"

    @property
    def endpoint(self) -> str:
        """Zenoh endpoint of the router, as every group sees it."""
        return f"tcp/{HUB_ADDRESS}:{PORT}"

    def cut_off(self, groups: Collection[str]) -> set[str]:
        """Take exactly these groups' links down, and return those of which that is news.

        Raises:
            NamespacesUnavailableError: a command failed.
        """
        wanted = set(groups)
        changed = wanted ^ self._cut
        for group in sorted(changed):
            state = "down" if group in wanted else "up"
            self._namespaces[HUB].ip("link", "set", "dev", group, state)
        self._cut = wanted
        return changed

    def close(self) -> None:
        """Let the kernel have the namespaces; to be called when the roles in them have ended."""
        for namespace in self._namespaces.values():
            namespace.close()
        self._namespaces.clear()
