"""The transport in virtual time: a network inside one process.

Nodes, messages and computations share one event queue; time jumps from event to event. Loss,
duplication and delay are drawn for each message and receiver from one seeded generator: the same
seed gives the same run. Nodes can be killed, paused, resumed and disconnected, the router can be
lost, and clocks can be wrong. Liveliness behaves as measured on Zenoh: a killed process is detected
at once, a silent one when its lease expires; a disconnected node sees all tokens vanish.

Messages are sent as bytes and checked on receipt, as on Zenoh. All receivers of the same bytes
share one decoded message, so cores must not modify it. With `skip_codec`, messages are sent as
objects, without encoding or checks, for speed.
"""

from __future__ import annotations

import heapq
import math
from bisect import insort
from collections.abc import Callable, Iterable
from functools import lru_cache
from itertools import count

from attrs import frozen

from laneweave.protocol.runtime.node import Core, Node, Started, Stopping
from laneweave.protocol.runtime.transport import (
    Answer,
    Delivery,
    LinkDown,
    LinkUp,
    Query,
    Received,
    TokenDown,
    TokenUp,
)
from laneweave.protocol.transports.simulated.member import Member, Tokens
from laneweave.protocol.transports.simulated.parcels import CACHE_SIZE, Parcel, Reader
from laneweave.protocol.transports.simulated.virtual_time import Clock, Conditions, Simulation
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.topics import Keys, Quality, matches, matches_any

KILL_SEEN_S = 0.005
"""Time until others detect a killed process (measured on Zenoh: 2 to 9 ms)."""
REJOIN_S = (0.2, 0.9)
"""Range of the time that nodes take to reconnect to a restored router (measured on Zenoh)."""


@frozen
class _OpenQuery:
    """A query as sent to one of the servers that may answer it."""

    server: Member
    answer: Callable[[Answer | None], None]
    tokens: set[int]
    """Tokens of this query for all servers that may still answer; shared by their entries."""


class _Transport:
    """`Transport` of one node over the simulated network."""

    def __init__(self, network: SimulatedNetwork, member: Member) -> None:
        self._network = network
        self._member = member

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        del quality
        if not self._member.closed:
            self._network.transmit(self._member.name, key, payload)

    def subscribe(self, key_expression: str) -> None:
        self._member.declared.subscriptions[key_expression] = None
        self._network.update_routes(self._member, key_expression)

    def unsubscribe(self, key_expression: str) -> None:
        self._member.declared.subscriptions.pop(key_expression, None)
        self._network.update_routes(self._member, key_expression)

    def announce(self, key: str) -> None:
        if key not in self._member.declared.tokens and not self._member.closed:
            self._member.declared.tokens[key] = None
            self._network.tokens.report(TokenUp, self._member, (key,))

    def withdraw(self, key: str) -> None:
        if key in self._member.declared.tokens and not self._member.closed:
            del self._member.declared.tokens[key]
            self._network.tokens.report(TokenDown, self._member, (key,))

    def watch(self, key_expression: str) -> None:
        member = self._member
        if key_expression not in member.declared.watched and not member.closed:
            member.declared.watched[key_expression] = None
            if member.connected:
                self._network.tokens.report_existing(member, (key_expression,))

    def serve(self, key: str) -> None:
        self._member.declared.served.add(key)

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        self._network.accept_answer(self._member, token, Answer(payload, ok, encoding))

    def decline(self, token: int) -> None:
        self._network.accept_answer(self._member, token, None)

    def close(self) -> None:
        if not self._member.closed:
            self._network.remove(self._member.name)


class SimulatedNetwork(Simulation):
    """The network with its nodes, in virtual time."""

    def __init__(
        self, seed: int, conditions: Conditions | None = None, *, skip_codec: bool = False
    ) -> None:
        """Create an empty network at time 0; `skip_codec`: send messages as objects."""
        super().__init__(seed, conditions)
        self._skip_codec = skip_codec
        self._members: dict[str, Member] = {}
        self.tokens = Tokens(self, self._members)
        self._clocks: dict[str, Clock] = {}
        self._routes: dict[str, tuple[Member, ...]] = {}
        """Receivers of each key that has any, in the order in which they started."""
        self._first_sender: dict[str, Member] = {}
        """Member whose message led to the route of each key."""
        self._keys_by_prefix: dict[str, dict[str, None]] = {}
        """Keys with routes, grouped by the key without its last part."""
        self._extra_delay_s: Callable[[str, str, str], float] | None = None
        self._router_up = True
        self._outages = 0
        self._queries: dict[int, _OpenQuery] = {}
        """Open queries by token; each server of a query has its own token."""
        self._token_count = count(1)
        self._label_count = count(1)
        self._member_count = count()
        self._readers: dict[str, Reader] = {}
        self._decode = lru_cache(maxsize=CACHE_SIZE)(decode)

    # --- nodes ------------------------------------------------------------------------------

    def add(self, name: str, core: Core, realm: str) -> Node:
        """Start a node; while the router is lost, it starts without a connection.

        Raises:
            ValueError: a node of this name exists.
        """
        if name in self._members:
            raise ValueError(f"node {name} is already in the network")
        member = Member(self, name, next(self._member_count))
        member.transport = _Transport(self, member)
        member.clock = self._clocks.get(name)
        member.node = Node(
            core,
            member.transport,
            Keys(realm),
            member.compute,
            Name(f"{next(self._label_count)}"),
            self._reader(realm),
            Parcel if self._skip_codec else encode,
        )
        self._members[name] = member
        self.at(self.now_s, member.handle, Started())
        if not self._router_up:
            member.connected = False
            self.at(self.now_s, member.handle, LinkDown())
        return member.node

    def __contains__(self, name: str) -> bool:
        """Return whether a node is in the network."""
        return name in self._members

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes, in the order in which they started."""
        return tuple(self._members)

    def node(self, name: str) -> Node:
        """Return a node."""
        return self._members[name].node

    def offline_s(self, name: str) -> float:
        """Return for how long a running node has been without a connection; 0 if it is paused."""
        member = self._members[name]
        return 0.0 if member.connected or member.paused else self.now_s - member.lost_s

    # --- faults of nodes --------------------------------------------------------------------

    def kill(self, name: str) -> None:
        """Kill a node; its tokens vanish at once."""
        self._vanish(name, KILL_SEEN_S)

    def stop(self, name: str, grace_s: float = 0.0) -> None:
        """Ask a node to stop, as SIGTERM does; a paused node stops when it is resumed."""
        member = self._members.get(name)
        if member is not None:
            member.handle(Stopping(grace_s))

    def pause(self, name: str) -> None:
        """Pause a node, as SIGSTOP does; its tokens vanish when the lease expires."""
        member = self._members[name]
        if member.paused:
            return
        member.paused = True
        member.pauses += 1
        self.at(self.now_s + self.conditions.lease_s, self._lapse, member, member.pauses)

    def resume(self, name: str) -> None:
        """Resume a paused node, which then handles its queued inputs."""
        member = self._members[name]
        if not member.paused:
            return
        if member.lapsed:
            member.lapsed = False
            self.tokens.report(TokenUp, member, member.declared.tokens)
        member.resume()
        self._rejoin_later(member)

    def set_clock(self, name: str, offset_s: float = 0.0, rate: float = 1.0) -> None:
        """Set a node's clock to `offset_s + rate * t` at virtual time t.

        The clock belongs to the machine: later nodes of this name have the same clock. For a
        running node, time jumps.

        Raises:
            ValueError: an argument is not finite, or the rate is not positive.
        """
        clock = self._clocks[name] = Clock(offset_s, rate)
        if name in self._members:
            self._members[name].set_clock(clock)

    def advance_clock(self, name: str, by_s: float) -> None:
        """Let a node's clock jump ahead."""
        clock = self._clocks.get(name, Clock(0.0, 1.0))
        self.set_clock(name, clock.offset_s + by_s, clock.rate)

    # --- faults of the network --------------------------------------------------------------

    def hinder(self, extra_delay_s: Callable[[str, str, str], float] | None) -> None:
        """Delay messages from a to b on a key by `extra_delay_s(a, b, key)`; infinity: drop them.

        None ends all delays.
        """
        self._extra_delay_s = extra_delay_s

    def disconnect(self, name: str) -> None:
        """Disconnect a node; its tokens vanish for all other nodes at once.

        For the node itself, all tokens vanish; `LinkDown` is placed at random among these events.
        """
        member = self._members[name]
        member.unplugged = True
        self._break_links([member])

    def reconnect(self, name: str) -> None:
        """Reconnect a node at once, or when the router is restored."""
        member = self._members[name]
        member.unplugged = False
        if self._router_up:
            self._join(member)

    def lose_router(self) -> None:
        """Disconnect all nodes; for each node, all tokens vanish at once."""
        if self._router_up:
            self._router_up = False
            self._outages += 1
            self._break_links(self._members.values())

    def restore_router(self) -> None:
        """Restore the router; each node reconnects after a random time in `REJOIN_S`."""
        if not self._router_up:
            self._router_up = True
            for member in self._members.values():
                self._rejoin_later(member)

    def inject(self, key: str, payload: bytes) -> None:
        """Deliver arbitrary bytes on a key."""
        for receiver in self._receivers(key):
            self._send(receiver, Received(key, payload))

    # --- called by transports ---------------------------------------------------------------

    def transmit(self, sender: str, key: str, payload: bytes) -> None:
        """Send a payload to every subscriber of its key."""
        source = self._members.get(sender)
        if source is None or not source.connected:
            self.dropped += 1
            return
        conditions, draw = self.conditions, self.random.random
        hindrance = self._extra_delay_s
        duplication, loss = conditions.duplication, conditions.loss
        route = self._routes.get(key)
        message = Received(key, payload)
        for receiver in self._new_route(key, source) if route is None else route:
            extra_s = 0.0 if hindrance is None else hindrance(sender, receiver.name, key)
            if not receiver.connected or extra_s == math.inf or (loss and draw() < loss):
                self.dropped += 1
                continue
            # `_send` inlined, because most events of a simulation originate here.
            arrival_s = self.now_s + conditions.delay_s + conditions.jitter_s * draw() + extra_s
            arguments = (receiver.connection, message)
            heapq.heappush(self.queue, (arrival_s, next(self.order), receiver.receive, arguments))
            if duplication and draw() < duplication:
                self._send(receiver, message)

    def query(self, key: str, payload: bytes, answer: Callable[[Answer | None], None]) -> None:
        """Query all servers of a key and pass the first answer to `answer`.

        The answer is None if there is no server, or if all have declined, exited or disconnected.
        """
        servers = [
            member
            for member in self._members.values()
            if member.connected and key in member.declared.served
        ]
        numbered = {next(self._token_count): server for server in servers}
        tokens = set(numbered)
        for token, server in numbered.items():
            self._queries[token] = _OpenQuery(server, answer, tokens)
            self._send(server, Query(key, payload, token))
        if not servers:
            self.at(self.now_s + self.delay_s(), answer, None)

    def accept_answer(self, server: Member, token: int, given: Answer | None) -> None:
        """Process a server's answer; None: the server declines."""
        if token in self._queries and server.connected and not server.closed:
            self._settle(token, given)

    def _settle(self, token: int, given: Answer | None) -> None:
        """Pass on the first answer, or None if no other server can answer."""
        query = self._queries.get(token)
        if query is None:
            return
        for other in tuple(query.tokens) if given is not None else (token,):
            del self._queries[other]
            query.tokens.discard(other)
        if not query.tokens:
            self.at(self.now_s + self.delay_s(), query.answer, given)

    def _abandon_queries(self, server: Member) -> None:
        """Remove a server that can no longer answer from all open queries."""
        for token in [token for token, one in self._queries.items() if one.server is server]:
            self._settle(token, None)

    def update_routes(self, member: Member, expression: str) -> None:
        """Update the routes of all keys that a changed subscription matches."""
        for key in self._known_keys(expression):
            receivers = [other for other in self._routes[key] if other is not member]
            if not member.closed and matches_any(member.declared.subscriptions, key):
                insort(receivers, member, key=lambda other: other.number)
            if receivers:
                self._routes[key] = tuple(receivers)
            else:
                self._forget_route(key)

    def _known_keys(self, expression: str) -> list[str]:
        """Return the keys with routes that an expression matches."""
        fixed, star, rest = expression.partition("*")
        if not star:
            return [expression] if expression in self._routes else []
        if not rest and fixed.endswith("/"):
            return list(self._keys_by_prefix.get(fixed, ()))
        return [key for key in self._routes if matches(expression, key)]

    def remove(self, name: str) -> None:
        """Remove a node that has left the network on its own."""
        self._vanish(name, self.conditions.delay_s)

    # --- internals --------------------------------------------------------------------------

    def _reader(self, realm: str) -> Reader:
        """Return the reader that all nodes of a realm share."""
        if realm not in self._readers:
            self._readers[realm] = Reader(Keys(realm), self._decode)
        return self._readers[realm]

    def _vanish(self, name: str, seen_after_s: float) -> None:
        member = self._members.pop(name, None)
        if member is None:
            return
        member.closed = True
        for expression in member.declared.subscriptions:
            self.update_routes(member, expression)
        for key in list(member.declared.routed):
            self._forget_route(key)
        if member.visible:
            self.at(self.now_s + seen_after_s, self._hide, member)
        self.at(self.now_s + seen_after_s, self._abandon_queries, member)

    def _hide(self, member: Member) -> None:
        """Report to all other members that the tokens of a member have vanished."""
        self.tokens.report(TokenDown, member, member.declared.tokens, exclude=member)

    def _lapse(self, member: Member, pause: int) -> None:
        if member.paused and member.pauses == pause and not member.closed:
            self._hide(member)
            member.lapsed = True
            self._abandon_queries(member)

    def _break_links(self, members: Iterable[Member]) -> None:
        broken = [member for member in members if member.connected]
        for member in broken:
            self._hide(member)
            member.connected, member.lost_s = False, self.now_s
            member.connection += 1
            self._abandon_queries(member)
        for member in broken:
            events: list[Delivery] = [TokenDown(key) for key in member.seen]
            member.seen.clear()
            events.insert(self.random.randint(0, len(events)), LinkDown())
            for item in events:
                member.handle(item)

    def _join(self, member: Member) -> None:
        if member.connected:
            return
        member.connected = True
        self.tokens.report(TokenUp, member, member.declared.tokens, exclude=member)
        self.tokens.report_existing(member, member.declared.watched)
        member.handle(LinkUp())

    def _rejoin_later(self, member: Member) -> None:
        if self._router_up and not member.connected and not member.unplugged:
            join_s = self.now_s + self.random.uniform(*REJOIN_S)
            self.at(join_s, self._rejoin, member, self._outages)

    def _rejoin(self, member: Member, outage: int) -> None:
        lost_again = self._outages != outage
        # A paused node reconnects after it has been resumed.
        if not (lost_again or member.paused or member.unplugged or member.closed):
            self._join(member)

    def _receivers(self, key: str) -> tuple[Member, ...]:
        """Return the members that subscribe to a key, in the order in which they started."""
        return tuple(
            member
            for member in self._members.values()
            if matches_any(member.declared.subscriptions, key)
        )

    def _new_route(self, key: str, sender: Member) -> tuple[Member, ...]:
        """Return the receivers of a key; store them until there are none, or the sender leaves."""
        route = self._receivers(key)
        if route:
            self._routes[key], self._first_sender[key] = route, sender
            self._keys_by_prefix.setdefault(_prefix_of(key), {})[key] = None
            sender.declared.routed[key] = None
        return route

    def _forget_route(self, key: str) -> None:
        if self._routes.pop(key, None) is not None:
            del self._first_sender.pop(key).declared.routed[key]
            prefix = _prefix_of(key)
            keys = self._keys_by_prefix[prefix]
            del keys[key]
            if not keys:
                del self._keys_by_prefix[prefix]

    def _send(self, receiver: Member, delivery: Delivery) -> None:
        # Must draw exactly as `transmit` does.
        conditions = self.conditions
        arrival_s = self.now_s + conditions.delay_s + conditions.jitter_s * self.random.random()
        self.at(arrival_s, receiver.receive, receiver.connection, delivery)


def _prefix_of(key: str) -> str:
    """Return a key without its last part."""
    return key[: key.rfind("/") + 1]
