"""Network namespaces for groups of processes, so that faults of links affect real connections.

The namespaces form a star. The router runs in the hub, which has the same address for all groups. A
pair of virtual Ethernet devices (veth) connects each group to the hub. Packet filters at both ends
of a pair drop a share of the received packets. Taking the hub's end down disconnects the group: all
packets are lost, connections end when their leases expire, and the group loses the liveliness
tokens of all others. The launcher reaches the router through a Unix socket, which is independent of
namespaces.

The namespaces have no names; each is held by a process of the run. The kernel removes a namespace
with its devices and addresses when its last process exits, so nothing remains after a run. This
requires CAP_SYS_ADMIN and the program `ip`, and `nft` for links that lose packets.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
from collections.abc import Iterable, Mapping
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path

from attrs import define, field, frozen

from laneweave.launch.faults.specification import NAMESPACES, FaultSpec
from laneweave.protocol.errors import BadInputError

HUB_ADDRESS = "10.77.255.1"
"""Address of the hub for all groups, so that they can share one configuration."""
LISTEN = "tcp/0.0.0.0:7447"
"""Zenoh endpoint on which the router listens for the groups."""
ENDPOINT = f"tcp/{HUB_ADDRESS}:7447"
"""Zenoh endpoint of the router for all groups."""
ANSWER_S = 10.0
"""Maximum time to create a namespace or to run a command in it."""
HUB = "hub"
_CLONE_NEWNET = 0x40000000
_PATH = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
_PARTS = 10_000
"""Denominator of shares of lost packets."""
_DEVICE = ("address", "02:00:0a:4d:ff:01", "arp", "off")
"""Properties of all devices. ARP would delay packets over a restored link by up to 1 s. Without it,
packets are addressed to the sender's own hardware address, so both ends need the same."""
_UPLINK = "uplink"
"""A group's end of its device pair; the hub's end is named after the group."""


@frozen
class Link:
    """State of the link between a group and the hub."""

    up: bool = True
    loss: float = 0.0
    """Share of packets lost in each direction, in [0, 1]."""
    burst: int = 1
    """Number of successive packets lost together; 1: packets are lost independently."""


PERFECT = Link()


class NamespacesUnavailableError(RuntimeError):
    """Network namespaces cannot be created or used; the message gives the reason."""


def join_namespace(process_id: int) -> None:
    """Move this process, which must be single-threaded, into the namespace of another process.

    Raises:
        OSError: permission is missing, or the other process does not exist.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with Path(f"/proc/{process_id}/ns/net").open("rb") as namespace:
        _check(libc.setns(namespace.fileno(), _CLONE_NEWNET))


def hold_namespace(connection: Connection) -> None:
    """Create a network namespace, and run commands in it until the connection is closed.

    Receives each command as a list of words. Sends an error text (empty on success) after creating
    the namespace and after each command.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _check(ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET))
    except OSError as error:
        connection.send(f"cannot create a network namespace: {error.strerror}")
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
        done = subprocess.run(  # noqa: S603 (the words come from this module)
            words, capture_output=True, text=True, timeout=ANSWER_S / 2, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return "" if done.returncode == 0 else f"{' '.join(words)}: {done.stderr.strip()}"


@define
class _Namespace:
    """A namespace and the process that holds it, controlled by the launcher."""

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

    def run(self, name: str, *words: str) -> None:
        """Run a program in this namespace."""
        program = shutil.which(name, path=_PATH)
        if program is None:
            raise NamespacesUnavailableError(f"the program `{name}` is not installed")
        try:
            self.connection.send([program, *words])
        except OSError as error:
            raise NamespacesUnavailableError("the process of a namespace has exited") from error
        self.check_answer()

    def check_answer(self) -> None:
        try:
            answer = self.connection.recv() if self.connection.poll(ANSWER_S) else "no answer"
        except (EOFError, OSError) as error:
            raise NamespacesUnavailableError("the process of a namespace has exited") from error
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
    """Namespaces of a run: the hub with the router, and one per group."""

    context: ForkServerContext
    groups: tuple[str, ...]
    _namespaces: dict[str, _Namespace] = field(factory=dict)
    _links: dict[str, Link] = field(factory=dict)

    def open(self) -> None:
        """Create the namespaces and their links.

        Raises:
            NamespacesUnavailableError: creation failed; nothing remains.
        """
        try:
            for name in (HUB, *self.groups):
                namespace = self._namespaces[name] = _Namespace.make(self.context, name)
                namespace.check_answer()
                namespace.run("ip", "link", "set", "lo", "up")
            self._namespaces[HUB].run("ip", "addr", "add", f"{HUB_ADDRESS}/32", "dev", "lo")
            for group in self.groups:
                self._link(group)
        except NamespacesUnavailableError:
            self.close()
            raise

    def _link(self, group: str) -> None:
        hub, leaf = self._namespaces[HUB], self._namespaces[group]
        pair = ("name", group, *_DEVICE, "type", "veth", "peer", "name", _UPLINK, *_DEVICE)
        hub.run("ip", "link", "add", *pair, "netns", str(leaf.process_id))
        for namespace, device, last in ((hub, group, 1), (leaf, _UPLINK, 2)):
            namespace.run("ip", "addr", "add", f"{self._network(group)}.{last}/30", "dev", device)
            namespace.run("ip", "link", "set", "dev", device, "up")
        leaf.run("ip", "route", "add", "default", "via", f"{self._network(group)}.1")

    def _network(self, group: str) -> str:
        """Return the first three bytes of the addresses on the link of a group."""
        return f"10.77.{self.groups.index(group)}"

    def process_id(self, name: str) -> int:
        """Return the id of a process in the namespace of a group or the hub."""
        return self._namespaces[name].process_id

    def set_links(self, links: Mapping[str, Link]) -> None:
        """Change the links of groups; all other links become perfect.

        Raises:
            NamespacesUnavailableError: a command failed.
        """
        hub = filter_rules(self._links.items())
        for group in self.groups:
            wanted, current = links.get(group, PERFECT), self._links.get(group, PERFECT)
            self._links[group] = wanted
            if wanted.up != current.up:
                state = "up" if wanted.up else "down"
                self._namespaces[HUB].run("ip", "link", "set", "dev", group, state)
            if (wanted.loss, wanted.burst) != (current.loss, current.burst):
                self._filter(group, [(_UPLINK, wanted)])
        if filter_rules(self._links.items()) != hub:
            self._filter(HUB, self._links.items())

    def check_filters(self) -> None:
        """Check that links can lose packets.

        Raises:
            NamespacesUnavailableError: they cannot; nothing remains.
        """
        try:
            self._filter(HUB, ())
        except NamespacesUnavailableError:
            self.close()
            raise

    def _filter(self, namespace: str, links: Iterable[tuple[str, Link]]) -> None:
        """Drop packets received in a namespace, by device."""
        self._namespaces[namespace].run("nft", filter_rules(links))

    def close(self) -> None:
        """Release the namespaces; call this after the roles in them have exited."""
        for namespace in self._namespaces.values():
            namespace.close()
        self._namespaces.clear()


def filter_rules(links: Iterable[tuple[str, Link]]) -> str:
    """Return commands for `nft` that replace the packet filter of a namespace.

    Filters are at the receiving end, because the kernel reports a packet that is dropped at the
    sending end as an error to the sender, which then closes the connection.
    """
    rules = []
    for device, link in links:
        if link.loss > 0.0:
            match = f'iifname "{device}" meta l4proto {{ tcp, udp }} {_condition(link)} drop'
            rules.append(f"add rule inet laneweave received {match}")
    chain = "{ type filter hook input priority 0 ; }"
    return "; ".join(
        [
            "flush ruleset",
            "add table inet laneweave",
            f"add chain inet laneweave received {chain}",
            *rules,
        ]
    )


def _condition(link: Link) -> str:
    """Return the condition of `nft` for losing a packet."""
    if link.loss >= 1.0:
        return ""
    if link.burst > 1:
        # The first ones of each group of packets.
        return f"numgen inc mod {round(link.burst / link.loss)} < {link.burst}"
    return f"numgen random mod {_PARTS} < {min(round(link.loss * _PARTS), _PARTS - 1)}"


def open_network(
    specification: FaultSpec, context: ForkServerContext
) -> tuple[GroupNetwork | None, str]:
    """Create the namespaces that partitions and faults of links use.

    Returns:
        (namespaces, ""), or (None, reason); the reason is empty if no fault needs namespaces.

    Raises:
        BadInputError: a fault requires namespaces, which cannot be created.
    """
    parts = [part for part in specification.partition if part.may_use_links]
    groups = dict.fromkeys(part.between[0] for part in parts)
    groups |= dict.fromkeys(group for fault in specification.link for group in fault.groups)
    if not groups:
        return None, ""
    network = GroupNetwork(context, tuple(groups))
    try:
        network.open()
        if specification.link:
            network.check_filters()
    except NamespacesUnavailableError as error:
        if specification.link:
            allowed = f"nothing, because links cannot lose packets here ({error})"
            raise BadInputError("link[0]", "a table", allowed) from error
        for name, partition in specification.partitions():
            if partition.method == NAMESPACES:
                allowed = f"messages, because namespaces cannot be created ({error})"
                raise BadInputError(f"{name}.method", NAMESPACES, allowed) from error
        return None, str(error)
    return network, ""
