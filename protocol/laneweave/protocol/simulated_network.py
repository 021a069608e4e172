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
from laneweave.protocol.topics import Keys, Quality
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
    """A paused node or one cut off is given up after this time."""
    compute_s: float = 0.05
    """Virtual time that a computation takes."""


class SimulatedTransport:
    """One node's view of the simulated network; made by `SimulatedNetwork.add`."""

    def __init__(self, network: SimulatedNetwork, name: str) -> None:
        """Attach a named node to a network."""
        self._network = network
        self.name = name
        self.subscriptions: dict[str, None] = {}
        self.watched: dict[str, None] = {}
        self.tokens: dict[str, None] = {}
        self.served: set[str] = set()

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Send to all subscribers, each with its own fate."""
        del quality
        self._network.carry(self.name, key, payload)

    def subscribe(self, key_expression: str) -> None:
        """Subscribe."""
        self.subscriptions[key_expression] = None
        self._network.forget_routes()

    def unsubscribe(self, key_expression: str) -> None:
        """Undo `subscribe`."""
        self.subscriptions.pop(key_expression, None)
        self._network.forget_routes()

    def announce(self, key: str) -> None:
        """Show a token."""
        if key not in self.tokens:
            self.tokens[key] = None
            self._network.tell_token(self.name, key, up=True)

    def withdraw(self, key: str) -> None:
        """Take a token back."""
        if key in self.tokens:
            del self.tokens[key]
            self._network.tell_token(self.name, key, up=False)

    def watch(self, key_expression: str) -> None:
        """Watch tokens, beginning with those that are there."""
        self.watched[key_expression] = None
        self._network.show_tokens(self.name, key_expression)

    def serve(self, key: str) -> None:
        """Answer questions on a key."""
        self.served.add(key)

    def answer(self, token: int, payload: bytes, *, ok: bool) -> None:
        """Answer a question once."""
        self._network.take_answer(token, payload, ok=ok)

    def close(self) -> None:
        """Leave the network."""
        self._network.remove(self.name)


class _Member:
    """A node with its place in the network."""

    def __init__(self, node: Node, transport: SimulatedTransport) -> None:
        self.node = node
        self.transport = transport
        self.connected = True
        self.paused = False
        self.backlog: list[Delivery | Computed] = []
        self.wakeup_s: float | None = None


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
        self._answers: dict[int, Callable[[bytes, bool], None]] = {}
        self._token_count = count(1)

    # --- building and driving ---------------------------------------------------------------

    def add(self, name: str, core: Core, realm: str) -> Node:
        """Start a node now.

        Raises:
            ValueError: a node of this name is there already.
        """
        if name in self._members:
            raise ValueError(f"node {name} is already in the network")
        transport = SimulatedTransport(self, name)
        node = Node(core, transport, Keys(realm), lambda job: self._compute(name, job))
        self._members[name] = _Member(node, transport)
        self._in(0.0, lambda: self._dispatch(name, Started()))
        return node

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
        self.now_s = max(self.now_s, until_s)

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Do something at a virtual time, e.g. inject a fault."""
        heapq.heappush(self._queue, (max(time_s, self.now_s), next(self._order), action))

    # --- faults -----------------------------------------------------------------------------

    def kill(self, name: str) -> None:
        """Kill a node: it is gone without a word; its tokens vanish at once."""
        self._vanish(name, KILL_SEEN_S)

    def stop(self, name: str) -> None:
        """Ask a node to end, as SIGTERM does."""
        self._dispatch(name, Stopping())
        self.remove(name)

    def pause(self, name: str) -> None:
        """Stop a node's clock and hands; its tokens vanish after the lease."""
        member = self._members[name]
        member.paused = True
        self._in(self.conditions.lease_s, lambda: self._lapse(name))

    def resume(self, name: str) -> None:
        """Wake a paused node: it finds everything that queued up, as a zombie does."""
        member = self._members[name]
        member.paused = False
        member.wakeup_s = None
        for key in member.transport.tokens:
            self.tell_token(name, key, up=True)
        backlog, member.backlog = member.backlog, []
        for item in backlog:
            self._hand_over(name, item)
        self._plan_wakeup(name)

    def cut(self, blocked: Callable[[str, str], bool] | None) -> None:
        """Partition: messages from a to b are lost where `blocked(a, b)`; None heals."""
        self._cut = blocked

    def disconnect(self, name: str) -> None:
        """Take a node off the network: it and the others see each other's tokens vanish."""
        member = self._members[name]
        if not member.connected:
            return
        member.connected = False
        self._hand_over(name, LinkDown())
        for other in self._members.values():
            for key in other.transport.tokens:
                if _matches_any(member.transport.watched, key):
                    self._hand_over(name, TokenDown(key))
        for key in member.transport.tokens:
            self._tell_others(name, TokenDown(key), key)

    def reconnect(self, name: str) -> None:
        """Bring a node back."""
        member = self._members[name]
        if member.connected:
            return
        member.connected = True
        self._hand_over(name, LinkUp())
        for key in member.transport.tokens:
            self.tell_token(name, key, up=True)
        for expression in member.transport.watched:
            self.show_tokens(name, expression)

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
            self._send(receiver, Received(key, payload))

    def ask(self, key: str, payload: bytes, answer: Callable[[bytes, bool], None]) -> bool:
        """Ask a service; false when nobody serves the key."""
        for name, member in self._members.items():
            if key in member.transport.served:
                token = next(self._token_count)
                self._answers[token] = answer
                self._send(name, Question(key, payload, token))
                return True
        return False

    def take_answer(self, token: int, payload: bytes, *, ok: bool) -> None:
        """Hand an answer to whoever asked."""
        waiting = self._answers.pop(token, None)
        if waiting is not None:
            self._in(self._delay(), lambda: waiting(payload, ok))

    def tell_token(self, owner: str, key: str, *, up: bool) -> None:
        """Tell all watchers that a token appeared or vanished."""
        if self._members[owner].connected:
            self._tell_others(owner, TokenUp(key) if up else TokenDown(key), key)

    def show_tokens(self, watcher: str, expression: str) -> None:
        """Tell a new watcher of the tokens that are there."""
        for member in self._members.values():
            if member.connected and not member.paused:
                for key in member.transport.tokens:
                    if matches(expression, key):
                        self._send(watcher, TokenUp(key))

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
        self.forget_routes()
        keys = tuple(member.transport.tokens)
        self._in(seen_after_s, lambda: self._tell_tokens_down(name, keys))

    def _lapse(self, name: str) -> None:
        member = self._members.get(name)
        if member is not None and member.paused:
            self._tell_tokens_down(name, tuple(member.transport.tokens))

    def _tell_tokens_down(self, owner: str, keys: tuple[str, ...]) -> None:
        for key in keys:
            self._tell_others(owner, TokenDown(key), key)

    def _tell_others(self, owner: str, news: TokenUp | TokenDown, key: str) -> None:
        for name, member in self._members.items():
            if name != owner and member.connected and _matches_any(member.transport.watched, key):
                self._send(name, news)

    def _route(self, key: str) -> tuple[str, ...]:
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = tuple(
                name
                for name, member in self._members.items()
                if _matches_any(member.transport.subscriptions, key)
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
        self._send(receiver, Received(key, payload))
        if conditions.duplication and self._random.random() < conditions.duplication:
            self._send(receiver, Received(key, payload))

    def _send(self, receiver: str, delivery: Delivery) -> None:
        self._in(self._delay(), lambda: self._hand_over(receiver, delivery))

    def _delay(self) -> float:
        return self.conditions.delay_s + self.conditions.jitter_s * self._random.random()

    def _in(self, delay_s: float, action: Callable[[], None]) -> None:
        self.at(self.now_s + delay_s, action)

    def _hand_over(self, name: str, item: Delivery | Computed) -> None:
        member = self._members.get(name)
        if member is None:
            return
        if member.paused:
            member.backlog.append(item)
            return
        self.delivered += 1
        if isinstance(item, Computed):
            member.node.dispatch(item, self.now_s)
        else:
            member.node.deliver(item, self.now_s)
        self._plan_wakeup(name)

    def _dispatch(self, name: str, event: Started | Stopping) -> None:
        member = self._members.get(name)
        if member is not None:
            member.node.dispatch(event, self.now_s)
            self._plan_wakeup(name)

    def _plan_wakeup(self, name: str) -> None:
        member = self._members.get(name)
        if member is None or member.paused:
            return
        wakeup_s = member.node.core.wakeup_s
        if wakeup_s is not None and wakeup_s != member.wakeup_s:
            member.wakeup_s = wakeup_s
            self.at(wakeup_s, lambda: self._wake(name, wakeup_s))

    def _wake(self, name: str, wakeup_s: float) -> None:
        member = self._members.get(name)
        if member is None or member.paused or member.wakeup_s != wakeup_s:
            return
        member.wakeup_s = None
        due_s = member.node.core.wakeup_s
        if due_s is not None and due_s <= self.now_s:
            member.node.dispatch(Wakeup(), self.now_s)
        self._plan_wakeup(name)

    def _compute(self, name: str, job: Compute) -> None:
        computed = run_job(job)
        self._in(self.conditions.compute_s, lambda: self._hand_over(name, computed))


def matches(expression: str, key: str) -> bool:
    """Tell whether a key expression matches a key: `*` is one part, `**` any number of parts."""
    return _match_parts(expression.split("/"), key.split("/"))


def _match_parts(expression: list[str], key: list[str]) -> bool:
    if not expression:
        return not key
    head, rest = expression[0], expression[1:]
    if head == "**":
        return any(_match_parts(rest, key[start:]) for start in range(len(key) + 1))
    return bool(key) and head in ("*", key[0]) and _match_parts(rest, key[1:])


def _matches_any(expressions: dict[str, None], key: str) -> bool:
    return any(matches(expression, key) for expression in expressions)
