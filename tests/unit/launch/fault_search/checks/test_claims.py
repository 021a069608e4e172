"""Claims in messages that the motion controllers and bodies do not confirm are reported."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from laneweave.launch.fault_search.checks.claims import Claims, required_before
from laneweave.launch.fault_search.events.forgeries import Harm
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Name, Prepare, VehicleRecord, VehicleState
from support.states import changed, holding, make_plan

A, B = Name("a"), Name("b")
BALLOT = Ballot(1, Name("c1"), 1, 1)
BLOCK = 0
STORED = VehicleRecord(
    incarnation=1, joined=(BLOCK,), accepted=BALLOT, promised=None, owned=(), transfer=None
)
CELLS: dict[Name, Cell] = {A: (0, 0), B: (2, 0)}
PLAN = make_plan(CELLS, {A: ((0, (0, 0), (0, 1)),), B: ()}, ballot=BALLOT)
ACCEPTED = holding(A, BALLOT, (0, 0), accepted=True, joined=(BLOCK,))


class Scene:
    """Two vehicles whose processes have promised a ballot and received its plan."""

    def __init__(self) -> None:
        """Send nothing yet."""
        self.kinds: list[str] = []
        self.claims = Claims(self._tell, {BALLOT: PLAN})
        for name in CELLS:
            self.claims.enter(0.0, name, 99)
            self.claims.store(name, STORED)

    def _tell(self, kind: str, t_s: float, vehicles: list[str], text: str) -> None:
        del t_s, vehicles, text
        self.kinds.append(kind)

    def send(self, state: VehicleState, finished: int = 0, at_rest: Cell | None = (0, 0)) -> None:
        self.claims.record(state)
        self.claims.on_state(1.0, state, finished, at_rest)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_true_states_are_not_reported(scene: Scene) -> None:
    scene.send(ACCEPTED)
    scene.send(replace(ACCEPTED, vehicle=B, ready=True, hold_cell=(2, 0)), at_rest=(2, 0))
    scene.send(replace(ACCEPTED, go=True, ready=True))
    scene.send(replace(ACCEPTED, go=True, completed=1, hold_cell=(0, 1)), 1, (0, 1))
    assert scene.kinds == []


@pytest.mark.parametrize(
    ("state", "finished", "at_rest"),
    [
        (changed(ACCEPTED, incarnation=2, accepted=False), 0, (0, 0)),  # never in charge
        (changed(ACCEPTED, joined=(BLOCK, 1)), 0, (0, 0)),
        (changed(ACCEPTED, promised=BALLOT._replace(seq=2)), 0, (0, 0)),  # not stored
        (replace(ACCEPTED, completed=1), 0, (0, 0)),
        (ACCEPTED, 0, None),  # holds, but moves
        (ACCEPTED, 0, (0, 1)),  # another cell
        (changed(ACCEPTED, owned=((5, 5),)), 0, (0, 0)),
        (replace(ACCEPTED, attended=False), 0, (0, 0)),  # moves without an agent
    ],
)
def test_a_false_state_is_reported(
    scene: Scene, state: VehicleState, finished: int, at_rest: Cell | None
) -> None:
    scene.send(state, finished, at_rest)
    assert scene.kinds == ["false"]


def test_a_gate_that_opens_too_early_is_reported(scene: Scene) -> None:
    scene.send(replace(ACCEPTED, go=True))
    assert scene.kinds == ["gate"]


def test_who_must_refuse_a_harmful_plan_must_not_accept_it(scene: Scene) -> None:
    scene.claims.harmful[BALLOT] = Harm(frozenset({B}), "wrong")
    scene.send(ACCEPTED)
    assert scene.kinds == []
    scene.send(replace(ACCEPTED, vehicle=B, hold_cell=(2, 0)), at_rest=(2, 0))
    assert scene.kinds == ["harmful"]


def test_a_plan_needs_promises_from_its_start_cells(scene: Scene) -> None:
    scene.claims.record(changed(ACCEPTED, accepted=False))
    scene.claims.record(holding(B, BALLOT, (3, 0)))
    scene.claims.on_plan(1.0, PLAN)
    assert scene.kinds == ["basis"]


def test_a_plan_contains_all_vehicles_of_its_blocks(scene: Scene) -> None:
    for name, cell in CELLS.items():
        scene.claims.record(holding(name, BALLOT, cell))
    scene.claims.on_plan(1.0, PLAN)
    assert scene.kinds == []
    scene.claims.enter(2.0, "c", PLAN.blocks[0])
    scene.claims.on_plan(3.0, PLAN)
    assert scene.kinds == ["roster", "roster"]


def test_only_a_plan_that_all_have_accepted_is_adopted(scene: Scene) -> None:
    known = {A: ACCEPTED, B: replace(ACCEPTED, vehicle=B)}
    for state in known.values():
        scene.claims.record(state)
    scene.claims.on_adoption(1.0, BALLOT, CELLS, known)
    assert scene.kinds == []
    scene.claims.on_adoption(1.0, BALLOT, CELLS, known | {B: replace(known[B], overdue=True)})
    scene.claims.on_adoption(1.0, BALLOT._replace(seq=2), CELLS, known)
    assert scene.kinds == ["adoption"] * 3


def test_promises_of_ended_processes_do_not_count(scene: Scene) -> None:
    promises = {A: ACCEPTED, B: replace(ACCEPTED, vehicle=B)}
    scene.claims.on_planning(1.0, 1.0, BALLOT, promises, promises)
    assert scene.kinds == []
    scene.claims.on_planning(2.0, 2.0, BALLOT, promises, {B: changed(promises[B], incarnation=2)})
    assert scene.kinds == ["basis"]


def test_planning_is_not_repeated_at_once(scene: Scene) -> None:
    for t_s in (1.0, 2.0, 2.5):
        scene.claims.on_planning(t_s, t_s, BALLOT, {A: ACCEPTED}, {})
    assert scene.kinds == ["busy"]
    # The clock of the leader has jumped.
    scene.claims.on_planning(2.6, 3.5, BALLOT, {A: ACCEPTED}, {})
    assert scene.kinds == ["busy"]


def test_a_process_keeps_the_stored_promise(scene: Scene) -> None:
    stored = replace(STORED, promised=BALLOT._replace(seq=2), owned=((0, 0),))
    scene.claims.store(A, stored)
    scene.send(changed(ACCEPTED, accepted=False))
    assert scene.kinds == ["false"]


def test_a_ballot_has_one_roster(scene: Scene) -> None:
    for roster in ((A, B), (A, B), (A,)):
        scene.claims.on_prepare(1.0, Prepare(BALLOT, (BLOCK,), roster))
    assert scene.kinds == ["two-plans"]


def test_a_process_of_an_earlier_road_may_report_anything(scene: Scene) -> None:
    scene.claims.begin_road()
    scene.claims.store(A, replace(STORED, incarnation=2, accepted=None))
    scene.send(replace(ACCEPTED, completed=7))
    assert scene.kinds == []


def test_what_must_have_ended_before_a_move() -> None:
    moves = {A: ((0, (0, 0), (1, 1)), (1, (1, 1), (2, 1))), B: ((2, (0, 1), (0, 0)),)}
    plan = make_plan({A: (0, 0), B: (0, 1)}, moves, ballot=BALLOT)
    assert list(required_before(plan, A, 0)) == []
    assert list(required_before(plan, B, 0)) == [(A, 1)]
