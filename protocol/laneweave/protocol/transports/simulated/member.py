"""Members of the simulated network (nodes with their machines), and liveliness tokens."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from attrs import define, field

from laneweave.protocol.runtime.node import (
    Compute,
    Computed,
    Delegate,
    Node,
    StopJob,
    Stopping,
    Wakeup,
    run_delegated,
    run_job,
)
from laneweave.protocol.runtime.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Overflow,
    Query,
    Received,
    TokenDown,
    TokenUp,
    Transport,
    update_tokens,
)
from laneweave.protocol.transports.simulated.virtual_time import Clock, Item, Simulation
from laneweave.protocol.wire.topics import matches_any

WAKE_AGAIN_S = 0.001
"""Delay of a wakeup requested for a past time, so that virtual time advances."""
INJECTED_FAILURE = "injected failure"
"""Error of a computation that `Conditions.compute_failure` makes fail."""
_DELIVERIES = (Received, Overflow, TokenUp, TokenDown, LinkUp, LinkDown, Query)


@define
class Declarations:
    """What a node has declared to the network, in order."""

    subscriptions: dict[str, None] = field(factory=dict)
    watched: dict[str, None] = field(factory=dict)
    """Expressions of the tokens that it watches."""
    tokens: dict[str, None] = field(factory=dict)
    served: set[str] = field(factory=set)
    routed: dict[str, None] = field(factory=dict)
    """Keys with routes that its messages led to."""


class Member:
    """A node with its clock, alarm, computations and connection."""

    node: Node
    transport: Transport

    def __init__(self, simulation: Simulation, name: str, number: int) -> None:
        """Start connected and running; the network sets `node` and `transport`."""
        self.name = name
        self.number = number
        """Position in the order in which members joined, from 0."""
        self.declared = Declarations()
        self.closed = False
        self.clock: Clock | None = None
        """None: virtual time."""
        self.connected = True
        self.lost_s = 0.0
        """Time at which the connection was last lost."""
        self.unplugged = False
        """Disconnected on its own: a restored router does not reconnect it."""
        self.connection = 0
        """Id of the current connection; messages sent over earlier connections are dropped."""
        self.paused = False
        self.pauses = 0
        self.lapsed = False
        """Paused for longer than the lease."""
        self.last_token_s = 0.0
        """Arrival time of the newest token event, which later token events must not overtake."""
        self.seen: dict[str, None] = {}
        """Tokens that the node has been notified of."""
        self._simulation = simulation
        self._backlog: list[Item] = []
        self._alarm = 0, math.inf
        """Id of the newest alarm, and its virtual time; infinite: none. Older ones are ignored."""
        self._computed_s = {Compute: 0.0, Delegate: 0.0}
        """Virtual time at which the newest computation of each kind ends."""

    @property
    def visible(self) -> bool:
        """Whether the member's tokens are visible to others."""
        return self.connected and not self.lapsed

    # --- input ------------------------------------------------------------------------------

    def receive(self, connection: int, delivery: Delivery) -> None:
        """Handle a delivery that was sent during the given connection."""
        if not self.connected or self.connection != connection:
            return
        simulation = self._simulation
        if isinstance(delivery, Received) and not self.paused and simulation.trace is None:
            # Most events of a simulation: `handle` inlined.
            if not self.closed:
                simulation.delivered += 1
                self.node.deliver(delivery, self._local_s())
                self._set_alarm()
            return
        if not isinstance(delivery, (TokenUp, TokenDown)) or update_tokens(self.seen, delivery):
            self.handle(delivery)

    def handle(self, item: Item) -> None:
        """Pass an input to the node, or queue it while the node is paused."""
        if self.closed:
            return
        if self.paused:
            self._backlog.append(item)
        else:
            self._process(item)
            if isinstance(item, Stopping) and not item.grace_s:
                self.transport.close()
            self._set_alarm()

    def _process(self, item: Item) -> None:
        simulation = self._simulation
        now_s = simulation.now_s
        if simulation.trace is not None:
            simulation.trace(now_s, self.name, item)
        local_s = self._local_s()
        if isinstance(item, _DELIVERIES):
            simulation.delivered += 1
            self.node.deliver(item, local_s)
        else:
            self.node.dispatch(item, local_s)

    # --- time -------------------------------------------------------------------------------

    def _local_s(self) -> float:
        """Return the time on this member's clock."""
        now_s = self._simulation.now_s
        return now_s if self.clock is None else self.clock.local_s(now_s)

    def resume(self) -> None:
        """End a pause and handle all queued inputs in order."""
        self.paused = False
        backlog, self._backlog = self._backlog, []
        for item in backlog:
            self.handle(item)
        self._reset_alarm()

    def set_clock(self, clock: Clock) -> None:
        """Replace the clock."""
        self.clock = clock
        self._reset_alarm()

    def _reset_alarm(self) -> None:
        self._alarm = self._alarm[0], math.inf
        self._set_alarm()

    def _set_alarm(self, min_s: float = 0.0) -> None:
        """Set an alarm for the core's wakeup unless an earlier alarm is set.

        A postponed wakeup does not move the alarm, which then rings too early and sets the next.
        """
        if self.closed or self.paused:
            return
        wakeup_s = self.node.core.wakeup_s
        if wakeup_s is None:
            return
        due_s = wakeup_s if self.clock is None else self.clock.virtual_s(wakeup_s)
        newest, newest_s = self._alarm
        if due_s < newest_s:
            self._alarm = newest + 1, due_s
            at_s = due_s if due_s > self._simulation.now_s else min_s
            self._simulation.at(at_s, self._ring, newest + 1)

    def _ring(self, alarm: int) -> None:
        if self.closed or self.paused or self._alarm[0] != alarm:
            return
        self._alarm = alarm, math.inf
        now_s = self._simulation.now_s
        wakeup_s = self.node.core.wakeup_s
        local_s = self._local_s()
        if wakeup_s is not None and wakeup_s <= local_s:
            self._process(Wakeup())
        self._set_alarm(now_s + WAKE_AGAIN_S)

    # --- computations -----------------------------------------------------------------------

    def compute(self, job: Compute | Delegate | StopJob) -> None:
        """Run a computation and deliver its result after its virtual duration.

        A computation that should stop has been run already; its result is delivered.
        """
        if isinstance(job, StopJob):
            return
        simulation = self._simulation
        conditions, draw = simulation.conditions, simulation.random.random
        duration_s = conditions.compute_s
        if conditions.compute_jitter_s:
            duration_s += conditions.compute_jitter_s * draw()
        # As with one thread and one worker, jobs of a kind end in the order in which they start.
        end_s = max(self._computed_s[type(job)], simulation.now_s + duration_s)
        self._computed_s[type(job)] = end_s
        if conditions.compute_failure and draw() < conditions.compute_failure:
            simulation.at(end_s, self.handle, Computed(job.job, None, INJECTED_FAILURE))
        elif isinstance(job, Delegate):
            simulation.at(end_s, self.handle, run_delegated(job, self._local_s, self._local_s))
        else:
            simulation.at(end_s, self._run, job)

    def _run(self, job: Compute) -> None:
        """Run a computation at its end, since a thread may read what has changed meanwhile."""
        if self.closed:
            return
        computed = run_job(job, self._local_s)
        if computed.error:
            self._simulation.failed_jobs.append((self._simulation.now_s, self.name, computed.error))
        self.handle(computed)


class Tokens:
    """Liveliness tokens: notifies members when tokens that they watch appear or vanish.

    A token that several nodes declare on one key appears when the first declares it, and vanishes
    when the last withdraws it. Notifications are never lost and stay in order, as on Zenoh.
    """

    def __init__(self, simulation: Simulation, members: Mapping[str, Member]) -> None:
        """Create an empty registry; `members` is a live view of the network's members."""
        self._simulation = simulation
        self._members = members

    def report(
        self,
        kind: type[TokenUp | TokenDown],
        owner: Member,
        keys: Iterable[str],
        exclude: Member | None = None,
    ) -> None:
        """Report tokens that a visible member has just declared or withdrawn."""
        if not owner.visible:
            return
        for key in keys:
            if not self._declared_elsewhere(key, owner):
                event = kind(key)
                for member in self._members.values():
                    watches = member is not exclude and member.connected
                    if watches and matches_any(member.declared.watched, key):
                        self._send(member, event)

    def report_existing(self, watcher: Member, expressions: Iterable[str]) -> None:
        """Report the existing tokens to one watcher."""
        keys = (
            key
            for member in self._members.values()
            if member.visible
            for key in member.declared.tokens
            if matches_any(expressions, key)
        )
        for key in dict.fromkeys(keys):
            self._send(watcher, TokenUp(key))

    def _declared_elsewhere(self, key: str, owner: Member) -> bool:
        """Return whether another visible member has a token on this key."""
        return any(
            member is not owner and member.visible and key in member.declared.tokens
            for member in self._members.values()
        )

    def _send(self, watcher: Member, event: TokenUp | TokenDown) -> None:
        simulation = self._simulation
        watcher.last_token_s = max(watcher.last_token_s, simulation.now_s + simulation.delay_s())
        simulation.at(watcher.last_token_s, watcher.receive, watcher.connection, event)
