"""Forgeries: changed plans must be refused, and absurd numbers are out of bounds."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from laneweave.launch.fault_search.events.forgeries import absurd, harmful, malformed
from laneweave.launch.fault_search.road_setup import RoadSetup
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.vehicle.territory import BlockTerritory, CellTerritory
from laneweave.protocol.wire.bounds import Bounds, check_ballot
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Heartbeat,
    Name,
    Plan,
    Prepare,
    RoadClock,
    VehicleRecord,
)
from support.states import holding, make_plan

A, B = Name("a"), Name("b")
BALLOT = Ballot(1, Name("c1"), 1, 1)
CELLS: dict[Name, Cell] = {A: (-1, 0), B: (0, 0)}
LATTICE = RoadSetup(lanes=3).make_scenario().lattice
BLOCKS = (LATTICE.block_of(0),)
PLAN = make_plan(CELLS, {B: ((0, (0, 0), (0, 1)),)}, ballot=BALLOT, blocks=BLOCKS)
OWNED: dict[Name, tuple[Cell, ...]] = {A: ((-1, 0),), B: ((0, 0), (0, 1))}
ROLLING = replace(PLAN, before=OWNED, after=OWNED)


def accepts(name: Name, plan: Plan) -> bool:
    """Return whether a vehicle that has promised the ballot takes a plan."""
    execution = PlanExecution(
        vehicle=name,
        incarnation=PLAN.incarnations[name],
        hold_cell=CELLS[name],
        territory=CellTerritory() if plan.before else BlockTerritory(LATTICE),
        stored=VehicleRecord(joined=PLAN.blocks, owned=OWNED[name]),
        rules=VEHICLE_RULES,
    )
    execution.on_prepare(Prepare(BALLOT, PLAN.blocks, PLAN.roster))
    return execution.on_plan(plan)


@pytest.mark.parametrize("plan", [PLAN, ROLLING], ids=["formations", "rolling"])
def test_a_changed_plan_is_refused_by_those_who_must(plan: Plan) -> None:
    assert all(accepts(name, plan) for name in CELLS)
    texts = set()
    for seed in range(200):
        change = harmful(plan, random.Random(seed))
        assert change is not None
        changed, harm = change
        assert harm.refusing
        for name in harm.refusing:
            assert not accepts(name, changed), harm.text
        texts.add(harm.text.replace(A, "").replace(B, ""))
    assert len(texts) >= 6


def test_absurd_numbers_are_out_of_bounds() -> None:
    bounds = Bounds(incarnation=1000, tick_s=0.1, max_road_s=3600.0)
    messages = [
        Heartbeat(Name("c1"), 1, 1, leading=True, plans=1),
        RoadClock(10, 1.0, 1, 1, 1, 0, ended=False, bridge=1),
        Census(1.0, (), (), (), -1, 1),
        holding(A, BALLOT, (0, 0)),
    ]
    for seed in range(100):
        for message in messages:
            changed = absurd(message, random.Random(seed))
            with pytest.raises(BadInputError):
                bounds.check(changed, 1.0, 1.0)
        prepare = absurd(Prepare(BALLOT, BLOCKS, (A,)), random.Random(seed))
        assert isinstance(prepare, Prepare)
        with pytest.raises(BadInputError):
            check_ballot(prepare.ballot, 1.0)


def test_a_message_without_such_numbers_is_not_changed() -> None:
    assert absurd(PLAN, random.Random(1)) is None


def test_malformed_bytes_are_no_message() -> None:
    payload = encode(holding(A, BALLOT, (0, 0)))
    for seed in range(200):
        with pytest.raises(BadInputError):
            decode(malformed(payload, random.Random(seed)))
