"""The rolling operation: when it plans, what it plans from, and which ballots it begins."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from itertools import count
from typing import Any

import pytest
from attrs import define, field
from msgspec.structs import replace

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.operation import LogEntry
from laneweave.coordinator.planning.rolling.problem import OpenRoad, StreamPlan, StreamVehicle
from laneweave.coordinator.rolling.checked_planner import checked, stream_planner, stream_road
from laneweave.coordinator.rolling.known_road import LOOKAHEAD_M, MARGIN_COLUMNS
from laneweave.coordinator.rolling.operation import (
    AGAIN_S,
    HEAR_S,
    LISTEN_S,
    MAX_DELAY_S,
    RollingOperation,
    _clusters,
)
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import TemporaryClosure, TemporaryParts
from laneweave.protocol.runtime.node import Compute, Computed
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import READY_LATE_S, SNAPSHOT_S
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.wire.events import PLANNING_FAILED, PLANNING_LATE
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    Name,
    OffLattice,
    PendingTransfer,
    Plan,
    Prepare,
)
from laneweave.protocol.wire.messages import VehicleState as State
from support.convoy import ROLLING
from support.rolling_samples import state
from support.states import changed

A, B, C, D = (Name(letter) for letter in "ABCD")
SLOT_S = ROLLING.timing.cycles_s[0]
SLOT = 5
BEGUN_S = SLOT * SLOT_S
LOOK_S = BEGUN_S + SNAPSHOT_S + 0.1
"""The first tick after what is planned from."""
HOMES: dict[Name, Cell] = {A: (0, 0), B: (2, 1), C: (-4, 0), D: (-8, 2)}
OWNED: dict[Name, tuple[Cell, ...]] = {
    A: ((0, 0), (1, 0), (-1, 0)),
    B: ((2, 1), (1, 1), (0, 1), (-1, 1)),
    C: ((-4, 0), (-5, 0), (-4, 1)),
    D: ((-8, 2), (-9, 2), (-8, 1)),
}
OLD = Ballot(1, Name("c0"), 1, 1)


def shown(
    name: Name,
    promised: Ballot | None = None,
    transfer: PendingTransfer | None = None,
    **changes: Any,  # noqa: ANN401 (fields)
) -> State:
    plain = state(name, promised, transfer, owned=OWNED[name], t_s=BEGUN_S + 0.4)
    values: dict[str, Any] = {"hold_cell": HOMES[name], "done": True} | changes
    return changed(plain, **values)


def census(*names: Name) -> Census:
    entries = tuple(CensusEntry(name, HOMES[name], 1, 0.0) for name in names)
    return Census(BEGUN_S, entries, ())


@define
class Call:
    """Input of a planning."""

    slot: int
    vehicles: dict[str, StreamVehicle]
    before: StreamPlan | None
    blocked: frozenset[Cell]
    now: OpenRoad | None


def place_m(state: State) -> float:
    """Return where a vehicle is that is in its cell."""
    return ROLLING.lattice.cell_s_m(state.hold_cell[0], state.t_s)


@define
class Bench:
    """A rolling operation with a planner that returns the paths of the test."""

    ways: dict[str, tuple[Cell, ...]] = field(factory=dict)
    missed: tuple[str, ...] = ()
    calls: list[Call] = field(factory=list)
    seq: Iterable[int] = field(factory=lambda: count(1))
    jobs: Iterable[int] = field(factory=lambda: count(100))
    asked_above: list[Ballot | None] = field(factory=list)
    scenario: Scenario = ROLLING
    control: RollingOperation = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Make the operation, with this object's planner."""
        self.control = RollingOperation(self.scenario, self.new_ballot, self.new_job, self.plan)

    def new_ballot(self, above: Ballot | None) -> Ballot:
        self.asked_above.append(above)
        return Ballot(7, Name("c1"), 1, next(iter(self.seq)))

    def plan(
        self,
        slot: int,
        vehicles: Iterable[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Iterable[Cell] = (),
        now: OpenRoad | None = None,
    ) -> StreamPlan:
        asked = {vehicle.vehicle: vehicle for vehicle in vehicles}
        self.calls.append(Call(slot, asked, before, frozenset(blocked), now))
        return StreamPlan(slot, self.ways, self.missed)

    def new_job(self) -> int:
        return next(iter(self.jobs))

    def hear(self, *states: State) -> list[LogEntry]:
        """Hear the states of vehicles that are in their cells."""
        placed = [replace(each, s_m=place_m(each)) for each in states]
        return [entry for each in placed for entry in self.control.on_state(each, 0.0) or ()]

    def order(self, t_s: float = LOOK_S, now_s: float | None = None) -> Compute | None:
        """Order at a road time; the node's clock is alike, unless it is given."""
        clock_s = t_s if now_s is None else now_s
        orders = [one for one in self.control.order(t_s, clock_s) if isinstance(one, Compute)]
        assert len(orders) <= 1
        return orders[0] if orders else None

    def think(self, t_s: float = LOOK_S) -> list[LogEntry]:
        """Order a plan, compute it, and take it at once."""
        compute = self.order(t_s)
        assert compute is not None
        return self.finish(compute, t_s)

    def finish(self, compute: Compute, t_s: float) -> list[LogEntry]:
        computed = Computed(compute.job, compute.work(time.monotonic))
        return list(self.control.finish(computed, t_s, 50.0))

    def call(self, t_s: float = LOOK_S) -> Call:
        """Plan at a road time; return what the planner was asked."""
        self.think(t_s)
        return self.calls[-1]

    @property
    def transfer(self) -> CellTransfer:
        """The only ballot."""
        (transfer,) = self.control.transfers
        return transfer


def bench(*names: Name, ways: dict[str, tuple[Cell, ...]] | None = None) -> Bench:
    """Return a bench that has observed vehicles for long enough."""
    made = Bench(ways or {})
    made.control.on_census(census(*names))
    assert made.order(BEGUN_S - 2.0) is None
    made.hear(*(shown(name) for name in names))
    return made


# --- when it plans ----------------------------------------------------------------------------


def test_plans_the_next_slot_when_this_one_s_moves_are_shown() -> None:
    desk = bench(A, B)
    assert desk.order(BEGUN_S + SNAPSHOT_S) is None
    desk.think()
    assert [call.slot for call in desk.calls] == [SLOT + 1]
    assert desk.order(BEGUN_S + SLOT_S - 0.1) is None  # once a slot
    assert desk.order(BEGUN_S + SLOT_S + SNAPSHOT_S) is None
    desk.think(LOOK_S + SLOT_S)
    assert [call.slot for call in desk.calls] == [SLOT + 1, SLOT + 2]


PART = TemporaryClosure(1, 600.0, 650.0)


def test_a_slot_is_planned_again_when_a_part_of_a_lane_is_closed() -> None:
    desk = bench(A, B)
    desk.think()
    desk.control.on_obstacles(TemporaryParts((PART,)))
    desk.think(LOOK_S + 1.0)
    assert [call.slot for call in desk.calls] == [SLOT + 1, SLOT + 1]
    desk.control.on_obstacles(TemporaryParts((PART,)))  # repeated
    assert desk.order(LOOK_S + 1.5) is None


def test_a_slot_that_begins_soon_is_not_planned_again() -> None:
    desk = bench(A, B)
    desk.think()
    desk.control.on_obstacles(TemporaryParts((PART,)))
    assert desk.order(BEGUN_S + SLOT_S - AGAIN_S + 0.1) is None
    call = desk.call(LOOK_S + SLOT_S)
    assert call.slot == SLOT + 2
    assert call.now is not None
    assert len(call.now.sections) == 4


def in_force_when_a_part_is_closed(
    desk: Bench, ways: dict[str, tuple[Cell, ...]] | None = None
) -> CellTransfer:
    """Put a ballot of A and B into force, and close a part; return the ballot.

    `ways`: what the planner finds from now on, if it is something else.
    """
    desk.think()
    earlier = desk.transfer
    plan = run_ballot(desk)
    transfers = [
        PendingTransfer(plan.ballot, plan.before[name], plan.after[name], (A, B)) for name in (A, B)
    ]
    desk.hear(
        *(
            changed(
                shown(name, plan.ballot, transfer, accepted=True, done=name != A, go=name == A),
                t_s=BEGUN_S + 1.1,
            )
            for name, transfer in zip((A, B), transfers, strict=True)
        )
    )
    assert earlier.phase is BallotPhase.IN_FORCE
    desk.ways = desk.ways if ways is None else ways
    desk.control.on_obstacles(TemporaryParts((PART._replace(lane=2),)))
    return earlier


def test_a_ballot_with_the_same_moves_is_kept_when_a_slot_is_planned_again() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk)
    desk.think(LOOK_S + 1.0)
    assert desk.control.transfers == [earlier]


def test_a_ballot_with_other_moves_is_replaced_when_a_slot_is_planned_again() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk, {})
    call = desk.call(LOOK_S + 1.0)
    assert not any(one.held or one.waits for one in call.vehicles.values())
    assert (0, 1) not in call.blocked
    # Each vehicle drops its moves when it promises, also one with an open gate.
    prepares = dict(desk.control.outgoing(50.0))
    assert {*prepares} == {A, B}
    assert all(
        isinstance(one, Prepare) and one.ballot > earlier.ballot for one in prepares.values()
    )
    assert [one.roster for one in desk.control.transfers] == [(A,), (B,)]


@pytest.mark.parametrize(
    ("line_m", "brakes"), [(570.0 + 57.0, False), (570.0 + 55.0, True), (500.0, True)]
)
def test_one_that_brakes_before_a_closed_part_keeps_its_cells(
    line_m: float, *, brakes: bool
) -> None:
    """B is at 570 m when the slot begins; its gentle braking distance is 56 m."""
    desk = bench(A, B)
    queue_m = ROLLING.types.longest_body_m + ROLLING.tracking.min_gap_m
    from_m = line_m + queue_m + re_entry(ROLLING).room_m
    part = TemporaryClosure(1, from_m, from_m + 50.0)
    desk.control.on_obstacles(TemporaryParts((part,)))
    call = desk.call()
    assert call.now is not None
    assert call.vehicles[B].held == brakes
    assert not call.vehicles[A].held
    assert ({*OWNED[B]} - {HOMES[B]} <= call.blocked) == brakes


def test_a_slot_may_be_planned_a_third_time() -> None:
    """Vehicles then still store the transfers of the first ballot."""
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk, {A: ((0, 0), (1, 0))})
    desk.think(LOOK_S + 1.0)
    desk.control.on_obstacles(TemporaryParts((PART._replace(lane=2, from_m=590.0),)))
    call = desk.call(LOOK_S + 2.0)
    assert not any(one.held or one.waits for one in call.vehicles.values())
    assert (0, 1) not in call.blocked
    assert {one.roster for one in desk.control.transfers} == {(A,), (B,)}
    assert all(earlier.ballot in one.replaced for one in desk.control.transfers)


def test_a_member_of_a_replaced_ballot_is_asked_until_it_promises() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk, {})
    desk.think(LOOK_S + 1.0)
    newest = desk.control.transfers[0].ballot
    pending = PendingTransfer(earlier.ballot, OWNED[A], OWNED[A], (A, B))
    desk.hear(changed(shown(A, newest, pending), t_s=BEGUN_S + 2.0))
    desk.think(LOOK_S + SLOT_S)
    assert [one.roster for one in desk.control.transfers] == [(B,)]


@pytest.mark.parametrize("late_s", [-0.1, 0.1])
def test_a_failed_or_late_second_plan_leaves_the_first_ballots_as_they_are(late_s: float) -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    earlier = desk.transfer
    desk.control.on_obstacles(TemporaryParts((PART,)))
    compute = desk.order(LOOK_S + 1.0)
    assert compute is not None
    failed = Computed(compute.job, None, "no") if late_s < 0.0 else None
    computed = failed or Computed(compute.job, compute.work(time.monotonic))
    notes = list(desk.control.finish(computed, BEGUN_S + SLOT_S + late_s, 50.0))
    assert [note.kind for note in notes] == [PLANNING_FAILED if failed else PLANNING_LATE]
    assert desk.control.transfers == [earlier]
    assert earlier.unfinished


def test_a_plan_does_not_wait_for_a_member_of_a_replaced_ballot_that_leaves_the_lattice() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk, {A: ((0, 0), (1, 0))})
    desk.think(LOOK_S + 1.0)
    transfer = desk.control.transfers[0]
    pending = PendingTransfer(earlier.ballot, OWNED[A], OWNED[A], (A, B))
    desk.hear(changed(shown(A, transfer.ballot, pending), t_s=BEGUN_S + 2.0))
    assert transfer.plan is None
    desk.control.on_census(replace(census(A), t_s=BEGUN_S + 2.0))
    assert transfer.plan is not None


def test_nothing_is_replaced_once_the_slot_has_begun() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk, {})
    compute = desk.order(LOOK_S + 1.0)
    assert compute is not None
    (note,) = desk.finish(compute, BEGUN_S + SLOT_S + 0.1)
    assert note.kind == PLANNING_LATE
    assert desk.control.transfers == [earlier]


def test_a_new_plan_waits_until_it_is_known_who_owns_the_cells_of_a_replaced_ballot() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    earlier = in_force_when_a_part_is_closed(desk, {A: ((0, 0), (1, 0))})
    desk.think(LOOK_S + 1.0)
    ballot_of = {one.roster: one.ballot for one in desk.control.transfers}
    transfer = desk.control.transfers[0]
    assert transfer.roster == (A,)
    assert earlier.ballot in transfer.replaced
    for name in (A, B):
        assert transfer.phase is BallotPhase.PREPARING
        before, after = (OWNED[name], (HOMES[name],))
        pending = PendingTransfer(earlier.ballot, before, after, (A, B))
        desk.hear(changed(shown(name, ballot_of[name,], pending), t_s=BEGUN_S + 2.0))
    assert transfer.phase is BallotPhase.ISSUING
    assert transfer.plan is not None
    assert {*transfer.plan.before[A]} == {*OWNED[A]}


@pytest.mark.parametrize(("from_m", "waits"), [(800.0, 0), (700.0, 1)])
def test_a_lane_that_is_closed_ends_before_the_queue_of_those_that_cannot_leave_it(
    from_m: float, waits: int
) -> None:
    """B is at 570 m when the slot begins, and needs 90 m to leave the lane."""
    desk = bench(A, B)
    desk.control.on_obstacles(TemporaryParts((TemporaryClosure(1, from_m, from_m + 50.0),)))
    now = desk.call().now
    assert now is not None
    sections = now.sections
    queue_m = ROLLING.types.longest_body_m + ROLLING.tracking.min_gap_m
    line_m = from_m - re_entry(ROLLING).room_m
    (closing,) = sections[3:]
    assert (closing.lane, closing.to_m) == (1, line_m - waits * queue_m)
    # Behind the part, no path may begin that has passed it within a slot.
    assert sections[1].from_m >= from_m + 50.0


def test_only_one_planning_at_a_time() -> None:
    desk = bench(A)
    compute = desk.order()
    assert compute is not None
    later_s = LOOK_S + SLOT_S
    assert desk.order(later_s) is None
    desk.finish(compute, later_s - SLOT_S + 1.0)
    assert desk.order(later_s) is not None


def test_nothing_is_planned_without_a_road() -> None:
    desk = Bench()
    assert desk.order() is None
    desk.control.on_census(census())
    assert desk.order(now_s=0.0) is None
    assert desk.order(now_s=10.0) is None


def test_a_new_leader_listens_first() -> None:
    """However fast or slow the road is; then it looks at once, and at the newest."""
    desk = Bench()
    desk.control.on_census(replace(census(), t_s=BEGUN_S + 0.9))
    assert desk.order(LOOK_S, now_s=10.0) is None
    desk.control.on_census(replace(census(A), t_s=BEGUN_S + 0.9))
    desk.hear(replace(shown(A), t_s=BEGUN_S + 1.0))
    assert desk.order(BEGUN_S + 3.0, now_s=10.0 + LISTEN_S - 0.01) is None
    compute = desk.order(BEGUN_S + 1.0, now_s=10.0 + LISTEN_S)
    assert compute is not None
    compute.work(time.monotonic)
    assert not desk.calls[0].vehicles[A].held


def test_a_leader_that_is_elected_again_listens_again() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    desk.control.take_over()
    assert (desk.control.transfers, desk.control.wakeups) == ([], [])
    assert set(desk.control.observed.states) == {A, B}  # what they have shown stays true
    later_s = LOOK_S + SLOT_S
    assert desk.order(later_s + LISTEN_S) is None  # it needs a census, too
    desk.control.on_census(census(A, B))
    assert desk.order(later_s) is None
    desk.hear(replace(shown(A), hold_cell=(1, 0), t_s=later_s + 0.2))
    compute = desk.order(later_s + LISTEN_S)
    assert compute is not None
    compute.work(time.monotonic)
    assert desk.calls[-1].vehicles == {
        A: StreamVehicle(A, (1, 0), 1, held=False),
        B: StreamVehicle(B, HOMES[B], 1, held=True),  # where it was when it was heard last
    }


@pytest.mark.parametrize(
    ("late_s", "kind", "ballots"), [(0.1, "planning-late", 0), (-0.1, "stream-planned", 1)]
)
def test_a_plan_that_comes_late_is_dropped(late_s: float, kind: str, ballots: int) -> None:
    desk = bench(A, ways={A: ((0, 0), (1, 0))})
    compute = desk.order()
    assert compute is not None
    entries = desk.finish(compute, (SLOT + 1) * SLOT_S + MAX_DELAY_S + late_s)
    assert [entry.kind for entry in entries] == [kind]
    assert len(desk.control.transfers) == ballots


def test_results_of_others_and_failures_change_nothing() -> None:
    desk = bench(A)
    compute = desk.order()
    assert compute is not None
    stranger = Computed(compute.job + 1, compute.work(time.monotonic))
    assert list(desk.control.finish(stranger, BEGUN_S, 0.0)) == []
    failed = Computed(compute.job, None, "out of memory")
    (note,) = desk.control.finish(failed, BEGUN_S, 0.0)
    assert (note.kind, note.data["error"]) == ("planning-failed", "out of memory")
    assert list(desk.control.finish(failed, BEGUN_S, 0.0)) == []
    assert desk.order(LOOK_S + SLOT_S) is not None


# --- what it plans from -----------------------------------------------------------------------


def test_the_planner_gets_all_vehicles_and_owned_cells() -> None:
    desk = bench(A, B)
    call = desk.call()
    assert call.vehicles == {
        name: StreamVehicle(name, HOMES[name], 1, held=False) for name in (A, B)
    }
    free = {*OWNED[A], *OWNED[B]}
    lanes = range(ROLLING.road.lanes)
    window = {
        (column, lane)
        for column in range(-MARGIN_COLUMNS, 2 + MARGIN_COLUMNS + 1)
        for lane in lanes
    }
    assert call.blocked == window - free
    assert call.before is None
    desk.think(LOOK_S + SLOT_S)
    assert desk.calls[1].before == StreamPlan(SLOT + 1, {}, ())


def test_the_planner_gets_types_and_goals_that_suit_them() -> None:
    scenario = parse_scenario(
        {
            "formation": {"operation": "rolling"},
            "vehicle_type": [{"name": "truck", "share": 0.1}],
            "road": {"restrictions": [{"lane": 1, "vehicle_types": ["truck"], "from_m": 500.0}]},
        }
    )
    desk = Bench(scenario=scenario)
    own = census(A, B)
    trucks = replace(
        own, on_road=(replace(own.on_road[0], vehicle_type=Name("truck")), own.on_road[1])
    )
    desk.control.on_census(trucks)
    assert desk.order(BEGUN_S - 2.0) is None
    desk.hear(shown(A), shown(B))
    vehicles = desk.call().vehicles
    assert (vehicles[A].vehicle_type, vehicles[B].vehicle_type) == ("truck", "car")
    # They want lane 1, in which trucks may not drive at the end.
    assert vehicles[A].targets == frozenset({0, 2})
    assert vehicles[B].targets == frozenset({1})


def test_later_states_do_not_count() -> None:
    """Whether it has arrived by then depends on how fast messages are."""
    desk = bench(A, B)
    desk.control.on_census(census(A, B, C))
    desk.hear(replace(shown(A, OLD), hold_cell=(1, 0), t_s=LOOK_S))
    desk.hear(replace(shown(C), t_s=LOOK_S))
    desk.control.on_census(replace(census(B, D), t_s=LOOK_S))
    call = desk.call()
    assert call.vehicles == {
        name: StreamVehicle(name, HOMES[name], 1, held=name is C) for name in (A, B, C)
    }
    desk.think(LOOK_S + SLOT_S)
    assert set(desk.calls[1].vehicles) == {B, D}


@pytest.mark.parametrize(
    ("ahead_m", "held"), [(15.9, False), (16.1, True), (-15.9, False), (-16.1, True)]
)
def test_a_body_that_is_more_than_a_move_from_its_cell_is_held(
    ahead_m: float, *, held: bool
) -> None:
    """It is not ready for plans, and others plan around its cell."""
    desk = bench(A)
    state = replace(shown(A), t_s=BEGUN_S + SNAPSHOT_S)
    desk.control.on_state(replace(state, s_m=place_m(state) + ahead_m), 0.0)
    desk.think()
    assert desk.calls[0].vehicles[A].held == held


@pytest.mark.parametrize(
    ("ready_s", "waits"),
    [(0.0, 0), ((SLOT + 1) * SLOT_S + READY_LATE_S, 0), ((SLOT + 2) * SLOT_S + 1.3, 2)],
)
def test_a_vehicle_that_settles_is_planned_from_when_it_is_ready(
    ready_s: float, waits: int
) -> None:
    desk = bench(A)
    entry = CensusEntry(A, HOMES[A], 1, 0.0, ready_s=ready_s)
    desk.control.on_census(Census(BEGUN_S + 0.1, (entry,), ()))
    state = replace(shown(A), t_s=BEGUN_S + SNAPSHOT_S)
    far_m = 40.0 if waits else 0.0
    desk.control.on_state(replace(state, s_m=place_m(state) + far_m), 0.0)
    desk.think()
    asked = desk.calls[0].vehicles[A]
    assert (asked.waits, asked.held) == (waits, False)


def test_members_of_a_ballot_whose_gate_is_closed_take_part_in_no_other() -> None:
    """If it waits for one that settles; with another promise, the gate would stay closed."""
    desk = bench(A, B, ways={A: ((0, 0), (1, 0))})
    settles = CensusEntry(A, HOMES[A], 1, 0.0, ready_s=BEGUN_S + SLOT_S + 1.0)
    desk.control.on_census(Census(BEGUN_S + 0.1, (settles, CensusEntry(B, HOMES[B], 1, 0.0)), ()))
    desk.think()
    transfer = desk.transfer
    transfer.phase = BallotPhase.IN_FORCE

    def next_call(slots: int, *, go: bool) -> Call:
        t_s = BEGUN_S + slots * SLOT_S
        pending = PendingTransfer(transfer.ballot, OWNED[A], OWNED[A], (A,))
        first = shown(A, transfer.ballot, pending, accepted=True, go=go, done=False)
        desk.hear(*(replace(one, t_s=t_s + 0.4) for one in (first, shown(B))))
        return desk.call(t_s + SNAPSHOT_S + 0.1)

    call = next_call(1, go=False)
    desk.control.on_obstacles(TemporaryParts((PART._replace(lane=2),)))
    again = desk.call(BEGUN_S + SLOT_S + SNAPSHOT_S + 1.0)
    assert again.slot == call.slot
    for each in (call, again):
        assert each.vehicles[A].waits == 1
        assert {(1, 0), (-1, 0)} <= each.blocked
        assert each.vehicles[B].waits == 0
    later = next_call(2, go=False)
    assert later.vehicles[A].waits == 0


def test_vehicles_without_cells_are_not_planned_and_end_the_sections_they_are_in() -> None:
    desk = bench(A, B)
    entries = census(A, B).on_road
    body = OffLattice(lane=1, rear_m=700.0)
    desk.control.on_census(
        replace(census(A), on_road=(entries[0], replace(entries[1], off_lattice=body)))
    )
    desk.think()
    assert set(desk.calls[0].vehicles) == {A}
    now = desk.calls[0].now
    assert now is not None
    assert [section.to_m for section in now.sections] == [1000.0, 700.0, 1000.0]


def test_states_may_arrive_in_any_order() -> None:
    desk = bench(A)
    desk.hear(replace(shown(A), hold_cell=(2, 0), t_s=LOOK_S))
    moving = shown(A, OLD, moving=True, accepted=True, t_s=BEGUN_S + SNAPSHOT_S)
    desk.hear(replace(moving, hold_cell=(1, 0)))
    desk.hear(replace(shown(A), hold_cell=(0, 0), t_s=BEGUN_S + SNAPSHOT_S - 0.1))
    desk.hear(replace(shown(A, OLD), hold_cell=(2, 0), t_s=LOOK_S))  # twice in a tick
    desk.think()
    assert desk.calls[0].vehicles == {A: StreamVehicle(A, (1, 0), 1, held=False)}


def test_an_unheard_vehicle_does_not_keep_others_from_being_planned() -> None:
    """Another vehicle may be where it entered by now."""
    for names in ((A, B), (B, A)):
        desk = bench(*names)
        desk.control.on_census(census(*names, C))
        desk.hear(replace(shown(A), hold_cell=HOMES[C], t_s=BEGUN_S + SNAPSHOT_S))
        desk.think()
        assert set(desk.calls[0].vehicles) == {A, B}
    desk = bench(A, B)
    desk.hear(replace(shown(A), hold_cell=HOMES[B], t_s=BEGUN_S + SNAPSHOT_S))
    desk.think()
    assert len(desk.calls[0].vehicles) == 1


def test_a_vehicle_that_has_moved_since_is_left_out() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1)), B: ((2, 1), (2, 2))})
    compute = desk.order()
    assert compute is not None
    desk.hear(replace(shown(A, OLD, moving=True), hold_cell=(1, 0), t_s=LOOK_S))
    desk.hear(changed(shown(B), owned=(*OWNED[B], (2, 2)), t_s=LOOK_S))
    desk.finish(compute, LOOK_S)
    assert [set(transfer.moves) for transfer in desk.control.transfers] == [{B}]


def test_a_ballot_that_is_not_in_force_is_given_up_when_its_slot_has_begun() -> None:
    desk = bench(A, ways={A: ((0, 0), (1, 0))})
    desk.think()
    transfer = desk.transfer
    desk.order(transfer.t0_s + MAX_DELAY_S)
    assert transfer.wakeup_s is not None
    desk.order(transfer.t0_s + MAX_DELAY_S + 0.1)
    assert transfer.phase is BallotPhase.ABORTED


@pytest.mark.parametrize("result", ["in time", "late", "failed"])
def test_the_result_of_the_next_planning_ends_older_ballots(result: str) -> None:
    desk = bench(A, ways={A: ((0, 0), (1, 0))})
    desk.think()
    old = desk.transfer
    compute = desk.order(LOOK_S + SLOT_S)
    assert compute is not None
    if result == "failed":
        list(desk.control.finish(Computed(compute.job, None, "out of memory"), LOOK_S, 0.0))
    else:
        late_s = 0.1 if result == "late" else -0.1
        desk.finish(compute, (SLOT + 2) * SLOT_S + MAX_DELAY_S + late_s)
    assert old.phase is BallotPhase.ABORTED
    if result == "in time":
        assert desk.transfer.ballot > old.ballot


CLOSED = PendingTransfer(OLD, OWNED[A], (HOMES[A], (1, 0)), (A, B))


@pytest.mark.parametrize(
    ("observed", "held", "blocked", "usable"),
    [
        (  # its gate is open: its move may begin at any time until it promises another ballot
            shown(A, OLD, PendingTransfer(OLD, open=True), accepted=True, go=True, done=False),
            True,
            {(1, 0), (-1, 0)},
            {HOMES[A]},
        ),
        (  # its gate is closed: what it owns either way may be used
            shown(A, OLD, CLOSED, accepted=True, done=False),
            False,
            {(-1, 0)},
            {HOMES[A], (1, 0)},
        ),
        (shown(A, attended=False), True, set(), {*OWNED[A]}),
        (  # its cells are not known
            shown(A, OLD, PendingTransfer(OLD, OWNED[A], (HOMES[A],), (A, B)), accepted=True),
            False,
            {*OWNED[A]} - {HOMES[A]},
            {HOMES[A]},
        ),
        (shown(A, OLD, owned=()), False, {*OWNED[A]}, set()),
    ],
    ids=["late", "closed gate", "without agent", "no certain owner", "promise not noted"],
)
def test_which_vehicles_are_held_and_which_cells_are_blocked(
    observed: State, held: bool, blocked: set[Cell], usable: set[Cell]
) -> None:
    desk = bench(A, B)
    desk.hear(replace(observed, t_s=BEGUN_S + 0.5))
    call = desk.call()
    assert [vehicle.held for vehicle in call.vehicles.values()] == [held, False]
    assert blocked <= call.blocked
    assert not usable & call.blocked


def test_vehicles_far_from_where_moves_begin_are_not_planned_for() -> None:
    road = parse_scenario({"formation": {"operation": "rolling"}, "road": {"s2_m": 2000.0}})
    desk = Bench()
    desk.control = RollingOperation(road, desk.new_ballot, desk.new_job, desk.plan)
    far_s = (road.geometry.moves_from_m - LOOKAHEAD_M) / 15.0
    slot = math.ceil(far_s / SLOT_S)
    desk.control.on_census(census(A, D))  # D is 120 m behind A
    assert desk.order(slot * SLOT_S - 2.0) is None
    desk.hear(shown(A), shown(D))
    desk.think(slot * SLOT_S + LOOK_S - BEGUN_S)
    assert set(desk.calls[0].vehicles) == {A}


def test_an_unheard_vehicle_stays_where_it_entered_and_owns_nothing() -> None:
    desk = bench(A)
    desk.control.on_census(census(A, B))
    desk.ways = {A: ((0, 0), (0, 1)), B: ((2, 1), (2, 1))}
    call = desk.call()
    assert call.vehicles[B] == StreamVehicle(B, HOMES[B], 1, held=True)
    assert set(OWNED[B]) <= call.blocked
    assert desk.control.transfers == []  # A would need a cell that is B's


# --- states -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("older", "newer"),
    [
        (shown(A), replace(shown(A), t_s=BEGUN_S + 1.0)),
        (changed(shown(A), t_s=BEGUN_S + 1.0), changed(shown(A), incarnation=8)),
        (shown(A), shown(A, OLD)),
        (changed(shown(A, OLD), owned=()), shown(A, OLD)),
        (shown(A, OLD), shown(A, OLD, accepted=True)),
        (shown(A, OLD), shown(A, OLD, PendingTransfer(OLD))),
        (shown(A, OLD, PendingTransfer(OLD)), shown(A, OLD, PendingTransfer(OLD, open=True))),
    ],
    ids=["tick", "process", "promise", "noted", "acceptance", "transfer", "gate"],
)
def test_the_newest_state_counts_in_whichever_order_they_come(older: State, newer: State) -> None:
    for states in ((older, newer), (newer, older)):
        desk = Bench()
        desk.control.on_census(census(A))
        desk.hear(*states)
        assert desk.control.observed.states[A] == replace(newer, s_m=place_m(newer))


def test_ballots_are_above_all_that_was_promised() -> None:
    desk = bench(A, B)
    desk.hear(replace(shown(B, OLD), t_s=BEGUN_S + 0.5))
    desk.ways = {A: ((0, 0), (1, 0))}
    desk.think()
    assert desk.asked_above == [OLD]


# --- ballots ----------------------------------------------------------------------------------


def test_one_ballot_for_the_mover_and_the_owners_of_its_cells() -> None:
    desk = bench(A, B, C, ways={A: ((0, 0), (0, 1)), B: ((2, 1), (2, 1)), C: ((-4, 0),)})
    (note,) = desk.think()
    (transfer,) = desk.control.transfers
    assert transfer.roster == (A, B)
    assert transfer.moves == {A: ((0, 0), (0, 1))}
    assert (transfer.t0_s, transfer.slot_s) == ((SLOT + 1) * SLOT_S, SLOT_S)
    expected = {"slot": SLOT + 1, "moves": 1, "ballots": 1, "largest": 2, "vehicles": 3}
    assert expected.items() <= note.data.items()


def test_moves_that_share_an_owner_share_a_ballot() -> None:
    desk = bench(A, B, C, D)
    desk.ways = {
        A: ((0, 0), (0, 1)),
        B: ((2, 1), (1, 1)),
        C: ((-4, 0), (-5, 0)),
        D: ((-8, 2), (-8, 2)),
    }
    desk.think()
    assert [transfer.roster for transfer in desk.control.transfers] == [(A, B), (C,)]
    assert set(desk.control.transfers[0].moves) == {A, B}


def test_vehicles_whose_promises_tell_ownership_are_in_the_roster() -> None:
    """C's gate is closed as far as it knows: B may have opened its own, and D of an older plan."""
    newer = OLD._replace(seq=2)
    desk = bench(A, B, C, D)
    desk.hear(
        shown(C, newer, PendingTransfer(newer, OWNED[C], OWNED[C], (B, C)), accepted=True),
        shown(B, newer, PendingTransfer(newer, OWNED[B], OWNED[B], (B, C)), accepted=True),
        shown(D, OLD, PendingTransfer(OLD, open=True), accepted=True),
    )
    desk.ways = {C: ((-4, 0), (-5, 0))}
    desk.think()
    assert [transfer.roster for transfer in desk.control.transfers] == [(B, C)]
    desk = bench(A, B, C, D, ways={C: ((-4, 0), (-5, 0))})
    desk.think()
    assert [transfer.roster for transfer in desk.control.transfers] == [(C,)]


def test_groups_that_share_a_vehicle_are_one_cluster() -> None:
    groups = [{A, B}, {C}, {D}, {B, C}]
    assert sorted(map(sorted, _clusters(groups))) == [[A, B, C], [D]]


def run_ballot(desk: Bench) -> Plan:
    """Let A and B promise what they are asked; return the plan that A is sent."""
    sent = dict(desk.control.outgoing(50.0))
    assert {type(message) for message in sent.values()} == {Prepare}
    ballot = desk.control.transfers[0].ballot
    desk.hear(*(replace(shown(name, ballot), t_s=BEGUN_S + 1.0) for name in sent))
    plan = dict(desk.control.outgoing(50.0))[A]
    assert isinstance(plan, Plan)
    return plan


def test_from_the_plan_to_a_ballot_in_force() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    assert desk.control.wakeups == [50.0]
    plan = run_ballot(desk)
    assert plan.moves == {A: ((0, (0, 0), (0, 1)),), B: ()}
    assert desk.control.in_force == 0
    accepted = [
        changed(shown(name, plan.ballot, accepted=True), t_s=BEGUN_S + 1.0) for name in (A, B)
    ]
    assert desk.hear(accepted[0]) == []
    assert desk.hear(accepted[1]) == [
        LogEntry("plan-in-force", {"slot": SLOT + 1, "closed_s": BEGUN_S + SNAPSHOT_S})
    ]
    assert desk.control.in_force == 1
    assert desk.control.wakeups == []


def test_a_ballot_that_fails_is_noted() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    (note,) = desk.hear(replace(shown(B, Ballot(9, Name("c2"), 1, 1)), t_s=BEGUN_S + 1.0))
    assert note.kind == "handover-given-up"
    assert note.data == {"roster": [A, B], "why": "outbid", "unanswered": []}
    assert desk.hear(replace(shown(A), t_s=BEGUN_S + 1.0)) == []


@pytest.mark.parametrize("answered", [(), (A,)])
def test_a_ballot_without_answers_is_noted(answered: tuple[Name, ...]) -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    desk.hear(*(replace(shown(name, desk.transfer.ballot), t_s=BEGUN_S + 1.0) for name in answered))
    awaited = ", ".join(name for name in (A, B) if name not in answered)
    begins_s = (SLOT + 1) * SLOT_S
    assert desk.transfer.unfinished
    late = desk.control.order(begins_s + MAX_DELAY_S + 0.1, 50.0)
    assert [one for one in late if isinstance(one, LogEntry)] == [
        LogEntry(
            "handover-given-up",
            {
                "roster": [A, B],
                "why": f"its slot has begun, and {awaited} did not answer",
                "unanswered": awaited.split(", "),
            },
        )
    ]
    again = desk.control.order(begins_s + MAX_DELAY_S + 0.2, 50.0)
    assert [one for one in again if isinstance(one, LogEntry)] == []


def test_a_ballot_that_the_next_plan_ends_is_noted() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    desk.hear(*(replace(shown(name, desk.transfer.ballot), t_s=BEGUN_S + 1.0) for name in (A, B)))
    assert desk.transfer.plan is not None
    accepted = changed(shown(A, desk.transfer.ballot, accepted=True), t_s=BEGUN_S + 1.1)
    desk.hear(accepted, replace(accepted, t_s=BEGUN_S + SLOT_S))
    notes = desk.think(LOOK_S + SLOT_S)
    assert [note.kind for note in notes] == ["handover-given-up", "stream-planned"]
    assert notes[0].data["unanswered"] == [B]


def test_a_plan_waits_for_vehicles_that_should_move_now_and_are_not_heard() -> None:
    """From the cell that one has left, its path and those through its cells would be void."""
    desk = bench(A, B, C, ways={A: ((0, 0), (0, 1))})
    desk.think()
    ballot = desk.transfer.ballot
    desk.hear(*(replace(shown(name, ballot), t_s=BEGUN_S + 1.0) for name in (A, B)))
    desk.hear(*(changed(shown(name, ballot, accepted=True), t_s=BEGUN_S + 1.1) for name in (A, B)))
    assert desk.transfer.phase is BallotPhase.IN_FORCE
    look_s = LOOK_S + SLOT_S
    assert desk.order(look_s) is None
    assert desk.order(look_s + HEAR_S - 0.2) is None
    moving = changed(shown(A, ballot, accepted=True), t_s=BEGUN_S + SLOT_S, hold_cell=(0, 1))
    desk.hear(replace(moving, moving=True))
    call = desk.call(look_s + HEAR_S - 0.2)
    assert call.vehicles[A].cell == (0, 1)  # B and C, which do not move, need not be heard


def test_a_plan_does_not_wait_for_ever_for_a_vehicle_that_is_not_heard() -> None:
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    ballot = desk.transfer.ballot
    desk.hear(*(replace(shown(name, ballot), t_s=BEGUN_S + 1.0) for name in (A, B)))
    desk.hear(*(changed(shown(name, ballot, accepted=True), t_s=BEGUN_S + 1.1) for name in (A, B)))
    assert desk.order(LOOK_S + SLOT_S + HEAR_S - 0.2) is None
    assert desk.order(LOOK_S + SLOT_S + HEAR_S) is not None


# --- the census -------------------------------------------------------------------------------


def test_a_vehicle_that_leaves_is_forgotten_and_its_ballot_given_up() -> None:
    desk = bench(A, B, C, ways={A: ((0, 0), (0, 1)), C: ((-4, 0), (-5, 0))})
    desk.think()
    first, second = desk.control.transfers
    (note,) = desk.control.on_census(census(A, C))
    assert note.data == {"roster": [A, B], "why": "B has left", "unanswered": []}
    assert set(desk.control.observed.states) == {A, C}
    assert (first.phase, first.reason) == (BallotPhase.ABORTED, "B has left")
    assert second.phase is BallotPhase.PREPARING


def test_a_new_road_starts_without_memory() -> None:
    """Its clock begins at 0."""
    desk = bench(A, B, ways={A: ((0, 0), (0, 1))})
    desk.think()
    desk.control.forget()
    assert (desk.control.observed.states, desk.control.transfers, desk.control.wakeups) == (
        {},
        [],
        [],
    )
    assert desk.order(LOOK_S + SLOT_S) is None
    desk.control.on_census(replace(census(A), t_s=0.0))
    assert desk.order(0.0, now_s=100.0) is None  # it listens first
    compute = desk.order(SNAPSHOT_S + 0.1, now_s=101.0)
    assert compute is not None
    compute.work(time.monotonic)
    call = desk.calls[-1]
    assert (call.slot, call.before) == (1, None)
    assert call.vehicles == {A: StreamVehicle(A, HOMES[A], 1, held=True)}  # not heard


def test_vehicles_that_have_left_are_forgotten() -> None:
    desk = bench(A, B, C)
    desk.hear(*(replace(shown(name), t_s=BEGUN_S + 0.5) for name in (A, B, C)))
    desk.control.on_census(replace(census(B), t_s=BEGUN_S + 0.5))
    desk.think()
    kept = desk.control.observed
    assert set(kept.states) == {B}
    assert (set(kept._before), kept._left) == ({B}, {})


# --- the real planner -------------------------------------------------------------------------


def test_the_real_planner_accepts_its_input() -> None:
    """Also a vehicle that was not heard, whose own cell is blocked."""
    new_ballot = Ballot(7, Name("c1"), 1, 1)
    control = RollingOperation(ROLLING, lambda _: new_ballot, lambda: 1, stream_planner(ROLLING))
    control.on_census(census(A, B, C))
    assert list(control.order(BEGUN_S - 2.0, 0.0)) == []
    for name in (A, B):
        assert control.on_state(shown(name), 0.0) is None
    (compute,) = control.order(LOOK_S, 9.0)
    assert isinstance(compute, Compute)
    plan = compute.work(time.monotonic)
    assert isinstance(plan, StreamPlan)
    assert set(plan.paths) == {A, B, C}
    for vehicle, way in plan.paths.items():
        assert way[0] == HOMES[Name(vehicle)]
    assert set(plan.paths[C]) == {HOMES[C]}
    (note,) = control.finish(Computed(1, plan), LOOK_S, 0.0)
    assert note.kind == "stream-planned"


def test_a_wrong_plan_is_not_issued() -> None:
    """The planner is not trusted: a path that ends on the road is not issued."""
    bench = Bench(ways={A: (HOMES[A], HOMES[A])}, missed=(A,))
    planner = checked(stream_road(ROLLING), bench.plan)
    bench.control = RollingOperation(ROLLING, bench.new_ballot, bench.new_job, planner)
    bench.control.on_census(census(A))
    bench.hear(shown(A))
    assert bench.order(BEGUN_S - 2.0) is None
    compute = bench.order()
    assert compute is not None
    one = rf"the plan of slot {SLOT + 1} is invalid: [^;]* on the road$"
    with pytest.raises(ValueError, match=one):
        compute.work(time.monotonic)
    (note,) = bench.control.finish(Computed(compute.job, None, "wrong"), LOOK_S, 0.0)
    assert note == LogEntry("planning-failed", {"slot": SLOT + 1, "error": "wrong"})
    assert bench.control.transfers == []
