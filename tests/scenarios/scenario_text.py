"""The notation of scenarios, and the errors that a scenario can end with."""

from __future__ import annotations

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, VehicleState


class ScenarioError(AssertionError):
    """A scenario does not go as written, or cannot be parsed."""


class CollisionError(ScenarioError):
    """Two vehicles occupy one cell."""


def cell_of(text: str) -> Cell:
    """Read a cell: column,lane."""
    column, lane = text.split(",")
    return int(column), int(lane)


def shown(cell: Cell) -> str:
    """Write a cell."""
    return f"{cell[0]},{cell[1]}"


def written(ballot: Ballot) -> str:
    """Write a ballot: term/coordinator/incarnation/seq."""
    return "/".join(str(part) for part in ballot)


def state_text(name: str, state: VehicleState) -> str:
    """Write the state of a vehicle."""
    parts = [f"{name} {'moves to' if state.moving else 'holds'} {shown(state.hold_cell)}"]
    if state.record.promised is not None:
        has = "accepted" if state.accepted else "promised"
        parts.append(f"{has} {written(state.record.promised)}")
    if state.accepted:
        parts.append(f"completed {state.completed}")
    for word, holds in (
        ("ready", state.ready),
        ("gate open", state.go),
        ("done", state.done),
        ("overdue", state.overdue),
        ("unattended", not state.attended),
    ):
        if holds:
            parts.append(word)
    if len(state.record.joined) > 1:
        parts.append(f"joined {' '.join(map(str, state.record.joined))}")
    if state.record.owned:
        parts.append(f"owns {' '.join(map(shown, state.record.owned))}")
    if state.record.transfer is not None:
        gate = "open" if state.record.transfer.open else "closed"
        parts.append(f"transfer {written(state.record.transfer.ballot)} {gate}")
    return ", ".join(parts)
