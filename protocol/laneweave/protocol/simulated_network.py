"""The transport in virtual time: a network inside one process that is harsher than Zenoh.

Nodes, messages and computations live on one event queue; time jumps from event to event. Each
message to each receiver may be lost, duplicated, delayed and so overtaken, drawn from one seeded
generator: equal seeds give equal runs. Nodes can be killed, paused, woken and cut off, with the
liveliness behaviour that was measured on Zenoh (a killed process is seen at once, a silent one
after its lease; a node that loses the network sees everybody else vanish).
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from itertools import count

from attrs import frozen

from laneweave.protocol.messages import Name
from laneweave.protocol.node import (
    Compute,
    Computed,
    Core,
    Node,
    Started,
    Stopping,
    Wakeup,
    run_job,
)
from laneweave.protocol.simulated_transport import SimulatedTransport
from laneweave.protocol.topics import Keys, matches_any
from laneweave.protocol.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Question,
    Received,
    TokenDown,
    TokenUp,
)

KILL_SEEN_S = 0.005
"""A killed process is noticed within this time (measured on Zenoh: 2 to 9 ms)."""
WAKE_AGAIN_S = 0.001
"""A core that asks for a time that has passed is woken this much later: time goes on for it too."""


@frozen
class Conditions:
    """How the network treats messages."""

    delay_s: float = 0.002
    jitter_s: float = 0.003
    """Delay is drawn uniformly from [delay, delay + jitter]: messages overtake each other."""
    loss: float = 0.0
    """Probability that a message does not reach a receiver."""
    duplication: float = 0.0
    """Probability that a receiver gets a message twice."""
    lease_s: float = 0.5
    """A paused node is given up after this time."""
    compute_s: float = 0.05
    """Virtual time that a computation takes."""


_Item = Delivery | Computed | Started | Stopping


class _Member:
    """A node with its place in the network."""

    node: Node

    def __init__(self, transport: SimulatedTransport) -> None:
        self.transport = transport
        self.connected = True
        self.connection = 0
        """What was under way when a connection ended does not arrive in the next one."""
        self.paused = False
        self.pauses = 0
        self.lapsed = False
        """Paused for longer than its lease."""
        self.backlog: list[_Item] = []
        self.wakeup_s: float | None = None
        self.news_s = 0.0
        """When the newest news of a token arrives: they do not overtake each other."""
        self.seen: dict[str, None] = {}
        """Tokens that have been shown to it."""

    @property
    def visible(self) -> bool:
        """Whether others see its tokens."""
        return self.connected and not self.lapsed

    def learn(self, news: TokenUp | TokenDown) -> bool:
        """Remember what it is shown; false when that is nothing new."""
        known = news.key in self.seen
        if isinstance(news, TokenUp):
            self.seen[news.key] = None
            return not known
        self.seen.pop(news.key, None)
        return known


class SimulatedNetwork:
    """The network, its nodes and the virtual clock."""

    def __init__(self, seed: int, conditions: Conditions | None = None) -> None:
        """Make an empty network at time 0."""
        self.now_s = 0.0
        self.conditions = conditions or Conditions()
        self.dropped = 0
        self.delivered = 0
        self._random = random.Random(seed)  # noqa: S311 (simulation, not secrets)
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._members: dict[str, _Member] = {}
        self._routes: dict[str, tuple[str, ...]] = {}
        self._cut: Callable[[str, str], bool] | None = None
        self._answers: dict[int, tuple[Callable[[bytes, bool], None], tuple[int, ...]]] = {}
        """For each open question who asked, and all tokens under which it was asked."""
        self._token_count = count(1)
        self._label_count = count(1)

    # --- building and driving ---------------------------------------------------------------

    def add(self, name: str, core: Core, realm: str) -> Node:
        """Start a node now.

        Raises:
            ValueError: a node of this name is there already.
        """
        if name in self._members:
            raise ValueError(f"node {name} is already in the network")
        member = _Member(SimulatedTransport(self, name))
        member.node = Node(
            core,
            member.transport,
            Keys(realm),
            lambda job: self._compute(member, job),
            Name(f"{next(self._label_count)}"),
        )
        self._members[name] = member
        self._in(0.0, lambda: self._hand_over(member, Started()))
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

    def step(self) -> bool:
        """Process the next event; false when there is none."""
        if not self._queue:
            return False
        self.now_s, _, action = heapq.heappop(self._queue)
        action()
        return True

    def run(self, until_s: float, stop: Callable[[], bool] | None = None) -> None:
        """Process events up to a virtual time, or until `stop` says so."""
        while self._queue and self._queue[0][0] <= until_s:
            if stop is not None and stop():
                return
            self.step()
        if stop is None or not stop():
            self.now_s = max(self.now_s, until_s)

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Do something at a virtual time, e.g. inject a fault."""
        heapq.heappush(self._queue, (max(time_s, self.now_s), next(self._order), action))

    # --- faults -----------------------------------------------------------------------------

    def kill(self, name: str) -> None:
        """Kill a node: it is gone without a word; its tokens vanish at once."""
        self._vanish(name, KILL_SEEN_S)

    def stop(self, name: str) -> None:
        """Ask a node to end, as SIGTERM does; a paused one does so when it is resumed."""
        member = self._members.get(name)
        if member is not None:
            self._hand_over(member, Stopping())

    def pause(self, name: str) -> None:
        """Stop a node's clock and hands; its tokens vanish after the lease."""
        member = self._members[name]
        if member.paused:
            return
        member.paused = True
        member.pauses += 1
        pause = member.pauses
        self._in(self.conditions.lease_s, lambda: self._lapse(member, pause))

    def resume(self, name: str) -> None:
        """Wake a paused node: it finds everything that queued up, as a zombie does."""
        member = self._members[name]
        if not member.paused:
            return
        member.paused = False
        member.wakeup_s = None
        if member.lapsed:
            member.lapsed = False
            self._show_own(member)
        backlog, member.backlog = member.backlog, []
        for item in backlog:
            self._hand_over(member, item)
        self._plan_wakeup(member)

    def cut(self, blocked: Callable[[str, str], bool] | None) -> None:
        """Partition: messages from a to b are lost where `blocked(a, b)`; None heals."""
        self._cut = blocked

    def disconnect(self, name: str) -> None:
        """Take a node off the network: it and the others see each other's tokens vanish, at once.

        The node sees its own vanish too, and its `LinkDown` anywhere among them.
        """
        member = self._members[name]
        if not member.connected:
            return
        self._hide_own(member)
        member.connected = False
        member.connection += 1
        news: list[Delivery] = [TokenDown(key) for key in member.seen]
        member.seen.clear()
        news.insert(self._random.randint(0, len(news)), LinkDown())
        for item in news:
            self._hand_over(member, item)

    def reconnect(self, name: str) -> None:
        """Bring a node back."""
        member = self._members[name]
        if member.connected:
            return
        member.connected = True
        self._show_own(member, but=member)
        for key in self._seen_tokens(member.transport.watched):
            self._tell(member, TokenUp(key))
        self._hand_over(member, LinkUp())

    # --- what transports call ---------------------------------------------------------------

    def carry(self, sender: str, key: str, payload: bytes) -> None:
        """Carry a payload to every subscriber of its key."""
        source = self._members.get(sender)
        if source is None or not source.connected:
            self.dropped += 1
            return
        for receiver in self._route(key):
            self._carry_to(sender, receiver, key, payload)

    def inject(self, key: str, payload: bytes) -> None:
        """Deliver any bytes on any key, as a stranger on the network could."""
        for receiver in self._route(key):
            self._send(self._members[receiver], Received(key, payload))

    def ask(self, key: str, payload: bytes, answer: Callable[[bytes, bool], None]) -> bool:
        """Ask all who serve the key and take the first answer; false when nobody serves it."""
        servers = [
            member
            for member in self._members.values()
            if member.connected and key in member.transport.served
        ]
        tokens = tuple(next(self._token_count) for _ in servers)
        for server, token in zip(servers, tokens, strict=True):
            self._answers[token] = answer, tokens
            self._send(server, Question(key, payload, token))
        return bool(servers)

    def take_answer(self, server: str, token: int, payload: bytes, *, ok: bool) -> None:
        """Hand the first answer to whoever asked."""
        if token not in self._answers or not self._members[server].connected:
            return
        answer, tokens = self._answers[token]
        for other in tokens:
            del self._answers[other]
        self._in(self._delay(), lambda: answer(payload, ok))

    def show_token(self, owner: str, key: str) -> None:
        """Tell all watchers of a new token."""
        member = self._members[owner]
        if member.visible and not self._shown(key, member):
            self._tell_watchers(TokenUp(key))

    def hide_token(self, owner: str, key: str) -> None:
        """Tell all watchers that a token is gone."""
        member = self._members[owner]
        if member.visible and not self._shown(key, member):
            self._tell_watchers(TokenDown(key))

    def show_all_tokens(self, watcher: str, expression: str) -> None:
        """Tell a new watcher of the tokens that are there."""
        member = self._members[watcher]
        if member.connected:
            for key in self._seen_tokens({expression: None}):
                self._tell(member, TokenUp(key))

    def forget_routes(self) -> None:
        """Subscriptions changed: look receivers up again."""
        self._routes.clear()

    def remove(self, name: str) -> None:
        """Take a node out that left in good order."""
        self._vanish(name, self.conditions.delay_s)

    # --- inside -----------------------------------------------------------------------------

    def _vanish(self, name: str, seen_after_s: float) -> None:
        member = self._members.pop(name, None)
        if member is None:
            return
        member.transport.closed = True
        self.forget_routes()
        if member.visible:
            self._in(seen_after_s, lambda: self._hide_own(member))

    def _lapse(self, member: _Member, pause: int) -> None:
        if member.paused and member.pauses == pause and not member.transport.closed:
            self._hide_own(member)
            member.lapsed = True

    def _shown(self, key: str, owner: _Member) -> bool:
        """Tell whether somebody else shows a token on this key."""
        return any(
            member is not owner and member.visible and key in member.transport.tokens
            for member in self._members.values()
        )

    def _seen_tokens(self, watched: dict[str, None]) -> list[str]:
        keys = (
            key
            for member in self._members.values()
            if member.visible
            for key in member.transport.tokens
            if matches_any(watched, key)
        )
        return list(dict.fromkeys(keys))

    def _show_own(self, owner: _Member, but: _Member | None = None) -> None:
        if owner.visible:
            for key in owner.transport.tokens:
                if not self._shown(key, owner):
                    self._tell_watchers(TokenUp(key), but)

    def _hide_own(self, owner: _Member) -> None:
        if owner.visible:
            for key in owner.transport.tokens:
                if not self._shown(key, owner):
                    self._tell_watchers(TokenDown(key), owner)

    def _tell_watchers(self, news: TokenUp | TokenDown, but: _Member | None = None) -> None:
        for member in self._members.values():
            if (
                member is not but
                and member.connected
                and matches_any(member.transport.watched, news.key)
            ):
                self._tell(member, news)

    def _tell(self, watcher: _Member, news: TokenUp | TokenDown) -> None:
        """Send news of a token, which stay in order as Zenoh's declarations do."""
        watcher.news_s = max(watcher.news_s, self.now_s + self._delay())
        self._arrive_at(watcher.news_s, watcher, news)

    def _route(self, key: str) -> tuple[str, ...]:
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = tuple(
                name
                for name, member in self._members.items()
                if matches_any(member.transport.subscriptions, key)
            )
        return route

    def _carry_to(self, sender: str, receiver: str, key: str, payload: bytes) -> None:
        conditions = self.conditions
        if not self._members[receiver].connected or (
            self._cut is not None and self._cut(sender, receiver)
        ):
            self.dropped += 1
            return
        if conditions.loss and self._random.random() < conditions.loss:
            self.dropped += 1
            return
        member = self._members[receiver]
        self._send(member, Received(key, payload))
        if conditions.duplication and self._random.random() < conditions.duplication:
            self._send(member, Received(key, payload))

    def _send(self, receiver: _Member, delivery: Delivery) -> None:
        self._arrive_at(self.now_s + self._delay(), receiver, delivery)

    def _arrive_at(self, time_s: float, receiver: _Member, delivery: Delivery) -> None:
        connection = receiver.connection

        def arrive() -> None:
            if not receiver.connected or receiver.connection != connection:
                return
            if not isinstance(delivery, (TokenUp, TokenDown)) or receiver.learn(delivery):
                self._hand_over(receiver, delivery)

        self.at(time_s, arrive)

    def _delay(self) -> float:
        return self.conditions.delay_s + self.conditions.jitter_s * self._random.random()

    def _in(self, delay_s: float, action: Callable[[], None]) -> None:
        self.at(self.now_s + delay_s, action)

    def _hand_over(self, member: _Member, item: _Item) -> None:
        if member.transport.closed:
            return
        if member.paused:
            member.backlog.append(item)
            return
        if isinstance(item, (Computed, Started, Stopping)):
            member.node.dispatch(item, self.now_s)
        else:
            self.delivered += 1
            member.node.deliver(item, self.now_s)
        if isinstance(item, Stopping):
            member.transport.close()
        self._plan_wakeup(member)

    def _plan_wakeup(self, member: _Member, earliest_s: float = 0.0) -> None:
        if member.transport.closed or member.paused:
            return
        wakeup_s = member.node.core.wakeup_s
        if wakeup_s is not None and wakeup_s != member.wakeup_s:
            member.wakeup_s = wakeup_s
            self.at(max(wakeup_s, earliest_s), lambda: self._wake(member, wakeup_s))

    def _wake(self, member: _Member, wakeup_s: float) -> None:
        if member.transport.closed or member.paused or member.wakeup_s != wakeup_s:
            return
        member.wakeup_s = None
        due_s = member.node.core.wakeup_s
        if due_s is not None and due_s <= self.now_s:
            member.node.dispatch(Wakeup(), self.now_s)
        self._plan_wakeup(member, self.now_s + WAKE_AGAIN_S)

    def _compute(self, member: _Member, job: Compute) -> None:
        computed = run_job(job)
        self._in(self.conditions.compute_s, lambda: self._hand_over(member, computed))
