"""The story of a run for the person who looks for a cause: what was said, moved and broken."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from laneweave.launch.fault_search.checker import Violation
from laneweave.protocol.runtime.node import Send
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    Heartbeat,
    LogEvent,
    Plan,
    Prepare,
    VehicleState,
)

BEFORE_S = 4.0
"""How much is told from before a violation."""
AFTER_S = 0.2


class Story:
    """Collects lines; repeated states and commands are left out."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._lines: list[tuple[float, str]] = []
        self._said: dict[tuple[str, str], str] = {}

    def tell(self, t_s: float, text: str) -> None:
        """Something happened that is no message."""
        self._lines.append((t_s, text))

    def said(self, t_s: float, sender: str, effect: Send) -> None:
        """A process says something."""
        text = _words(effect)
        if text is None:
            return
        key = (sender, effect.topic.name + str(effect.parameters))
        if self._said.get(key) != text:
            self._said[key] = text
            self._lines.append((t_s, f"{sender}: {text}"))

    def around(self, violations: Iterable[Violation]) -> Iterator[str]:
        """Return the lines around the first violation; without violations all."""
        first = next(iter(violations), None)
        for t_s, text in self._lines:
            if first is None or first.t_s - BEFORE_S <= t_s <= first.t_s + AFTER_S:
                yield f"{t_s:8.3f}  {text}"


def _words(effect: Send) -> str | None:
    match effect.message:
        case VehicleState() as state:
            marks = [
                mark
                for mark, is_so in (
                    ("accepted", state.accepted),
                    ("ready", state.ready),
                    ("go", state.go),
                    ("moving", state.moving),
                    ("done", state.done),
                    ("overdue", state.overdue),
                    ("unattended", not state.attended),
                )
                if is_so
            ]
            return (
                f"STATE of {state.vehicle}/{state.incarnation} promised {_short(state.promised)} "
                f"k={state.completed} at {state.hold_cell} joined {state.joined} {' '.join(marks)}"
                f"{_owned(state)}"
            )
        case Command() as command:
            return (
                f"COMMAND of {command.vehicle}/{command.incarnation} hold {command.hold_cell}"
                f" joined {command.joined}"
            )
        case Prepare() as prepare:
            return (
                f"PREPARE {_short(prepare.ballot)} of {prepare.formations} "
                f"to {effect.parameters['vehicle']}, roster {' '.join(prepare.roster)}"
            )
        case Plan() as plan:
            moves = {name: list(each) for name, each in plan.moves.items() if each}
            return (
                f"PLAN {_short(plan.ballot)} of {plan.formations} to {effect.parameters['vehicle']}"
                f" t0={plan.t0_s:.1f} moves {moves}"
            )
        case LogEvent() as event:
            return f"{event.kind} {event.data}"
        case Heartbeat() as beat:
            return f"heartbeat term {beat.term} leading {beat.leading}"
        case _:
            return None


def _owned(state: VehicleState) -> str:
    """Return what a vehicle of the rolling operation shows to own."""
    if not state.estate and state.deed is None:
        return ""
    deed = state.deed
    if deed is None:
        return f" owns {list(state.estate)}"
    word = "open" if deed.open else f"waits for {list(deed.after)} with {' '.join(deed.roster)}"
    return f" owns {list(state.estate)}, deed {_short(deed.ballot)} {word}"


def _short(ballot: Ballot | None) -> str:
    return "nothing" if ballot is None else ".".join(str(part) for part in ballot)
