"""Timeline of a run: a readable log of its messages, motions and violations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from laneweave.launch.fault_search.checks.claims import short
from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.protocol.runtime.node import Send
from laneweave.protocol.wire.messages import Command, Heartbeat, Plan, Prepare, VehicleState
from laneweave.protocol.wire.process_messages import LogEvent

BEFORE_S = 4.0
"""How long before the first violation the printed timeline begins."""
AFTER_S = 0.2


class Timeline:
    """Log of events and messages, without repeated messages."""

    def __init__(self) -> None:
        """Start with an empty log."""
        self._lines: list[tuple[float, str]] = []
        self._last: dict[tuple[str, str], str] = {}

    def add(self, t_s: float, text: str) -> None:
        """Add an event that is not a message."""
        self._lines.append((t_s, text))

    def add_message(self, t_s: float, sender: str, effect: Send) -> None:
        """Add a message, unless it repeats the last one from this sender under this key."""
        text = _text_of(effect)
        if text is None:
            return
        key = (sender, effect.topic.name + str(effect.parameters))
        if self._last.get(key) != text:
            self._last[key] = text
            self._lines.append((t_s, f"{sender}: {text}"))

    def around(self, violations: Iterable[Violation]) -> Iterator[str]:
        """Yield the lines around the first violation; all lines if there is none."""
        first = next(iter(violations), None)
        for t_s, text in self._lines:
            if first is None or first.t_s - BEFORE_S <= t_s <= first.t_s + AFTER_S:
                yield f"{t_s:8.3f}  {text}"


def _text_of(effect: Send) -> str | None:
    match effect.message:
        case VehicleState() as state:
            flags = {
                "accepted": state.accepted,
                "ready": state.ready,
                "go": state.go,
                "moving": state.moving,
                "done": state.done,
                "overdue": state.overdue,
                "unattended": not state.attended,
            }
            marks = " ".join(mark for mark, is_set in flags.items() if is_set)
            record = state.record
            return (
                f"STATE of {state.vehicle}/{record.incarnation} promised {short(record.promised)} "
                f"k={state.completed} at {state.hold_cell} joined {record.joined} {marks}"
                f"{_ownership(state)}"
            )
        case Command() as command:
            record = command.record
            return (
                f"COMMAND of {command.vehicle}/{record.incarnation} hold {command.hold_cell}"
                f" joined {record.joined}"
            )
        case Prepare() as prepare:
            return (
                f"PREPARE {short(prepare.ballot)} of {prepare.blocks} "
                f"to {effect.parameters['vehicle']}, roster {' '.join(prepare.roster)}"
            )
        case Plan() as plan:
            moves = {name: list(each) for name, each in plan.moves.items() if each}
            return (
                f"PLAN {short(plan.ballot)} of {plan.blocks} to {effect.parameters['vehicle']}"
                f" t0={plan.t0_s:.1f} moves {moves}"
            )
        case LogEvent() as event:
            return f"{event.kind} {event.data}"
        case Heartbeat() as beat:
            return f"heartbeat term {beat.term} leading {beat.leading}"
        case _:
            return None


def _ownership(state: VehicleState) -> str:
    """Return owned cells and newest transfer of a vehicle as text (rolling operation)."""
    transfer = state.record.transfer
    if transfer is None:
        return f" owns {list(state.record.owned)}" if state.record.owned else ""
    change = f"{list(transfer.after)} with {' '.join(transfer.roster)}"
    status = "open" if transfer.open else f"pending, then {change}"
    return f" owns {list(state.record.owned)}, transfer {short(transfer.ballot)} {status}"
