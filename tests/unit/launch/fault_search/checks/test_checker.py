"""The checker notices what must not happen: each kind of violation, made by hand."""

from __future__ import annotations

from itertools import pairwise

import pytest

from laneweave.launch.fault_search.checks.checker import MAX_VIOLATIONS, Checker
from laneweave.launch.fault_search.checks.geometry import Geometry
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import (
    Ballot,
    CurrentMotion,
    Name,
    Sense,
    VehicleRecord,
    VehicleState,
)
from support.states import holding, make_plan
from support.tables import for_each

GEOMETRY = Geometry(pitch_m=15.0, lane_width_m=3.5, length_m=5.0, width_m=1.8)
A, B, C = Name("a"), Name("b"), Name("c")
MOVE_S = 0.8
OTHER_BLOCK = 99
"""A block that is in no plan."""

Paths = dict[Name, tuple[Cell, ...]]
Motion = tuple[float, Name, int, Cell]
"""Time, vehicle, number of the plan, target."""


def ballot(seq: int) -> Ballot:
    return Ballot(1, Name("c1"), 1, seq)


def state(vehicle: Name, seq: int | None, hold_cell: Cell = (0, 0), **more: object) -> VehicleState:
    return holding(vehicle, None if seq is None else ballot(seq), hold_cell, **more)


def sense(in_charge: int, joined: tuple[int, ...] = (0,)) -> Sense:
    record = VehicleRecord(in_charge, joined)
    return Sense(A, 1, 0.1, (0.0,) * 6, (0, 0), CurrentMotion((0, 0)), 0, record, ())


class Scene:
    """A road with vehicles whose agents execute plans."""

    def __init__(self, *plans: Paths, rolling: bool = False) -> None:
        """Put vehicles in the first cells of their paths, and send the plans."""
        self.checker = Checker(GEOMETRY, rolling=rolling)
        self.cells: dict[Name, Cell] = {}
        for paths in plans:
            self.cells = {name: path[0] for name, path in paths.items()} | self.cells
        for name, cell in self.cells.items():
            self.checker.enter(0.0, name, cell, OTHER_BLOCK)
            self.checker.sent(0.0, state(name, None, cell))
        for seq, paths in enumerate(plans, start=1):
            self.issue(seq, paths)

    def issue(self, seq: int, paths: Paths) -> None:
        moves = {
            name: tuple((step, *move) for step, move in enumerate(pairwise(path)))
            for name, path in paths.items()
        }
        cells = {name: path[0] for name, path in paths.items()}
        for name, cell in cells.items():
            self.checker.claims.record(state(name, seq, cell))
        self.checker.sent(0.0, make_plan(cells, moves, ballot=ballot(seq)))

    def move(self, t_s: float, name: Name, seq: int, target: Cell, lasts_s: float = MOVE_S) -> None:
        """Let an agent publish that it moves under a ballot, and move the body."""
        self.checker.sent(t_s, state(name, seq, target, accepted=True, moving=True, go=True))
        self.checker.begin(t_s, name, 1, (self.cells[name], target), lasts_s)
        self.cells[name] = target

    @property
    def kinds(self) -> list[str]:
        return [violation.kind for violation in self.checker.violations]


FOLLOWING: Paths = {A: ((0, 0), (1, 0)), B: ((1, 0), (1, 1))}
THERE_AND_BACK: Paths = {A: ((0, 0), (1, 0), (0, 0), (0, 1))}
SHARED: tuple[Paths, Paths] = (
    {A: ((0, 0), (0, 1), (0, 0)), B: ((4, 0), (4, 1))},
    {B: ((4, 1), (4, 0)), C: ((8, 0), (8, 1))},
)
"""A and B share the first plan, B and C the second one."""
APART: tuple[Paths, Paths] = ({A: SHARED[0][A]}, {B: SHARED[0][B]})
SHORT: Paths = {A: ((0, 0), (1, 0))}
LONG: Paths = {A: ((0, 0), (1, 0), (1, 1))}
A_GOES: Motion = (1.0, A, 1, (0, 1))


@for_each(
    ("kind", "plans", "motions"),
    [
        (None, [FOLLOWING], [(1.0, B, 1, (1, 1)), (1.9, A, 1, (1, 0))]),  # in order
        ("cell", [FOLLOWING], [(1.0, B, 1, (1, 1)), (1.5, A, 1, (1, 0))]),  # still occupied
        ("cell", [{A: ((0, 0), (1, 0)), B: ((1, 0),)}], [(1.0, A, 1, (1, 0))]),  # held
        ("cell", [{A: ((0, 0), (1, 1)), B: ((1, 0),)}], [(1.0, A, 1, (1, 1))]),  # a corner
        ("motion", [THERE_AND_BACK], [(1.0, A, 1, (0, 1))]),  # another lane than planned
        ("motion", [THERE_AND_BACK], [(1.0, A, 1, (-1, 0))]),  # another column
        ("motion", [THERE_AND_BACK], [(at_s, A, 1, (at_s % 2, 0)) for at_s in (1, 2, 3)]),  # order
        ("motion", [SHORT], [(1.0, A, 1, (1, 0)), (2.0, A, 1, (1, 1))]),  # after the plan's end
        ("motion", [LONG], [(1.0, A, 1, (1, 0)), (1.4, A, 1, (1, 1))]),  # before the last has ended
        # Plans one after the other; one that begins during a motion of another; one that goes on
        # after another has begun; and plans without a common vehicle at the same time.
        (None, SHARED, [A_GOES, (1.0, B, 1, (4, 1)), (1.9, C, 2, (8, 1)), (3.0, B, 2, (4, 0))]),
        ("interleaved", SHARED, [A_GOES, (1.5, C, 2, (8, 1))]),
        ("interleaved", SHARED, [A_GOES, (2.0, C, 2, (8, 1)), (3.0, A, 1, (0, 0))]),
        (None, APART, [A_GOES, (1.5, B, 2, (4, 1)), (2.0, A, 1, (0, 0))]),
    ],
)
def test_motions(kind: str | None, plans: list[Paths], motions: list[Motion]) -> None:
    scene = Scene(*plans)
    for motion in motions:
        scene.move(*motion)
    scene.checker.advance(5.0)
    assert [each for each in scene.kinds if each != "overlap"] == ([] if kind is None else [kind])
    assert kind or "overlap" not in scene.kinds
    assert scene.checker.motions == len(motions)


def test_an_entry_into_an_occupied_cell_is_reported() -> None:
    scene = Scene({A: ((0, 0),)})
    scene.checker.enter(1.0, B, (0, 0), OTHER_BLOCK)
    assert scene.kinds == ["cell"]


def test_an_overlap_is_reported_with_the_time_of_contact() -> None:
    scene = Scene({A: ((0, 0), (1, 0)), B: ((1, 0),)})
    scene.move(1.0, A, 1, (1, 0), lasts_s=1.5)
    scene.checker.advance(1.5)
    assert "overlap" not in scene.kinds
    scene.checker.advance(4.0)
    overlap = scene.checker.violations[-1]
    assert overlap.kind == "overlap"
    assert overlap.t_s == pytest.approx(2.0)  # 10 m of net gap at 10 m/s


def test_an_overlap_of_two_that_both_move_is_reported_once() -> None:
    scene = Scene({A: ((0, 0), (1, 0)), B: ((1, 0), (0, 0))})
    scene.move(1.0, A, 1, (1, 0), lasts_s=1.5)
    scene.move(1.0, B, 1, (0, 0), lasts_s=1.5)
    scene.checker.advance(4.0)
    (overlap,) = (each for each in scene.checker.violations if each.kind == "overlap")
    assert set(overlap.vehicles) == {A, B}
    assert overlap.t_s == pytest.approx(1.5)  # 10 m of net gap at twice 10 m/s


@pytest.mark.parametrize(("first", "second"), [(1, 2), (2, 1)])
def test_a_motion_during_one_of_an_earlier_plan_of_a_member_is_reported(
    first: int, second: int
) -> None:
    """In the rolling operation, only the earlier plan of a member must have ended."""
    both: Paths = {A: ((0, 0), (0, 1)), B: ((4, 0), (4, 1))}
    scene = Scene(both, both, rolling=True)
    scene.move(1.0, B, first, (4, 1))
    scene.move(1.2, A, second, (0, 1))
    found = [each.vehicles for each in scene.checker.violations if each.kind == "interleaved"]
    assert found == ([(A, B)] if first < second else [])


def test_a_vehicle_that_has_left_frees_its_cell() -> None:
    scene = Scene({A: ((0, 0), (1, 0)), B: ((1, 0),)})
    scene.checker.leave(0.5, B)
    scene.move(1.0, A, 1, (1, 0))
    scene.checker.advance(3.0)
    assert scene.kinds == []


def test_a_motion_without_a_plan_is_reported() -> None:
    scene = Scene()
    scene.checker.enter(0.0, A, (0, 0), OTHER_BLOCK)
    scene.checker.begin(1.0, A, 1, ((0, 0), (1, 0)), MOVE_S)
    assert scene.kinds == ["motion"]


def test_a_motion_that_its_process_has_not_published_is_reported() -> None:
    scene = Scene({A: ((0, 0), (1, 0))})
    scene.checker.sent(1.0, state(A, 1, (1, 0), accepted=True, moving=True))
    scene.checker.begin(1.0, A, 2, ((0, 0), (1, 0)), MOVE_S)
    assert scene.kinds == ["motion"]


def test_a_second_plan_under_one_ballot_is_reported() -> None:
    scene = Scene({A: ((0, 0), (0, 1))})
    scene.issue(1, {A: ((0, 0), (0, 1))})
    assert scene.kinds == []
    scene.issue(1, {A: ((0, 0), (1, 0))})
    assert scene.kinds == ["two-plans"]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (state(A, 2), state(A, 1)),
        (state(A, 1), state(A, None)),
        (state(A, 1, accepted=True), state(A, 1)),
        (state(A, 1, accepted=True, completed=2), state(A, 1, accepted=True, completed=1)),
        (state(A, 1, accepted=True, go=True), state(A, 1, accepted=True)),
        (state(A, 1, joined=(0, 1)), state(A, 2, joined=(0,))),
        (state(A, 1, joined=(0, 1)), state(A, None, joined=(0,), incarnation=2)),
        (sense(5), sense(4)),
        (sense(5, (0, 1)), sense(6, (0,))),
    ],
)
def test_a_revocation_is_reported(before: object, after: object) -> None:
    checker = Checker(GEOMETRY)
    checker.sent(0.0, before)
    assert checker.violations == []
    checker.sent(0.1, after)
    assert [violation.kind for violation in checker.violations] == ["monotone"]


@pytest.mark.parametrize(
    "after",
    [
        state(A, 2),
        state(A, 1, accepted=True, completed=3, go=True, joined=(0, 1)),
        state(A, None, incarnation=2),
        state(A, None, incarnation=0, joined=()),
    ],
)
def test_progress_and_other_processes_are_fine(after: VehicleState) -> None:
    checker = Checker(GEOMETRY)
    checker.sent(0.0, state(A, 1, accepted=True, completed=1))
    checker.sent(0.1, after)
    assert checker.violations == []


def test_a_stuck_vehicle_is_reported() -> None:
    checker = Checker(GEOMETRY)
    checker.stuck(50.0, A, "in (0, 0), wants lane 1")
    assert str(checker.violations[0]) == "  50.000 s  stuck: a: in (0, 0), wants lane 1"


def test_violations_are_limited() -> None:
    checker = Checker(GEOMETRY)
    for _ in range(2 * MAX_VIOLATIONS):
        checker.stuck(1.0, A, "")
    assert len(checker.violations) == MAX_VIOLATIONS
