"""Messages for tests, and what a core has sent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, PlannedMove, territory
from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.wire.field_types import Message
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    CurrentMotion,
    Name,
    Plan,
    Sense,
    VehicleRecord,
    VehicleState,
)
from laneweave.sim_bridge.bodies.record_store import RecordStore
from support.paper import PAPER

T = TypeVar("T")
Changed = TypeVar("Changed", bound=Message)
RECORD = frozenset(VehicleRecord.__struct_fields__)
A, B, C, D, E, F = (Name(letter) for letter in "ABCDEF")
BALLOT = Ballot(1, Name("c1"), 1, 1)


def changed(message: Changed, **changes: Any) -> Changed:  # noqa: ANN401 (fields)
    """Return a message with other fields, of its own or of its record, if it has one.

    `accepted` of a state may be True: the plan of the promised ballot is accepted.
    """
    if not isinstance(message, VehicleState | Sense | Command):
        return replace(message, **changes)
    record = {name: changes.pop(name) for name in RECORD & changes.keys()}
    if isinstance(message, VehicleState):
        promised = record.get("promised", message.record.promised)
        accepted = record.get("accepted", message.accepted)
        record["accepted"] = promised if accepted else None
    return replace(message, record=replace(message.record, **record), **changes)


def set_record(store: RecordStore, **changes: object) -> None:
    """Change what a motion controller stores."""
    store.record = replace(store.record, **changes)


def holding(
    vehicle: Name, promised: Ballot | None = None, hold_cell: Cell = (0, 0), **more: object
) -> VehicleState:
    """Return the state of a vehicle of block 0; `more` replaces or adds fields."""
    values: dict[str, Any] = {
        "vehicle": vehicle,
        "block": 0,
        "record": VehicleRecord(incarnation=1, joined=(0,), promised=promised),
        "ready": False,
        "completed": 0,
        "hold_cell": hold_cell,
        "moving": False,
        "go": False,
        "done": False,
        "overdue": False,
        "attended": True,
        "s_m": 0.0,
        "y_m": 0.0,
        "speed_mps": 0.0,
        "t_s": 0.0,
    }
    return changed(VehicleState(**values), **more)


def make_plan(
    cells: Mapping[Name, Cell],
    moves: Mapping[Name, tuple[PlannedMove, ...]] | None = None,
    **more: object,
) -> Plan:
    """Return a plan of vehicles in cells, which hold unless they have moves.

    Args:
        cells: start cell of each vehicle of the roster.
        moves: moves of those that move.
        more: replaces fields; incarnations are 1, and the ballot is `BALLOT`.
    """
    all_moves = {name: (moves or {}).get(name, ()) for name in cells}
    steps = [move for each in all_moves.values() for move in each]
    values: dict[str, Any] = {
        "ballot": BALLOT,
        "blocks": (0,),
        "roster": tuple(cells),
        "incarnations": dict.fromkeys(cells, 1),
        "start_cells": dict(cells),
        "moves": all_moves,
        "t0_s": 0.0,
        "slot_s": 4.0,
        "territory": tuple(sorted(territory(cells.values(), steps))),
    }
    return Plan(**(values | more))


def sense_in(cell: Cell, tick: int = 0, **more: Any) -> Sense:  # noqa: ANN401 (fields)
    """Return what a vehicle senses that holds exactly in a cell; `more` replaces fields."""
    t_s = tick * PAPER.runtime.tick_s
    block = PAPER.lattice.block_of(cell[0])
    values: dict[str, Any] = {
        "vehicle": Name("me"),
        "tick": tick,
        "t_s": t_s,
        "measured": cell_state(PAPER.lattice, cell, t_s),
        "hold_cell": cell,
        "motion": CurrentMotion(cell),
        "preferred_lane": 0,
        "record": VehicleRecord(joined=(block,)),
        "ahead": (),
        "block": block,
    }
    return changed(Sense(**values), **more)


def command(
    tick: int, *pairs: tuple[float, float], hold_cell: Cell = (0, 1), **more: object
) -> Command:
    """Return a command with a jerk for each tick; `more` replaces fields."""
    values: dict[str, Any] = {
        "vehicle": Name("me"),
        "record": VehicleRecord(incarnation=1),
        "tick": tick,
        "hold_cell": hold_cell,
        "motion": CurrentMotion((0, 1), tick + len(pairs)),
        "jerks": jerks(*pairs),
    }
    return changed(Command(**values), **more)


def jerks(*pairs: tuple[float, float], ticks: int = 1) -> bytes:
    """Return jerks (along, across) as they are sent; `ticks` repeats them."""
    return np.array(pairs * ticks, dtype="<f4").tobytes()


def sent(effects: Iterable[Effect], kind: type[T]) -> list[T]:
    """Return the messages of a kind."""
    return [e.message for e in effects if isinstance(e, Send) and isinstance(e.message, kind)]
