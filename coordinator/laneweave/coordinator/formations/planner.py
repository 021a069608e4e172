"""What a leader has planned for its formations, and what becomes of the results (rule L5).

The planning itself runs beside the core (`Compute`); here its orders are written and its results
turned into plans, into failures, or into formations that are joined because one alone lacks room.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from functools import partial
from typing import Any

from attrs import field, frozen

from laneweave.coordinator.formations.borders import steps_of
from laneweave.coordinator.formations.control import FormationControl
from laneweave.coordinator.formations.groups import Groups, Numbers
from laneweave.coordinator.formations.leader_rules import Phase
from laneweave.coordinator.formations.pacing import comfortable_steps, paced
from laneweave.coordinator.formations.road_pace import RoadPace
from laneweave.coordinator.formations.roster import (
    STAGE_LEAD_S,
    Formation,
    on_tick,
    stage_begin_s,
    start_time_s,
    steps_left,
    time_left_s,
)
from laneweave.coordinator.formations.sorting import Sorting, SortingTask, sort_lanes
from laneweave.coordinator.planning import PlanResponse, Weights
from laneweave.protocol.lattice import Cell, territory
from laneweave.protocol.runtime.node import Compute, Computed
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.plans import plan_problems
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
from laneweave.protocol.wire.messages import Ballot, Plan

START_MARGIN_S = 0.5
"""A plan made late starts this much road time after it is ready."""
ROOM_S = 2.5
"""A formation that lacks room waits at most so long for the next one to close (road time)."""
SHORTEST_DEADLINE_S = 1.0
"""Deadline of planning where the first move could begin at once."""
LONGEST_DEADLINE_S = 15.0
"""Deadline of planning where the first move is far off: the other formations wait meanwhile."""
MOST_DOUBLINGS = 4
"""The bound on search nodes doubles with each failed planning, this often."""


@frozen
class Note:
    """Something worth a line in `events.jsonl`."""

    kind: str
    data: dict[str, Any] = field(factory=dict)


class FormationPlanner:
    """Orders and results of planning."""

    def __init__(self, scenario: Scenario, groups: Groups) -> None:
        """Begin with nothing ordered; `groups` is the leader's, and grows here."""
        self._scenario = scenario
        self._groups = groups
        self._ordered: dict[int, tuple[int, Ballot]] = {}
        """For each job the formation and the ballot that it was ordered for."""
        self._pace = RoadPace()
        formation = scenario.formation
        oblique = formation.weight_oblique
        self._weights = Weights(
            formation.weight_straight, formation.oblique_steps if oblique is None else oblique
        )

    def forget(self) -> None:
        """Nobody waits for results any more."""
        self._ordered.clear()

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Measure the pace of the road, from which deadlines follow."""
        self._pace.on_clock(t_s, now_s)

    def _deadline_s(self, start_s: float, t_s: float) -> float:
        """Return the deadline: that of the scenario, or the time until the first move."""
        given_s = self._scenario.formation.planning_deadline_s
        if given_s is not None:
            return given_s
        until_start_s = self._pace.node_s(start_s - t_s)
        return min(max(until_start_s, SHORTEST_DEADLINE_S), LONGEST_DEADLINE_S)

    def order(
        self, job: int, control: FormationControl, t_s: float, now_s: float
    ) -> Iterator[Compute | Note]:
        """Order a plan from the promises of a formation; too late for any step, settle it.

        Args:
            job: number of the computation.
            control: in phase `PLANNING`.
            t_s: road time.
            now_s: node clock.
        """
        numbers, ballot = control.formation.numbers, control.ballot
        assert ballot is not None  # noqa: S101 (set before planning begins)
        formation, scenario = control.formation, self._scenario
        block_of = scenario.lattice.block_of
        # A promise of a cell elsewhere makes planning fail; it says nothing of the time left.
        cells = [cell for cell in control.hold_cells.values() if block_of(cell[0]) in numbers]
        cells = cells or self._block_cells(numbers)
        start_s, end_s = self._start_s(formation, cells, t_s), self._end_s(formation)
        if not formation.sorts and end_s < start_s + scenario.cycles_s[0]:
            control.on_planning_failed(now_s)
            yield Note(STRUCTURE_TOO_LATE, {"formation": numbers[0], "stage": formation.stage})
            return
        if steps_left(cells, start_s, scenario.cycles_s[0], scenario) == 0:
            control.settle(now_s)
            yield Note(FORMATION_TOO_LATE, {"formation": numbers[0]})
            return
        task = SortingTask(
            numbers,
            control.hold_cells,
            {member.vehicle: member.preferred_lane for member in control.formation.members},
            control.unattended,
            scenario,
            self._deadline_s(start_s, t_s),
            comfortable_steps(start_s, end_s, scenario),
            formation.deserted,
            None if formation.sorts else scenario.formation.structures[formation.stage],
        )
        # What was ordered under an earlier ballot is not waited for any more.
        for other, (number, _) in list(self._ordered.items()):
            if number == numbers[0]:
                del self._ordered[other]
        self._ordered[job] = (numbers[0], ballot)
        nodes = scenario.formation.max_nodes * 2 ** min(control.failures, MOST_DOUBLINGS)
        # In the job: promises that cannot be planned from fail there, as any failed planning does.
        yield Compute(job, partial(self._sort, job, task, nodes))

    def _end_s(self, formation: Formation) -> float:
        """Return the road time by which a formation should have done what it does now.

        That is when its next plan is to be made, or when its foremost column leaves the road.
        """
        if not formation.sorts:
            next_s = stage_begin_s(formation.numbers, formation.stage + 1, self._scenario)
            return next_s - STAGE_LEAD_S
        front = self._scenario.lattice.block_range(formation.numbers[0])[-1]
        return time_left_s([(front, 0)], 0.0, self._scenario)

    def _sort(self, job: int, task: SortingTask, nodes: int) -> Sorting | None:
        """Do the work, unless nobody waits for it any more when its turn comes."""
        if job not in self._ordered:
            return None
        return sort_lanes(task, nodes, self._weights)

    def finish(
        self,
        computed: Computed,
        controls: Mapping[int, FormationControl],
        t_s: float,
        now_s: float,
    ) -> Iterator[Note]:
        """Take a result; of a ballot that is not waited for any more it is dropped.

        Args:
            computed: the result of a job, a `Sorting`, or an error.
            controls: all formations, each under its least number.
            t_s: road time.
            now_s: node clock.
        """
        if computed.job not in self._ordered:
            return
        number, ballot = self._ordered.pop(computed.job)
        control = controls.get(number)
        if control is None or control.ballot != ballot or control.phase is not Phase.PLANNING:
            return
        result, error, status = computed.result, computed.error, "error"
        if isinstance(result, Sorting):
            status = result.response.status if result.response is not None else "optimal"
            if result.short_of_room and self._join_neighbour(control, controls, t_s):
                yield Note(FORMATIONS_JOINED, {"formations": list(self._groups.of(number))})
                return
            if result.short_of_room and self._room_is_coming(control.formation.numbers, t_s):
                control.on_planning_failed(now_s)
                yield Note(ROOM_AWAITED, {"formation": number})
                return
            if result.solved:
                planned = self._plan(control, result, t_s)
                plan = self._paced(planned, control, controls, t_s)
                problems = plan_problems(plan)
                if not problems:
                    control.on_plan(plan, now_s, result.out_of_reach)
                    pauses = steps_of(plan) - steps_of(planned)
                    yield from _notes(control.formation, result, pauses, plan)
                    return
                error = "; ".join(problems)
        control.on_planning_failed(now_s)
        data = {"formation": number, "status": status, "error": error}
        yield Note(PLANNING_FAILED, data)

    def _join_neighbour(
        self, control: FormationControl, controls: Mapping[int, FormationControl], t_s: float
    ) -> bool:
        """Join a formation that lacks room with a neighbour; false when none can help.

        Both plan under one ballot from now on.
        """
        numbers, most = control.formation.numbers, self._scenario.formation.max_joined
        for other in self._neighbours(numbers, controls):
            if other.phase is Phase.SETTLED:
                continue
            if control.formation.joined + other.formation.joined > most:
                continue
            union = (*numbers, *other.formation.numbers)
            if self._steps_left_in(union, t_s) > 0:
                return self._groups.join(union)
        return False

    def _steps_left_in(self, numbers: Numbers, t_s: float) -> int:
        """Return how many steps fit in for all cells of some blocks."""
        cells, scenario = self._block_cells(numbers), self._scenario
        start_s = start_time_s(cells, t_s + START_MARGIN_S, scenario)
        return steps_left(cells, start_s, scenario.cycles_s[0], scenario)

    def _block_cells(self, numbers: Numbers) -> list[Cell]:
        lattice = self._scenario.lattice
        return [cell for number in numbers for cell in lattice.block_cells(number)]

    def _neighbours(
        self, numbers: Numbers, controls: Mapping[int, FormationControl]
    ) -> Iterator[FormationControl]:
        """Yield the formation behind and the one ahead, as far as there are any."""
        for number in (numbers[-1] + 1, numbers[0] - 1):
            neighbour = controls.get(self._groups.of(number)[0])
            if neighbour is not None:
                yield neighbour

    def _room_is_coming(self, numbers: Numbers, t_s: float) -> bool:
        """Tell whether the next formation, which may be joined, is closed in a moment."""
        formation, lattice = self._scenario.formation, self._scenario.lattice
        if formation.closes_by_vehicles or len(numbers) >= formation.max_joined:
            return False
        rear = lattice.block_range(numbers[-1] + 1)[0]
        closes_s = lattice.passing_time_s(rear) + formation.entry_spread_s
        return closes_s - ROOM_S < t_s <= closes_s + START_MARGIN_S

    def _plan(self, control: FormationControl, sorting: Sorting, t_s: float) -> Plan:
        hold_cells, numbers, ballot = control.hold_cells, control.formation.numbers, control.ballot
        assert ballot is not None  # noqa: S101 (set before planning begins)
        all_moves = [move for each in sorting.moves.values() for move in each]
        return Plan(
            ballot=ballot,
            formations=numbers,
            roster=tuple(hold_cells),
            incarnations=control.incarnations,
            start_cells=hold_cells,
            moves=sorting.moves,
            t0_s=self._start_s(control.formation, hold_cells.values(), t_s),
            slot_s=self._scenario.cycles_s[0],
            territory=tuple(sorted(territory(hold_cells.values(), all_moves))),
        )

    def _paced(
        self,
        plan: Plan,
        control: FormationControl,
        controls: Mapping[int, FormationControl],
        t_s: float,
    ) -> Plan:
        """Choose the slots of a plan; it begins when its vehicles have settled in their cells."""
        formation, cells = control.formation, plan.start_cells.values()
        others = self._plans_beside(plan, controls)
        if not formation.sorts:
            return paced(plan, others, plan.t0_s, self._end_s(formation), self._scenario)
        end_s = time_left_s({*cells, *plan.territory}, 0.0, self._scenario)
        not_before_s = max(self._settled_s(cells), t_s + START_MARGIN_S)
        return paced(plan, others, not_before_s, end_s, self._scenario)

    def _plans_beside(self, plan: Plan, controls: Mapping[int, FormationControl]) -> list[Plan]:
        """Return the plans of the neighbours that this leader has made, and that are driven."""
        if "closing" not in self._scenario.formation.conflict_kinds:
            return []
        return [
            neighbour.plan
            for neighbour in self._neighbours(plan.formations, controls)
            # In other phases it has been outbid, or given up, and is not what is driven.
            if neighbour.plan is not None
            and neighbour.plan.ballot == neighbour.ballot
            and neighbour.phase in (Phase.ISSUING, Phase.WATCHING)
        ]

    def _start_s(self, formation: Formation, cells: Collection[Cell], t_s: float) -> float:
        """Return the road time at which a formation may begin to move."""
        if formation.sorts:
            return start_time_s(cells, t_s + START_MARGIN_S, self._scenario)
        begin_s = stage_begin_s(formation.numbers, formation.stage, self._scenario)
        return on_tick(max(begin_s, self._settled_s(cells), t_s + START_MARGIN_S), self._scenario)

    def _settled_s(self, cells: Collection[Cell]) -> float:
        """Return the road time at which vehicles that entered in some cells rest in them."""
        formation, lattice = self._scenario.formation, self._scenario.lattice
        rear = min(column for column, _ in cells)
        return lattice.passing_time_s(rear) + formation.entry_spread_s + formation.settle_s


def _notes(formation: Formation, sorting: Sorting, pauses: int, plan: Plan) -> Iterator[Note]:
    number = formation.numbers[0]
    if sorting.impossible:
        data = {"formation": number, "stage": formation.stage, "why": sorting.impossible}
        yield Note(STRUCTURE_IMPOSSIBLE, data)
    if sorting.response is not None:
        timing = {"t0_s": plan.t0_s, "slot_s": plan.slot_s}
        yield Note(PLAN_MADE, _facts(number, sorting.response) | timing)
    if pauses:
        yield Note(NEIGHBOURS_AWAITED, {"formation": number, "slots": pauses})
    if sorting.out_of_reach:
        vehicles = [str(name) for name in sorting.out_of_reach]
        yield Note(LANE_OUT_OF_REACH, {"formation": number, "vehicles": vehicles})


def _facts(number: int, response: PlanResponse) -> dict[str, Any]:
    return {
        "formation": number,
        "vehicles": len(response.paths),
        "status": response.status,
        "cost": response.cost,
        "lower_bound": response.lower_bound,
        "steps": response.steps,
        "solve_ms": response.solve_ms,
        "assignments_tried": response.assignments_tried,
        "nodes_expanded": response.nodes_expanded,
        "solver": response.solver,
        "fallback": response.fallback,
    }
