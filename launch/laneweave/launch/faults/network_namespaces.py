"""Network namespaces for groups of processes, so that faults of links affect real connections.

The namespaces form a star. The router runs in the hub, which has the same address for all groups. A
pair of virtual Ethernet devices (veth) connects each group to the hub. Packet filters at both ends
of a pair drop a share of the received packets. If a link can delay packets, a process passes them
between two devices instead (`packet_relay`). Taking the hub's end down disconnects the group: all
packets are lost, connections end when their leases expire, and the group loses the liveliness
tokens of all others. The launcher reaches the router through a Unix socket, which is independent of
namespaces.

The namespaces have no names; each is held by a process of the run. The kernel removes a namespace
with its devices and addresses when its last process exits, so nothing remains after a run. This
requires CAP_SYS_ADMIN and the program `ip`, `nft` for links that lose packets, and /dev/net/tun for
links that delay packets.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess
from typing import Self

from attrs import define, field, frozen

from laneweave.launch.faults.fault_file import NAMESPACES, FaultSpec
from laneweave.launch.faults.namespace_processes import ANSWER_S, hold_namespace
from laneweave.launch.faults.packet_relay import MAX_WAITING, relay_packets
from laneweave.protocol.errors import BadInputError

HUB_ADDRESS = "10.77.255.1"
"""Address of the hub for all groups, so that they can share one configuration."""
LISTEN = "tcp/0.0.0.0:7447"
"""Zenoh endpoint on which the router listens for the groups."""
ENDPOINT = f"tcp/{HUB_ADDRESS}:7447"
"""Zenoh endpoint of the router for all groups."""
HUB = "hub"
_PATH = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
_PARTS = 10_000
"""Denominator of shares of lost packets."""
_DEVICE = ("address", "02:00:0a:4d:ff:01", "arp", "off")
"""Properties of all devices. ARP would delay packets over a restored link by up to 1 s. Without it,
packets are addressed to the sender's own hardware address, so both ends need the same."""
_EXITED = "the process of a namespace or a link has exited"
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
    delay_s: float = 0.0
    """Delay in each direction."""
    jitter_s: float = 0.0
    """Maximum of an additional, uniformly distributed delay of each packet."""


PERFECT = Link()


class NamespacesUnavailableError(RuntimeError):
    """Network namespaces cannot be created or used; the message gives the reason."""


@define
class _Helper:
    """A process controlled by the launcher; it exits when the connection is closed."""

    process: ForkServerProcess
    connection: Connection

    @classmethod
    def start(
        cls, context: ForkServerContext, name: str, target: Callable[..., None], *arguments: object
    ) -> Self:
        """Start a process that first sends an error text, which is empty on success."""
        ours, theirs = context.Pipe()
        process = context.Process(target=target, args=(theirs, *arguments), name=name)
        process.start()
        theirs.close()
        return cls(process, ours)

    @property
    def process_id(self) -> int:
        return self.process.pid or 0

    def ask(self, request: object) -> None:
        """Send a request and check the answer."""
        try:
            self.connection.send(request)
        except OSError as error:
            raise NamespacesUnavailableError(_EXITED) from error
        self.check_answer()

    def check_answer(self) -> None:
        try:
            answer = self.connection.recv() if self.connection.poll(ANSWER_S) else "no answer"
        except (EOFError, OSError) as error:
            raise NamespacesUnavailableError(_EXITED) from error
        if answer:
            raise NamespacesUnavailableError(answer)

    def close(self) -> None:
        self.connection.close()
        self.process.join(ANSWER_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(ANSWER_S)


@define
class _Namespace(_Helper):
    """A namespace and the process that holds it."""

    def run(self, name: str, *words: str) -> None:
        """Run a program in this namespace."""
        program = shutil.which(name, path=_PATH)
        if program is None:
            raise NamespacesUnavailableError(f"the program `{name}` is not installed")
        self.ask([program, *words])


@define
class GroupNetwork:
    """Namespaces of a run: the hub with the router, and one per group."""

    context: ForkServerContext
    groups: tuple[str, ...]
    delayed: Collection[str] = ()
    """Groups whose links can delay packets."""
    seed: int = 0
    """Of the jitter."""
    _relays: dict[str, _Helper] = field(factory=dict)
    _namespaces: dict[str, _Namespace] = field(factory=dict)
    _links: dict[str, Link] = field(factory=dict)

    def open(self) -> None:
        """Create the namespaces and their links.

        Raises:
            NamespacesUnavailableError: creation failed; nothing remains.
        """
        try:
            for name in (HUB, *self.groups):
                namespace = self._namespaces[name] = _Namespace.start(
                    self.context, f"namespace-{name}", hold_namespace
                )
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
        state = ["up"]
        if group in self.delayed:
            state += ["txqueuelen", str(MAX_WAITING)]
            ends = ((hub.process_id, group), (leaf.process_id, _UPLINK))
            seed = f"{self.seed}/{group}"
            relay = _Helper.start(self.context, f"link-{group}", relay_packets, ends, seed)
            self._relays[group] = relay
            relay.check_answer()
        else:
            pair = ("name", group, *_DEVICE, "type", "veth", "peer", "name", _UPLINK, *_DEVICE)
            hub.run("ip", "link", "add", *pair, "netns", str(leaf.process_id))
        for namespace, device, last in ((hub, group, 1), (leaf, _UPLINK, 2)):
            namespace.run("ip", "addr", "add", f"{self._network(group)}.{last}/30", "dev", device)
            namespace.run("ip", "link", "set", "dev", device, *state)
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
            if (wanted.delay_s, wanted.jitter_s) != (current.delay_s, current.jitter_s):
                self._relays[group].ask((wanted.delay_s, wanted.jitter_s))
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
        for helper in (*self._relays.values(), *self._namespaces.values()):
            helper.close()
        self._relays.clear()
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
    specification: FaultSpec, context: ForkServerContext, seed: int
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
    delayed = {group for fault in specification.link if fault.delays for group in fault.groups}
    network = GroupNetwork(context, tuple(groups), delayed, seed)
    try:
        network.open()
        if specification.link:
            network.check_filters()
    except NamespacesUnavailableError as error:
        if specification.link:
            allowed = f"nothing, because links cannot lose or delay packets here ({error})"
            raise BadInputError("link[0]", "a table", allowed) from error
        for name, partition in specification.partitions():
            if partition.method == NAMESPACES:
                allowed = f"messages, because namespaces cannot be created ({error})"
                raise BadInputError(f"{name}.method", NAMESPACES, allowed) from error
        return None, str(error)
    return network, ""
