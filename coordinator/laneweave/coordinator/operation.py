"""The interface of the two operations: `formations` (the paper's) and `rolling`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from attrs import field, frozen

from laneweave.protocol.runtime.node import Compute, Computed, Effect, Send
from laneweave.protocol.wire.messages import Census, Name, Plan, Prepare, VehicleState
from laneweave.protocol.wire.topics import PLAN, PREPARE


@frozen
class LogEntry:
    """Something worth a line in `events.jsonl`."""

    kind: str
    data: dict[str, Any] = field(factory=dict)


class Operation(Protocol):
    """What the coordinator that leads does for the vehicles on the road.

    Times are road time (`t_s`) and the node's clock (`now_s`). Methods that return effects may
    return log entries, too.
    """

    def forget(self) -> None:
        """Forget everything: there is another road."""

    def take_over(self) -> None:
        """Begin anew: this coordinator has begun to lead, or has stopped."""

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Take a message of the road's clock, leading or not."""

    def on_state(self, state: VehicleState, now_s: float) -> list[LogEntry] | None:
        """Take the state of a vehicle on the road; None: nothing waits for it."""

    def lead(
        self, census: Census, t_s: float, now_s: float, *, changed: bool
    ) -> Iterable[Effect | LogEntry]:
        """Do what is due: let timers run out, order plans, send messages (again).

        Args:
            census: the newest one.
            t_s: road time.
            now_s: node clock.
            changed: the census, the road time or the leader has changed since the last call.
        """

    def finish(self, computed: Computed, t_s: float, now_s: float) -> Iterable[Compute | LogEntry]:
        """Take the result of a computation; one that is not waited for any more is dropped."""

    @property
    def wakeups(self) -> list[float]:
        """Times at which `lead` has something to do (node clock)."""

    @property
    def in_force(self) -> int:
        """Number of plans in force."""


def to_vehicle(vehicle: Name, message: Prepare | Plan) -> Send:
    """Return the effect that sends a message to a vehicle."""
    topic = PLAN if isinstance(message, Plan) else PREPARE
    return Send(topic, message, {"vehicle": vehicle})
