"""The interface of the two operations: `formations` (the paper's) and `rolling`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from attrs import field, frozen

from laneweave.protocol.quick_frozen import quick_frozen
from laneweave.protocol.road_layout import TemporaryParts
from laneweave.protocol.runtime.node import Compute, Computed, Effect
from laneweave.protocol.wire.messages import Census, Name, Plan, Prepare, VehicleState


@frozen
class LogEntry:
    """Kind and data of a line in `events.jsonl`."""

    kind: str
    data: dict[str, Any] = field(factory=dict)


@quick_frozen
class ToVehicle:
    """A message to send to a vehicle."""

    vehicle: Name
    message: Prepare | Plan


Outcome = Effect | LogEntry | ToVehicle
"""What an operation yields; the coordinator's core turns log entries and messages to vehicles into
effects."""


class Operation(Protocol):
    """A leader's tasks for the vehicles on the road.

    `t_s` is road time, `now_s` is the node clock.
    """

    def forget(self) -> None:
        """Discard all state: the road is new."""

    def take_over(self) -> None:
        """Reset because this coordinator has begun or stopped leading."""

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Handle a road clock message, even while not leading."""

    def on_obstacles(self, temporary: TemporaryParts) -> None:
        """Handle the parts of lanes that are not open as always, even while not leading."""

    def on_state(self, state: VehicleState, now_s: float) -> list[LogEntry] | None:
        """Handle the state of a vehicle on the road; return None if nothing depends on it."""

    def lead(self, census: Census, t_s: float, now_s: float, *, changed: bool) -> Iterable[Outcome]:
        """Handle expired timers, request plans, and send or resend messages.

        Args:
            census: the newest census.
            t_s: road time.
            now_s: node clock.
            changed: whether the census, road time or leader has changed since the last call.
        """

    def finish(self, computed: Computed, t_s: float, now_s: float) -> Iterable[Compute | LogEntry]:
        """Handle the result of a computation; ignore results that are no longer needed."""

    @property
    def wakeups(self) -> list[float]:
        """Times at which `lead` must be called (node clock)."""

    @property
    def in_force(self) -> int:
        """Number of plans in force."""
