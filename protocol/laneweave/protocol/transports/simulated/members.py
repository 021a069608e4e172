"""A member of the simulated network: a node on its machine, in virtual time."""

from __future__ import annotations

import math

from laneweave.protocol.runtime.node import (
    Compute,
    Computed,
    Delegate,
    Node,
    Stopping,
    Wakeup,
    run_delegated,
    run_job,
)
from laneweave.protocol.runtime.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Question,
    Received,
    TokenDown,
    TokenUp,
    learn,
)
from laneweave.protocol.transports.simulated.conditions import Clock
from laneweave.protocol.transports.simulated.transport import SimulatedTransport
from laneweave.protocol.transports.simulated.virtual_time import Item, Simulation

WAKE_AGAIN_S = 0.001
"""A core that asks for a time that has passed is woken this much later: time goes on for it too."""
INJECTED_FAILURE = "injected failure"
"""The error of a computation that `Conditions.compute_failure` let fail."""


_DELIVERIES = (Received, TokenUp, TokenDown, LinkUp, LinkDown, Question)


class Member:
    """One node with its clock, its alarm, its computations and its place in the network."""

    node: Node

    def __init__(self, simulation: Simulation, transport: SimulatedTransport, number: int) -> None:
        """Be connected and awake, with an exact clock; whoever makes it sets `node`."""
        self.transport = transport
        self.number = number
        """Greater than those of all who joined before."""
        self.clock: Clock | None = None
        """None: it shows virtual time."""
        self.connected = True
        self.unplugged = False
        """Taken off the network by itself: a router that comes back does not change that."""
        self.connection = 0
        """What was under way when a connection ended does not arrive in the next one."""
        self.paused = False
        self.pauses = 0
        self.lapsed = False
        """Paused for longer than its lease."""
        self.news_s = 0.0
        """When the newest news of a token arrives: they do not overtake each other."""
        self.seen: dict[str, None] = {}
        """Tokens that have been shown to it."""
        self._simulation = simulation
        self._backlog: list[Item] = []
        self._alarm = 0
        """Number of the newest alarm; older ones do not count any more."""
        self._alarm_s = math.inf
        """Virtual time at which the newest alarm is due; infinite: there is none."""
        self._computed_s = {Compute: 0.0, Delegate: 0.0}
        """When the newest computation of each kind ends."""

    @property
    def visible(self) -> bool:
        """Whether others see its tokens."""
        return self.connected and not self.lapsed

    # --- what it is handed ------------------------------------------------------------------

    def arrive(self, connection: int, delivery: Delivery) -> None:
        """Hand over what was sent to it while it had this connection."""
        if not self.connected or self.connection != connection:
            return
        if (
            isinstance(delivery, Received)
            or not isinstance(delivery, (TokenUp, TokenDown))
            or learn(self.seen, delivery)
        ):
            self.hand_over(delivery)

    def hand_over(self, item: Item) -> None:
        """Let the node handle something, now or when it wakes."""
        if self.transport.closed:
            return
        if self.paused:
            self._backlog.append(item)
        else:
            self._handle(item)
            if isinstance(item, Stopping):
                self.transport.close()
            self._set_alarm()

    def _handle(self, item: Item) -> None:
        simulation = self._simulation
        now_s = simulation.now_s
        if simulation.trace is not None:
            simulation.trace(now_s, self.transport.name, item)
        local_s = self._local_s()
        if isinstance(item, _DELIVERIES):
            simulation.delivered += 1
            self.node.deliver(item, local_s)
        else:
            self.node.dispatch(item, local_s)

    # --- its time ---------------------------------------------------------------------------

    def _local_s(self) -> float:
        """Return the time on its own clock."""
        now_s = self._simulation.now_s
        return now_s if self.clock is None else self.clock.local_s(now_s)

    def wake(self) -> None:
        """End a pause: handle all that queued up, in order."""
        self.paused = False
        backlog, self._backlog = self._backlog, []
        for item in backlog:
            self.hand_over(item)
        self._reset_alarm()

    def set_clock(self, clock: Clock) -> None:
        """Put another clock in the place of the one that it had."""
        self.clock = clock
        self._reset_alarm()

    def _reset_alarm(self) -> None:
        self._alarm_s = math.inf
        self._set_alarm()

    def _set_alarm(self, soonest_s: float = 0.0) -> None:
        """Set an alarm for when the core wants to be woken, unless one is due before that.

        One that turns out to be too early sets the next. That happens much less often than that a
        core puts its time off.
        """
        if self.transport.closed or self.paused:
            return
        wakeup_s = self.node.core.wakeup_s
        if wakeup_s is None:
            return
        due_s = wakeup_s if self.clock is None else self.clock.virtual_s(wakeup_s)
        if due_s < self._alarm_s:
            self._alarm_s = due_s
            self._alarm += 1
            at_s = due_s if due_s > self._simulation.now_s else soonest_s
            self._simulation.at(at_s, self._ring, self._alarm)

    def _ring(self, alarm: int) -> None:
        if self.transport.closed or self.paused or self._alarm != alarm:
            return
        self._alarm_s = math.inf
        now_s = self._simulation.now_s
        wakeup_s = self.node.core.wakeup_s
        local_s = self._local_s()
        if wakeup_s is not None and wakeup_s <= local_s:
            self._handle(Wakeup())
        self._set_alarm(now_s + WAKE_AGAIN_S)

    # --- its computations -------------------------------------------------------------------

    def compute(self, job: Compute | Delegate) -> None:
        """Do a computation and hand its result over when it is due."""
        simulation = self._simulation
        conditions, draw = simulation.conditions, simulation.random.random
        duration_s = conditions.compute_s
        if conditions.compute_jitter_s:
            duration_s += conditions.compute_jitter_s * draw()
        if conditions.compute_failure and draw() < conditions.compute_failure:
            computed = Computed(job.job, None, INJECTED_FAILURE)
        else:
            computed = (
                run_job(job) if isinstance(job, Compute) else run_delegated(job, self._local_s)
            )
        # As on one thread and one worker: jobs of a kind end in the order in which they came.
        end_s = max(self._computed_s[type(job)], simulation.now_s + duration_s)
        self._computed_s[type(job)] = end_s
        simulation.at(end_s, self.hand_over, computed)
