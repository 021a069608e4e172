"""Plan requests for formations, and their results (rule L5).

The planner runs outside the core (`Compute`), for one formation at a time. This module makes the
requests. It turns results into plans or failures, or joins formations if one alone lacks room.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial

from attrs import define, evolve, field

from laneweave.coordinator.ballots.ballot_round import FAILED, TOO_LATE, BallotPhase
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.pacing import comfortable_steps, paced, steps_of
from laneweave.coordinator.formations.roster import (
    Formation,
    Groups,
    Numbers,
    moves_end_s,
    on_tick,
    settled_s,
    sorting_start_s,
    stage_begin_s,
    stage_end_s,
    steps_left,
)
from laneweave.coordinator.formations.sorting import (
    Sorting,
    SortingTask,
    has_formed,
    sort_lanes,
)
from laneweave.coordinator.formations.stages import Stage
from laneweave.coordinator.operation import LogEntry
from laneweave.coordinator.planning.budget import Clock
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.response import PlanFunction
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Compute, Computed
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plans import plan_problems
from laneweave.protocol.wire import reasons
from laneweave.protocol.wire.events import (
    FORMATION_TOO_LATE,
    FORMATIONS_JOINED,
    LANE_OUT_OF_REACH,
    NEIGHBOURS_AWAITED,
    PLAN_MADE,
    PLANNING_FAILED,
    ROOM_AWAITED,
    STRUCTURE_IMPOSSIBLE,
    STRUCTURE_TOO_LATE,
)
from laneweave.protocol.wire.messages import Ballot, Name, Plan, VehicleState

START_MARGIN_S = 0.5
"""Minimum road time from the end of planning to the start of the plan."""
ROOM_S = 2.5
"""Maximum time that a formation that lacks room waits for the next one to close (road time)."""
SHORTEST_DEADLINE_S = 1.0
"""Planning deadline if the first move could begin at once."""
LONGEST_DEADLINE_S = 15.0
"""Planning deadline if the first move is far off; other formations wait meanwhile."""
MAX_DOUBLINGS = 4
"""The node limit doubles with each failed attempt, up to this number of times."""
PACE_WINDOW_S = 2.0
"""Measurement window for the road's pace (node clock)."""
LOGGED = (
    "status", "cost", "lower_bound", "steps", "solve_ms",
    "assignments_tried", "nodes_expanded", "solver", "fallback",
)  # fmt: skip
"""Fields of a response that are logged with the plan."""
MIN_PACE = 0.1
"""Minimum pace; it keeps deadlines finite while the road stands still."""


@define
class RoadPace:
    """Ratio of road time to the node's clock, measured from clock messages."""

    pace: float = field(default=1.0, init=False)
    """Road seconds per second of the node's clock, as last measured."""
    _since: tuple[float, float] | None = field(default=None, init=False)
    """Road time and node clock at the beginning of the current measurement."""

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Handle a road clock message; a decrease in `t_s` restarts the measurement."""
        if self._since is None or t_s < self._since[0]:
            self._since = t_s, now_s
            return
        road_s, node_s = t_s - self._since[0], now_s - self._since[1]
        if node_s >= PACE_WINDOW_S:
            self.pace = max(road_s / node_s, MIN_PACE)
            self._since = t_s, now_s


class FormationPlanner:
    """Requests plans for formations and handles results; times as in `Operation`."""

    def __init__(
        self,
        scenario: Scenario,
        groups: Groups,
        leaders: Mapping[int, FormationLeader],
        new_job: Callable[[], int],
        plan: PlanFunction,
    ) -> None:
        """Begin without requests.

        Args:
            scenario: road, lattice, planning settings.
            groups: joined blocks; new joins are added.
            leaders: leaders of all formations by lowest block number.
            new_job: returns the id of a new computation.
            plan: answers a request.
        """
        self._scenario = scenario
        self._groups = groups
        self._leaders = leaders
        self._new_job = new_job
        self._waiting: dict[int, tuple[Ballot, Callable[[Clock], Sorting]]] = {}
        """Waiting requests, oldest first: ballot and computation of each formation."""
        self._under_way: tuple[int, int, Ballot] | None = None
        """Id, formation and ballot of the current computation."""
        self._formed: dict[int, tuple[object, bool]] = {}
        """Input and result of the last call of `has_formed` for each formation."""
        self.pace = RoadPace()
        """Pace of the road, for deadlines."""
        self.leading_since_s: float | None = None
        """Road time since which this coordinator leads; None: it does not."""
        formation = scenario.formation
        oblique = formation.weight_oblique
        weights = Weights(
            formation.weight_straight, formation.oblique_steps if oblique is None else oblique
        )
        self._make_plan = partial(plan, weights=weights)

    def forget(self) -> None:
        """Discard all waiting requests; the coordinator has begun or stopped leading."""
        self._waiting.clear()
        self._formed.clear()
        self.leading_since_s = None

    def _deadline_s(self, start_s: float, t_s: float) -> float:
        """Return the scenario's deadline if given, else the time until the first move."""
        given_s = self._scenario.formation.planning_deadline_s
        if given_s is not None:
            return given_s
        until_start_s = (start_s - t_s) / self.pace.pace
        return min(max(until_start_s, SHORTEST_DEADLINE_S), LONGEST_DEADLINE_S)

    def order(
        self, leader: FormationLeader, t_s: float, now_s: float
    ) -> Iterator[Compute | LogEntry]:
        """Request a plan from a formation's promises, unless it is too late for any step."""
        formation, ballot, scenario = leader.formation, leader.ballot, self._scenario
        assert ballot is not None  # noqa: S101 (set before planning begins)
        numbers, block_of = formation.numbers, scenario.lattice.block_of
        # Hold cells outside the blocks make planning fail later; they do not affect the time left.
        lanes, possible = range(scenario.road.lanes), leader.hold_cells.values()
        cells = [cell for cell in possible if block_of(cell[0]) in numbers and cell[1] in lanes]
        cells = cells or self._block_cells(numbers)
        stage, is_last = formation.stage, formation.stage.is_last
        start_s = self._start_s(formation, cells, t_s)
        soonest_s = start_s + scenario.timing.cycles_s[0]
        stage_s = stage_end_s(numbers, stage, scenario)
        ends_s = {} if is_last else self._ends_s(leader)
        too_late = frozenset(name for name, each_s in ends_s.items() if each_s < soonest_s)
        end_s = min([stage_s, *(each_s for each_s in ends_s.values() if each_s >= soonest_s)])
        if not is_last and (end_s < soonest_s or (too_late and len(too_late) == len(ends_s))):
            if not leader.failures:
                data = {"formation": numbers[0], "stage": stage.number}
                yield LogEntry(STRUCTURE_TOO_LATE, data)
            leader.take(FAILED, now_s)
            return
        if steps_left(cells, start_s, scenario.timing.cycles_s[0], scenario) == 0:
            yield LogEntry(FORMATION_TOO_LATE, self._too_late(leader, cells))
            leader.take(TOO_LATE, now_s)
            return
        task = evolve(
            self._task(formation, leader.promises),
            unattended=leader.unattended | too_late,
            deadline_s=self._deadline_s(start_s, t_s),
            steps=comfortable_steps(start_s, end_s, scenario),
            too_late=too_late - leader.unattended,
        )
        nodes = scenario.formation.max_nodes * 2 ** min(leader.failures, MAX_DOUBLINGS)
        # Replaces a request under an earlier ballot, at the end of the queue.
        self._waiting.pop(numbers[0], None)
        # The job detects invalid promises; they are handled like any planning failure.
        self._waiting[numbers[0]] = ballot, partial(sort_lanes, task, nodes, self._make_plan)
        yield from self._begin()

    def has_formed(self, formation: Formation, states: Mapping[Name, VehicleState]) -> bool:
        """Return whether a formation has the structure of its stage, if there is one."""
        if formation.stage.structure is None:
            return True
        # Leaders ask with every state, and hold cells rarely change.
        members = tuple((states[one].hold_cell, states[one].attended) for one in formation.roster)
        given, number = (formation, members), formation.numbers[0]
        if self._formed.get(number, (None, True))[0] != given:
            self._formed[number] = given, has_formed(self._task(formation, states))
        return self._formed[number][1]

    def _task(self, formation: Formation, states: Mapping[Name, VehicleState]) -> SortingTask:
        """Return the task of a formation from its members' states, without a deadline."""
        scenario, roster, stage = self._scenario, formation.roster, formation.stage
        return SortingTask(
            formation.numbers,
            {name: states[name].hold_cell for name in roster},
            formation.goal_lanes,
            frozenset(name for name in roster if not states[name].attended),
            scenario,
            deadline_s=math.inf,
            deserted=formation.deserted,
            structure=stage.structure,
            stage=stage if formation.sorts else None,
            moves={
                member.vehicle: moves
                for member in formation.members
                if (moves := scenario.types.moves_of(member.vehicle_type)) is not None
            },
        )

    def _too_late(self, leader: FormationLeader, cells: Collection[Cell]) -> dict[str, object]:
        """Return which vehicles do not sort their lanes, as it is too late for any step, and why.

        Args:
            leader: leader of the formation.
            cells: cells of the members that count for the time left.
        """
        formation, goals = leader.formation, leader.formation.goal_lanes
        off_lane = [
            str(name)
            for name, cell in leader.hold_cells.items()
            if formation.sorts and cell[1] not in goals[name]
        ]
        closed_s, since_s = formation.closed_s, self.leading_since_s or 0.0
        slot_s = self._scenario.timing.cycles_s[0]

        def was_too_late(t_s: float) -> bool:
            start_s = self._start_s(formation, cells, t_s)
            return steps_left(cells, start_s, slot_s, self._scenario) == 0

        if was_too_late(closed_s):
            reason = reasons.ROAD_TOO_SHORT
        elif was_too_late(since_s):
            reason = reasons.NO_LEADER
        else:
            failed = leader.failures > 0
            reason = reasons.PLANNING_FAILED if failed else reasons.LATE_PROMISES
        return {
            "formation": formation.numbers[0],
            "vehicles": off_lane,
            "reason": reason,
            "closed_s": closed_s,
            "since_s": since_s,
        }

    def _ends_s(self, leader: FormationLeader) -> dict[Name, float]:
        """Return until when the members that have to change lanes can do so (road time)."""
        formation, scenario = leader.formation, self._scenario
        block_of, goals = scenario.lattice.block_of, formation.goal_lanes
        return {
            name: moves_end_s([cell], formation.numbers, formation.stage, scenario)
            for name, cell in leader.hold_cells.items()
            if formation.sorts
            and name not in leader.unattended
            and cell[1] not in goals[name]
            and block_of(cell[0]) in formation.numbers
        }

    def _begin(self) -> Iterator[Compute]:
        """Start the oldest request that is still needed, unless a computation is running."""
        while self._waiting and self._under_way is None:
            number = next(iter(self._waiting))
            ballot, work = self._waiting.pop(number)
            if self._wanted(number, ballot):
                self._under_way = self._new_job(), number, ballot
                yield Compute(self._under_way[0], work)

    def _wanted(self, number: int, ballot: Ballot) -> bool:
        """Return whether the leader of a formation still needs a plan under a ballot."""
        leader = self._leaders.get(number)
        return (
            leader is not None
            and (leader.ballot, leader.phase) == (ballot, BallotPhase.PLANNING)
            and leader.formation.numbers == self._groups.of(number)
        )

    def finish(self, computed: Computed, t_s: float, now_s: float) -> Iterator[Compute | LogEntry]:
        """Handle a result, unless it is no longer needed, and start the next request."""
        if self._under_way is None or computed.job != self._under_way[0]:
            return
        _, number, ballot = self._under_way
        self._under_way = None
        if self._wanted(number, ballot):
            yield from self._apply(computed, self._leaders[number], t_s, now_s)
        yield from self._begin()

    def _apply(
        self, computed: Computed, leader: FormationLeader, t_s: float, now_s: float
    ) -> Iterator[LogEntry]:
        number = leader.formation.numbers[0]
        result, error, status = computed.result, computed.error, "error"
        if isinstance(result, Sorting):
            status = result.response.status if result.response is not None else "optimal"
            if result.short_of_room and self._join_neighbour(leader, t_s):
                yield LogEntry(FORMATIONS_JOINED, {"formations": list(self._groups.of(number))})
                return
            if result.short_of_room and self._next_closes_soon(leader.formation.numbers, t_s):
                leader.take(FAILED, now_s)
                yield LogEntry(ROOM_AWAITED, {"formation": number})
                return
            if result.solved:
                planned = self._plan(leader, result, t_s)
                plan = self._paced(planned, leader, t_s)
                problems = plan_problems(plan)
                if not problems:
                    leader.on_plan(plan, now_s, result.out_of_reach)
                    pauses = steps_of(plan) - steps_of(planned)
                    yield from _log_entries(leader.formation, result, pauses, plan)
                    return
                error = "; ".join(problems)
        leader.take(FAILED, now_s)
        data = {"formation": number, "status": status, "error": error}
        yield LogEntry(PLANNING_FAILED, data)

    def _join_neighbour(self, leader: FormationLeader, t_s: float) -> bool:
        """Join a formation that lacks room with a neighbour; return whether this was possible."""
        numbers, max_joined = leader.formation.numbers, self._scenario.formation.max_joined
        for other in self._neighbours(numbers):
            if other.phase is BallotPhase.ABORTED:
                continue
            if leader.formation.joined + other.formation.joined > max_joined:
                continue
            union = (*numbers, *other.formation.numbers)
            if self.steps_left_in(union, leader.formation.stage, t_s) > 0:
                return self._groups.join(union)
        return False

    def steps_left_in(self, numbers: Numbers, stage: Stage, t_s: float) -> int:
        """Return the number of steps left in a stage for vehicles anywhere in these blocks."""
        cells, scenario = self._block_cells(tuple(sorted(numbers))), self._scenario
        start_s = sorting_start_s(cells, t_s + START_MARGIN_S, scenario, stage.from_m)
        end_s = moves_end_s(cells, tuple(sorted(numbers)), stage, scenario)
        return int((end_s - start_s) / scenario.timing.cycles_s[0] + 1e-6)

    def _block_cells(self, numbers: Numbers) -> list[Cell]:
        lattice = self._scenario.lattice
        return [cell for number in numbers for cell in lattice.block_cells(number)]

    def _neighbours(self, numbers: Numbers) -> Iterator[FormationLeader]:
        """Yield the formation behind and the formation ahead, if they exist."""
        for number in (numbers[-1] + 1, numbers[0] - 1):
            neighbour = self._leaders.get(self._groups.of(number)[0])
            if neighbour is not None:
                yield neighbour

    def _next_closes_soon(self, numbers: Numbers, t_s: float) -> bool:
        """Return whether the next formation, which may be joined, is about to close."""
        formation, lattice = self._scenario.formation, self._scenario.lattice
        if formation.closes_by_vehicles or len(numbers) >= formation.max_joined:
            return False
        rear = lattice.block_range(numbers[-1] + 1)[0]
        entered_s = lattice.passing_time_s(rear, max(self._scenario.geometry.entry_m))
        closes_s = entered_s + formation.entry_spread_s
        return closes_s - ROOM_S < t_s <= closes_s + START_MARGIN_S

    def _plan(self, leader: FormationLeader, sorting: Sorting, t_s: float) -> Plan:
        t0_s = self._start_s(leader.formation, leader.hold_cells.values(), t_s)
        slot_s = self._scenario.timing.cycles_s[0]
        return leader.make_plan(leader.formation.numbers, sorting.moves, t0_s, slot_s)

    def _paced(self, plan: Plan, leader: FormationLeader, t_s: float) -> Plan:
        """Choose a plan's start and slots so that its vehicles settle before they move."""
        formation, cells = leader.formation, plan.start_cells.values()
        others, scenario = self._neighbouring_plans(plan), self._scenario
        if not formation.sorts:
            end_s = stage_end_s(formation.numbers, formation.stage, scenario)
            return paced(plan, others, plan.t0_s, lambda _: end_s, scenario)
        stage, numbers = formation.stage, formation.numbers
        not_before_s = max(settled_s(cells, scenario), t_s + START_MARGIN_S)
        return paced(
            plan,
            others,
            not_before_s,
            lambda moved: moves_end_s(moved, numbers, stage, scenario),
            scenario,
            stage.from_m,
        )

    def _neighbouring_plans(self, plan: Plan) -> list[Plan]:
        """Return the neighbours' plans that this leader has made and that may be executed."""
        if "closing" not in self._scenario.formation.conflict_kinds:
            return []
        return [
            neighbour.plan
            for neighbour in self._neighbours(plan.blocks)
            # In other phases the plan has been outbid or aborted and is not executed.
            if neighbour.plan is not None
            and neighbour.plan.ballot == neighbour.ballot
            and neighbour.phase in (BallotPhase.ISSUING, BallotPhase.IN_FORCE)
        ]

    def _start_s(self, formation: Formation, cells: Collection[Cell], t_s: float) -> float:
        """Return the earliest road time at which a formation may begin to move."""
        scenario, not_before_s = self._scenario, t_s + START_MARGIN_S
        if formation.sorts:
            return sorting_start_s(cells, not_before_s, scenario, formation.stage.from_m)
        begin_s = stage_begin_s(formation.numbers, formation.stage, scenario)
        return on_tick(max(begin_s, settled_s(cells, scenario), not_before_s), scenario)


def _log_entries(
    formation: Formation, sorting: Sorting, pauses: int, plan: Plan
) -> Iterator[LogEntry]:
    number, stage = formation.numbers[0], formation.stage
    if sorting.impossible:
        data = {"formation": number, "stage": stage.number, "why": sorting.impossible}
        yield LogEntry(STRUCTURE_IMPOSSIBLE, data)
    if (response := sorting.response) is not None:
        data = {"formation": number, "vehicles": len(response.paths)}
        data |= {name: getattr(response, name) for name in LOGGED}
        yield LogEntry(PLAN_MADE, data | {"t0_s": plan.t0_s, "slot_s": plan.slot_s})
    if pauses:
        yield LogEntry(NEIGHBOURS_AWAITED, {"formation": number, "slots": pauses})
    missed = {
        str(member.vehicle): sorting.reasons[member.vehicle]
        for member in formation.members
        if member.vehicle in sorting.out_of_reach
        and stage.is_last_for(member.preferred_lane, member.destination)
    }
    if missed:
        data = {"formation": number, "vehicles": list(missed)}
        data["reasons"] = {name: one.reason for name, one in missed.items()}
        data["blocked_by"] = {
            name: list(one.blocked_by) for name, one in missed.items() if one.blocked_by
        }
        yield LogEntry(LANE_OUT_OF_REACH, data)
