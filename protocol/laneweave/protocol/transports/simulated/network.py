"""The transport in virtual time: a network inside one process that is harsher than Zenoh.

Nodes, messages and computations live on one event queue; time jumps from event to event. Each
message to each receiver may be lost, duplicated, delayed and so overtaken, drawn from one seeded
generator: equal seeds give equal runs. Nodes can be killed, paused, woken and cut off, the router
can be lost and clocks can be wrong, with the liveliness behaviour that was measured on Zenoh (a
killed process is seen at once, a silent one after its lease; a node that loses the network sees
everybody else vanish).

Every message travels as bytes and is checked on receipt, as on Zenoh. But all who receive the same
bytes are handed one and the same message: no core may change what it is handed. Where speed is all
that matters messages may travel as they are (`in_kind`).
"""

from __future__ import annotations

import heapq
from bisect import insort
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from itertools import count

from laneweave.protocol.runtime.node import (
    Arrived,
    Core,
    Node,
    Started,
    Stopping,
    known_key,
    read_message,
)
from laneweave.protocol.runtime.transport import (
    Answer,
    Delivery,
    LinkDown,
    LinkUp,
    Question,
    Received,
    TokenDown,
)
from laneweave.protocol.transports.simulated.conditions import Clock, Conditions
from laneweave.protocol.transports.simulated.members import Member
from laneweave.protocol.transports.simulated.tokens import Tokens
from laneweave.protocol.transports.simulated.transport import SimulatedTransport
from laneweave.protocol.transports.simulated.virtual_time import Simulation
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.topics import Keys, Topic, matches, matches_any

__all__ = ["KILL_SEEN_S", "REJOIN_S", "Clock", "Conditions", "SimulatedNetwork"]

KILL_SEEN_S = 0.005
"""A killed process is noticed within this time (measured on Zenoh: 2 to 9 ms)."""
REJOIN_S = (0.2, 0.9)
"""How long a node takes to find a router that has come back (measured on Zenoh)."""
_REMEMBERED = 4096
"""Messages that are remembered as they were read, once for all receivers."""


class Parcel(bytes):
    """A message that travels as it is, in place of its bytes."""

    message: object

    def __new__(cls, message: object) -> Parcel:
        """Wrap a message."""
        parcel = super().__new__(cls)
        parcel.message = message
        return parcel


class _Reader:
    """Reads what arrives at the nodes of a realm, whether it travelled as bytes or as it is."""

    def __init__(self, keys: Keys, read_payload: Callable[[bytes, type], object]) -> None:
        self._keys = keys
        self._known: dict[str, tuple[Topic, Mapping[str, str]]] = {}
        # Some go to many on keys of their own, like a plan: they are still decoded only once.
        read = partial(read_message, keys, decode=read_payload)
        self._read = lru_cache(maxsize=_REMEMBERED)(read)

    def __call__(self, key: str, payload: bytes) -> Arrived:
        if not isinstance(payload, Parcel):
            return self._read(key, payload)
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = known_key(self._keys, key)
        return Arrived(known[0], known[1], payload.message)


class SimulatedNetwork(Simulation):
    """The network and its nodes, in virtual time."""

    def __init__(
        self, seed: int, conditions: Conditions | None = None, *, in_kind: bool = False
    ) -> None:
        """Make an empty network at time 0; `in_kind`: messages travel without codec and checks."""
        super().__init__(seed, conditions)
        self._in_kind = in_kind
        self._members: dict[str, Member] = {}
        self._tokens = Tokens(self, self._members)
        self._clocks: dict[str, Clock] = {}
        self._routes: dict[str, tuple[Member, ...]] = {}
        """For each key who receives what is published on it, in order of their start."""
        self._beside: dict[str, list[str]] = {}
        """Keys of the routes that differ in their last part only, by what they have in common."""
        self._cut: Callable[[str, str], bool] | None = None
        self._loss_on: Callable[[str], float] | None = None
        self._router_up = True
        self._outages = 0
        self._answers: dict[int, tuple[Callable[[Answer | None], None], set[int]]] = {}
        """For each open question who asked, and the tokens of those who may still answer."""
        self._token_count = count(1)
        self._label_count = count(1)
        self._member_count = count()
        self._readers: dict[str, _Reader] = {}
        self._decode = lru_cache(maxsize=_REMEMBERED)(decode)

    # --- nodes ------------------------------------------------------------------------------

    def add(self, name: str, core: Core, realm: str) -> Node:
        """Start a node now; while the router is lost it starts without a connection.

        Raises:
            ValueError: a node of this name is there already.
        """
        if name in self._members:
            raise ValueError(f"node {name} is already in the network")
        member = Member(self, SimulatedTransport(self, name), next(self._member_count))
        member.clock = self._clocks.get(name)
        member.node = Node(
            core,
            member.transport,
            Keys(realm),
            member.compute,
            Name(f"{next(self._label_count)}"),
            self._reader(realm),
            Parcel if self._in_kind else encode,
        )
        self._members[name] = member
        self.at(self.now_s, member.hand_over, Started())
        if not self._router_up:
            member.connected = False
            self.at(self.now_s, member.hand_over, LinkDown())
        return member.node

    def __contains__(self, name: str) -> bool:
        """Tell whether a node is in the network."""
        return name in self._members

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes, in order of their start."""
        return tuple(self._members)

    def node(self, name: str) -> Node:
        """Return a node."""
        return self._members[name].node

    # --- faults of nodes --------------------------------------------------------------------

    def kill(self, name: str) -> None:
        """Kill a node: it is gone without a word; its tokens vanish at once."""
        self._vanish(name, KILL_SEEN_S)

    def stop(self, name: str) -> None:
        """Ask a node to end, as SIGTERM does; a paused one does so when it is resumed."""
        member = self._members.get(name)
        if member is not None:
            member.hand_over(Stopping())

    def pause(self, name: str) -> None:
        """Stop a node's clock and hands; its tokens vanish after the lease."""
        member = self._members[name]
        if member.paused:
            return
        member.paused = True
        member.pauses += 1
        self.at(self.now_s + self.conditions.lease_s, self._lapse, member, member.pauses)

    def resume(self, name: str) -> None:
        """Wake a paused node: it finds everything that queued up, as a zombie does."""
        member = self._members[name]
        if not member.paused:
            return
        if member.lapsed:
            member.lapsed = False
            self._tokens.show_all(member)
        member.wake()
        self._rejoin_later(member)

    def set_clock(self, name: str, offset_s: float = 0.0, rate: float = 1.0) -> None:
        """Let the clock of a node show `offset + rate * t` at virtual time t; default: exact.

        The clock is its machine's: a node that starts under this name later finds it so. For a
        node that runs already time jumps.

        Raises:
            ValueError: an argument is not finite, or the clock does not go forwards.
        """
        clock = self._clocks[name] = Clock(offset_s, rate)
        if name in self._members:
            self._members[name].set_clock(clock)

    # --- faults of the network --------------------------------------------------------------

    def cut(self, blocked: Callable[[str, str], bool] | None) -> None:
        """Partition: messages from a to b are lost where `blocked(a, b)`; None heals."""
        self._cut = blocked

    def lose(self, loss_on: Callable[[str], float] | None) -> None:
        """Lose messages by their key: with probability `loss_on(key)` where that is the greater.

        None: with `Conditions.loss` on every key.
        """
        self._loss_on = loss_on

    def disconnect(self, name: str) -> None:
        """Take a node off the network: it and the others see each other's tokens vanish, at once.

        The node sees its own vanish too, and its `LinkDown` anywhere among them.
        """
        member = self._members[name]
        member.unplugged = True
        self._break_links([member])

    def reconnect(self, name: str) -> None:
        """Bring a node back at once; while the router is lost: when it finds that again."""
        member = self._members[name]
        member.unplugged = False
        if self._router_up:
            self._join(member)

    def lose_router(self) -> None:
        """Take every node off the network: everybody sees everybody vanish, at once."""
        if self._router_up:
            self._router_up = False
            self._outages += 1
            self._break_links(list(self._members.values()))

    def restore_router(self) -> None:
        """Bring the router back; each node finds it in its own time, drawn from `REJOIN_S`."""
        if not self._router_up:
            self._router_up = True
            for member in self._members.values():
                self._rejoin_later(member)

    def inject(self, key: str, payload: bytes) -> None:
        """Deliver any bytes on any key, as a stranger on the network could."""
        for receiver in self._route(key):
            self._send(receiver, Received(key, payload))

    # --- what transports call ---------------------------------------------------------------

    def carry(self, sender: str, key: str, payload: bytes) -> None:
        """Carry a payload to every subscriber of its key."""
        source = self._members.get(sender)
        if source is None or not source.connected:
            self.dropped += 1
            return
        conditions, cut, draw = self.conditions, self._cut, self.random.random
        duplication, loss = conditions.duplication, conditions.loss
        if self._loss_on is not None:
            loss = max(loss, self._loss_on(key))
        route = self._routes.get(key)
        message = Received(key, payload)
        for receiver in self._route(key) if route is None else route:
            if (
                not receiver.connected
                or (cut is not None and cut(sender, receiver.transport.name))
                or (loss and draw() < loss)
            ):
                self.dropped += 1
                continue
            # `_send` written out: most events of a simulation are made here.
            arrival_s = self.now_s + conditions.delay_s + conditions.jitter_s * draw()
            arguments = (receiver.connection, message)
            heapq.heappush(self.queue, (arrival_s, next(self.order), receiver.arrive, arguments))
            if duplication and draw() < duplication:
                self._send(receiver, message)

    def ask(self, key: str, payload: bytes, answer: Callable[[Answer | None], None]) -> None:
        """Ask all who serve the key and take the first answer; None: nobody serves it."""
        servers = [
            member
            for member in self._members.values()
            if member.connected and key in member.transport.served
        ]
        numbered = {next(self._token_count): server for server in servers}
        open_tokens = set(numbered)
        for token, server in numbered.items():
            self._answers[token] = answer, open_tokens
            self._send(server, Question(key, payload, token))
        if not servers:
            self.at(self.now_s + self.delay_s(), answer, None)

    def take_answer(self, server: str, token: int, given: Answer | None) -> None:
        """Hand the first answer to whoever asked; None when all leave it to others."""
        if token not in self._answers or not self._members[server].connected:
            return
        answer, open_tokens = self._answers[token]
        done = open_tokens if given is not None else {token}
        for other in tuple(done):
            del self._answers[other]
            open_tokens.discard(other)
        if not open_tokens:
            self.at(self.now_s + self.delay_s(), answer, given)

    def show_token(self, owner: str, key: str) -> None:
        """Tell all watchers of a new token."""
        self._tokens.appeared(self._members[owner], key)

    def hide_token(self, owner: str, key: str) -> None:
        """Tell all watchers that a token is gone."""
        self._tokens.vanished(self._members[owner], key)

    def show_all_tokens(self, watcher: str, expression: str) -> None:
        """Tell a new watcher of the tokens that are there."""
        member = self._members[watcher]
        if member.connected:
            self._tokens.introduce(member, (expression,))

    def reroute(self, name: str, expressions: Iterable[str]) -> None:
        """Bring the routes up to date after subscriptions of a node have changed.

        Args:
            name: the node.
            expressions: what it has subscribed to, or does not subscribe to any more.
        """
        member = self._members.get(name)
        if member is not None:
            for expression in expressions:
                self._reroute(member, expression)

    def _reroute(self, member: Member, expression: str) -> None:
        """Give a member its place in the routes of all keys that match, or take it out of them."""
        for key in self._known_keys(expression):
            receivers = [other for other in self._routes[key] if other is not member]
            transport = member.transport
            if not transport.closed and matches_any(transport.subscriptions, key):
                insort(receivers, member, key=lambda other: other.number)
            self._routes[key] = tuple(receivers)

    def _known_keys(self, expression: str) -> list[str]:
        """Return the keys of the routes that match."""
        fixed, star, rest = expression.partition("*")
        if not star:
            return [expression] if expression in self._routes else []
        if not rest and fixed.endswith("/"):
            return self._beside.get(fixed, [])
        return [key for key in self._routes if matches(expression, key)]

    def remove(self, name: str) -> None:
        """Take a node out that left in good order."""
        self._vanish(name, self.conditions.delay_s)

    # --- inside -----------------------------------------------------------------------------

    def _reader(self, realm: str) -> _Reader:
        """Return what reads messages for all nodes of a realm: each only once."""
        if realm not in self._readers:
            self._readers[realm] = _Reader(Keys(realm), self._decode)
        return self._readers[realm]

    def _vanish(self, name: str, seen_after_s: float) -> None:
        member = self._members.pop(name, None)
        if member is None:
            return
        member.transport.closed = True
        for expression in member.transport.subscriptions:
            self._reroute(member, expression)
        if member.visible:
            self.at(self.now_s + seen_after_s, self._tokens.hide_all, member)

    def _lapse(self, member: Member, pause: int) -> None:
        if member.paused and member.pauses == pause and not member.transport.closed:
            self._tokens.hide_all(member)
            member.lapsed = True

    def _break_links(self, members: Iterable[Member]) -> None:
        broken = [member for member in members if member.connected]
        for member in broken:
            self._tokens.hide_all(member)
            member.connected = False
            member.connection += 1
        for member in broken:
            news: list[Delivery] = [TokenDown(key) for key in member.seen]
            member.seen.clear()
            news.insert(self.random.randint(0, len(news)), LinkDown())
            for item in news:
                member.hand_over(item)

    def _join(self, member: Member) -> None:
        if member.connected:
            return
        member.connected = True
        self._tokens.show_all(member, but=member)
        self._tokens.introduce(member, member.transport.watched)
        member.hand_over(LinkUp())

    def _rejoin_later(self, member: Member) -> None:
        if self._router_up and not member.connected and not member.unplugged:
            join_s = self.now_s + self.random.uniform(*REJOIN_S)
            self.at(join_s, self._rejoin, member, self._outages)

    def _rejoin(self, member: Member, outage: int) -> None:
        lost_again = self._outages != outage
        # A paused node looks for the router when it wakes.
        if not (lost_again or member.paused or member.unplugged or member.transport.closed):
            self._join(member)

    def _route(self, key: str) -> tuple[Member, ...]:
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = tuple(
                member
                for member in self._members.values()
                if matches_any(member.transport.subscriptions, key)
            )
            self._beside.setdefault(key[: key.rfind("/") + 1], []).append(key)
        return route

    def _send(self, receiver: Member, delivery: Delivery) -> None:
        # As in `carry`, to the last bit.
        conditions = self.conditions
        arrival_s = self.now_s + conditions.delay_s + conditions.jitter_s * self.random.random()
        self.at(arrival_s, receiver.arrive, receiver.connection, delivery)
