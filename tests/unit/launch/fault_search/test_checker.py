"""The checker notices what must not happen: each kind of violation, made by hand."""

from __future__ import annotations

import attrs
import pytest

from laneweave.launch.fault_search.bodies import Geometry
from laneweave.launch.fault_search.checker import MAX_VIOLATIONS, Checker, Violation
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.wire.messages import Ballot, Name, Plan, Sense, VehicleState
from support.states import holding

GEOMETRY = Geometry(pitch_m=15.0, lane_width_m=3.5, length_m=5.0, width_m=1.8)
A, B, C = Name("a"), Name("b"), Name("c")
MOVE_S = 0.8


def ballot(seq: int) -> Ballot:
    return Ballot(1, Name("c1"), 1, seq)


def plan(seq: int, moves: dict[Name, tuple[PlannedMove, ...]]) -> Plan:
    return Plan(
        ballot=ballot(seq),
        formations=(0,),
        roster=tuple(moves),
        incarnations=dict.fromkeys(moves, 1),
        start_cells={},
        moves=moves,
        t0_s=0.0,
        slot_s=1.0,
        territory=(),
    )


def state(vehicle: Name, seq: int | None, hold_cell: Cell = (0, 0), **more: object) -> VehicleState:
    return holding(vehicle, None if seq is None else ballot(seq), hold_cell, **more)


def sense(attendant: int, joined: tuple[int, ...] = (0,)) -> Sense:
    return Sense(
        A, 1, 0.1, (0.0,) * 6, (0, 0), 0, (0, 0), 0, (), attendant=attendant, joined=joined
    )


class Scene:
    """A road with vehicles whose agents do as plans say."""

    def __init__(self, **cells: Cell) -> None:
        """Put vehicles in cells."""
        self.checker = Checker(GEOMETRY)
        self.cells = {Name(name): cell for name, cell in cells.items()}
        for name, cell in self.cells.items():
            self.checker.enter(0.0, name, cell)
            self.checker.sent(0.0, state(name, None, cell))

    def issue(self, t_s: float, seq: int, **moves: tuple[PlannedMove, ...]) -> None:
        self.checker.sent(t_s, plan(seq, {Name(name): each for name, each in moves.items()}))

    def move(self, t_s: float, name: Name, seq: int, target: Cell, lasts_s: float = MOVE_S) -> None:
        """Let an agent say that it moves under a ballot, and let the body do so."""
        self.checker.sent(t_s, state(name, seq, target, accepted=True, moving=True, go=True))
        self.checker.begin(t_s, name, 1, (self.cells[name], target), lasts_s)
        self.cells[name] = target

    @property
    def kinds(self) -> list[str]:
        return [violation.kind for violation in self.checker.violations]


def test_a_plan_that_is_executed_in_order_is_fine() -> None:
    scene = Scene(a=(0, 0), b=(1, 0))
    scene.issue(0.0, 1, a=((1, (0, 0), (1, 0)),), b=((0, (1, 0), (1, 1)),))
    scene.move(1.0, B, 1, (1, 1))
    scene.move(1.9, A, 1, (1, 0))
    scene.checker.advance(5.0)
    assert scene.checker.violations == []
    assert scene.checker.motions == 2


def test_a_cell_that_is_still_occupied_is_seen() -> None:
    scene = Scene(a=(0, 0), b=(1, 0))
    scene.issue(0.0, 1, a=((1, (0, 0), (1, 0)),), b=((0, (1, 0), (1, 1)),))
    scene.move(1.0, B, 1, (1, 1))
    scene.move(1.5, A, 1, (1, 0))
    assert scene.kinds == ["cell"]
    assert set(scene.checker.violations[0].vehicles) == {A, B}


def test_a_cell_that_another_vehicle_holds_is_seen() -> None:
    scene = Scene(a=(0, 0), b=(1, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)),), b=())
    scene.move(1.0, A, 1, (1, 0))
    assert scene.kinds == ["cell"]


def test_the_corners_of_an_oblique_motion_are_occupied() -> None:
    scene = Scene(a=(0, 0), b=(1, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 1)),), b=())
    scene.move(1.0, A, 1, (1, 1))
    assert scene.kinds == ["cell"]


def test_an_entry_into_an_occupied_cell_is_seen() -> None:
    scene = Scene(a=(0, 0))
    scene.checker.enter(1.0, B, (0, 0))
    assert scene.kinds == ["cell"]


def test_bodies_that_overlap_are_seen_at_the_time_at_which_they_touch() -> None:
    scene = Scene(a=(0, 0), b=(1, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)),), b=())
    scene.move(1.0, A, 1, (1, 0), lasts_s=1.5)
    scene.checker.advance(1.5)
    assert "overlap" not in scene.kinds
    scene.checker.advance(4.0)
    overlap = scene.checker.violations[-1]
    assert overlap.kind == "overlap"
    assert overlap.t_s == pytest.approx(2.0)  # 10 m of net gap at 10 m/s


def test_a_vehicle_that_has_left_blocks_no_cell() -> None:
    scene = Scene(a=(0, 0), b=(1, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)),), b=())
    scene.checker.leave(0.5, B)
    scene.move(1.0, A, 1, (1, 0))
    scene.checker.advance(3.0)
    assert scene.kinds == []


def test_a_motion_without_a_plan_is_seen() -> None:
    scene = Scene(a=(0, 0))
    scene.checker.begin(1.0, A, 1, ((0, 0), (1, 0)), MOVE_S)
    assert scene.kinds == ["motion"]


def test_a_motion_of_a_process_that_said_nothing_of_it_is_seen() -> None:
    scene = Scene(a=(0, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)),))
    scene.checker.sent(1.0, state(A, 1, (1, 0), accepted=True, moving=True))
    scene.checker.begin(1.0, A, 2, ((0, 0), (1, 0)), MOVE_S)
    assert scene.kinds == ["motion"]


@pytest.mark.parametrize("target", [(0, 1), (-1, 0)])
def test_a_motion_that_is_not_in_the_plan_is_seen(target: Cell) -> None:
    scene = Scene(a=(0, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)),))
    scene.move(1.0, A, 1, target)
    assert scene.kinds == ["motion"]


def test_a_motion_out_of_turn_is_seen() -> None:
    scene = Scene(a=(0, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)), (1, (1, 0), (0, 0)), (2, (0, 0), (0, 1))))
    scene.move(1.0, A, 1, (1, 0))
    scene.move(2.0, A, 1, (0, 0))
    scene.move(3.0, A, 1, (1, 0))
    assert scene.kinds == ["motion"]


def test_a_motion_that_turns_off_is_seen() -> None:
    scene = Scene(a=(0, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (1, 0)), (1, (1, 0), (1, 1))))
    scene.move(1.0, A, 1, (1, 0))
    scene.move(1.4, A, 1, (1, 1))
    assert scene.kinds == ["motion"]


def _two_plans(scene: Scene) -> None:
    """A and B share the first plan, B and C the second one."""
    scene.issue(0.0, 1, a=((0, (0, 0), (0, 1)), (1, (0, 1), (0, 0))), b=((0, (4, 0), (4, 1)),))
    scene.issue(0.0, 2, b=((0, (4, 1), (4, 0)),), c=((0, (8, 0), (8, 1)),))


def test_plans_one_after_the_other_are_fine() -> None:
    scene = Scene(a=(0, 0), b=(4, 0), c=(8, 0))
    _two_plans(scene)
    scene.move(1.0, A, 1, (0, 1))
    scene.move(1.0, B, 1, (4, 1))
    scene.move(1.9, C, 2, (8, 1))
    scene.move(3.0, B, 2, (4, 0))
    assert scene.kinds == []


def test_a_plan_that_begins_during_a_motion_of_another_one_is_seen() -> None:
    scene = Scene(a=(0, 0), b=(4, 0), c=(8, 0))
    _two_plans(scene)
    scene.move(1.0, A, 1, (0, 1))
    scene.move(1.5, C, 2, (8, 1))
    assert scene.kinds == ["interleaved"]


def test_a_plan_that_goes_on_after_another_one_has_begun_is_seen() -> None:
    scene = Scene(a=(0, 0), b=(4, 0), c=(8, 0))
    _two_plans(scene)
    scene.move(1.0, A, 1, (0, 1))
    scene.move(2.0, C, 2, (8, 1))
    scene.move(3.0, A, 1, (0, 0))
    assert scene.kinds == ["interleaved"]


def test_plans_without_a_common_vehicle_may_run_at_once() -> None:
    scene = Scene(a=(0, 0), b=(4, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (0, 1)), (1, (0, 1), (0, 0))))
    scene.issue(0.0, 2, b=((0, (4, 0), (4, 1)),))
    scene.move(1.0, A, 1, (0, 1))
    scene.move(1.5, B, 2, (4, 1))
    scene.move(2.0, A, 1, (0, 0))
    assert scene.kinds == []


def test_a_second_plan_under_one_ballot_is_seen() -> None:
    scene = Scene(a=(0, 0))
    scene.issue(0.0, 1, a=((0, (0, 0), (0, 1)),))
    scene.issue(0.2, 1, a=((0, (0, 0), (0, 1)),))
    assert scene.kinds == []
    scene.issue(0.4, 1, a=((0, (0, 0), (1, 0)),))
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
def test_what_is_taken_back_is_seen(before: object, after: object) -> None:
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


def test_a_violation_is_data() -> None:
    violation = Violation("cell", 1.0, (A, B), "both occupy [(0, 0)]")
    assert attrs.asdict(violation)["vehicles"] == (A, B)
